"""Settings of every recording of SLAM, each a tagged union over ``kind``.

Reading this module imports no reader: a configuration is checked before OpenCV or Open3D is loaded.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, FrameSelection
from fgslam.worlds.lab_settings import RenderedLabSettings
from fgslam.worlds.simulated.settings import Correlation, SimulatedMeasurementsSettings

__all__ = [
    "DatasetSettings",
    "EurocSettings",
    "FileRecordingSettings",
    "ImageFolderSettings",
    "KittiSettings",
    "LightFieldSettings",
    "MeasurementDatasetSettings",
    "RecordingSettings",
    "RenderedLabSettings",
    "SimulatedMeasurementsSettings",
    "StereoTracksSettings",
    "UtiasRangeBearingSettings",
    "UtiasStereoSettings",
]

Vector3: TypeAlias = tuple[float, float, float]

# --------------------------------------------------------------------------------------------
# Images on disk


@dataclass(frozen=True, config=STRICT, kw_only=True)
class RecordingSettings(FrameSelection):
    """What every recording on disk has: where it lies and which of its frames are used."""

    path: Annotated[str, Field(min_length=1, description="folder of the recording")]


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
# Measurements without images


@dataclass(frozen=True, config=STRICT)
class StereoTracksSettings(FrameSelection):
    """Stereo feature tracks of KITTI drives, inside GTSAM (docs/datasets/stereo_tracks.md)."""

    kind: Literal["stereo_tracks"] = "stereo_tracks"
    file: Annotated[
        str,
        Field(
            min_length=1,
            description='"00s", "00" or "large": those inside the installed gtsam; or the path of '
            "a file VO_stereo_factors*.txt with its calibration beside it",
        ),
    ] = "00s"
    pixel_sigma: Annotated[
        float,
        Field(
            gt=0.0,
            description="noise of one image coordinate, pixels (measured: docs/datasets/"
            "stereo_tracks.md)",
        ),
    ] = 0.25
    frame_period_s: Annotated[
        float,
        Field(gt=0.0, description="time between frames, which the files lack; KITTI's is 0.1 s"),
    ] = 0.1


@dataclass(frozen=True, config=STRICT, kw_only=True)
class UtiasStereoSettings(RecordingSettings):
    """UTIAS "Starry Night": stereo pixels, body rates, truth (docs/datasets/utias.md)."""

    path: Annotated[str, Field(min_length=1, description="the .mat file of dataset 3")]
    kind: Literal["utias_stereo"] = "utias_stereo"
    pixel_sigma_scale: Annotated[
        float, Field(gt=0.0, description="factor on the file's standard deviations of the pixels")
    ] = 1.0
    left_right_correlation: Annotated[
        tuple[Correlation, Correlation],
        Field(
            description="correlation of the noise of both images, in columns and in rows (measured "
            "against the truth); [0, 0]: independent, as the file's variances alone would have it"
        ),
    ] = (0.86, 0.99)
    rate_sigma_scale: Annotated[
        float, Field(gt=0.0, description="factor on the file's standard deviations of the rates")
    ] = 1.0


@dataclass(frozen=True, config=STRICT, kw_only=True)
class UtiasRangeBearingSettings(RecordingSettings):
    """UTIAS "Lost in the Woods": laser ranges, wheel odometry, truth (docs/datasets/utias.md)."""

    path: Annotated[str, Field(min_length=1, description="the .mat file of dataset 2")]
    kind: Literal["utias_range_bearing"] = "utias_range_bearing"
    max_range_m: Annotated[
        float, Field(gt=0.0, description="readings farther than this are left out, metres")
    ] = 5.0
    rate_sigma_scale: Annotated[
        float, Field(gt=0.0, description="factor on the file's standard deviations of the rates")
    ] = 1.0
    lateral_sigma_mps: Annotated[
        float,
        Field(gt=0.0, description="sideways speed, which the wheels do not measure, m/s"),
    ] = 0.03


# --------------------------------------------------------------------------------------------
# Any of them


FileRecordingSettings: TypeAlias = (
    ImageFolderSettings | KittiSettings | EurocSettings | LightFieldSettings
)
MeasurementDatasetSettings: TypeAlias = (
    StereoTracksSettings
    | UtiasStereoSettings
    | UtiasRangeBearingSettings
    | SimulatedMeasurementsSettings
)
DatasetSettings: TypeAlias = Annotated[
    RenderedLabSettings | FileRecordingSettings | MeasurementDatasetSettings,
    Field(discriminator="kind"),
]
