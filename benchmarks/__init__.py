"""Speeds of the product, each beside its ceiling measured in the same run."""
