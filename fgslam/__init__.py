"""Filters and smoothers for stereo, trinocular and omnidirectional SLAM on one measurement log."""

__version__ = "0.1.0"
