"""Many runs as one: grids, searches, and what becomes of their runs, on this machine or on a Ray cluster."""
