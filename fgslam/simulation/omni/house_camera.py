"""The house's camera, from its settings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fgslam.omni_cameras.hyperbolic_mirror import mirror_seeing
from fgslam.omni_cameras.panoramas import Equirectangular
from fgslam.omni_cameras.protocol import OmniCamera
from fgslam.settings.omni_worlds import HouseCameraSettings, HousePanoramaSettings


def make_house_camera(settings: HouseCameraSettings) -> OmniCamera:
    """The camera model that images of the house obey.

    Raises:
        CalibrationError: the mirror cannot show what is asked for.
    """
    if isinstance(settings, HousePanoramaSettings):
        return Equirectangular(settings.width, settings.height)
    top, bottom = np.deg2rad([settings.top_elevation_deg, settings.bottom_elevation_deg])
    whole = mirror_seeing(settings.width, settings.height, settings.xi, float(top))
    return replace(whole, inner_radius=float(whole.radius(bottom)))
