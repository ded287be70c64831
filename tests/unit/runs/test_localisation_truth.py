"""Truth laid onto a map's drive: how much of it the drive's shape leaves open."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core import geometry as g
from fgslam.runs.tasks.slam_results import alignment_slack


def test_a_straight_drive_leaves_the_roll_open_and_a_bent_one_does_not() -> None:
    rng = np.random.default_rng(2)
    along = np.linspace(0.0, 2.0, 30)
    straight = np.column_stack([0.0 * along, 0.0 * along, along])
    bent = np.column_stack([0.5 * along**2, 0.0 * along, along])
    error = 0.002 * rng.standard_normal((30, 3))
    assert alignment_slack(straight, straight) == np.inf
    assert alignment_slack(straight + error, straight + 2e-4 * error[::-1]) > 1.0
    assert alignment_slack(bent + error, bent) < 0.05


def test_slack_is_the_angle_that_a_turn_about_the_line_leaves() -> None:
    along = np.linspace(-1.0, 1.0, 40)
    own = np.column_stack([0.05 * np.cos(40.0 * along), 0.0 * along, along])
    turn = g.pose(g.so3_exp(np.array([0.0, 0.0, 0.03])), np.zeros(3))
    assert alignment_slack(g.transform_to_world(turn, own), own) == pytest.approx(0.03, rel=0.05)
