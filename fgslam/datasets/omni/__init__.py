"""TODO omni."""
