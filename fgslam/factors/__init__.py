"""Measurements to factors: noise models and keys."""
