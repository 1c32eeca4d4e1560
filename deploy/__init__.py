"""Starts, places, supervises and watches the roles; the only package that knows them all."""
