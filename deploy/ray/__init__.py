"""A run on a Ray cluster: placement, role actors, supervision."""
