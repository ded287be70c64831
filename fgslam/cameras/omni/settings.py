"""Settings of omnidirectional cameras, tagged by ``kind`` (docs/datasets/mirror_images.md).

Angles are degrees here; the picture's direction ``ahead_deg`` is measured clockwise from the right,
so -90 is up.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT

Pair: TypeAlias = tuple[float, float]
Size: TypeAlias = tuple[Annotated[int, Field(ge=2)], Annotated[int, Field(ge=2)]]


@dataclass(frozen=True, config=STRICT)
class EquirectangularSettings:
    """A panorama; its size is that of the pictures."""

    kind: Literal["equirectangular"] = "equirectangular"
    top_elevation_deg: Annotated[
        float, Field(ge=-90.0, le=90.0, description="of the first row, degrees up")
    ] = 90.0
    bottom_elevation_deg: Annotated[
        float, Field(ge=-90.0, le=90.0, description="of the last row, degrees up")
    ] = -90.0


@dataclass(frozen=True, config=STRICT)
class CylinderSettings:
    """A panorama whose rows are proportional to the tangent of elevation."""

    kind: Literal["cylinder"] = "cylinder"
    top_elevation_deg: Annotated[
        float, Field(gt=-90.0, lt=90.0, description="of the first row, degrees up")
    ] = 45.0
    bottom_elevation_deg: Annotated[
        float, Field(gt=-90.0, lt=90.0, description="of the last row, degrees up")
    ] = -45.0


@dataclass(frozen=True, config=STRICT)
class MirrorMountSettings:
    """How a mirror lies in its picture."""

    ahead_deg: Annotated[
        float,
        Field(
            ge=-360.0,
            le=360.0,
            description="direction of the robot's heading in the picture, clockwise from the right;"
            " -90 is up",
        ),
    ] = -90.0
    clockwise: Annotated[
        bool,
        Field(description="bearings grow clockwise, as in an upward-looking camera's raw picture"),
    ] = True


@dataclass(frozen=True, config=STRICT)
class HyperbolicMirrorSettings(MirrorMountSettings):
    """A hyperbolic mirror as a unified sphere."""

    kind: Literal["mirror"] = "mirror"
    size: Annotated[
        Size | None, Field(description="width, height calibrated, pixels; null: any picture's")
    ] = None
    centre: Annotated[
        Pair | None, Field(description="column, row of the mirror's axis; null: the middle")
    ] = None
    xi: Annotated[
        float, Field(gt=0.0, le=1.0, description="2 e / (1 + e^2), e the mirror's eccentricity")
    ] = 0.92
    focal_px: Annotated[
        float | None,
        Field(
            gt=0.0,
            description="of the unified model: the horizon's radius times xi; null: by the "
            "outer rim",
        ),
    ] = None
    inner_radius_px: Annotated[
        float | None,
        Field(ge=0.0, description="nothing is seen inside; null: where its elevation is"),
    ] = None
    outer_radius_px: Annotated[
        float | None,
        Field(
            gt=0.0,
            description="nothing is seen outside; null: by its elevation",
        ),
    ] = None
    inner_elevation_deg: Annotated[
        float, Field(ge=-90.0, lt=90.0, description="at the inner rim, used where it says so above")
    ] = -65.0
    outer_elevation_deg: Annotated[
        float, Field(gt=-90.0, lt=90.0, description="at the outer rim, used where it says so above")
    ] = 25.0


@dataclass(frozen=True, config=STRICT)
class OCamCalibSettings(MirrorMountSettings):
    """A camera calibrated with OCamCalib."""

    kind: Literal["ocamcalib"] = "ocamcalib"
    file: Annotated[
        str,
        Field(
            min_length=1,
            description="calib_results.txt, looked for beside the pictures, then from here",
        ),
    ] = "calib_results.txt"
    ring_px: Annotated[
        Pair | None,
        Field(description="inner and outer radius; null: as the file says"),
    ] = None


@dataclass(frozen=True, config=STRICT)
class LensSettings(MirrorMountSettings):
    """A camera of camodocal (MEI, KANNALA_BRANDT) or of Kalibr whose axis is vertical."""

    kind: Literal["lens"] = "lens"
    file: Annotated[
        str,
        Field(
            min_length=1, description="its calibration, looked for beside the pictures, then here"
        ),
    ] = "camera.yaml"
    middle: Annotated[
        Literal["down", "up"],
        Field(
            description="where the picture's middle looks: down as of a mirror above the camera, "
            "up as of a fisheye that looks up"
        ),
    ] = "down"
    ring_px: Annotated[
        Pair | None,
        Field(description="inner and outer radius; null: the largest circle in the picture"),
    ] = None


@dataclass(frozen=True, config=STRICT)
class RadialPolynomialSettings(MirrorMountSettings):
    """The paper's polynomial of elevation over radius, or a line between two elevations."""

    kind: Literal["radial_polynomial"] = "radial_polynomial"
    size: Annotated[
        Size | None, Field(description="width, height calibrated, pixels; null: any picture's")
    ] = None
    centre: Annotated[
        Pair | None, Field(description="column, row of the mirror's axis; null: the middle")
    ] = None
    ring_px: Annotated[Pair, Field(description="inner and outer radius, pixels")] = (20.0, 119.0)
    coefficients_deg: Annotated[
        tuple[float, ...],
        Field(
            min_length=2,
            max_length=12,
            description="elevation over the radius scaled to [-1, 1], from the constant upward",
        ),
    ] = (-20.0, 45.0)


@dataclass(frozen=True, config=STRICT)
class BloggieSettings:
    """Sony's Bloggie with its 360 degree accessory, by the file of Levin's unwarping tool.

    No calibration of the accessory is published. The model is that tool's measured vertical
    correction with its 60 degrees of view, of which 80 % lie above the horizon.
    """

    kind: Literal["bloggie"] = "bloggie"
    file: Annotated[
        str,
        Field(
            min_length=1, description="settings.txt, looked for beside the video, then from here"
        ),
    ] = "bloggie_settings.txt"


OmniCameraSettings: TypeAlias = Annotated[
    EquirectangularSettings
    | CylinderSettings
    | HyperbolicMirrorSettings
    | OCamCalibSettings
    | LensSettings
    | RadialPolynomialSettings
    | BloggieSettings,
    Field(discriminator="kind"),
]
