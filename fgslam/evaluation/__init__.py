"""Trajectory error and consistency."""
