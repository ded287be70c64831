"""TODO slam."""
