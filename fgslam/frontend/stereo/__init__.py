"""TODO stereo."""
