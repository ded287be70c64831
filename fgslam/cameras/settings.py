"""Settings of omnidirectional cameras, tagged by ``kind`` (docs/datasets/omnidirectional.md).

Angles are degrees here; the picture's direction ``ahead_deg`` is measured clockwise from the right,
so -90 is up.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, Positive

Pair: TypeAlias = tuple[float, float]
Elevation: TypeAlias = Annotated[float, Field(ge=-90.0, le=90.0)]
Below90: TypeAlias = Annotated[float, Field(gt=-90.0, lt=90.0)]
File: TypeAlias = Annotated[str, Field(min_length=1)]
Size: TypeAlias = tuple[Annotated[int, Field(ge=2)], Annotated[int, Field(ge=2)]]


@dataclass(frozen=True, config=STRICT)
class EquirectangularSettings:
    """A panorama; its size is that of the pictures."""

    kind: Literal["equirectangular"] = "equirectangular"
    top_elevation_deg: Elevation = Field(default=90.0, description="of the first row")
    bottom_elevation_deg: Elevation = Field(default=-90.0, description="of the last row")


@dataclass(frozen=True, config=STRICT)
class CylinderSettings:
    """A panorama whose rows are proportional to the tangent of elevation."""

    kind: Literal["cylinder"] = "cylinder"
    top_elevation_deg: Below90 = Field(default=45.0, description="of the first row")
    bottom_elevation_deg: Below90 = Field(default=-45.0, description="of the last row")


@dataclass(frozen=True, config=STRICT)
class MirrorMountSettings:
    """How a mirror lies in its picture."""

    ahead_deg: float = Field(
        default=-90.0,
        ge=-360.0,
        le=360.0,
        description="the robot's heading in the picture, clockwise from the right",
    )
    clockwise: bool = Field(
        default=True, description="bearings grow clockwise, as in a picture from below"
    )
    ring_px: Pair | None = Field(
        default=None,
        description="radii of what is shown; null: as stated, by elevations, or the largest circle",
    )


@dataclass(frozen=True, config=STRICT)
class PlacedMirrorSettings(MirrorMountSettings):
    """A mirror whose place in the picture no file states."""

    size: Size | None = Field(default=None, description="width, height in pixels; null: any")
    centre: Pair | None = Field(default=None, description="column, row; null: the middle")


@dataclass(frozen=True, config=STRICT)
class HyperbolicMirrorSettings(PlacedMirrorSettings):
    """A hyperbolic mirror as a unified sphere."""

    kind: Literal["mirror"] = "mirror"
    xi: float = Field(default=0.92, gt=0.0, le=1.0, description="2 e / (1 + e^2) of eccentricity e")
    focal_px: Positive | None = Field(
        default=None, description="the horizon's radius times xi; null: by the outer rim"
    )
    inner_elevation_deg: float = Field(
        default=-65.0, ge=-90.0, lt=90.0, description="at the inner rim without ring_px"
    )
    outer_elevation_deg: Below90 = Field(
        default=25.0, description="at the outer rim without ring_px or focal_px"
    )


@dataclass(frozen=True, config=STRICT)
class VerticalSettings(MirrorMountSettings):
    """How a camera hangs or stands whose axis is vertical."""

    middle: Literal["down", "up"] = Field(
        default="down", description="where its middle points: up as of a fisheye that points up"
    )


@dataclass(frozen=True, config=STRICT)
class OCamCalibSettings(VerticalSettings):
    """A camera calibrated with OCamCalib."""

    kind: Literal["ocamcalib"] = "ocamcalib"
    file: File = Field(default="calib_results.txt", description="next to the pictures, else here")


@dataclass(frozen=True, config=STRICT)
class LensSettings(VerticalSettings):
    """A camera of camodocal (MEI, KANNALA_BRANDT) or of Kalibr whose axis is vertical."""

    kind: Literal["lens"] = "lens"
    file: File = Field(default="camera.yaml", description="next to the pictures, else here")


@dataclass(frozen=True, config=STRICT)
class RadialPolynomialSettings(PlacedMirrorSettings):
    """The paper's polynomial of elevation over radius, or a line between two elevations."""

    kind: Literal["radial_polynomial"] = "radial_polynomial"
    ring_px: Pair = Field(default=(20.0, 119.0), description="inner and outer radius, pixels")
    coefficients_deg: tuple[float, ...] = Field(
        default=(-20.0, 45.0),
        min_length=2,
        max_length=12,
        description="elevation over the radius in [-1, 1], from the constant up",
    )


@dataclass(frozen=True, config=STRICT)
class BloggieSettings:
    """Sony's Bloggie with its 360 degree accessory, by the file of Levin's unwarping tool.

    No calibration of the accessory is published. The model is that tool's measured vertical
    correction with its 60 degrees of view, of which 80 % lie above the horizon.
    """

    kind: Literal["bloggie"] = "bloggie"
    file: File = Field(default="bloggie_settings.txt", description="next to the video, else here")


OmniCameraKind: TypeAlias = (
    EquirectangularSettings
    | CylinderSettings
    | HyperbolicMirrorSettings
    | OCamCalibSettings
    | LensSettings
    | RadialPolynomialSettings
    | BloggieSettings
)
OmniCameraSettings: TypeAlias = Annotated[OmniCameraKind, Field(discriminator="kind")]
