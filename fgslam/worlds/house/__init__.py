"""Simulated omnidirectional camera, colour world, wheelchair and bearings."""
