"""Errors and consistency of homings, on estimates whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray
from fgslam.core.bearings import HomingEstimate, HomingTruth
from fgslam.core.geometry import between
from fgslam.evaluation.homing import homing_errors, summarise_homings

TRUTH = HomingTruth(
    np.array([1.8, 0.6, 0.4]), np.array([[0.4, 0.1, 0.2], [1.2, 0.5, 0.3]]), np.zeros((0, 2))
)


def estimate(robot: FloatArray, target: FloatArray, covariance: FloatArray) -> HomingEstimate:
    none = np.empty((0, 2))
    return HomingEstimate(
        1.0, robot, target, covariance, np.empty(0, np.int64), none, np.empty((0, 2, 2))
    )


def in_legs(pose: FloatArray) -> FloatArray:
    return pose / np.array([TRUTH.leg_m, TRUTH.leg_m, 1.0])


def test_truth_has_no_error() -> None:
    exact = [estimate(in_legs(p), in_legs(TRUTH.target), np.eye(6)) for p in TRUTH.robots]
    errors = homing_errors(exact, TRUTH)
    for part in (errors.direction, errors.rotation, errors.distance):
        np.testing.assert_allclose(part, 0.0, atol=1e-15)
    np.testing.assert_allclose(errors.joint.values, 0.0, atol=1e-15)
    np.testing.assert_array_equal(errors.joint.dof, 6)


def test_errors_are_those_of_the_home_vector() -> None:
    robot = in_legs(TRUTH.robots[1]) + np.array([0.02, -0.03, 0.05])
    errors = homing_errors(
        [
            estimate(in_legs(TRUTH.robots[0]), in_legs(TRUTH.target), np.eye(6)),
            estimate(robot, in_legs(TRUTH.target), np.eye(6)),
        ],
        TRUTH,
    )
    exact = between(in_legs(TRUTH.robots[1]), in_legs(TRUTH.target))
    wrong = between(robot, in_legs(TRUTH.target))
    assert errors.direction[1] == pytest.approx(
        np.arctan2(wrong[1], wrong[0]) - np.arctan2(exact[1], exact[0])
    )
    assert errors.distance[1] == pytest.approx(np.hypot(*wrong[:2]) - np.hypot(*exact[:2]))
    assert errors.rotation[1] == pytest.approx(-0.05)
    assert errors.robot.values[1] == pytest.approx(0.02**2 + 0.03**2 + 0.05**2)


def test_held_leg_is_no_degree_of_freedom() -> None:
    covariance = np.diag([0.01, 0.01, 0.01, 0.0, 0.0, 0.0])
    target = in_legs(TRUTH.target)
    across = np.array([-target[1], target[0]])
    covariance[3:5, 3:5] = 1e-4 * np.outer(across, across)
    covariance[5, 5] = 1e-4
    errors = homing_errors([estimate(in_legs(r), target, covariance) for r in TRUTH.robots], TRUTH)
    np.testing.assert_array_equal(errors.target.dof, 2)
    np.testing.assert_array_equal(errors.joint.dof, 5)


def test_no_covariance_no_distance_no_consistency() -> None:
    unknown = np.full((6, 6), np.nan)
    errors = homing_errors(
        [estimate(np.zeros(3), np.array([1.0, 0.0, 0.1]), unknown) for _ in TRUTH.robots], TRUTH
    )
    assert np.isnan(errors.distance).all()
    assert errors.home.dof.sum() == 0
    summary = summarise_homings([errors])
    assert summary["distance_median"] is None
    assert summary["nees_robot"] is None
    assert summary["direction_median_deg"] > 0.0


def test_consistent_estimates_are_found_consistent_and_divergence_is_counted() -> None:
    rng = np.random.default_rng(0)
    root = 0.02 * rng.standard_normal((6, 6))
    covariance = root @ root.T + 1e-5 * np.eye(6)
    half = np.linalg.cholesky(covariance)
    exact = np.concatenate([in_legs(TRUTH.robots[1]), in_legs(TRUTH.target)])
    one = HomingTruth(TRUTH.target, TRUTH.robots[1:], TRUTH.landmarks)
    runs = []
    for _ in range(400):
        noisy = exact + 0.3 * half @ rng.standard_normal(6)
        runs.append(homing_errors([estimate(noisy[:3], noisy[3:], 0.09 * covariance)], one))
    summary = summarise_homings(runs)
    for judged in (summary["nees_robot"], summary["nees_joint"]):
        assert judged is not None
        assert judged["verdict"] == "consistent"
    turned = exact[:3] + np.array([0.0, 0.0, 1.0])
    over = [
        homing_errors([estimate(turned, exact[3:], covariance)], one),
        *runs[:9],
    ]
    assert summarise_homings(over)["diverged"] == 1
    assert summarise_homings(runs)["trials"] == 400


def test_estimates_without_a_covariance_are_counted() -> None:
    """They have no NEES; the consistency of the others must not pass for that of all."""
    one = HomingTruth(TRUTH.target, TRUTH.robots[:1], TRUTH.landmarks)
    exact = in_legs(TRUTH.robots[0]), in_legs(TRUTH.target)
    known, unknown = estimate(*exact, np.eye(6)), estimate(*exact, np.full((6, 6), np.nan))
    summary = summarise_homings([homing_errors([e], one) for e in (known, unknown, unknown)])
    assert (summary["trials"], summary["unjudged"]) == (3, 2)
    assert summary["nees_home"] is not None
    assert summary["nees_home"]["items"] == 1
