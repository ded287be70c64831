"""A robot that homing sends into a dead end finds out of it."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray
from fgslam.core.planar import to_robot, wrap
from fgslam.homing.command import Drive
from fgslam.homing.settings import AvoidanceSettings
from fgslam.homing.steering import CorridorAvoidance, RangeScan

BEAMS = np.linspace(-np.pi, np.pi, 72, endpoint=False)


def dead_end() -> FloatArray:
    """(n, 2) points of a pocket that opens to the west, its end at x = 1.

    It is as wide as the bare robot with 6 cm on either side: too narrow for a corridor.
    """
    along = np.arange(0.0, 1.0, 0.05)
    sides = [np.column_stack([along, np.full(len(along), y)]) for y in (-0.41, 0.41)]
    across = np.arange(-0.41, 0.41, 0.05)
    return np.vstack([*sides, np.column_stack([np.ones(len(across)), across])])


def scan_from(pose: FloatArray, points: FloatArray) -> RangeScan:
    seen = to_robot(pose, points)
    bearing, distance = np.arctan2(seen[:, 1], seen[:, 0]), np.hypot(*seen.T)
    ranges = np.full(len(BEAMS), np.inf)
    for k, beam in enumerate(BEAMS):
        near = np.abs(wrap(bearing - beam)) < np.pi / 72
        ranges[k] = distance[near].min(initial=np.inf)
    return RangeScan(BEAMS, ranges)


def drive() -> FloatArray:
    """(k, 2) places while homing points east, through the pocket's end, for 40 s."""
    avoider = CorridorAvoidance(AvoidanceSettings(), 40.0)
    pose, places = np.array([0.4, 0.0, 0.0]), []
    for _ in range(400):
        heading = float(wrap(np.arctan2(-pose[1], 5.0 - pose[0]) - pose[2]))
        wanted = Drive(0.4, 1.5 * heading, False)
        done = avoider.override(wanted, heading, scan_from(pose, dead_end()))
        pose = pose + 0.1 * np.array(
            [done.speed * np.cos(pose[2]), done.speed * np.sin(pose[2]), done.turn_rate]
        )
        places.append(pose[:2].copy())
    return np.array(places)


def test_held_up_robot_leaves_the_pocket_and_touches_nothing() -> None:
    places = drive()
    assert np.min(places[:, 0]) < -0.3
    nearest = np.hypot(*(places[:, None] - dead_end()).transpose(2, 0, 1)).min(axis=1)
    assert np.min(nearest) > 0.35


def test_robot_that_does_not_escape_stays_in_the_pocket(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fgslam.homing.steering._ESCAPE_AFTER", 10_000)
    places = drive()
    assert np.min(places[:, 0]) > 0.0
