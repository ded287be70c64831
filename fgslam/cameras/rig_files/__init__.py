"""Calibration files of stereo rigs: one reader a format, found by content."""
