"""Behaviour: homing step by step, path following, topological maps."""
