"""TODO places."""
