"""Settings of every recording and of its odometry, tagged unions over ``kind``.

Reading this module imports no reader: a configuration is checked before OpenCV or Open3D is loaded.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.cameras.settings import (
    BloggieSettings,
    EquirectangularSettings,
    HyperbolicMirrorSettings,
    OmniCameraSettings,
)
from fgslam.core.settings import STRICT, FrameSelection, NonNegative, Positive
from fgslam.worlds.settings import (
    OmniHouseSettings as OmniHouseSettings,
    RenderedLabSettings as RenderedLabSettings,
    SimulatedBearingsSettings as SimulatedBearingsSettings,
    SimulatedMeasurementsSettings as SimulatedMeasurementsSettings,
)

Vector3: TypeAlias = tuple[float, float, float]
FramesASecond: TypeAlias = Annotated[
    Annotated[float, Field(gt=0.0, le=1e4)] | None,
    Field(description="frames a second; null: as stated, else 10"),
]

# --------------------------------------------------------------------------------------------
# Images on disk


@dataclass(frozen=True, config=STRICT, kw_only=True)
class RecordingSettings(FrameSelection):
    """What every recording on disk has: where it lies and which of its frames are used."""

    path: str = Field(min_length=1, description="folder of the recording")
    scale: float = Field(
        default=1.0, gt=0.0, le=1.0, description="by which images and calibration are made smaller"
    )


@dataclass(frozen=True, config=STRICT, kw_only=True)
class CalibratedSettings(RecordingSettings):
    """What a recording has whose calibration may be another file than its own."""

    camera_file: str | None = Field(default=None, description="calibration in place of its own")
    resized: bool = Field(
        default=False, description="images were resized as a whole: scale the calibration"
    )
    fov_deg: float | None = Field(
        default=None,
        gt=0.0,
        lt=170.0,
        description="horizontal, of the rectified view; null: all that cameras fill",
    )
    unit_m: Positive = Field(
        default=1.0, description="metres of the calibration's unit: 0.001, the side of a square"
    )
    lens: Literal["radtan", "equidistant"] | None = Field(
        default=None, description="model of four coefficients; null: as stated, or by rows of pairs"
    )
    camera_yaw_deg: float | None = Field(
        default=None, description="of the camera in the body, degrees to the left; null: calibrated"
    )
    lever_arm_m: Vector3 | None = Field(
        default=None, description="right camera in the body, forward, left, up; null: calibrated"
    )


@dataclass(frozen=True, config=STRICT)
class ImageFolderSettings(CalibratedSettings):
    """Our own layout, left/ right/ [top/] calib.json times.txt: docs/datasets/images.md."""

    kind: Literal["image_folder"] = "image_folder"


@dataclass(frozen=True, config=STRICT, kw_only=True)
class LooseImagesSettings(CalibratedSettings):
    """Folders of images with any names, with or without times (docs/datasets/images.md)."""

    path: str = Field(min_length=1, description="the folder, or a pattern of file names in it")
    kind: Literal["loose_images"] = "loose_images"
    fps: FramesASecond = None


@dataclass(frozen=True, config=STRICT, kw_only=True)
class VideoSettings(CalibratedSettings):
    """Stereo films: one of both views, or one a camera (docs/datasets/images.md)."""

    path: str = Field(min_length=1, description="the film, a folder of one to three, or a pattern")
    kind: Literal["video"] = "video"
    fps: FramesASecond = None


@dataclass(frozen=True, config=STRICT, kw_only=True)
class DepthSettings(CalibratedSettings):
    """What a recording has that may be of one camera and its depth."""

    depth_scale: Positive | None = Field(
        default=None,
        description="units in a metre; null: as stated, else 5000 (TUM), 1000 or 1 (floats)",
    )
    colour_camera: int | None = Field(
        default=None,
        ge=0,
        description="the calibration's camera, from 0; null: by topic, size or name",
    )


@dataclass(frozen=True, config=STRICT, kw_only=True)
class RgbdSettings(DepthSettings):
    """Colour and depth images, as in TUM RGB-D or in two folders (docs/datasets/images.md)."""

    kind: Literal["rgbd"] = "rgbd"
    fps: FramesASecond = None


@dataclass(frozen=True, config=STRICT, kw_only=True)
class BagSettings(DepthSettings):
    """ROS 1 and ROS 2 bags: .bag, .db3, .mcap (docs/datasets/bags.md)."""

    path: str = Field(min_length=1, description="the bag, its folder, or a pattern of file names")
    kind: Literal["bag"] = "bag"
    topics: tuple[str, ...] = Field(
        default=(), description="left, right[, top], odometry; empty: by type and name"
    )


@dataclass(frozen=True, config=STRICT)
class KittiRawSettings(CalibratedSettings):
    """A synchronised and rectified drive of KITTI raw (docs/datasets/published.md)."""

    kind: Literal["kitti_raw"] = "kitti_raw"


@dataclass(frozen=True, config=STRICT)
class KittiSettings(RecordingSettings):
    """KITTI odometry in its native layout (docs/datasets/published.md)."""

    kind: Literal["kitti"] = "kitti"
    sequence: str = Field(
        default="00", pattern=r"^\d{2}$", description='which drive, in quotes: "06"'
    )


@dataclass(frozen=True, config=STRICT)
class EurocSettings(CalibratedSettings):
    """EuRoC MAV in its native layout, rectified on reading (docs/datasets/published.md)."""

    kind: Literal["euroc"] = "euroc"


FileRecordingSettings: TypeAlias = (
    ImageFolderSettings
    | LooseImagesSettings
    | VideoSettings
    | RgbdSettings
    | BagSettings
    | KittiSettings
    | KittiRawSettings
    | EurocSettings
)

# --------------------------------------------------------------------------------------------
# Measurements without images


@dataclass(frozen=True, config=STRICT)
class StereoTracksSettings(FrameSelection):
    """Stereo feature tracks of KITTI drives, inside GTSAM (docs/datasets/published.md)."""

    kind: Literal["stereo_tracks"] = "stereo_tracks"
    file: str = Field(
        default="00s",
        min_length=1,
        description='"00s", "00", "large", or a file VO_stereo_factors*.txt',
    )
    pixel_sigma: Positive = Field(default=0.25, description="noise of one image coordinate, pixels")


@dataclass(frozen=True, config=STRICT, kw_only=True)
class MeasurementFilesSettings(FrameSelection):
    """The measurements of a run folder, or of a converted recording: docs/datasets/published.md.

    Frames build upon those before them: the first ones (``stop``) are used, or all.
    """

    path: str = Field(min_length=1, description="folder with measurements.npz")
    kind: Literal["measurements"] = "measurements"


MeasurementDatasetSettings: TypeAlias = (
    StereoTracksSettings | MeasurementFilesSettings | SimulatedMeasurementsSettings
)
DatasetSettings: TypeAlias = Annotated[
    RenderedLabSettings | FileRecordingSettings | MeasurementDatasetSettings,
    Field(discriminator="kind"),
]

# --------------------------------------------------------------------------------------------
# Pictures of an omnidirectional camera


@dataclass(frozen=True, config=STRICT)
class PanoramasSettings(RecordingSettings):
    """A folder of panoramas, with or without ``poses.csv`` (docs/datasets/omnidirectional.md)."""

    kind: Literal["panoramas"] = "panoramas"
    camera: EquirectangularSettings = EquirectangularSettings()
    width: int | None = Field(
        default=None, ge=64, le=16384, description="to which pictures are reduced; null: none"
    )


@dataclass(frozen=True, config=STRICT)
class OmniPathSettings(RecordingSettings):
    """A folder of a mirror camera's pictures along a path (docs/datasets/omnidirectional.md)."""

    kind: Literal["omni_path"] = "omni_path"
    camera: OmniCameraSettings = HyperbolicMirrorSettings()
    pattern: str = Field(
        default="*", min_length=1, pattern=r"^[^/\\]+$", description="names of the pictures"
    )


