"""Settings of simulated measurements: the world, the drive, the noise, the faults; and homings."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, FrameSelection
from fgslam.worlds.lab_settings import DriveLimits, LabRigSettings, WheelOdometrySettings

Correlation: TypeAlias = Annotated[float, Field(gt=-1.0, lt=1.0)]


@dataclass(frozen=True, config=STRICT)
class MeasurementWorldSettings:
    """Landmarks without appearance, on the surfaces of a place."""

    place: Annotated[
        Literal["room", "corridor"],
        Field(description="`room`: the lab's walls and furniture; `corridor`: walls along the way"),
    ] = "room"
    landmarks: Annotated[
        int, Field(ge=10, le=1_000_000, description="points in the room, or in 100 m of corridor")
    ] = 2500
    world_seed: Annotated[
        int, Field(ge=0, description="where the points lie; the run's seed changes noise only")
    ] = 0


@dataclass(frozen=True, config=STRICT)
class MeasurementDriveSettings(DriveLimits):
    """The robot's path and speed."""

    path: Annotated[
        Literal["lab_loop", "laps", "sharp_turns", "exploring"],
        Field(
            description="`lab_loop` the paper's; `laps`; `sharp_turns`; `exploring` through "
            "corridors"
        ),
    ] = "lab_loop"
    frames: Annotated[
        Annotated[int, Field(ge=2, le=100_000)] | None,
        Field(description="number of frames; null: one way at nine tenths of the speed limits"),
    ] = 249
    laps: Annotated[int, Field(ge=1, le=1000, description="rounds, for `laps`")] = 1
    length_m: Annotated[
        float, Field(ge=30.0, le=10_000.0, description="least way, metres, for `exploring`")
    ] = 200.0
    turn_deg_per_frame: Annotated[
        float, Field(gt=0.0, le=45.0, description="turn a frame, degrees, for `sharp_turns`")
    ] = 12.0


@dataclass(frozen=True, config=STRICT)
class DetectionSettings:
    """Which landmarks are measured, how well, and how long they keep their identity."""

    pixel_sigma: Annotated[
        float,
        Field(gt=0.0, description="noise of one coordinate in each image, as stereo.pixel_sigma"),
    ] = 0.2
    noise_scale: Annotated[
        float,
        Field(ge=0.0, description="drawn over stated noise, of pixels and odometry; 0: exact"),
    ] = 1.0
    features: Annotated[
        int, Field(ge=1, le=10_000, description="most landmarks measured in a frame")
    ] = 100
    probability: Annotated[
        float, Field(gt=0.0, le=1.0, description="that a landmark in view is found in a frame")
    ] = 0.85
    max_range_m: Annotated[
        float, Field(gt=0.1, description="landmarks farther than this are not in view, metres")
    ] = 8.0


@dataclass(frozen=True, config=STRICT)
class WhiteWheelOdometrySettings(WheelOdometrySettings):
    """The rendered lab's wheels, by default without scale errors: each step errs by itself."""

    distance_scale: Annotated[
        float, Field(ge=0.0, le=0.5, description="constant relative error of distance, per drive")
    ] = 0.0
    turn_scale: Annotated[
        float, Field(ge=0.0, le=0.5, description="constant relative error of turns, per drive")
    ] = 0.0


@dataclass(frozen=True, config=STRICT)
class OdometryFaultSettings:
    """Wheels that report the wrong motion for a while, flagged nowhere."""

    start: Annotated[int, Field(ge=1, description="first step with the fault (into this frame)")]
    frames: Annotated[int, Field(ge=1, description="how many steps")] = 10
    scale: Annotated[
        float, Field(ge=-2.0, le=5.0, description="reported over true motion, way and turn")
    ] = 0.5


@dataclass(frozen=True, config=STRICT)
class BlackoutSettings:
    """Blocked cameras: frames without any observation."""

    start: Annotated[int, Field(ge=1, description="first blocked frame")]
    frames: Annotated[int, Field(ge=1, description="how many frames")] = 30


@dataclass(frozen=True, config=STRICT)
class MovedLandmarksSettings:
    """Landmarks that are somewhere else from one frame on."""

    frame: Annotated[int, Field(ge=1, description="from this frame on")]
    fraction: Annotated[float, Field(gt=0.0, le=1.0, description="of all landmarks")] = 0.1
    distance_m: Annotated[
        float, Field(gt=0.0, description="moved so far, level, in any direction")
    ] = 0.5


@dataclass(frozen=True, config=STRICT)
class SimulatedMeasurementsSettings(FrameSelection):
    """A simulated drive without images (docs/datasets/simulated_measurements.md)."""

    kind: Literal["simulated_measurements"] = "simulated_measurements"
    world: MeasurementWorldSettings = MeasurementWorldSettings()
    drive: MeasurementDriveSettings = MeasurementDriveSettings()
    rig: LabRigSettings = LabRigSettings()
    detection: DetectionSettings = DetectionSettings()
    odometry: WhiteWheelOdometrySettings = WhiteWheelOdometrySettings()
    outlier_fraction: Annotated[
        float,
        Field(
            ge=0.0,
            le=0.9,
            description="share of wrong matches: another landmark's, or anywhere, half each",
        ),
    ] = 0.0
    odometry_fault: OdometryFaultSettings | None = None
    blackout: BlackoutSettings | None = None
    moved: MovedLandmarksSettings | None = None


# --------------------------------------------------------------------------------------------
# Homings of bearings alone


@dataclass(frozen=True, config=STRICT)
class SimulatedBearingsSettings:
    """A room of points, a start, a target, and a robot that drives from one towards the other."""

    features: Annotated[
        int,
        Field(ge=3, description="points that are matched rightly; wrong matches come on top"),
    ] = 30
    surrounding: Annotated[
        Literal["isotropic", "anisotropic"],
        Field(description="`isotropic`: all around; `anisotropic`: four in five near on one side"),
    ] = "isotropic"
    leg_m: Annotated[
        float, Field(gt=0.0, description="from start to target, metres (paper: about 2 m)")
    ] = 2.0
    part: Annotated[
        float, Field(gt=0.0, lt=1.0, description="part of the way after which the drive ends")
    ] = 0.8
    images_per_s: Annotated[
        float, Field(gt=0.0, description="tracked images a second (paper: 10)")
    ] = 10.0
    bearing_sigma_deg: Annotated[
        float, Field(gt=0.0, description="noise of all bearings (0.5 to 1)")
    ] = 1.0
    elevation_sigma_deg: Annotated[float, Field(gt=0.0, description="noise of all elevations")] = (
        1.0
    )
    tracked_elevations: Annotated[
        bool, Field(description="images on the way state elevations, too")
    ] = False
    lost_per_s: Annotated[
        float, Field(ge=0.0, description="part of the tracks that get lost in a second")
    ] = 0.02
