"""Consistency: NEES follows its distribution; wrong covariances are recognised."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from fgslam.core.geometry import se3_exp
from fgslam.evaluation.statistics import (
    Nees,
    chi_square_band,
    judge,
    landmark_nees,
    nees,
    pose_errors,
    pose_nees,
    within,
)


def random_covariances(rng: np.random.Generator, n: int, d: int) -> np.ndarray:
    root = rng.normal(scale=0.05, size=(n, d, d))
    return root @ np.swapaxes(root, 1, 2) + 1e-6 * np.eye(d)


def drawn(rng: np.random.Generator, covariances: np.ndarray) -> np.ndarray:
    return np.array([rng.multivariate_normal(np.zeros(len(c)), c) for c in covariances])


def test_full_rank_nees_is_the_mahalanobis_distance() -> None:
    rng = np.random.default_rng(1)
    covariances = random_covariances(rng, 20, 6)
    errors = rng.normal(size=(20, 6))
    expected = [e @ np.linalg.solve(c, e) for e, c in zip(errors, covariances, strict=True)]
    result = nees(errors, covariances)
    np.testing.assert_allclose(result.values, expected, rtol=1e-6)
    assert (result.dof == 6).all()


@pytest.mark.parametrize("free", [3, 5])
def test_constrained_poses_count_only_their_free_directions(free: int) -> None:
    rng = np.random.default_rng(2)
    basis, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    inner = random_covariances(rng, 400, free)
    covariances = basis[:, :free] @ inner @ basis[:, :free].T
    errors = drawn(rng, inner) @ basis[:, :free].T
    result = nees(errors, covariances)
    assert (result.dof == free).all()
    expected = [
        e @ np.linalg.pinv(c, rcond=1e-9) @ e for e, c in zip(errors, covariances, strict=True)
    ]
    np.testing.assert_allclose(result.values, expected, rtol=1e-4)
    assert result.per_dof == pytest.approx(1.0, abs=4 * np.sqrt(2 / (400 * free)))


def test_an_exactly_known_pose_adds_no_degrees_of_freedom() -> None:
    result = nees(np.ones((2, 6)), np.stack([np.zeros((6, 6)), np.eye(6)]))
    np.testing.assert_array_equal(result.dof, [0, 6])
    np.testing.assert_allclose(result.values, [0.0, 6.0])
    assert nees(np.ones((1, 6)), np.zeros((1, 6, 6))).per_dof is None


def test_unknown_truth_is_left_out() -> None:
    truth = np.array([[1.0, 2.0, 3.0], [np.nan] * 3])
    result = landmark_nees(np.zeros((2, 3)), np.tile(np.eye(3), (2, 1, 1)), truth)
    np.testing.assert_allclose(result.values, [14.0, 0.0])
    np.testing.assert_array_equal(result.dof, [3, 0])


def test_pose_errors_invert_the_retraction() -> None:
    rng = np.random.default_rng(3)
    xi = rng.normal(scale=0.3, size=(10, 6))
    estimate = np.array([se3_exp(v) for v in rng.normal(size=(10, 6))])
    truth = np.array([p @ se3_exp(v) for p, v in zip(estimate, xi, strict=True)])
    np.testing.assert_allclose(pose_errors(estimate, truth), xi, atol=1e-10)
    assert pose_errors(estimate[:0], truth[:0]).shape == (0, 6)


def simulated_run(seed: int, inflation: float) -> Nees:
    rng = np.random.default_rng(seed)
    covariances = random_covariances(rng, 60, 6) * 1e-2
    estimate = np.array([se3_exp(v) for v in rng.normal(size=(60, 6))])
    xi = drawn(rng, covariances)
    truth = np.array([p @ se3_exp(v) for p, v in zip(estimate, xi, strict=True)])
    return pose_nees(estimate, inflation * covariances, truth)


@pytest.mark.parametrize(
    ("inflation", "verdict"), [(1.0, "consistent"), (0.25, "overconfident"), (4.0, "conservative")]
)
def test_wrong_covariances_are_recognised_over_many_runs(inflation: float, verdict: str) -> None:
    runs = [simulated_run(seed, inflation) for seed in range(10)]
    for independent in (False, True):
        result = judge(runs, items_independent=independent)
        assert result is not None
        assert result.verdict == verdict
        assert result.items == 600
        assert result.independent == (600 if independent else 10)
        assert result.per_dof == pytest.approx(1.0 / inflation, rel=0.1)


def test_band_holds_the_stated_share_of_consistent_runs() -> None:
    rng = np.random.default_rng(4)
    lower, upper = chi_square_band(18.0, 0.9)
    means = rng.chisquare(18, size=20000) / 18
    assert np.mean((means >= lower) & (means <= upper)) == pytest.approx(0.9, abs=0.01)
    assert chi2.cdf(18.0 * lower, 18) == pytest.approx(0.05)


def test_without_degrees_of_freedom_consistency_is_not_known() -> None:
    empty = Nees(np.empty(0), np.empty(0, np.int64))
    assert judge([]) is None
    assert judge([empty]) is None
    assert judge([nees(np.ones((3, 6)), np.zeros((3, 6, 6)))]) is None


def test_two_sigmas_hold_95_percent_of_errors_that_are_as_large_as_stated() -> None:
    rng = np.random.default_rng(8)
    covariances = random_covariances(rng, 4000, 6)
    errors = drawn(rng, covariances)
    np.testing.assert_allclose(within(errors, covariances), chi2.cdf(4.0, 1), atol=0.02)
    np.testing.assert_allclose(within(errors, covariances / 16.0), chi2.cdf(0.25, 1), atol=0.03)


def test_an_axis_that_is_held_has_no_share() -> None:
    covariances = np.tile(np.diag([1e-4, 0.0, 1e-4]), (3, 1, 1))
    errors = np.array([[0.0, 0.0, 0.03], [0.01, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    np.testing.assert_equal(within(errors, covariances), [1.0, np.nan, 0.5])


def test_an_axis_that_leans_out_of_a_constraint_by_rounding_is_not_judged() -> None:
    """A floor held stiffly: what it excludes is tilted by a ten-thousandth."""
    basis = np.array([[1.0, 0.0], [0.0, 1.0], [1e-4, 0.0]])
    covariances = np.tile(basis @ np.diag([1.0, 0.25]) @ basis.T, (4, 1, 1))
    errors = np.tile([0.5, 0.5, 1e-3], (4, 1))
    np.testing.assert_equal(within(errors, covariances), [1.0, 1.0, np.nan])
