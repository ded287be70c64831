"""Recordings of omnidirectional cameras."""
