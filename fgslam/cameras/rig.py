"""The rectified stereo rig as users describe it: checked, with defaults."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fgslam.cameras.rectification import Rectifier
from fgslam.cameras.rig_files.reading import read_rig
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import CalibrationError
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
        values = {name: getattr(found.rig, name) for name in CameraRig.__dataclass_fields__}
        return StereoRig(**values, rectifier=found.rectifier)

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
        if not _is_finite(value) or not -extent <= value <= 2 * extent:
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
    if not _is_finite(value) or value <= 0.0:
        what = (
            "the distance between the cameras in metres; one camera alone cannot measure depth, "
            "and a negative one means that left and right are swapped"
            if "baseline" in name
            else "the focal length in pixels"
        )
        raise CalibrationError(f"rig: {name} is {value!r}, not a positive number; give {what}")


def _is_finite(value: object) -> bool:
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return number and math.isfinite(float(value))  # type: ignore[arg-type]