@dataclass(frozen=True, config=STRICT)
class OmniVideoSettings(RecordingSettings):
    """A mirror camera's video file; ``path`` is the file (docs/datasets/omnidirectional.md)."""

    kind: Literal["omni_video"] = "omni_video"
    camera: OmniCameraSettings = BloggieSettings()


OmniDatasetSettings: TypeAlias = Annotated[
    PanoramasSettings | OmniPathSettings | OmniVideoSettings, Field(discriminator="kind")
]

# --------------------------------------------------------------------------------------------
# Odometry


@dataclass(frozen=True, config=STRICT)
class ConstantVelocitySettings:
    """No odometry: the camera is expected to keep its velocity, up to a random acceleration.

    How large the acceleration is, is estimated from the frames so far (docs/derivations/motion.md).
    """

    kind: Literal["constant_velocity"] = "constant_velocity"


@dataclass(frozen=True, config=STRICT)
class RecordedOdometrySettings:
    """Use the recording's own odometry, with this noise.

    The rates are taken as constant over one step, so each standard deviation is multiplied by the
    step's duration. Defaults: measured on KITTI raw 2011_09_26 against its truth (step 0.206 s,
    7.5 m/s), where truth's own noise is included; docs/datasets/images.md has the numbers.
    """

    kind: Literal["recorded"] = "recorded"
    time_offset_s: float = Field(
        default=0.0, allow_inf_nan=False, description="added to its time stamps, seconds"
    )
    speed_sigma_mps: Positive = Field(
        default=0.10, description="speed and yaw rate: noise of the forward speed, m/s"
    )
    yaw_rate_sigma_dps: Positive = Field(
        default=0.30, description="speed and yaw rate: noise of the yaw rate, degrees/s"
    )
    translation_sigma_fraction: NonNegative = Field(
        default=0.02, description="poses: noise per axis as a fraction of the step's length"
    )
    rotation_sigma_fraction: NonNegative = Field(
        default=0.05, description="poses: noise per axis as a fraction of the step's angle"
    )


@dataclass(frozen=True, config=STRICT)
class SyntheticOdometrySettings:
    """Ground truth plus stated noise stands in for odometry; every output states so.

    Independent normal noise per body axis on each step, drawn from the experiment's seed.
    """

    kind: Literal["synthetic"] = "synthetic"
    translation_sigma_fraction: NonNegative = Field(
        default=0.02, description="per axis, as a fraction of the step's length"
    )
    rotation_sigma_deg: NonNegative = Field(default=1.0, description="per axis and step, degrees")


OdometrySettings: TypeAlias = Annotated[
    RecordedOdometrySettings | ConstantVelocitySettings | SyntheticOdometrySettings,
    Field(discriminator="kind"),
]
