"""Settings of the rendered lab: rig, drive, wheel odometry and effects (Se et al. 2.2 and 5)."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, FrameSelection

PlaceName: TypeAlias = Literal["lab", "rooms", "corridors"]
PathName: TypeAlias = Literal["paper_loop", "laps", "waypoints", "tour", "one_way", "random_poses"]
FrameRange = tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]


@dataclass(frozen=True, config=STRICT)
class LabRigSettings:
    """The cameras: the right one is the reference, left beside it, top above it."""

    width: Annotated[int, Field(ge=16, le=4096, description="image width, pixels")] = 320
    height: Annotated[int, Field(ge=16, le=4096, description="image height, pixels")] = 240
    horizontal_fov_deg: Annotated[
        float, Field(gt=5.0, lt=150.0, description="width of the field of view, degrees")
    ] = 60.0
    baseline_m: Annotated[
        float, Field(gt=0.0, le=2.0, description="right to left camera, metres")
    ] = 0.10
    vertical_baseline_m: Annotated[
        Annotated[float, Field(gt=0.0, le=2.0)] | None,
        Field(description="right to top camera, metres; null for a two-camera rig"),
    ] = 0.10
    ahead_m: Annotated[
        float,
        Field(ge=-1.0, le=1.0, description="reference camera ahead of the robot's centre, metres"),
    ] = 0.25
    aside_m: Annotated[
        float,
        Field(ge=-1.0, le=1.0, description="reference camera left of the robot's centre, metres"),
    ] = 0.0
    above_m: Annotated[
        float, Field(gt=0.05, le=2.5, description="reference camera above the floor, metres")
    ] = 1.0
    tilt_deg: Annotated[
        float, Field(ge=-45.0, le=45.0, description="upward tilt of the cameras, degrees")
    ] = 0.0


@dataclass(frozen=True, config=STRICT)
class RandomPosesSettings:
    """Poses all over the free floor, in any heading: those of a robot that was carried away."""

    seed: Annotated[int, Field(ge=0, description="of the poses; not the run's seed")] = 0
    burst: Annotated[
        int, Field(ge=1, le=100, description="consecutive frames from each pose on, straight ahead")
    ] = 1
    clearance_m: Annotated[
        float,
        Field(ge=0.15, le=2.0, description="of robot and camera from walls and furniture, metres"),
    ] = 0.4


@dataclass(frozen=True, config=STRICT)
class DriveLimits:
    """How fast the robot drives, and how often it takes images."""

    frame_rate_hz: Annotated[float, Field(gt=0.0, le=120.0, description="frames a second")] = 2.0
    max_speed_m_s: Annotated[float, Field(gt=0.0, le=5.0, description="limit, metres a second")] = (
        0.40
    )
    max_turn_deg_s: Annotated[
        float, Field(gt=0.0, le=180.0, description="limit, degrees a second")
    ] = 10.0


@dataclass(frozen=True, config=STRICT)
class LabDriveSettings(DriveLimits):
    """The robot's path and speed."""

    path: Annotated[
        PathName,
        Field(
            description="lab: `paper_loop`, `laps`; rooms: `tour`; corridors: `tour`, `one_way`; "
            "any: the others"
        ),
    ] = "paper_loop"
    frames: Annotated[
        Annotated[int, Field(ge=2, le=100_000)] | None,
        Field(description="number of frames; null: at nine tenths of the speed limits"),
    ] = 249
    laps: Annotated[
        int,
        Field(ge=1, le=1000, description="times around the room, for `laps`; rounds of a `tour`"),
    ] = 1
    waypoints_m: Annotated[
        tuple[tuple[float, float], ...],
        Field(description="(x, y) in the room, metres from its centre, for `waypoints`"),
    ] = ()
    closed: Annotated[
        bool, Field(description="for `waypoints`: return to the first point and heading")
    ] = False
    random_poses: Annotated[
        RandomPosesSettings, Field(description="for `random_poses`: how they are drawn")
    ] = RandomPosesSettings()
    world_from: Annotated[
        Literal["paper_loop", "laps", "waypoints", "tour", "one_way"] | None,
        Field(description="drive whose first camera frame is the truth's world; null: this one"),
    ] = None


