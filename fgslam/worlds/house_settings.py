"""Settings of the rendered house: camera, disturbances, reference path.

The default camera is that of Goedemé et al. 2005 (section I: hyperbolic mirror, 320 x 240). What
the paper leaves open is said to be so in each description.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, Index


@dataclass(frozen=True, config=STRICT)
class HouseMirrorSettings:
    """A hyperbolic mirror above an upward-looking camera, as the unified sphere model."""

    kind: Literal["mirror"] = "mirror"
    width: int = Field(default=320, ge=64, le=4096, description="image width, pixels")
    height: int = Field(default=240, ge=64, le=4096, description="image height, pixels")


@dataclass(frozen=True, config=STRICT)
class HousePanoramaSettings:
    """An ideal panoramic camera: columns are bearings, rows elevations."""

    kind: Literal["equirectangular"] = "equirectangular"
    width: int = Field(default=1024, ge=64, le=8192, description="image width, pixels")
    height: int = Field(default=512, ge=32, le=4096, description="image height, pixels")


HouseCameraSettings: TypeAlias = Annotated[
    HouseMirrorSettings | HousePanoramaSettings, Field(discriminator="kind")
]


@dataclass(frozen=True, config=STRICT)
class HouseExposureSettings:
    """A camera's automatic exposure, over time."""

    wave: float = Field(default=0.0, ge=0.0, lt=0.9, description="amplitude of the gain's wave")


@dataclass(frozen=True, config=STRICT)
class HouseLightSettings:
    """The lamps."""

    level: float = Field(
        default=1.0, gt=0.0, le=3.0, description="brightness; 0.05 is a dark house"
    )


@dataclass(frozen=True, config=STRICT)
class HouseTiltSettings:
    """Tilt of the camera against the vertical."""

    constant_deg: float = Field(
        default=0.0, ge=0.0, le=10.0, description="size of a tilt that stays; its side is drawn"
    )
    sway_deg: float = Field(
        default=0.0, ge=0.0, le=10.0, description="amplitude of a slow swaying, roll and pitch"
    )


@dataclass(frozen=True, config=STRICT)
class HouseCalibrationSettings:
    """Errors of the mirror's calibration that the robot has; its images obey the true mirror."""

    mirror: float = Field(
        default=0.0,
        ge=0.0,
        le=0.08,
        description="relative, of xi and of the focal length; signs drawn",
    )
    centre_px: float = Field(
        default=0.0, ge=0.0, le=20.0, description="of the mirror's centre; its direction is drawn"
    )


@dataclass(frozen=True, config=STRICT)
class HousePathSettings:
    """The reference path, laid by a planner from the seed."""

    legs: int = Field(default=10, ge=1, le=100, description="targets to reach one after another")
    spacing_m: float = Field(
        default=3.0, ge=0.5, le=8.0, description="between a target and the next, metres"
    )
    rooms: Literal["house", "hall"] = Field(
        default="house", description="`house`: from room to room; `hall`: within the largest"
    )


@dataclass(frozen=True, config=STRICT)
class OmniHouseSettings:
    """A wheelchair with an omnidirectional camera in a furnished house of 20 m x 15 m."""

    kind: Literal["omni_house"] = "omni_house"
    camera: HouseCameraSettings = HouseMirrorSettings()
    house_seed: Index = Field(default=0, description="of textures and furniture")
    frame_rate_hz: float = Field(
        default=10.0, gt=0.0, le=120.0, description="images a second while driving"
    )
    noise_grey: float = Field(
        default=2.0, ge=0.0, le=50.0, description="Gaussian image noise, grey levels"
    )
    people: int = Field(default=0, ge=0, le=8, description="who walk about in the house")
    path: HousePathSettings = HousePathSettings()
    exposure: HouseExposureSettings = HouseExposureSettings()
    light: HouseLightSettings = HouseLightSettings()
    tilt: HouseTiltSettings = HouseTiltSettings()
    calibration: HouseCalibrationSettings = HouseCalibrationSettings()
