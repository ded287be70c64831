"""Settings of the front-end: SIFT, stereo matching, landmark database, map matching, ego-motion."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT
from fgslam.frontend.features.settings import AppearanceSettings, SiftSettings
from fgslam.frontend.places.relocalisation.settings import RelocalisationSettings
from fgslam.frontend.places.settings import LoopSettings, LostSettings
from fgslam.frontend.stereo.settings import StereoSettings
from fgslam.frontend.tracking.settings import (
    DatabaseSettings,
    EgoMotionSettings,
    MapMatchingSettings,
)


@dataclass(frozen=True, config=STRICT)
class FrontendSettings:
    """All of the front-end."""

    sift: SiftSettings = SiftSettings()
    stereo: StereoSettings = StereoSettings()
    appearance: AppearanceSettings = AppearanceSettings()
    matching: MapMatchingSettings = MapMatchingSettings()
    database: DatabaseSettings = DatabaseSettings()
    ego_motion: EgoMotionSettings = EgoMotionSettings()
    relocalisation: RelocalisationSettings = RelocalisationSettings()
    loops: Annotated[
        LoopSettings | None,
        Field(description="look for returns to mapped places and close the loop; null does not"),
    ] = None
    lost: Annotated[
        LostSettings | None,
        Field(description="search the whole map when lost; null goes on by odometry alone"),
    ] = None
