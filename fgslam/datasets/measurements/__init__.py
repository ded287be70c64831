"""Recordings of measurements without images."""
