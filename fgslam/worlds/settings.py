"""Settings of the rendered places, of the rendered house, and of simulations without images.

The lab's defaults are those of Se et al. (2.2 and 5), the house's those of Goedemé et al. 2005.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import (
    STRICT,
    Count,
    Degrees,
    FrameSelection,
    Index,
    NonNegative,
    Positive,
)

ImageSide: TypeAlias = Annotated[int, Field(ge=16, le=4096)]
Baseline: TypeAlias = Annotated[float, Field(gt=0.0, le=2.0)]
GreyLevels: TypeAlias = Annotated[float, Field(ge=0.0, le=50.0)]
Frames: TypeAlias = Annotated[int, Field(ge=2, le=100_000)]
Laps: TypeAlias = Annotated[int, Field(ge=1, le=1000)]
Burst: TypeAlias = Annotated[int, Field(ge=1, le=100)]
Chance: TypeAlias = Annotated[float, Field(gt=0.0, le=1.0)]
Factor: TypeAlias = Annotated[float, Field(ge=-2.0, le=5.0)]
Features: TypeAlias = Annotated[int, Field(ge=1, le=10_000)]
Legs: TypeAlias = Annotated[int, Field(ge=1, le=100)]
Persons: TypeAlias = Annotated[int, Field(ge=0, le=8)]
Pixels: TypeAlias = Annotated[float, Field(ge=0.0, le=20.0)]
Points: TypeAlias = Annotated[int, Field(ge=10, le=1_000_000)]
Relative: TypeAlias = Annotated[float, Field(ge=0.0, le=0.08)]
Spacing: TypeAlias = Annotated[float, Field(ge=0.5, le=8.0)]
Speed: TypeAlias = Annotated[float, Field(gt=0.0, le=5.0)]
Tilt: TypeAlias = Annotated[float, Field(ge=0.0, le=10.0)]
Times: TypeAlias = Annotated[float, Field(ge=0.0, le=50.0)]
Turn: TypeAlias = Annotated[float, Field(gt=0.0, le=45.0)]
Wave: TypeAlias = Annotated[float, Field(ge=0.0, lt=0.9)]
ScaleError: TypeAlias = Annotated[float, Field(ge=0.0, le=0.5)]
_SCALE_ERROR = "deviation of the constant relative errors of way and turns, once a drive"
PlaceName: TypeAlias = Literal["lab", "rooms", "corridors"]
PathName: TypeAlias = Literal["paper_loop", "laps", "waypoints", "tour", "one_way", "random_poses"]

# --------------------------------------------------------------------------------------------
# The lab, and the other places with a pinhole rig


@dataclass(frozen=True, config=STRICT)
class LabRigSettings:
    """The cameras: the right one is the reference, left next to it, top above it."""

    width: ImageSide = Field(default=320, description="image width, pixels")
    height: ImageSide = Field(default=240, description="image height, pixels")
    baseline_m: Baseline = Field(default=0.10, description="right to left camera, metres")
    vertical_baseline_m: Baseline | None = Field(
        default=0.10, description="right to top camera, metres; null for a two-camera rig"
    )


@dataclass(frozen=True, config=STRICT)
class RandomPosesSettings:
    """Poses all over the free floor, in any heading: those of a robot that was carried away."""

    seed: Index = Field(default=0, description="of the poses; not the run's seed")
    burst: Burst = Field(default=1, description="frames from each pose on, straight ahead")


@dataclass(frozen=True, config=STRICT)
class DriveLimits:
    """How fast the robot drives; it takes two images a second."""

    max_speed_m_s: Speed = Field(default=0.40, description="limit, metres a second")
    max_turn_deg_s: Degrees = Field(default=10.0, description="limit, degrees a second")


@dataclass(frozen=True, config=STRICT)
class LabDriveSettings(DriveLimits):
    """The robot's path and speed."""

    path: PathName = Field(
        default="paper_loop",
        description="lab: `paper_loop`, `laps`; rooms: `tour`; corridors: `tour`, `one_way`; any: "
        "the others",
    )
    frames: Frames | None = Field(
        default=249, description="number of frames; null: at nine tenths of the speed limits"
    )
    laps: Laps = Field(default=1, description="rounds, for `laps` and `tour`")
    waypoints_m: tuple[tuple[float, float], ...] = Field(
        default=(), description="(x, y) in the room, metres from its centre, for `waypoints`"
    )
    closed: bool = Field(default=False, description="for `waypoints`: back to the first one")
    random_poses: RandomPosesSettings = RandomPosesSettings()


