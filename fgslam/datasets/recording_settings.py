"""Settings of the recordings and of what serves as odometry, each a tagged union over ``kind``."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT

Vector3: TypeAlias = tuple[float, float, float]

# --------------------------------------------------------------------------------------------
# Recordings


@dataclass(frozen=True, config=STRICT)
class RecordingSettings:
    """What every recording has: where it lies and which of its frames are used."""

    path: Annotated[str, Field(min_length=1, description="folder of the recording")]
    start: Annotated[int, Field(ge=0, description="first frame used, counted from 0")] = 0
    stop: Annotated[
        int | None, Field(ge=1, description="frame before which to stop; null: to the end")
    ] = None
    stride: Annotated[int, Field(ge=1, description="use every n-th frame")] = 1


@dataclass(frozen=True, config=STRICT)
class ImageFolderSettings(RecordingSettings):
    """Our own layout, left/ right/ [top/] calib.json times.txt: docs/datasets/image_folder.md."""

    kind: Literal["image_folder"] = "image_folder"
    use_top: Annotated[bool, Field(description="use the third camera where the folder has one")] = (
        True
    )
    odometry_file: Annotated[
        str | None,
        Field(
            description="odometry inside the folder: .csv is speed and yaw rate, .txt is TUM poses "
            "of the body; null: odometry.txt or the only odom*.csv, where there is one"
        ),
    ] = None
    camera_yaw_deg: Annotated[
        float | None,
        Field(
            description="heading of the reference camera in the body, degrees to the left; given, "
            "it replaces the mounting (bTc) of calib.json; null: as calib.json, or straight ahead"
        ),
    ] = None
    lever_arm_m: Annotated[
        Vector3 | None,
        Field(
            description="position of the reference (right) camera in the body, metres forward, "
            "left, up; given, it replaces bTc of calib.json; null: as calib.json, or none"
        ),
    ] = None


@dataclass(frozen=True, config=STRICT)
class KittiSettings(RecordingSettings):
    """KITTI odometry in its native layout (docs/datasets/kitti.md)."""

    kind: Literal["kitti"] = "kitti"
    sequence: Annotated[
        str, Field(pattern=r"^\d{2}$", description='which drive, two digits in quotes: "06"')
    ] = "00"


@dataclass(frozen=True, config=STRICT)
class EurocSettings(RecordingSettings):
    """EuRoC MAV in its native layout, rectified on reading (docs/datasets/euroc.md)."""

    kind: Literal["euroc"] = "euroc"
    pairing_tolerance_ms: Annotated[
        float,
        Field(ge=0.0, le=50.0, description="largest time between the two images of a pair, ms"),
    ] = 2.0
    rectify_alpha: Annotated[
        float,
        Field(
            ge=0.0,
            le=1.0,
            description="0 crops the rectified image to valid pixels, 1 keeps all (black borders)",
        ),
    ] = 0.0


@dataclass(frozen=True, config=STRICT)
class LightFieldSettings(RecordingSettings):
    """A gantry's grid of views read as a trinocular walk (docs/datasets/light_field.md)."""

    kind: Literal["light_field"] = "light_field"
    row: Annotated[int, Field(ge=0, description="grid row along which the reference walks")] = 8
    spacing: Annotated[
        int, Field(ge=1, description="grid steps from the reference to the left and the top view")
    ] = 4
    use_top: Annotated[bool, Field(description="use the vertical neighbour as third camera")] = True
    focal_length_px: Annotated[
        float,
        Field(
            gt=0.0,
            description="nominal focal length: the recording gives none; depth scales with it, the "
            "trajectory does not",
        ),
    ] = 800.0
    shift_px_per_step: Annotated[
        float,
        Field(
            description="pixels by which each view is shifted per grid step, so that all "
            "disparities are positive (measured without: -0.3 to 1.5 px a step)"
        ),
    ] = 1.0
    metres_per_unit: Annotated[
        float, Field(gt=0.0, description="metres in one unit of positions.csv (taken as mm)")
    ] = 0.001


# --------------------------------------------------------------------------------------------
# Odometry
