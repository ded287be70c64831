"""The rig of a recording at another place in the body than its calibration says."""

from __future__ import annotations

from dataclasses import replace

from fgslam.cameras.calibration import level_mounting
from fgslam.cameras.rig import StereoRig
from fgslam.datasets.settings import CalibratedSettings


def mounted(rig: StereoRig, settings: CalibratedSettings) -> StereoRig:
    """The rig where the settings put it; as it is, where they name no place."""
    if settings.camera_yaw_deg is None and settings.lever_arm_m is None:
        return rig
    lever_arm = settings.lever_arm_m or (0.0, 0.0, 0.0)
    return replace(rig, bTc=level_mounting(settings.camera_yaw_deg or 0.0, lever_arm))
