"""A run's configuration, checks and folder."""
