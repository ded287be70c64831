"""Measurements and bearings simulated without images."""
