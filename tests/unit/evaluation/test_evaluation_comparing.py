"""Landmark errors, growth of time, intervals and paired tests against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from fgslam.core.estimates import LandmarkMap, Trajectory
from fgslam.core.geometry import inverse, se3_exp, transform_to_world
from fgslam.core.recordings import LandmarkTruth
from fgslam.evaluation.judging import landmark_errors, mean_interval, paired_test
from fgslam.evaluation.statistics import estimate_from_truth, time_growth

ALIGNED = se3_exp(np.array([0.1, -0.2, 0.3, 1.0, 2.0, -3.0]))


def test_landmarks_are_compared_in_the_estimates_world(rng: np.random.Generator) -> None:
    true = rng.normal(size=(5, 3))
    errors = 0.1 * rng.normal(size=(5, 3))
    ids = np.array([1, 3, 5, 7, 9])
    landmarks = LandmarkMap(
        np.array([0, 1, 3, 5, 7, 9]),
        np.vstack([[[9.0, 9.0, 9.0]], transform_to_world(ALIGNED, true) + errors]),
        np.tile(0.04 * np.eye(3), (6, 1, 1)),
    )
    truth = LandmarkTruth(np.array([*ids, 11]), np.vstack([true, [[0.0, 0.0, 0.0]]]))
    found = landmark_errors(landmarks, truth, ALIGNED)
    np.testing.assert_array_equal(found.ids, ids)
    distances = np.linalg.norm(errors, axis=1)
    np.testing.assert_allclose(found.distances_m, distances, atol=1e-12)
    assert found.rmse_m == pytest.approx(np.sqrt((distances**2).mean()))
    assert found.median_m == pytest.approx(np.median(distances))
    np.testing.assert_allclose(found.nees.values, distances**2 / 0.04, atol=1e-9)
    assert found.nees.dof.tolist() == 5 * [3]


def test_without_common_landmarks_nothing_is_known() -> None:
    none = LandmarkTruth(np.array([4]), np.zeros((1, 3)))
    landmarks = LandmarkMap(np.array([1]), np.zeros((1, 3)), np.eye(3)[None])
    found = landmark_errors(landmarks, none, np.eye(4))
    assert (len(found), found.rmse_m, found.median_m, found.nees.per_dof) == (0, None, None, None)


def test_the_first_pose_aligns_the_worlds() -> None:
    poses = np.array([se3_exp(k * np.array([0.0, 0.1, 0.0, 0.0, 0.0, 1.0])) for k in range(4)])
    truth = Trajectory(np.arange(4.0), inverse(ALIGNED) @ poses)
    estimate = Trajectory(np.arange(4.0), poses)
    found = estimate_from_truth(estimate, truth)
    assert found is not None
    np.testing.assert_allclose(found, ALIGNED, atol=1e-12)
    late = Trajectory(np.arange(4.0) + 100.0, poses)
    assert estimate_from_truth(late, truth) is None


def test_growth_of_a_line_and_of_a_flat_time() -> None:
    frames = np.arange(1000.0)
    line = time_growth(2.0 + 0.01 * frames)
    assert line is not None
    assert line.slope_ms_per_1000 == pytest.approx(10.0)
    # Medians lie in the middle of their fifths: frames 299.5 and 899.5.
    assert line.ratio == pytest.approx((2.0 + 8.995) / (2.0 + 2.995))
    flat = time_growth(np.full(1000, 3.0))
    assert flat is not None
    assert flat.ratio == 1.0
    assert flat.slope_ms_per_1000 == pytest.approx(0.0, abs=1e-9)
    assert time_growth(np.ones(24)) is None
    assert time_growth(np.zeros(100)) is None


def test_the_interval_is_students(rng: np.random.Generator) -> None:
    values = rng.normal(3.0, 2.0, 20)
    found = mean_interval(np.append(values, np.nan))
    assert found is not None
    expected = stats.t.interval(0.95, 19, values.mean(), values.std(ddof=1) / np.sqrt(20))
    assert (found.mean, found.count) == (pytest.approx(values.mean()), 20)
    assert (found.lower, found.upper) == pytest.approx(expected)
    one = mean_interval(np.array([2.0]))
    assert one is not None
    assert (one.mean, one.lower, one.upper) == (2.0, None, None)
    assert mean_interval(np.array([np.nan])) is None


def test_the_interval_covers_as_often_as_it_says(rng: np.random.Generator) -> None:
    found = [mean_interval(rng.normal(size=8)) for _ in range(1000)]
    covered = sum(f.lower <= 0.0 <= f.upper for f in found if f is not None)  # type: ignore[operator]
    assert 930 <= covered <= 970


def test_pairs_are_compared_pair_by_pair(rng: np.random.Generator) -> None:
    b = rng.uniform(1.0, 2.0, 12)
    a = b - rng.uniform(0.1, 0.2, 12)
    a[0] = b[0] + 0.05
    a = np.append(a, [np.nan, 1.0])
    b = np.append(b, [1.0, np.nan])
    found = paired_test(a, b)
    assert found is not None
    assert (found.wins, found.losses, found.difference.count) == (11, 1, 12)
    assert found.p_value == pytest.approx(stats.wilcoxon(a[:12], b[:12]).pvalue)
    assert found.p_value is not None
    assert found.p_value < 0.01
    assert found.difference.upper is not None
    assert found.difference.upper < 0.0
    assert found.ratio == pytest.approx(a[:12].mean() / b[:12].mean())


def test_ties_are_no_evidence_of_a_difference() -> None:
    found = paired_test(np.ones(5), np.ones(5))
    assert found is not None
    assert (found.wins, found.losses, found.p_value) == (0, 0, None)
    assert paired_test(np.full(3, np.nan), np.ones(3)) is None
