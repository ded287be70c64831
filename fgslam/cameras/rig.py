"""The rectified stereo rig as users describe it: checked, with defaults, or from a file."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeAlias

import numpy as np

from fgslam.cameras.calibration import read_json_object
from fgslam.cameras.calibration_formats import (
    read_asl_camera,
    read_camchain,
    read_camera_info_pair,
    read_opencv_pair,
    read_projections,
)
from fgslam.cameras.corrected import read_own_format
from fgslam.cameras.rectification import Rectifier, rectifier, right_and_left
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.checks import is_finite_number
from fgslam.core.errors import CalibrationError
from fgslam.core.files import read_lines, read_text
from fgslam.core.geometry import is_rigid
from fgslam.core.sensors import CameraRig


def _identity() -> FloatArray:
    return np.eye(4)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StereoRig(CameraRig):
    """Two or three rectified cameras, checked; it goes wherever a :class:`CameraRig` is asked for.

    The right camera is the reference. The left one sits ``baseline`` metres along its -x axis, the
    top one, if any, ``vertical_baseline`` metres along its -y axis. Camera axes: x right, y down,
    z forward; pixel (0, 0) is the centre of the top-left pixel.

    Attributes:
        width, height: image size, pixels.
        fx, fy: focal lengths, pixels; equal in all cameras.
        cx, cy: principal point (column, row), pixels.
        baseline: distance of left and right camera, metres.
        vertical_baseline: distance of top and right camera, metres; None without a top camera.
        bTc: (4, 4) pose of the right camera in the robot's body, where its odometry is measured.
            The identity where odometry is the camera's own motion, or there is none.

        rectifier: how raw images become rectified ones; None where they are rectified already.

    Raises:
        CalibrationError: a size, focal length or baseline is not positive and finite, the
            principal point is far from the image, or ``bTc`` is no rigid motion.
    """

    baseline: float = math.nan
    vertical_baseline: float | None = None
    bTc: FloatArray = field(default_factory=_identity)
    rectifier: Rectifier | None = None

    def __post_init__(self) -> None:
        require_rig(self)

    @staticmethod
    def load(path: str | Path, size: tuple[int, int] | None = None) -> StereoRig:
        """The rig of a calibration file or folder; its format is recognised by its content.

        Known are our calib.json; Kalibr's camchain (pinhole, radtan); the files of OpenCV's stereo
        calibration (M1, D1, M2, D2, R, T); a folder with left.yaml and right.yaml of ROS
        camera_info; KITTI's calib.txt and calib_cam_to_cam.txt; a EuRoC folder with
        cam0/sensor.yaml. Where the cameras are not rectified, the rig holds the maps that rectify
        them, and a session applies them to the raw images that it is given.

        Args:
            path: the file, or a folder that holds one.
            size: width and height of the images in pixels, for KITTI's calib.txt and OpenCV's
                files, which do not state it.

        Raises:
            CalibrationError: the format or a camera model is not known, a value is missing or
                impossible, or the cameras are no horizontal pair.
        """
        found = read_rig(Path(path), size)
        raw = found if isinstance(found, Rectifier) else None
        rig = found.rig if isinstance(found, Rectifier) else found
        values = {name: getattr(rig, name) for name in CameraRig.__dataclass_fields__}
        return StereoRig(**values, rectifier=raw)

    def rectified(self, images: tuple[Image, ...]) -> tuple[Image, ...]:
        """Rectified (right, left[, top]) of grey images (height, width) uint8 as the camera gives.

        The images themselves where the rig has nothing to rectify.
        """
        if self.rectifier is None:
            return images
        return tuple(self.rectifier.rectify(k, image) for k, image in enumerate(images))


def require_rig(rig: CameraRig) -> None:
    """Raises CalibrationError where ``rig`` is none, or its numbers cannot be those of one."""
    if not isinstance(rig, CameraRig):
        raise CalibrationError(
            f"rig: it is a {type(rig).__name__}; give a fgslam.StereoRig, or load one by "
            "fgslam.StereoRig.load(file)"
        )
    for name in ("width", "height"):
        value = getattr(rig, name)
        if not isinstance(value, int | np.integer) or isinstance(value, bool) or value <= 0:
            raise CalibrationError(f"rig: {name} is {value!r}; give the images' size in pixels")
    for name in ("fx", "fy", "baseline", "vertical_baseline"):
        _require_length(rig, name)
    for name, extent in (("cx", rig.width), ("cy", rig.height)):
        value = getattr(rig, name)
        # Cropped images may have it outside, but hardly by more than their own size.
        if not is_finite_number(value) or not -extent <= value <= 2 * extent:
            raise CalibrationError(
                f"rig: {name} is {value!r}, far from the image of {rig.width}x{rig.height} pixels; "
                "give the principal point (column, row) in pixels of these images"
            )
    if not is_rigid(np.asarray(rig.bTc, np.float64)):
        raise CalibrationError(
            "rig: bTc must be a rigid motion (4, 4), the pose of the right camera in the body; "
            "correct it, or leave it out"
        )


def _require_length(rig: CameraRig, name: str) -> None:
    value = getattr(rig, name)
    if name == "vertical_baseline" and value is None:
        return
    if not is_finite_number(value) or value <= 0.0:
        what = (
            "the distance between the cameras in metres; one camera alone cannot measure depth, "
            "and a negative one means that left and right are swapped"
            if "baseline" in name
            else "the focal length in pixels"
        )
        raise CalibrationError(f"rig: {name} is {value!r}, not a positive number; give {what}")


# --------------------------------------------------------------------------------------------
# Which format a calibration has, and its rig


Size: TypeAlias = tuple[int, int]
_KITTI_RAW = ("P_rect_00", "P_rect_01")


def read_rig(path: Path, size: Size | None = None) -> CameraRig | Rectifier:
    """The rectified rig of a calibration file or folder, or what rectifies its raw images.

    The format is recognised by the content.

    Args:
        path: see :meth:`fgslam.cameras.rig.StereoRig.load`.
        size: width and height of the images, for formats that do not state it.

    Raises:
        CalibrationError: the format is unknown, of one camera only, or a value is impossible.
    """
    if size is not None and not (isinstance(size, Sequence) and len(size) == 2):
        raise CalibrationError(f"size is {size!r}; give (width, height) of the images in pixels")
    if path.is_dir():
        return _of_folder(path, size)
    text = read_text(path, CalibrationError, _KNOWN)
    for mark, read in _MARKS:
        if mark in text:
            return read(path, size)
    raise CalibrationError(f"{path}: not a calibration of a stereo rig that is known; {_KNOWN}")


_KNOWN = (
    "known: calib.json of fgslam, Kalibr's camchain.yaml, OpenCV's stereo files (M1, D1, M2, D2, "
    "R, T), a folder with left.yaml and right.yaml of ROS camera_info, KITTI's calib.txt, a EuRoC "
    "folder with cam0/sensor.yaml"
)


def _of_folder(folder: Path, size: Size | None) -> CameraRig | Rectifier:
    root = folder / "mav0" if (folder / "mav0").is_dir() else folder
    if (root / "cam0" / "sensor.yaml").is_file():
        pair = (read_asl_camera(root / name / "sensor.yaml") for name in ("cam0", "cam1"))
        return rectifier(*right_and_left(*pair))
    if (folder / "left.yaml").is_file():
        return read_camera_info_pair(folder / "left.yaml", folder / "right.yaml")
    for pattern in ("calib.json", "*camchain.yaml", "calib.txt", "intrinsics.yml"):
        found = sorted(folder.glob(pattern))
        if len(found) == 1:
            return read_rig(found[0], size)
    raise CalibrationError(f"{folder}: holds no calibration of a stereo rig; {_KNOWN}")


def _own_format(path: Path, _: Size | None) -> CameraRig | Rectifier:
    three = "vertical_baseline_m" in read_json_object(path)
    return read_own_format(path, three)


def _of_camera_info(path: Path, _: Size | None) -> CameraRig | Rectifier:
    left, right = path.with_name("left.yaml"), path.with_name("right.yaml")
    if path.name not in (left.name, right.name):
        raise CalibrationError(
            f"{path}: one camera_info alone knows one camera; give the folder that holds left.yaml "
            "and right.yaml"
        )
    return read_camera_info_pair(left, right)


def _kitti(path: Path, size: Size | None) -> CameraRig | Rectifier:
    return read_projections(path).rig(*_known_size(path, size))


def _kitti_raw(path: Path, size: Size | None) -> CameraRig | Rectifier:
    size = _stated_size(path) if size is None else size
    return read_projections(path, _KITTI_RAW).rig(*_known_size(path, size))


def _stated_size(path: Path) -> Size | None:
    """Width and height by the line S_rect_00, if there is one."""
    for number, text in read_lines(path):
        if text.startswith("S_rect_00:"):
            try:
                width, height = map(float, text.split()[1:])
                return round(width), round(height)
            except (ValueError, OverflowError):
                raise CalibrationError(
                    f"{path}, line {number}: S_rect_00 must be width and height; restore the file"
                ) from None
    return None


def _kalibr(path: Path, _: Size | None) -> CameraRig | Rectifier:
    return rectifier(*right_and_left(*read_camchain(path)))


def _opencv(path: Path, size: Size | None) -> CameraRig | Rectifier:
    pair = read_opencv_pair(path, size)
    return rectifier(*right_and_left(*pair))


def _known_size(path: Path, size: Size | None) -> Size:
    if size is None:
        raise CalibrationError(f"{path} does not state the images' size; give size=(width, height)")
    return size


_MARKS: tuple[tuple[str, Callable[[Path, Size | None], CameraRig | Rectifier]], ...] = (
    ('"baseline_m"', _own_format),
    ("opencv-matrix", _opencv),
    ("projection_matrix:", _of_camera_info),
    ("P_rect_00:", _kitti_raw),
    ("P0:", _kitti),
    ("camera_model:", _kalibr),
)
"""Texts by which a format is recognised, and its reader; the first that is found counts."""