@dataclass(frozen=True, config=STRICT)
class WheelOdometrySettings:
    """Drift of the wheel odometry (docs/datasets/rendered.md)."""

    scale_error: ScaleError = Field(default=0.01, description=_SCALE_ERROR)
    noise: Times = Field(default=1.0, description="times the noise along, across and of heading")


@dataclass(frozen=True, config=STRICT)
class LabEffectsSettings:
    """Disturbances of the images; null or zero when off."""

    noise_grey: GreyLevels = Field(default=1.5, description="Gaussian image noise, grey levels")
    person: Index | None = Field(
        default=None, description="frame in which a person begins to walk through the view"
    )
    blocked_frames: tuple[Index, Index] | None = Field(
        default=None, description="[first, last) frames in which a dark cover blocks all cameras"
    )


@dataclass(frozen=True, config=STRICT)
class LabSettings:
    """The rendered lab, or another place: the robot's drive in it, its cameras and odometry."""

    place: PlaceName = Field(
        default="lab",
        description="`lab` 10 m x 10 m; `rooms` office of 36 m x 24 m; `corridors` ring of 24 m",
    )
    rig: LabRigSettings = LabRigSettings()
    drive: LabDriveSettings = LabDriveSettings()
    odometry: WheelOdometrySettings = WheelOdometrySettings()
    effects: LabEffectsSettings = LabEffectsSettings()
    room_seed: Index = Field(default=0, description="of the room's textures and small things")
    visit: Literal[1, 2, 3] = Field(
        default=1, description="2: chairs and cartons moved; 3: shelves and posters exchanged too"
    )
    posters: Literal["different", "identical"] = Field(
        default="different", description="`identical`: two posters on different walls are the same"
    )


@dataclass(frozen=True, config=STRICT)
class RenderedLabSettings(LabSettings, FrameSelection):
    """The rendered lab as a recording: which of the drive's frames are used."""

    kind: Literal["rendered_lab"] = "rendered_lab"


# --------------------------------------------------------------------------------------------
# The house


@dataclass(frozen=True, config=STRICT)
class HouseCameraSettings:
    """The camera above the wheelchair."""

    model: Literal["mirror", "equirectangular"] = Field(
        default="mirror",
        description="`mirror`: hyperbolic, above an upward camera; or an ideal panorama",
    )
    width: Annotated[int, Field(ge=64, le=8192, multiple_of=4)] | None = Field(
        default=None,
        description="pixels; the height is 3/4, of panoramas 1/2 of it; null: 320, panoramas 1024",
    )


@dataclass(frozen=True, config=STRICT)
class HouseCalibrationSettings:
    """Errors of the mirror's calibration that the robot has; its images obey the true mirror."""

    mirror: Relative = Field(default=0.0, description="of xi and focal length; signs drawn")
    centre_px: Pixels = Field(default=0.0, description="of the mirror's centre; direction drawn")


@dataclass(frozen=True, config=STRICT)
class HousePathSettings:
    """The reference path, laid by a planner from the seed."""

    legs: Legs = Field(default=10, description="targets to reach one after another")
    spacing_m: Spacing = Field(default=3.0, description="between a target and the next, metres")


@dataclass(frozen=True, config=STRICT)
class OmniHouseSettings:
    """A wheelchair with an omnidirectional camera in a furnished house of 20 m x 15 m."""

    kind: Literal["omni_house"] = "omni_house"
    camera: HouseCameraSettings = HouseCameraSettings()
    noise_grey: GreyLevels = Field(default=2.0, description="Gaussian image noise, grey levels")
    people: Persons = Field(default=0, description="who walk about in the house")
    path: HousePathSettings = HousePathSettings()
    exposure_wave: Wave = Field(default=0.0, description="amplitude of a slow wave of the gain")
    tilt_deg: Tilt = Field(default=0.0, description="of the camera, constant; its side is drawn")
    calibration: HouseCalibrationSettings = HouseCalibrationSettings()

    def __post_init__(self) -> None:
        """Raises ValueError for errors of a mirror that is not there."""
        if self.camera.model != "mirror" and self.calibration != HouseCalibrationSettings():
            raise ValueError(
                "dataset.calibration has errors of a mirror, but dataset.camera.model is "
                f"{self.camera.model}; take mirror, or leave them out"
            )


