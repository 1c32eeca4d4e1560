"""The run's Redis: the server, its users, connecting, registering the run."""
