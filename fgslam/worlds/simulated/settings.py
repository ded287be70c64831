"""Settings of simulated measurements: the world, the drive, the noise, the faults; and homings."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, Count, FrameSelection, Index, NonNegative, Positive
from fgslam.worlds.lab_settings import DriveLimits, LabRigSettings, WheelOdometrySettings


@dataclass(frozen=True, config=STRICT)
class MeasurementWorldSettings:
    """Landmarks without appearance, on the surfaces of a place."""

    place: Literal["room", "corridor"] = Field(
        default="room",
        description="`room`: the lab's walls and furniture; `corridor`: walls along the way",
    )
    landmarks: int = Field(
        default=2500, ge=10, le=1_000_000, description="points in the room, or in 100 m of corridor"
    )
    world_seed: Index = Field(
        default=0, description="where the points lie; the run's seed changes noise only"
    )


@dataclass(frozen=True, config=STRICT)
class MeasurementDriveSettings(DriveLimits):
    """The robot's path and speed."""

    path: Literal["lab_loop", "laps", "sharp_turns", "exploring"] = Field(
        default="lab_loop",
        description="`lab_loop` the paper's; `laps`; `sharp_turns`; `exploring` through corridors",
    )
    frames: Annotated[int, Field(ge=2, le=100_000)] | None = Field(
        default=249,
        description="number of frames; null: one way at nine tenths of the speed limits",
    )
    laps: int = Field(default=1, ge=1, le=1000, description="rounds, for `laps`")
    length_m: float = Field(
        default=200.0, ge=30.0, le=10_000.0, description="least way, metres, for `exploring`"
    )
    turn_deg_per_frame: float = Field(
        default=12.0, gt=0.0, le=45.0, description="turn a frame, degrees, for `sharp_turns`"
    )


@dataclass(frozen=True, config=STRICT)
class DetectionSettings:
    """Which landmarks are measured, how well, and how long they keep their identity."""

    pixel_sigma: Positive = Field(
        default=0.2, description="noise of one coordinate in each image, as stereo.pixel_sigma"
    )
    noise_scale: NonNegative = Field(
        default=1.0, description="drawn over stated noise, of pixels and odometry; 0: exact"
    )
    features: int = Field(
        default=100, ge=1, le=10_000, description="most landmarks measured in a frame"
    )
    probability: float = Field(
        default=0.85, gt=0.0, le=1.0, description="that a landmark in view is found in a frame"
    )
    max_range_m: float = Field(
        default=8.0, gt=0.1, description="landmarks farther than this are not in view, metres"
    )


@dataclass(frozen=True, config=STRICT)
class WhiteWheelOdometrySettings(WheelOdometrySettings):
    """The rendered lab's wheels, by default without scale errors: each step errs by itself."""

    distance_scale: float = Field(
        default=0.0, ge=0.0, le=0.5, description="constant relative error of distance, per drive"
    )
    turn_scale: float = Field(
        default=0.0, ge=0.0, le=0.5, description="constant relative error of turns, per drive"
    )


@dataclass(frozen=True, config=STRICT)
class OdometryFaultSettings:
    """Wheels that report the wrong motion for a while, flagged nowhere."""

    start: Count = Field(description="first step with the fault (into this frame)")
    frames: Count = Field(default=10, description="how many steps")
    scale: float = Field(
        default=0.5, ge=-2.0, le=5.0, description="reported over true motion, way and turn"
    )


@dataclass(frozen=True, config=STRICT)
class BlackoutSettings:
    """Blocked cameras: frames without any observation."""

    start: Count = Field(description="first blocked frame")
    frames: Count = Field(default=30, description="how many frames")


@dataclass(frozen=True, config=STRICT)
class MovedLandmarksSettings:
    """Landmarks that are somewhere else from one frame on."""

    frame: Count = Field(description="from this frame on")
    fraction: float = Field(default=0.1, gt=0.0, le=1.0, description="of all landmarks")
    distance_m: Positive = Field(default=0.5, description="moved so far, level, in any direction")


@dataclass(frozen=True, config=STRICT)
class SimulatedMeasurementsSettings(FrameSelection):
    """A simulated drive without images (docs/datasets/simulated_measurements.md)."""

    kind: Literal["simulated_measurements"] = "simulated_measurements"
    world: MeasurementWorldSettings = MeasurementWorldSettings()
    drive: MeasurementDriveSettings = MeasurementDriveSettings()
    rig: LabRigSettings = LabRigSettings()
    detection: DetectionSettings = DetectionSettings()
    odometry: WhiteWheelOdometrySettings = WhiteWheelOdometrySettings()
    outlier_fraction: float = Field(
        default=0.0,
        ge=0.0,
        le=0.9,
        description="share of wrong matches: another landmark's, or anywhere, half each",
    )
    odometry_fault: OdometryFaultSettings | None = None
    blackout: BlackoutSettings | None = None
    moved: MovedLandmarksSettings | None = None


# --------------------------------------------------------------------------------------------
# Homings of bearings alone


@dataclass(frozen=True, config=STRICT)
class SimulatedBearingsSettings:
    """A room of points, a start, a target, and a robot that drives from one towards the other."""

    features: int = Field(
        default=30, ge=3, description="points that are matched rightly; wrong matches come on top"
    )
    surrounding: Literal["isotropic", "anisotropic"] = Field(
        default="isotropic",
        description="`isotropic`: all around; `anisotropic`: four in five near on one side",
    )
    leg_m: Positive = Field(
        default=2.0, description="from start to target, metres (paper: about 2 m)"
    )
    part: float = Field(
        default=0.8, gt=0.0, lt=1.0, description="part of the way after which the drive ends"
    )
    images_per_s: Positive = Field(default=10.0, description="tracked images a second (paper: 10)")
    bearing_sigma_deg: Positive = Field(default=1.0, description="noise of all bearings (0.5 to 1)")
    elevation_sigma_deg: Positive = Field(default=1.0, description="noise of all elevations")
    tracked_elevations: bool = Field(
        default=False, description="images on the way state elevations, too"
    )
    lost_per_s: NonNegative = Field(
        default=0.02, description="part of the tracks that get lost in a second"
    )
