"""From the direction of home to the wheels of a unicycle: turn towards it, then drive."""

from __future__ import annotations

import numpy as np

from fgslam.homing.command import Command, Drive, HomingState
from fgslam.homing.settings import SteeringSettings

_TURN_IN_PLACE_DEG = 60.0
"""Home farther off than this: turn without driving, until it is within half of it."""

_GAIN_PER_S = 1.2
"""Turning rate over the direction of home; slow against the delay of 0.1 s between image and
wheels."""

_BLIND_SHARE = 0.4  # of the speed, without tracks
_PASSING_SHARE = 0.6  # of the speed, at targets on the way
_LEAST_SHARE = 0.25  # of the speed, at the last target
_SLOW_FRACTION = 0.3  # part of the leg that is left from which on the robot slows down

_BEHIND = np.deg2rad(150.0)  # from here on both ways round are as long; noise must not choose


class Steering:
    """Proportional steering with limits on rates and on their change.

    Speed follows the cosine of home's direction, so that the robot drives arcs where home is
    nearly ahead and turns on the spot where it is not. It slows down towards the last target;
    between targets less, for a smooth way (IV: "a smooth trajectory").
    """

    def __init__(self, settings: SteeringSettings) -> None:
        self._settings = settings
        self._speed, self._turn_rate = 0.0, 0.0
        self._turning = False

    def step(self, command: Command, dt: float) -> Drive:
        """Speed and turning rate for the next ``dt`` seconds."""
        s = self._settings
        if command.stop:
            wanted_speed, wanted_rate = 0.0, 0.0
            self._turning = False
        else:
            wanted_rate = self._turn(command.heading)
            wanted_speed = self._forward(command)
        self._speed = _towards(self._speed, wanted_speed, s.acceleration_mps2 * dt)
        most = np.deg2rad(s.turn_acceleration_deg_s2) * dt
        self._turn_rate = _towards(self._turn_rate, wanted_rate, most)
        return Drive(self._speed, self._turn_rate)

    def driven(self, drive: Drive) -> None:
        """What was commanded in the end, where avoidance overrode: limits start from there."""
        self._speed, self._turn_rate = drive.speed, drive.turn_rate

    def _turn(self, heading: float) -> float:
        s = self._settings
        if abs(heading) > _BEHIND and self._turn_rate != 0.0:
            heading = float(np.copysign(heading, self._turn_rate))
        limit = np.deg2rad(s.max_turn_deg_s)
        return float(np.clip(_GAIN_PER_S * heading, -limit, limit))

    def _forward(self, command: Command) -> float:
        s = self._settings
        limit = np.deg2rad(_TURN_IN_PLACE_DEG)
        # Two thresholds: with one, noise would switch between turning and driving.
        self._turning = abs(command.heading) > (0.5 * limit if self._turning else limit)
        if self._turning:
            return 0.0
        ahead = max(float(np.cos(command.heading)), 0.0)
        return s.max_speed_mps * ahead * self._share(command)

    def _share(self, command: Command) -> float:
        if command.state in (HomingState.BLIND, HomingState.SEARCH):
            return _BLIND_SHARE
        least = _LEAST_SHARE if command.final else _PASSING_SHARE
        return float(np.clip(command.remaining / _SLOW_FRACTION, least, 1.0))


def _towards(now: float, wanted: float, most: float) -> float:
    return now + float(np.clip(wanted - now, -most, most))
