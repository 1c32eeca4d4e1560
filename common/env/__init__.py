"""Environments as the roles see them: made by id, wrapped by option."""
