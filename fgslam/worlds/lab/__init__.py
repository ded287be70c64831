"""A robot with a rig of pinhole cameras in a rendered place: settings, places, images."""
