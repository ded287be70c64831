"""Homing experiments: what `fgslam run` does for each task."""
