"""A wheelchair: a unicycle with limits, latency and slip, a body that walls stop, range finders."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.planar import unit, wrap
from fgslam.worlds.rendering.patches import RayCaster

_STEP_S = 0.01
# Of an electric wheelchair indoors: half a metre a second squared is what its passenger takes
# without holding on.
MAX_ACCELERATION_M_S2 = 0.5
MAX_TURN_ACCELERATION_DEG_S2 = 120.0
MAX_SPEED_M_S, MAX_TURN_DEG_S = 0.5, 45.0  # one that is driven slowly
# Deviations of what is drawn once a drive: relative errors of speed and of turns, and the turn a
# metre that nobody asked for.
SPEED_SCALE, TURN_SCALE, PULL_DEG_M = 0.03, 0.03, 1.0
SLIP_M_SQRT_M, SLIP_DEG_SQRT_M = 0.02, 1.0
"""Noise along the way, metres, and of the heading, degrees, per root metre."""
LATENCY_S = 0.1
"""From a command to its effect."""
RADIUS_M = 0.35
"""Of the disc that must not touch anything; a door is twice as wide and a half."""

Blocked = Callable[[FloatArray], bool]
"""Whether the wheelchair, its middle at a place (2,), would touch something."""


class Wheelchair:
    """True motion under commands.

    Attributes:
        pose: (3,) true planar pose.
        speed, turn_rate: as the wheels turn now, before slip; m/s and rad/s.
        time: seconds since the start.
        collided: whether an obstacle stopped it in the last :meth:`advance`.
    """

    def __init__(
        self, pose: FloatArray, rng: np.random.Generator, blocked: Blocked | None = None
    ) -> None:
        """Stands still at ``pose``; the errors of this drive are drawn from ``rng``."""
        self._rng = rng
        self._blocked: Blocked = blocked or (lambda _place: False)
        self.pose = np.array(pose, dtype=np.float64)
        self.speed, self.turn_rate, self.time = 0.0, 0.0, 0.0
        self.collided = False
        drawn = rng.standard_normal(3)
        self._speed_scale = 1.0 + SPEED_SCALE * drawn[0]
        self._turn_scale = 1.0 + TURN_SCALE * drawn[1]
        self._pull = np.deg2rad(PULL_DEG_M) * drawn[2]
        self._pending: deque[tuple[float, float, float]] = deque()
        self._aim = (0.0, 0.0)
        self._steps, self._asked = 0, 0.0

    def command(self, speed: float, turn_rate: float) -> None:
        """Asks for a speed (m/s) and turn rate (rad/s); it takes effect after the latency.

        Raises:
            ValueError: a number is not finite.
        """
        if not (np.isfinite(speed) and np.isfinite(turn_rate)):
            raise ValueError(f"command ({speed}, {turn_rate}) is not finite")
        top = np.deg2rad(MAX_TURN_DEG_S)
        limited = float(np.clip(speed, -MAX_SPEED_M_S, MAX_SPEED_M_S))
        turn = float(np.clip(turn_rate, -top, top))
        self._pending.append((self.time + LATENCY_S, limited, turn))

    def advance(self, seconds: float) -> None:
        """Moves on, in steps of a hundredth of a second; what is left over is made up for later.

        Raises:
            ValueError: the time does not go forwards.
        """
        if not seconds > 0.0:
            raise ValueError(f"time must go forwards, got a step of {seconds} s")
        touched = False
        self._asked += seconds
        for _ in range(round(self._asked / _STEP_S) - self._steps):
            touched |= self._step()
        self.collided = touched

    def _step(self) -> bool:
        while self._pending and self._pending[0][0] <= self.time + 1e-9:
            self._aim = self._pending.popleft()[1:]
        gain = MAX_ACCELERATION_M_S2 * _STEP_S
        turn_gain = np.deg2rad(MAX_TURN_ACCELERATION_DEG_S2) * _STEP_S
        self.speed += float(np.clip(self._aim[0] - self.speed, -gain, gain))
        self.turn_rate += float(np.clip(self._aim[1] - self.turn_rate, -turn_gain, turn_gain))
        self._steps += 1
        self.time = self._steps * _STEP_S
        way, turn = self._slipped(self.speed * _STEP_S, self.turn_rate * _STEP_S)
        middle = self.pose[2] + 0.5 * turn
        place = self.pose[:2] + way * np.array([np.cos(middle), np.sin(middle)])
        self.pose[2] = wrap(self.pose[2] + turn)
        if way != 0.0 and self._blocked(place):
            self.speed = 0.0
            return True
        self.pose[:2] = place
        return False

    def _slipped(self, way: float, turn: float) -> tuple[float, float]:
        """What the floor makes of a small motion of the wheels."""
        noise = self._rng.standard_normal(2)
        root = np.sqrt(abs(way))
        true_way = way * self._speed_scale + SLIP_M_SQRT_M * root * noise[0]
        drift = self._pull * abs(way) + np.deg2rad(SLIP_DEG_SQRT_M) * root * noise[1]
        return float(true_way), float(turn * self._turn_scale + drift)


# --------------------------------------------------------------------------------------------
# Range finders


BEAMS = 32
"""Evenly spread, the first ahead: as many as the sonars below the paper's obstacle avoidance."""
MAX_RANGE_M = 5.0
NOISE_M = 0.02
_HEIGHTS_M = (0.15, 0.45, 0.72, 1.0)  # of chair legs, seats, table tops and shelves


