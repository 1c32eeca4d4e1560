"""Actors: step environments with a GRU state of their own and send overlapping windows."""
