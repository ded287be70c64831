"""TODO measurements."""