class RangeSensor:
    """Measures how far things are, from the wheelchair's middle.

    A beam reports the nearest of what it meets at several heights, so that table tops are seen.
    """

    def __init__(self, caster: RayCaster, noise_m: float = NOISE_M) -> None:
        """Scans the scene of ``caster``; ``noise_m`` is the standard deviation of a range."""
        self._caster, self._noise_m = caster, noise_m
        angle = 2.0 * np.pi * np.arange(BEAMS) / BEAMS
        self.angles: FloatArray = wrap(angle)

    def scan(
        self, pose: FloatArray, discs: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Angles (n,) in the robot's axes, radians, and ranges (n,), metres.

        A range of ``MAX_RANGE_M`` means that nothing was seen.

        Args:
            pose: (3,) true pose.
            discs: (k, 3) x, y and radius of people.
            rng: of the noise.
        """
        direction = unit(self.angles + pose[2])
        ranges = np.minimum(self._to_things(pose, direction), _to_discs(pose[:2], direction, discs))
        seen = ranges < MAX_RANGE_M
        noise = self._noise_m * rng.standard_normal(BEAMS)
        noisy = np.clip(ranges + noise, 0.0, MAX_RANGE_M)
        return self.angles.copy(), np.where(seen, noisy, MAX_RANGE_M)

    def _to_things(self, pose: FloatArray, direction: FloatArray) -> FloatArray:
        rays = np.column_stack([direction, np.zeros(len(direction))]).astype(np.float32)
        nearest = np.full(len(rays), np.inf)
        for height in _HEIGHTS_M:
            _, distance = self._caster.cast(np.array([pose[0], pose[1], height]), rays)
            nearest = np.minimum(nearest, distance)
        return nearest


def _to_discs(place: FloatArray, direction: FloatArray, discs: FloatArray) -> FloatArray:
    """(n,) distance along unit directions (n, 2) to upright cylinders; 0 inside one."""
    nearest = np.full(len(direction), np.inf)
    for x, y, radius in discs:
        offset = np.array([x, y]) - place
        along = direction @ offset
        aside2 = np.sum(offset * offset) - along**2
        hit = (aside2 < radius**2) & (along > 0.0)
        distance = along - np.sqrt(np.maximum(radius**2 - aside2, 0.0))
        nearest = np.where(hit, np.minimum(nearest, np.maximum(distance, 0.0)), nearest)
    return nearest
