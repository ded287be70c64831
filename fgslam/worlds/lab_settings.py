"""Settings of the rendered lab: rig, drive, wheel odometry and effects (Se et al. 2.2 and 5)."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, Degrees, FrameSelection, Index, Share

PlaceName: TypeAlias = Literal["lab", "rooms", "corridors"]
PathName: TypeAlias = Literal["paper_loop", "laps", "waypoints", "tour", "one_way", "random_poses"]
FrameRange = tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]]


@dataclass(frozen=True, config=STRICT)
class LabRigSettings:
    """The cameras: the right one is the reference, left beside it, top above it."""

    width: int = Field(default=320, ge=16, le=4096, description="image width, pixels")
    height: int = Field(default=240, ge=16, le=4096, description="image height, pixels")
    horizontal_fov_deg: float = Field(
        default=60.0, gt=5.0, lt=150.0, description="width of the field of view, degrees"
    )
    baseline_m: float = Field(
        default=0.10, gt=0.0, le=2.0, description="right to left camera, metres"
    )
    vertical_baseline_m: Annotated[float, Field(gt=0.0, le=2.0)] | None = Field(
        default=0.10, description="right to top camera, metres; null for a two-camera rig"
    )
    ahead_m: float = Field(
        default=0.25,
        ge=-1.0,
        le=1.0,
        description="reference camera ahead of the robot's centre, metres",
    )
    aside_m: float = Field(
        default=0.0,
        ge=-1.0,
        le=1.0,
        description="reference camera left of the robot's centre, metres",
    )
    above_m: float = Field(
        default=1.0, gt=0.05, le=2.5, description="reference camera above the floor, metres"
    )
    tilt_deg: float = Field(
        default=0.0, ge=-45.0, le=45.0, description="upward tilt of the cameras, degrees"
    )


@dataclass(frozen=True, config=STRICT)
class RandomPosesSettings:
    """Poses all over the free floor, in any heading: those of a robot that was carried away."""

    seed: Index = Field(default=0, description="of the poses; not the run's seed")
    burst: int = Field(
        default=1, ge=1, le=100, description="consecutive frames from each pose on, straight ahead"
    )
    clearance_m: float = Field(
        default=0.4,
        ge=0.15,
        le=2.0,
        description="of robot and camera from walls and furniture, metres",
    )


@dataclass(frozen=True, config=STRICT)
class DriveLimits:
    """How fast the robot drives, and how often it takes images."""

    frame_rate_hz: float = Field(default=2.0, gt=0.0, le=120.0, description="frames a second")
    max_speed_m_s: float = Field(default=0.40, gt=0.0, le=5.0, description="limit, metres a second")
    max_turn_deg_s: Degrees = Field(default=10.0, description="limit, degrees a second")


@dataclass(frozen=True, config=STRICT)
class LabDriveSettings(DriveLimits):
    """The robot's path and speed."""

    path: PathName = Field(
        default="paper_loop",
        description="lab: `paper_loop`, `laps`; rooms: `tour`; corridors: `tour`, `one_way`; "
        "any: the others",
    )
    frames: Annotated[int, Field(ge=2, le=100_000)] | None = Field(
        default=249, description="number of frames; null: at nine tenths of the speed limits"
    )
    laps: int = Field(
        default=1,
        ge=1,
        le=1000,
        description="times around the room, for `laps`; rounds of a `tour`",
    )
    waypoints_m: tuple[tuple[float, float], ...] = Field(
        default=(), description="(x, y) in the room, metres from its centre, for `waypoints`"
    )
    closed: bool = Field(
        default=False, description="for `waypoints`: return to the first point and heading"
    )
    random_poses: RandomPosesSettings = Field(
        default=RandomPosesSettings(), description="for `random_poses`: how they are drawn"
    )
    world_from: Literal["paper_loop", "laps", "waypoints", "tour", "one_way"] | None = Field(
        default=None,
        description="drive whose first camera frame is the truth's world; null: this one",
    )


@dataclass(frozen=True, config=STRICT)
class WheelOdometrySettings:
    """Drift of the wheel odometry, one standard deviation each.

    Noise that grows with the root of the way makes independent increments, however the way is cut
    into frames; the scale errors are drawn once a drive, as of worn or unequal wheels.
    """

    distance_scale: float = Field(
        default=0.01, ge=0.0, le=0.5, description="constant relative error of distance, per drive"
    )
    turn_scale: float = Field(
        default=0.01, ge=0.0, le=0.5, description="constant relative error of turns, per drive"
    )
    distance_m_sqrt_m: Share = Field(
        default=0.02, description="along the way, metres per root metre"
    )
    sideways_m_sqrt_m: Share = Field(
        default=0.01, description="across the way, metres per root metre"
    )
    yaw_deg_sqrt_m: float = Field(
        default=0.5, ge=0.0, le=45.0, description="heading, degrees per root metre driven"
    )
    yaw_deg_sqrt_rad: float = Field(
        default=0.8, ge=0.0, le=45.0, description="heading, degrees per root radian turned"
    )


@dataclass(frozen=True, config=STRICT)
class LabExposureSettings:
    """A camera's automatic exposure: a slow wave of the gain and one sudden jump."""

    wave: float = Field(default=0.15, ge=0.0, lt=0.9, description="amplitude of the gain's wave")
    jump: float = Field(
        default=0.7, gt=0.1, lt=5.0, description="factor of the gain after the jump"
    )


@dataclass(frozen=True, config=STRICT)
class LabBlurSettings:
    """Motion blur: the mean of several renders while the shutter is open."""

    exposure_s: float = Field(default=0.03, gt=0.0, le=0.5, description="shutter time, seconds")


@dataclass(frozen=True, config=STRICT)
class LabPersonSettings:
    """A person who walks through the cameras' view, from its right to its left."""

    first_frame: Index = Field(default=20, description="frame at which the person enters")
    frames: int = Field(default=12, ge=2, description="frames until the person has left")


@dataclass(frozen=True, config=STRICT)
class LabEffectsSettings:
    """Disturbances of the images; each null or zero when off."""

    noise_grey: float = Field(
        default=1.5, ge=0.0, le=50.0, description="Gaussian image noise, grey levels"
    )
    exposure: LabExposureSettings | None = None
    motion_blur: LabBlurSettings | None = None
    person: LabPersonSettings | None = None
    blocked_frames: FrameRange | None = Field(
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
    room_seed: Index = Field(default=0, description="seed of the room's textures and small things")
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