@dataclass(frozen=True, config=STRICT)
class WheelOdometrySettings:
    """Drift of the wheel odometry, one standard deviation each.

    Noise that grows with the root of the way makes independent increments, however the way is cut
    into frames; the scale errors are drawn once a drive, as of worn or unequal wheels.
    """

    distance_scale: Annotated[
        float, Field(ge=0.0, le=0.5, description="constant relative error of distance, per drive")
    ] = 0.01
    turn_scale: Annotated[
        float, Field(ge=0.0, le=0.5, description="constant relative error of turns, per drive")
    ] = 0.01
    distance_m_sqrt_m: Annotated[
        float, Field(ge=0.0, le=1.0, description="along the way, metres per root metre")
    ] = 0.02
    sideways_m_sqrt_m: Annotated[
        float, Field(ge=0.0, le=1.0, description="across the way, metres per root metre")
    ] = 0.01
    yaw_deg_sqrt_m: Annotated[
        float, Field(ge=0.0, le=45.0, description="heading, degrees per root metre driven")
    ] = 0.5
    yaw_deg_sqrt_rad: Annotated[
        float, Field(ge=0.0, le=45.0, description="heading, degrees per root radian turned")
    ] = 0.8


@dataclass(frozen=True, config=STRICT)
class LabExposureSettings:
    """A camera's automatic exposure: a slow wave of the gain and one sudden jump."""

    wave: Annotated[float, Field(ge=0.0, lt=0.9, description="amplitude of the gain's wave")] = 0.15
    jump: Annotated[
        float, Field(gt=0.1, lt=5.0, description="factor of the gain after the jump")
    ] = 0.7


@dataclass(frozen=True, config=STRICT)
class LabBlurSettings:
    """Motion blur: the mean of several renders while the shutter is open."""

    exposure_s: Annotated[float, Field(gt=0.0, le=0.5, description="shutter time, seconds")] = 0.03


@dataclass(frozen=True, config=STRICT)
class LabPersonSettings:
    """A person who walks through the cameras' view, from its right to its left."""

    first_frame: Annotated[int, Field(ge=0, description="frame at which the person enters")] = 20
    frames: Annotated[int, Field(ge=2, description="frames until the person has left")] = 12


@dataclass(frozen=True, config=STRICT)
class LabEffectsSettings:
    """Disturbances of the images; each null or zero when off."""

    noise_grey: Annotated[
        float, Field(ge=0.0, le=50.0, description="Gaussian image noise, grey levels")
    ] = 1.5
    exposure: LabExposureSettings | None = None
    motion_blur: LabBlurSettings | None = None
    person: LabPersonSettings | None = None
    blocked_frames: Annotated[
        FrameRange | None,
        Field(description="[first, last) frames in which a dark cover blocks all cameras"),
    ] = None


@dataclass(frozen=True, config=STRICT)
class LabSettings:
    """The rendered lab, or another place: the robot's drive in it, its cameras and odometry."""

    place: Annotated[
        PlaceName,
        Field(
            description="`lab` 10 m x 10 m; `rooms` office of 36 m x 24 m; `corridors` ring of 24 m"
        ),
    ] = "lab"
    rig: LabRigSettings = LabRigSettings()
    drive: LabDriveSettings = LabDriveSettings()
    odometry: WheelOdometrySettings = WheelOdometrySettings()
    effects: LabEffectsSettings = LabEffectsSettings()
    room_seed: Annotated[
        int, Field(ge=0, description="seed of the room's textures and small things")
    ] = 0
    visit: Annotated[
        Literal[1, 2, 3],
        Field(description="2: chairs and cartons moved; 3: shelves and posters exchanged too"),
    ] = 1
    posters: Annotated[
        Literal["different", "identical"],
        Field(description="`identical`: two posters on different walls are the same"),
    ] = "different"


@dataclass(frozen=True, config=STRICT)
class RenderedLabSettings(LabSettings, FrameSelection):
    """The rendered lab as a recording: which of the drive's frames are used."""

    kind: Literal["rendered_lab"] = "rendered_lab"
