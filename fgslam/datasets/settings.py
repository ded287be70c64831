"""Settings of every recording of SLAM and of its odometry, tagged unions over ``kind``.

Reading this module imports no reader: a configuration is checked before OpenCV or Open3D is loaded.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, FrameSelection, Positive
from fgslam.datasets.odometry_settings import ConstantVelocitySettings as ConstantVelocitySettings
from fgslam.datasets.odometry_settings import OdometrySettings as OdometrySettings
from fgslam.datasets.odometry_settings import RecordedOdometrySettings as RecordedOdometrySettings
from fgslam.datasets.odometry_settings import (
    SyntheticOdometrySettings as SyntheticOdometrySettings,
)
from fgslam.worlds.settings import RenderedLabSettings as RenderedLabSettings
from fgslam.worlds.settings import (
    SimulatedMeasurementsSettings as SimulatedMeasurementsSettings,
)

Vector3: TypeAlias = tuple[float, float, float]

# --------------------------------------------------------------------------------------------
# Images on disk


@dataclass(frozen=True, config=STRICT, kw_only=True)
class RecordingSettings(FrameSelection):
    """What every recording on disk has: where it lies and which of its frames are used."""

    path: str = Field(min_length=1, description="folder of the recording")
    scale: float = Field(
        default=1.0,
        gt=0.0,
        le=1.0,
        description="images are made smaller by this, the calibration too",
    )


@dataclass(frozen=True, config=STRICT, kw_only=True)
class CalibratedSettings(RecordingSettings):
    """What a recording has whose calibration may be another file than its own."""

    camera_file: str | None = Field(
        default=None,
        description="calibration in place of the recording's own (docs/howto/your_camera.md)",
    )
    resized: bool = Field(
        default=False,
        description="the images were made smaller or larger as a whole after calibration: "
        "scale it to them",
    )
    fov_deg: float | None = Field(
        default=None,
        gt=0.0,
        lt=170.0,
        description="horizontal angle of the rectified view; null: as wide as cameras fill",
    )
    unit_m: Positive = Field(
        default=1.0,
        description="metres of one unit of the calibration's lengths: 0.001 for millimetres, "
        "the side of a square for one in squares",
    )
    camera_yaw_deg: float | None = Field(
        default=None,
        description="heading of the camera in the body, degrees to the left; null: as calibrated",
    )
    lever_arm_m: Vector3 | None = Field(
        default=None,
        description="position of the right camera in the body, forward, left, up; null: as "
        "calibrated",
    )


@dataclass(frozen=True, config=STRICT)
class ImageFolderSettings(CalibratedSettings):
    """Our own layout, left/ right/ [top/] calib.json times.txt: docs/datasets/image_folder.md."""

    kind: Literal["image_folder"] = "image_folder"
    use_top: bool = Field(default=True, description="use the third camera where the folder has one")
    odometry_file: str | None = Field(
        default=None,
        description="odometry inside the folder: .csv (speed, yaw rate) or .txt (TUM poses of "
        "the body)",
    )


OdometryFile = Annotated[
    str | None,
    Field(description="odometry inside the folder; null: odometry.txt, odom.txt or odom*.csv"),
]
PairingTolerance = Annotated[
    float,
    Field(gt=0.0, le=1000.0, description="largest time between the two images of a pair, ms"),
]


@dataclass(frozen=True, config=STRICT, kw_only=True)
class LooseImagesSettings(CalibratedSettings):
    """Folders of images with any names, with or without times (docs/datasets/loose_images.md)."""

    path: str = Field(min_length=1, description="the folder, or a pattern of file names in it")
    kind: Literal["loose_images"] = "loose_images"
    fps: float | None = Field(
        default=None,
        gt=0.0,
        le=1e4,
        description="frames a second; null: by the list of times or by names, else 10",
    )
    pairing_tolerance_ms: float = Field(
        default=20.0,
        gt=0.0,
        le=1000.0,
        description="largest time between the images of a pair, where only times name them, ms",
    )
    odometry_file: OdometryFile = None


@dataclass(frozen=True, config=STRICT, kw_only=True)
class VideoSettings(CalibratedSettings):
    """Stereo films: one of both views, or one a camera (docs/datasets/video.md)."""

    path: str = Field(min_length=1, description="the film, a folder of one to three, or a pattern")
    kind: Literal["video"] = "video"
    views: Literal["side_by_side", "over_under"] | None = Field(
        default=None, description="how one film shows both views; null: by its size"
    )
    fps: float | None = Field(
        default=None, gt=0.0, le=1e4, description="frames a second, in place of the film's own rate"
    )
    pairing_tolerance_ms: PairingTolerance = 20.0


@dataclass(frozen=True, config=STRICT)
class RgbdSettings(CalibratedSettings):
    """Colour and depth images, as in TUM RGB-D or in two folders (docs/datasets/rgbd.md)."""

    kind: Literal["rgbd"] = "rgbd"
    depth_scale: Positive | None = Field(
        default=None,
        description="depth units in a metre; null: by the calibration's file, else 5000 (TUM), "
        "1000 (16 bits), 1 (floats)",
    )
    depth_sigma_m: Positive = Field(
        default=1.425e-3, description="noise of a depth of 1 m, growing with its square"
    )
    pairing_tolerance_ms: PairingTolerance = 20.0
    odometry_file: OdometryFile = None


@dataclass(frozen=True, config=STRICT)
class KittiRawSettings(CalibratedSettings):
    """A synchronised and rectified drive of KITTI raw (docs/datasets/kitti.md)."""

    kind: Literal["kitti_raw"] = "kitti_raw"


@dataclass(frozen=True, config=STRICT, kw_only=True)
class BagSettings(CalibratedSettings):
    """ROS 1 and ROS 2 bags: .bag, .db3, .mcap (docs/datasets/bags.md)."""

    path: str = Field(min_length=1, description="the bag, its folder, or a pattern of file names")
    kind: Literal["bag"] = "bag"
    topics: tuple[str, ...] = Field(
        default=(),
        description="topics: left, right[, top] images, odometry; empty: by type and name",
    )
    pairing_tolerance_ms: PairingTolerance = 20.0


@dataclass(frozen=True, config=STRICT)
class KittiSettings(RecordingSettings):
    """KITTI odometry in its native layout (docs/datasets/kitti.md)."""

    kind: Literal["kitti"] = "kitti"
    sequence: str = Field(
        default="00", pattern=r"^\d{2}$", description='which drive, two digits in quotes: "06"'
    )


@dataclass(frozen=True, config=STRICT)
class EurocSettings(CalibratedSettings):
    """EuRoC MAV in its native layout, rectified on reading (docs/datasets/euroc.md)."""

    kind: Literal["euroc"] = "euroc"
    pairing_tolerance_ms: float = Field(
        default=2.0,
        ge=0.0,
        le=50.0,
        description="largest time between the two images of a pair, ms",
    )


# --------------------------------------------------------------------------------------------
# Measurements without images


@dataclass(frozen=True, config=STRICT)
class StereoTracksSettings(FrameSelection):
    """Stereo feature tracks of KITTI drives, inside GTSAM (docs/datasets/stereo_tracks.md)."""

    kind: Literal["stereo_tracks"] = "stereo_tracks"
    file: str = Field(
        default="00s",
        min_length=1,
        description='"00s", "00" or "large" of gtsam; or a file VO_stereo_factors*.txt',
    )
    pixel_sigma: Positive = Field(
        default=0.25,
        description="noise of one image coordinate, pixels (measured: docs/datasets/"
        "stereo_tracks.md)",
    )
    frame_period_s: Positive = Field(
        default=0.1, description="time between frames, which the files lack; KITTI's is 0.1 s"
    )


@dataclass(frozen=True, config=STRICT, kw_only=True)
class MeasurementFilesSettings(FrameSelection):
    """The measurements of a run folder, or of a converted recording: docs/datasets/measurements.md.

    Frames build upon those before them: the first ones (``stop``) are used, or all.
    """

    path: str = Field(min_length=1, description="folder with measurements.npz")
    kind: Literal["measurements"] = "measurements"


# --------------------------------------------------------------------------------------------
# Any of them


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
MeasurementDatasetSettings: TypeAlias = (
    StereoTracksSettings | MeasurementFilesSettings | SimulatedMeasurementsSettings
)
DatasetSettings: TypeAlias = Annotated[
    RenderedLabSettings | FileRecordingSettings | MeasurementDatasetSettings,
    Field(discriminator="kind"),
]
