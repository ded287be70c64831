"""Settings of the rendered house: camera, disturbances, reference path.

The default camera is that of Goedemé et al. 2005 (section I: hyperbolic mirror, 320 x 240). What
the paper leaves open is said to be so in each description.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT


@dataclass(frozen=True, config=STRICT)
class HouseMirrorSettings:
    """A hyperbolic mirror above an upward-looking camera, as the unified sphere model."""

    kind: Literal["mirror"] = "mirror"
    width: Annotated[int, Field(ge=64, le=4096, description="image width, pixels")] = 320
    height: Annotated[int, Field(ge=64, le=4096, description="image height, pixels")] = 240


@dataclass(frozen=True, config=STRICT)
class HousePanoramaSettings:
    """An ideal panoramic camera: columns are bearings, rows elevations."""

    kind: Literal["equirectangular"] = "equirectangular"
    width: Annotated[int, Field(ge=64, le=8192, description="image width, pixels")] = 1024
    height: Annotated[int, Field(ge=32, le=4096, description="image height, pixels")] = 512


HouseCameraSettings: TypeAlias = Annotated[
    HouseMirrorSettings | HousePanoramaSettings, Field(discriminator="kind")
]


@dataclass(frozen=True, config=STRICT)
class HouseExposureSettings:
    """A camera's automatic exposure, over time."""

    wave: Annotated[float, Field(ge=0.0, lt=0.9, description="amplitude of the gain's wave")] = 0.0


@dataclass(frozen=True, config=STRICT)
class HouseLightSettings:
    """The lamps."""

    level: Annotated[
        float, Field(gt=0.0, le=3.0, description="brightness; 0.05 is a dark house")
    ] = 1.0


@dataclass(frozen=True, config=STRICT)
class HouseTiltSettings:
    """Tilt of the camera against the vertical."""

    constant_deg: Annotated[
        float,
        Field(ge=0.0, le=10.0, description="size of a tilt that stays; its side is drawn"),
    ] = 0.0
    sway_deg: Annotated[
        float, Field(ge=0.0, le=10.0, description="amplitude of a slow swaying, roll and pitch")
    ] = 0.0


@dataclass(frozen=True, config=STRICT)
class HouseCalibrationSettings:
    """Errors of the mirror's calibration that the robot has; its images obey the true mirror."""

    mirror: Annotated[
        float,
        Field(ge=0.0, le=0.08, description="relative, of xi and of the focal length; signs drawn"),
    ] = 0.0
    centre_px: Annotated[
        float, Field(ge=0.0, le=20.0, description="of the mirror's centre; its direction is drawn")
    ] = 0.0


@dataclass(frozen=True, config=STRICT)
class HousePathSettings:
    """The reference path, laid by a planner from the seed."""

    legs: Annotated[int, Field(ge=1, le=100, description="targets to reach one after another")] = 10
    spacing_m: Annotated[
        float, Field(ge=0.5, le=8.0, description="between a target and the next, metres")
    ] = 3.0
    rooms: Annotated[
        Literal["house", "hall"],
        Field(description="`house`: from room to room; `hall`: within the largest"),
    ] = "house"


@dataclass(frozen=True, config=STRICT)
class OmniHouseSettings:
    """A wheelchair with an omnidirectional camera in a furnished house of 20 m x 15 m."""

    kind: Literal["omni_house"] = "omni_house"
    camera: HouseCameraSettings = HouseMirrorSettings()
    house_seed: Annotated[int, Field(ge=0, description="of textures and furniture")] = 0
    frame_rate_hz: Annotated[
        float, Field(gt=0.0, le=120.0, description="images a second while driving")
    ] = 10.0
    noise_grey: Annotated[
        float, Field(ge=0.0, le=50.0, description="Gaussian image noise, grey levels")
    ] = 2.0
    people: Annotated[int, Field(ge=0, le=8, description="who walk about in the house")] = 0
    path: HousePathSettings = HousePathSettings()
    exposure: HouseExposureSettings = HouseExposureSettings()
    light: HouseLightSettings = HouseLightSettings()
    tilt: HouseTiltSettings = HouseTiltSettings()
    calibration: HouseCalibrationSettings = HouseCalibrationSettings()
