"""The rig of a recording: its own calibration or the one that is given in its place, mounted."""

from __future__ import annotations

from dataclasses import replace

from fgslam.cameras.calibration import level_mounting
from fgslam.cameras.rectification import Rectifier
from fgslam.core.sensors import CameraRig
from fgslam.datasets.settings import CalibratedSettings


def rig_and_rectifier(
    found: CameraRig | Rectifier, settings: CalibratedSettings
) -> tuple[CameraRig, Rectifier | None]:
    """The rectified rig, mounted as the settings say, and what rectifies images that are raw."""
    raw = found if isinstance(found, Rectifier) else None
    rig = found.rig if isinstance(found, Rectifier) else found
    return mounted(rig, settings), raw


def mounted(rig: CameraRig, settings: CalibratedSettings) -> CameraRig:
    """The rig at another place in the body, where the settings name one."""
    if settings.camera_yaw_deg is None and settings.lever_arm_m is None:
        return rig
    lever_arm = settings.lever_arm_m or (0.0, 0.0, 0.0)
    return replace(rig, bTc=level_mounting(settings.camera_yaw_deg or 0.0, lever_arm))
