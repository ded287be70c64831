"""Paths in closed loop over many seeds: arrival, no build-up of errors, reach of a target."""

from __future__ import annotations

import numpy as np
import pytest
from landmark_world import drive_path, winding_path

from fgslam.core.geometry import compose
from fgslam.homing.closed_loop import (
    DriveRecord,
    cross_track,
    pass_distances,
    slope_by_leg,
    truly_arrived,
)

LEGS = 10
SEEDS = 20


def drives(spacing: float, seeds: int, wrong: float = 0.1) -> list[DriveRecord]:
    """Ten legs each, with so many of the matches wrong."""
    out = []
    for seed in range(seeds):
        setting = winding_path(seed, LEGS, spacing)
        setting.front_end.wrong = wrong
        out.append(drive_path(setting))
    return out


@pytest.mark.slow
@pytest.mark.parametrize("spacing", [2.0, 3.0, 4.0])
def test_ten_legs_arrive_and_errors_do_not_build_up(spacing: float) -> None:
    """Every run arrives, passes each target within a tenth of a leg, and the last legs are as
    good as the first ones."""
    records = drives(spacing, SEEDS)
    assert sum(truly_arrived(r) for r in records) >= 0.98 * SEEDS
    passed = np.array([pass_distances(r) for r in records])
    assert passed.max() <= 0.1 * spacing
    # The first leg is left out: it begins on its own line, the others where a corner was cut.
    across = np.array([cross_track(r)[1:] for r in records])
    slope = slope_by_leg(np.tile(np.arange(1, LEGS), SEEDS), across.ravel())
    assert slope.flat
    assert slope.high < 0.005  # metres a leg: the interval is narrow enough to mean something


@pytest.mark.slow
def test_three_matches_in_ten_may_be_wrong() -> None:
    """The disturbed bound: nine of ten runs arrive."""
    records = drives(2.0, SEEDS, wrong=0.3)
    assert sum(truly_arrived(r) for r in records) >= 0.9 * SEEDS


def from_offset(seed: int, offset: float) -> bool:
    """Whether the robot gets to a target 2 m ahead from beside its way."""
    setting = winding_path(seed, 1, 2.0, offset=0.0)
    side = np.pi / 2 if seed % 2 else -np.pi / 2
    aside = np.array([offset * np.cos(side), offset * np.sin(side), 0.0])
    setting.world.true_pose = compose(setting.world.true_pose, aside)
    record = drive_path(setting)
    near = float(np.hypot(*(record.end[:2] - setting.targets[0, :2])))
    # Whatever the start, what claims to have arrived is there.
    if record.arrived:
        assert near < 0.15 * np.hypot(2.0, offset)
    return record.arrived


@pytest.mark.slow
def test_targets_are_reached_from_all_around_their_reach() -> None:
    """Catchment: sure within a leg beside the way, refused honestly where nothing is seen."""
    share = {
        offset: np.mean([from_offset(seed, offset) for seed in range(10)])
        for offset in (0.0, 1.0, 2.0, 4.0, 12.0)
    }
    assert share[0.0] == share[1.0] == share[2.0] == 1.0
    assert share[12.0] == 0.0
