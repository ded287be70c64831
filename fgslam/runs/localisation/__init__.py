"""Frames sought in a saved map: `fgslam localize`, and experiments of the task `localisation`."""
