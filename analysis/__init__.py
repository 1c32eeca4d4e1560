"""What is done with a run: evaluate, watch, draw, compare, export; and check an environment."""
