"""Calibration files of other tools: one module for each family, each gives a Calibration."""
