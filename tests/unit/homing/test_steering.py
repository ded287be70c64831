"""Steering of the unicycle, and obstacles that override it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from landmark_world import drive_path, ray_ranges, winding_path

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import to_robot, wrap
from fgslam.homing.settings import HomingBehaviourSettings, SteeringSettings
from fgslam.homing.steering import (
    ACCELERATION_MPS2,
    BLIND_SHARE,
    PASSING_SHARE,
    SLOW_FRACTION,
    TURN_ACCELERATION_DEG_S2,
    TURN_IN_PLACE_DEG,
    Command,
    CorridorAvoidance,
    Drive,
    HomingState,
    RangeScan,
    Steering,
    clear_ways,
)

SETTINGS = SteeringSettings()
DT = 0.1


def command(heading: float = 0.0, remaining: float = 1.0, **changes: object) -> Command:
    """A command to drive."""
    made = Command(
        0.0, HomingState.DRIVE, "", heading=heading, remaining=remaining, rotation=0.0, stop=False
    )
    return replace(made, **changes)  # type: ignore[arg-type]


def settled(steering: Steering, order: Command) -> Drive:
    """After two seconds of one command."""
    return [steering.step(order, DT) for _ in range(20)][-1]


def test_limits_hold_whatever_is_asked() -> None:
    """Speed, turning rate and the change of both."""
    steering, rng = Steering(SETTINGS), np.random.default_rng(1)
    before = Drive(0.0, 0.0)
    for _ in range(300):
        drive = steering.step(command(rng.uniform(-np.pi, np.pi), rng.uniform(0, 1)), DT)
        assert 0.0 <= drive.speed <= SETTINGS.max_speed_mps + 1e-12
        assert abs(drive.turn_rate) <= np.deg2rad(SETTINGS.max_turn_deg_s) + 1e-12
        assert abs(drive.speed - before.speed) <= ACCELERATION_MPS2 * DT + 1e-12
        change = np.rad2deg(abs(drive.turn_rate - before.turn_rate))
        assert change <= TURN_ACCELERATION_DEG_S2 * DT + 1e-9
        before = drive


def test_turns_on_the_spot_until_half_way_round() -> None:
    """Two thresholds, so that noise around one does not switch."""
    steering = Steering(SETTINGS)
    limit = np.deg2rad(TURN_IN_PLACE_DEG)
    assert settled(steering, command(1.01 * limit)).speed == 0.0
    assert settled(steering, command(0.9 * limit)).speed == 0.0
    assert settled(steering, command(0.49 * limit)).speed > 0.0
    assert settled(steering, command(0.9 * limit)).speed > 0.0


def test_slows_down_at_the_last_target_most() -> None:
    """Half the slow part left: half the speed at the last target, more at one on the way."""
    near = 0.5 * SLOW_FRACTION
    last = settled(Steering(SETTINGS), command(0.0, near)).speed
    between = settled(Steering(SETTINGS), command(0.0, near, final=False)).speed
    assert last == pytest.approx(0.5 * SETTINGS.max_speed_mps)
    assert between == pytest.approx(PASSING_SHARE * SETTINGS.max_speed_mps)
    assert settled(Steering(SETTINGS), command(0.0, 0.0)).speed > 0.0


def test_robot_stops_at_a_stop_command() -> None:
    """And drives slowly when blind or searching."""
    steering = Steering(SETTINGS)
    settled(steering, command(0.2))
    stop = command(stop=True, state=HomingState.WAIT)
    assert settled(steering, stop) == Drive(0.0, 0.0)
    for state in (HomingState.BLIND, HomingState.SEARCH):
        slow = settled(steering, command(state=state))
        assert slow.speed == pytest.approx(BLIND_SHARE * SETTINGS.max_speed_mps)


def test_home_behind_is_turned_to_one_way_round() -> None:
    """Noise around 180 degrees must not choose the side anew with every image."""
    steering, heading = Steering(SETTINGS), np.pi
    rng = np.random.default_rng(2)
    rates = []
    for _ in range(60):
        seen = float(wrap(np.array(heading + rng.normal(0.0, 0.1))))
        rates.append(steering.step(command(seen), DT).turn_rate)
        heading -= rates[-1] * DT
    assert len({np.sign(r) for r in rates[2:30]}) == 1
    assert abs(wrap(np.array(heading))) < 0.2


# --------------------------------------------------------------------------------------------
# Avoidance


def scan_of(discs: FloatArray) -> RangeScan:
    """From the origin, looking ahead."""
    angles = np.deg2rad(np.arange(-180.0, 180.0, 2.0))
    return RangeScan(angles, ray_ranges(np.zeros(3), angles, discs, 5.0))


def test_clear_way_is_where_the_robot_touches() -> None:
    """Exactly: a half circle in front against points ahead, beside and behind."""
    points = np.array([[2.0, 0.0], [0.0, 1.0], [-1.0, 0.0]])
    ways = clear_ways(np.deg2rad([0.0, 90.0, 45.0, 180.0]), points, 0.4)
    assert ways == pytest.approx([1.6, 0.6, np.inf, 0.6])
    beside = clear_ways(np.zeros(1), np.array([[2.0, 0.3]]), 0.5)
    assert beside[0] == pytest.approx(2.0 - np.sqrt(0.25 - 0.09))


def test_open_way_is_not_overridden() -> None:
    """Nor is a robot that turns on the spot."""
    avoider, wanted = CorridorAvoidance(40.0), Drive(0.4, 0.1)
    assert avoider.override(wanted, 0.0, scan_of(np.array([[0.0, 2.0, 0.5]]))) == wanted
    turning = Drive(0.0, 0.5)
    assert avoider.override(turning, 2.0, scan_of(np.array([[0.7, 0.0, 0.2]]))) == turning


def test_obstacle_ahead_is_turned_away_from() -> None:
    """To the nearer free side, and back when it is past."""
    avoider = CorridorAvoidance(40.0)
    drive = avoider.override(Drive(0.4, 0.0), 0.0, scan_of(np.array([[0.9, -0.15, 0.3]])))
    assert drive.overridden
    assert drive.turn_rate > 0.0
    assert drive.speed < 0.4
    free = avoider.override(Drive(0.4, 0.0), 0.0, scan_of(np.array([[-1.0, 0.0, 0.3]])))
    assert free == Drive(0.4, 0.0)


def test_walled_in_stands_still_rather_than_hits() -> None:
    """Nothing is free within reach: no speed into the wall."""
    around = np.deg2rad(np.arange(0.0, 360.0, 10.0))
    ring = np.column_stack([0.6 * np.cos(around), 0.6 * np.sin(around), np.full(36, 0.1)])
    drive = CorridorAvoidance(40.0).override(Drive(0.4, 0.0), 0.0, scan_of(ring))
    assert drive.speed < 0.1


def test_failed_beams_are_passed_over() -> None:
    """NaN and infinity are no obstacles."""
    angles = np.deg2rad(np.arange(-180.0, 180.0, 2.0))
    ranges = np.where(np.arange(180) % 2, np.nan, np.inf)
    wanted = Drive(0.4, 0.0)
    avoider = CorridorAvoidance(40.0)
    assert avoider.override(wanted, 0.0, RangeScan(angles, ranges)) == wanted


def test_homing_converges_although_it_is_overridden() -> None:
    """An obstacle stands on the leg; the avoider drives round it, homing brings it back."""
    setting = winding_path(5, 1, 4.0, offset=0.0)
    middle = 0.5 * setting.targets[0, :2]
    setting.world.discs = np.array([[*middle, 0.25]])
    avoider = CorridorAvoidance(40.0)
    record = drive_path(setting, HomingBehaviourSettings(), avoider=avoider)
    assert record.arrived
    assert np.count_nonzero(record.overridden) > 5
    from_disc = np.hypot(*(record.truth[:, :2] - middle).T) - 0.25
    assert from_disc.min() > 0.35
    assert np.hypot(*(record.end[:2] - setting.targets[0, :2])) < 0.4


# --------------------------------------------------------------------------------------------
# A robot that homing sends into a dead end finds out of it


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
    avoider = CorridorAvoidance(40.0)
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
