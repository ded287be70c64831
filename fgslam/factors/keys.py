"""Keys of the graph's variables: pose of frame k is ``x k``, the n-th landmark variable ``l n``.

A landmark's variable is numbered by the graph, not by its identity: an identity that starts anew
(it moved, or left a fixed lag and came back) gets a new variable.
"""

from __future__ import annotations

import gtsam

_POSE, _LANDMARK = "x", "l"
_TARGET, _VELOCITY, _HEIGHT = "t", "v", "h"


def pose_key(frame: int) -> int:
    """Key of the camera pose ``wTc`` of frame ``frame``, counted from 0."""
    return int(gtsam.symbol(_POSE, frame))


def landmark_key(variable: int) -> int:
    """Key of the landmark variable number ``variable``, counted from 0."""
    return int(gtsam.symbol(_LANDMARK, variable))


def is_pose(key: int) -> bool:
    """Whether a key is a pose's."""
    return gtsam.Symbol(key).chr() == ord(_POSE)


def number(key: int) -> int:
    """Frame or variable number of a key."""
    return int(gtsam.Symbol(key).index())


# --------------------------------------------------------------------------------------------
# Homing: the start is pose 0, images on the way are poses from 1 on


def target_key() -> int:
    """Key of the target's planar pose."""
    return int(gtsam.symbol(_TARGET, 0))


def velocity_key(image: int) -> int:
    """Key of the velocity at pose ``image``."""
    return int(gtsam.symbol(_VELOCITY, image))


def height_key(variable: int) -> int:
    """Key of the height of landmark ``variable``."""
    return int(gtsam.symbol(_HEIGHT, variable))
