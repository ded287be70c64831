"""Poses found without a prior are counted: right, less exact, false, refused, unknown."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.geometry import pose, so3_exp
from fgslam.evaluation.localisation import (
    Answers,
    Bounds,
    enough,
    localisation_errors,
    score,
    spread,
)

BOUNDS = Bounds(0.05, np.deg2rad(1.0), 0.3, np.deg2rad(5.0), 20)


def moved(metres: float, degrees: float = 0.0) -> np.ndarray:
    return pose(so3_exp(np.array([0.0, np.deg2rad(degrees), 0.0])), np.array([metres, 0.0, 0.0]))


def answers(poses: list[np.ndarray], accepted: list[bool], known: list[bool]) -> Answers:
    count = len(poses)
    truth = np.tile(np.eye(4), (count, 1, 1))
    truth[~np.array(known, np.bool_)] = np.nan
    return Answers(
        accepted=np.array(accepted, np.bool_),
        poses=np.array(poses).reshape(-1, 4, 4),
        covariances=np.tile(np.diag([0.01] * 3 + [0.02] * 3) ** 2, (count, 1, 1)),
        truth=truth,
        visible=np.full(count, 100),
        familiar=np.full(count, 50),
    )


def test_each_answer_falls_into_one_class() -> None:
    poses = [moved(0.03), moved(0.03, 2.0), moved(0.2), moved(0.1, 6.0), moved(3.0), moved(9.0)]
    given = answers([*poses, moved(5.0)], [True] * 5 + [False, True], [True] * 6 + [False])
    found = score(given, BOUNDS)
    assert [found[name] for name in ("asked", "accepted", "with_truth")] == [7, 6, 6]
    assert [found[name] for name in ("right", "inexact", "false")] == [1, 2, 2]
    assert found["share_right"] == pytest.approx(1 / 6)
    assert found["error_m"]["max"] == pytest.approx(3.0)
    assert found["error_deg"]["max"] == pytest.approx(6.0)


def test_refused_and_unknown_ones_have_no_error() -> None:
    errors = localisation_errors(
        answers([moved(0.1), moved(0.2), moved(0.3)], [True, False, True], [True, True, False])
    )
    np.testing.assert_allclose(errors.metres, [0.1, np.nan, np.nan])
    assert errors.dof.tolist() == [6, 0, 0]
    assert errors.nees[0] == pytest.approx((0.1 / 0.02) ** 2)


def test_share_of_errors_inside_the_claimed_95_percent_region() -> None:
    found = score(answers([moved(0.0), moved(0.02), moved(0.2)], [True] * 3, [True] * 3), BOUNDS)
    assert found["share_in_95_percent"] == pytest.approx(2 / 3)
    assert found["nees_per_dof"] == pytest.approx((0 + 1 + 100) / 18)


def test_no_queries_give_no_rates() -> None:
    found = score(answers([], [], []), BOUNDS)
    assert found["share_right"] is None
    assert found["share_in_95_percent"] is None
    assert found["error_m"] == spread(np.empty(0)) == dict.fromkeys(("median", "p95", "max"))


def test_too_few_landmarks_in_view_are_distinguished_but_unknown_ones_are_not() -> None:
    np.testing.assert_array_equal(
        enough(np.array([-1, 0, 19, 20, 500]), BOUNDS), [True, False, False, True, True]
    )
