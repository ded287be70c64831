"""Relocalisation: the pose of a frame in a map, without a prior (the kidnapped robot)."""
