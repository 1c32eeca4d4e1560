"""A run on this machine: processes under a supervisor, or all roles in one thread."""
