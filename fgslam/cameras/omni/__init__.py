"""Omnidirectional camera models: pixels to rays and back, for cameras that see all around."""
