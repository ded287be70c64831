"""The house's camera, from its settings."""

from __future__ import annotations

import numpy as np

from fgslam.cameras.omni.hyperbolic import HyperbolicMirror
from fgslam.cameras.omni.panoramas import Equirectangular
from fgslam.cameras.omni.protocol import OmniCamera
from fgslam.worlds.house.settings import HouseCameraSettings, HousePanoramaSettings

_MARGIN_PX = 0.5


def make_house_camera(settings: HouseCameraSettings) -> OmniCamera:
    """The camera model that images of the house obey.

    Raises:
        CalibrationError: the mirror cannot show what is asked for.
    """
    if isinstance(settings, HousePanoramaSettings):
        return Equirectangular(settings.width, settings.height)
    bottom, top = np.deg2rad([settings.bottom_elevation_deg, settings.top_elevation_deg])
    size = (settings.width, settings.height)
    return HyperbolicMirror.with_view(
        size, settings.xi, (float(bottom), float(top)), margin_px=_MARGIN_PX
    )