# --------------------------------------------------------------------------------------------
# Simulated measurements: the world, the drive, the noise, the faults


@dataclass(frozen=True, config=STRICT)
class MeasurementWorldSettings:
    """Landmarks without appearance, on the surfaces of a place."""

    place: Literal["room", "corridor"] = Field(
        default="room",
        description="`room`: the lab's walls and furniture; `corridor`: walls along the way",
    )
    landmarks: Points = Field(default=2500, description="in the room, or in 100 m of corridor")


@dataclass(frozen=True, config=STRICT)
class MeasurementDriveSettings(DriveLimits):
    """The robot's path and speed."""

    path: Literal["lab_loop", "laps", "sharp_turns"] = Field(
        default="lab_loop", description="`lab_loop` the paper's; `laps`; `sharp_turns`"
    )
    frames: Frames | None = Field(
        default=249, description="number of frames; null: at nine tenths of the speed limits"
    )
    laps: Laps = Field(default=1, description="rounds, for `laps`")
    turn_deg_per_frame: Turn = Field(default=12.0, description="for `sharp_turns`")


@dataclass(frozen=True, config=STRICT)
class DetectionSettings:
    """Which landmarks are measured, and how well."""

    noise_scale: NonNegative = Field(
        default=1.0, description="drawn over stated noise, of pixels and odometry; 0: exact"
    )
    features: Features = Field(default=100, description="most landmarks measured in a frame")
    probability: Chance = Field(default=0.85, description="that a landmark in view is found")


@dataclass(frozen=True, config=STRICT)
class WhiteWheelOdometrySettings(WheelOdometrySettings):
    """The rendered lab's wheels, by default without scale errors: each step errs by itself."""

    scale_error: ScaleError = Field(default=0.0, description=_SCALE_ERROR)


@dataclass(frozen=True, config=STRICT)
class OdometryFaultSettings:
    """Wheels that report the wrong motion for a while, flagged nowhere."""

    start: Count = Field(description="first step with the fault (into this frame)")
    frames: Count = Field(default=10, description="how many steps")
    scale: Factor = Field(default=0.5, description="reported over true motion, way and turn")


@dataclass(frozen=True, config=STRICT)
class BlackoutSettings:
    """Blocked cameras: frames without any observation."""

    start: Count = Field(description="first blocked frame")
    frames: Count = Field(default=30, description="how many frames")


@dataclass(frozen=True, config=STRICT)
class SimulatedMeasurementsSettings(FrameSelection):
    """A simulated drive without images (docs/datasets/rendered.md)."""

    kind: Literal["simulated_measurements"] = "simulated_measurements"
    world: MeasurementWorldSettings = MeasurementWorldSettings()
    drive: MeasurementDriveSettings = MeasurementDriveSettings()
    rig: LabRigSettings = LabRigSettings()
    detection: DetectionSettings = DetectionSettings()
    odometry: WhiteWheelOdometrySettings = WhiteWheelOdometrySettings()
    outlier_fraction: Annotated[float, Field(ge=0.0, le=0.9)] = Field(
        default=0.0,
        description="share of wrong matches: another landmark's, or anywhere, half each",
    )
    odometry_fault: OdometryFaultSettings | None = None
    blackout: BlackoutSettings | None = None


# --------------------------------------------------------------------------------------------
# Homings of bearings alone


@dataclass(frozen=True, config=STRICT)
class SimulatedBearingsSettings:
    """A room of points, a start, a target, and a robot that drives from one towards the other."""

    features: Annotated[int, Field(ge=3)] = Field(
        default=30, description="points matched rightly; wrong matches come on top"
    )
    part: Annotated[float, Field(gt=0.0, lt=1.0)] = Field(
        default=0.8, description="part of the way after which the drive ends"
    )
    images_per_s: Positive = Field(default=10.0, description="tracked images a second (paper: 10)")
    lost_per_s: NonNegative = Field(default=0.02, description="part of the tracks, a second")
