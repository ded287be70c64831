"""Cameras: rigs of two and three cameras, omnidirectional models, calibration."""
