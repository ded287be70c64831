"""What a homing commands after every image."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from fgslam.core.arrays import FloatArray
from fgslam.core.homing import Refusal, TwoViewVector

SURE = 0.9  # probability from which a place on a path counts as known


class HomingState(str, Enum):
    """Where a homing stands; the value is written into files."""

    INITIALISE = "initialise"
    """Standing: the target is not matched yet."""
    DRIVE = "drive"
    CONFIRM = "confirm"
    """Standing: a new homing vector contradicts the estimate."""
    BLIND = "blind"
    """Slowly straight on: there are no tracks, and the target is not matched anew yet."""
    WAIT = "wait"
    """Standing: the same, after the longest blind drive."""
    SEARCH = "search"
    """Slowly straight on: where it stood the target was refused, from elsewhere it may not be."""
    ARRIVED = "arrived"
    REFUSED = "refused"


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """The interface to what drives the robot.

    Attributes:
        time: of the image, seconds.
        state: of the homing.
        heading: direction of home from the robot's heading, radians; 0 where it is not known.
        remaining: part of the leg that is left: 1 where it began; its last known value while
            there is no estimate.
        rotation: heading of the target minus the present one, radians; NaN while not known.
        covariance: (3, 3) of (remaining, heading, rotation); NaN while there is no estimate.
        stop: the robot must stand.
        reason: one clause: why the state is what it is.
        target: number of the target image.
        final: it is the path's last one.
        refusal: why the homing ended, in state REFUSED.
    """

    time: float
    state: HomingState
    heading: float
    remaining: float
    rotation: float
    covariance: FloatArray
    stop: bool
    reason: str
    target: int = 0
    final: bool = True
    refusal: Refusal | None = None


@dataclass(frozen=True, slots=True)
class Drive:
    """Speed (m/s) and turning rate (rad/s, counter-clockwise); whether avoidance changed them."""

    speed: float
    turn_rate: float
    overridden: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class MetricPlace:
    """Where that is in metres, on a path whose images carry poses.

    Attributes:
        position: (3,) in the world of these poses, on the straight line between two path images.
        sigma: of it along the path and as the poses are known, metres.
        to_target: metres to the next path image.
    """

    position: FloatArray
    sigma: float
    to_target: float


@dataclass(frozen=True, slots=True, eq=False)
class PathPlace:
    """Where on a path one image was taken.

    Attributes:
        nearest: number of the path image that is probably the nearest one.
        probability: that it, or the one before or after it, is.
        target: number of the path image to go to next.
        vector: from the image to the target; None where it is refused.
        refusal: why, in words; empty where there is a vector.
        remaining: part of the way between path images that is left, roughly: by parallax.
        reached: the path's end is.
        metric: the same in metres; None where it is not known.
    """

    nearest: int
    probability: float
    target: int
    vector: TwoViewVector | None
    refusal: str
    remaining: float
    reached: bool
    metric: MetricPlace | None = None

    @property
    def sure(self) -> bool:
        """Whether the place is known."""
        return self.probability >= SURE


@dataclass(frozen=True, slots=True, eq=False)
class DriveCommand:
    """Speed and turning rate commanded after one image.

    Attributes:
        v: speed, m/s, forward.
        omega: turning rate, rad/s, counter-clockwise.
        homing: where home is and how sure that is; the properties below are of it.
        place: where on the path the image was taken; None where that was not looked for.
    """

    v: float
    omega: float
    homing: Command
    place: PathPlace | None = None

    @property
    def time(self) -> float:
        """Of the image, seconds."""
        return self.homing.time

    @property
    def state(self) -> HomingState:
        """Of the homing."""
        return self.homing.state

    @property
    def reason(self) -> str:
        """One clause: why the state is what it is."""
        return self.homing.reason

    @property
    def target(self) -> int:
        """Number of the target image that is aimed at, from 0."""
        return self.homing.target

    @property
    def heading(self) -> float:
        """Direction of home from the robot's heading, radians, counter-clockwise."""
        return self.homing.heading

    @property
    def remaining(self) -> float:
        """Part of the leg that is left: 1 where it began."""
        return self.homing.remaining
