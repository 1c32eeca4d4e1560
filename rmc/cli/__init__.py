"""The command ``rmc``."""
