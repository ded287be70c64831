"""ROS camera_info: one file a camera, each with its own rectification and projection."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from fgslam.cameras.formats.trees import Tree, Values
from fgslam.cameras.raw_cameras import (
    Calibration,
    RawCamera,
    StatedView,
    checked_camera,
    checked_view,
)
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import pose, reorthonormalise

_LENSES = {
    "plumb_bob": "radtan",
    "rational_polynomial": "radtan",
    "thin_prism": "radtan",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "kannala_brandt": "equidistant",
    "": "radtan",
    "none": "radtan",
}
_FORMAT = "ROS camera_info"


def is_camera_info(tree: Tree) -> bool:
    """Whether it is a camera_info, as camera_calibration or an echo of the topic writes it."""
    return {"camera_matrix", "distortion_model", "image_width"} <= as_file(tree).keys()


def as_file(tree: Tree) -> Tree:
    """The message as ``rostopic echo`` and ``ros2 topic echo`` write it, with a file's keys."""
    for letters in ("DKRP", "dkrp"):
        if tree.keys() >= {*letters, "distortion_model", "width", "height"}:
            named = {name: tree[letter] for name, letter in zip(_NAMES, letters, strict=True)}
            return {**tree, **named, "image_width": tree["width"], "image_height": tree["height"]}
    return tree


_NAMES = (
    *("distortion_coefficients", "camera_matrix"),
    *("rectification_matrix", "projection_matrix"),
)


def read_camera_info(path: Path, tree: Tree) -> Calibration:
    """The calibration of one camera alone."""
    camera, _, _ = _camera(Values(path, as_file(tree)))
    return Calibration(str(path), _FORMAT, (camera,))


def read_camera_info_pair(files: tuple[Path, Path], trees: tuple[Tree, Tree]) -> Calibration:
    """Left and right camera; the body is the rectified right one.

    The baseline is in the projection matrix of one of the two: its fourth number over fx.

    Raises:
        CalibrationError: a value is missing or malformed, a distortion model is not known, or the
            files are not of one rectified pair.
    """
    parts = [Values(path, as_file(tree)) for path, tree in zip(files, trees, strict=True)]
    (left, r_left, p_left), (right, r_right, p_right) = map(_camera, parts)
    if left.size != right.size:
        raise CalibrationError(
            f"{files[0]} is {left.width}x{left.height} but {files[1].name} is "
            f"{right.width}x{right.height}; both must have one resolution"
        )
    # The principal columns may differ: then far points have a disparity. One is taken for both.
    if not np.allclose(np.delete(p_left, 2, 1)[:, :2], np.delete(p_right, 2, 1)[:, :2]) or (
        not np.isclose(p_left[1, 2], p_right[1, 2])
    ):
        raise CalibrationError(
            f"{files[0]}: its projection_matrix differs from that of {files[1].name}, so the two "
            "are not of one rectified pair; calibrate them as a stereo pair"
        )
    offset = -(p_right[0, 3] - p_left[0, 3]) / (p_right[0, 0] or np.inf)
    if p_right[0, 0] <= 0.0 or offset == 0.0:
        raise CalibrationError(
            f"{files[1]}: projection_matrix states no baseline (its fourth number is "
            f"{p_right[0, 3]:g}, must be negative); calibrate a stereo pair, or swap the files"
        )
    cameras = (
        replace(left, bTc=pose(r_left, np.array([-offset, 0.0, 0.0]))),
        replace(right, bTc=pose(r_right, np.zeros(3))),
    )
    source = f"{files[0]} and {files[1].name}"
    view = checked_view(StatedView((r_left, r_right), p_right[:, :3], left.size), source)
    return Calibration(source, f"{_FORMAT}, a pair", cameras, True, view)


def _camera(part: Values) -> tuple[RawCamera, FloatArray, FloatArray]:
    """The camera, its rectifying rotation (3, 3) and its projection (3, 4)."""
    model = part.text("distortion_model")
    lens = _LENSES.get(model)
    if lens is None:
        known = ", ".join(name for name in _LENSES if name)
        raise part.refuse(f"distortion_model {model} is not known; known: {known}")
    matrix = part.matrix("camera_matrix", 3, 3)
    given = part.tree.get("distortion_coefficients")
    given = given.get("data") if isinstance(given, dict) else given
    empty = isinstance(given, np.ndarray | list) and not np.size(given)  # CameraInfo.msg: none
    none = np.zeros(5 if lens == "radtan" else 4)
    coefficients = none if empty else part.numbers("distortion_coefficients")
    width, height = part.size("image_width", "image_height")
    name = part.path.name
    raw = RawCamera(width, height, matrix, coefficients, np.eye(4), name, lens)
    rotation, projection = np.eye(3), np.column_stack([matrix, np.zeros(3)])
    if "rectification_matrix" in part:
        turn = pose(part.matrix("rectification_matrix", 3, 3), np.zeros(3))
        rotation = reorthonormalise(turn)[:3, :3]
        if not np.allclose(rotation, turn[:3, :3], atol=1e-3):
            raise part.refuse("rectification_matrix is not a rotation; calibrate again")
    if "projection_matrix" in part:
        projection = part.matrix("projection_matrix", 3, 4)
    return checked_camera(raw), rotation, projection
