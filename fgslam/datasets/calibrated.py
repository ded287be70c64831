"""The rig of a recording: its own calibration or the one that is given in its place, mounted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from fgslam.cameras.lenses import Calibration
from fgslam.cameras.rectify import Rectifier
from fgslam.cameras.rig import StereoRig, at_size, in_metres, load_rig, rig_of
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, pose, so3_exp
from fgslam.core.sensors import CameraRig, body_is_camera
from fgslam.datasets.odometry_files import is_of_gyroscope
from fgslam.datasets.settings import CalibratedSettings

Rig = TypeVar("Rig", bound=CameraRig)


def calibrated_rig(
    settings: CalibratedSettings, own: Path, size: tuple[int, int] | None, pair: bool = True
) -> StereoRig:
    """The rig by the file that the settings name, else by the recording's own file or folder.

    Args:
        settings: of the recording.
        own: the recording's file or folder of calibration.
        size: width and height of the images, for formats that do not state it.
        pair: whether they are of two cameras; else of three.

    Raises:
        CalibrationError: there is no calibration, or it cannot be used.
    """
    if settings.camera_file is not None:
        file = Path(settings.camera_file)
        return mounted(loaded_rig(settings, file, size=size, pair=pair), settings)
    try:
        return mounted(loaded_rig(settings, own, size=size, pair=pair), settings)
    except CalibrationError as fault:
        if not str(fault).startswith(f"{own}:"):  # of a file in it: that is there, and at fault
            raise
        raise CalibrationError(
            f"{fault}; give a calibration: {own / 'calib.json'}, or another one by --camera FILE"
        ) from None


def loaded_rig(
    settings: CalibratedSettings,
    *files: Path,
    size: tuple[int, int] | None,
    cameras: Sequence[int] | None = None,
    pair: bool = True,
) -> StereoRig:
    """:func:`fgslam.load_rig` of one file or two, in the unit, scaled, as wide as is asked for.

    Where the images are of a ``pair`` and the file has three cameras, those of its first two.
    """
    rig = _loaded(settings, *files, size=size, cameras=cameras)
    if not pair or max(rig.sources) < 2:
        return rig
    two = _loaded(settings, *files, size=size, cameras=(0, 1))
    text = f"{files[0]} holds three cameras, the images are of two: the first two are taken"
    return replace(two, remarks=(text, *two.remarks))


def _loaded(
    settings: CalibratedSettings,
    *files: Path,
    size: tuple[int, int] | None,
    cameras: Sequence[int] | None,
) -> StereoRig:
    return load_rig(
        *files,
        size=size,
        scale=settings.resized,
        unit_m=settings.unit_m,
        fov_deg=settings.fov_deg,
        cameras=cameras,
    )


def numbered(rig: StereoRig) -> StereoRig:
    """The rig of images that are given as those of a file's second and first camera.

    So do names with numbers, cam1 and cam0, whichever of them is the right one.
    """
    if rig.sources[:2] != (0, 1):
        return rig
    kept = rig.rectifier or Rectifier(rig.plain(), ())
    text = "the camera of the lower number is the right one by its calibration, and is taken so"
    return replace(rig, rectifier=replace(kept, order=(1, 0)), remarks=(*rig.remarks, text))


def read_rig(
    settings: CalibratedSettings, calibration: Calibration, size: tuple[int, int] | None
) -> StereoRig:
    """The same of a calibration that is read."""
    found = in_metres(calibration, settings.unit_m)
    return rig_of(at_size(found, size, settings.resized), settings.fov_deg)


def mounted(rig: Rig, settings: CalibratedSettings) -> Rig:
    """The rig where the settings put it; as it is, where they name no place."""
    if settings.camera_yaw_deg is None and settings.lever_arm_m is None:
        return rig
    lever_arm = settings.lever_arm_m or (0.0, 0.0, 0.0)
    heading = so3_exp(np.array([0.0, 0.0, np.radians(settings.camera_yaw_deg or 0.0)]))
    level = heading @ BODY_FORWARD_LEFT_UP_FROM_CAMERA[:3, :3]
    return replace(rig, bTc=pose(level, np.array(lever_arm, np.float64)))


def on_wheels(
    rig: Rig, settings: CalibratedSettings, odometry_file: Path | None
) -> tuple[Rig, tuple[str, ...]]:
    """The rig on the body that a file's odometry moves, and what is assumed of its place there.

    Where the calibration is of the cameras alone, they look straight ahead from its origin.
    """
    stated = settings.camera_yaw_deg is not None or settings.lever_arm_m is not None
    # A gyroscope is in the camera's own box, wheels turn about another axis.
    if stated or odometry_file is None or is_of_gyroscope(odometry_file):
        return rig, ()
    if not body_is_camera(rig.bTc):
        return rig, ()
    text = f"nothing says where the camera sits on the body of {odometry_file}: {LOOKS_AHEAD}"
    return replace(rig, bTc=BODY_FORWARD_LEFT_UP_FROM_CAMERA), (text,)


LOOKS_AHEAD = (
    "it is taken to look straight ahead from there (dataset.camera_yaw_deg and lever_arm_m say "
    "otherwise)"
)
"""What is assumed of a camera where nothing says how it sits on the body that odometry moves."""
