"""The two-point problem: exact on 20,000 cases, both counts of solutions, PoseLib's answers."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import unit, wrap
from fgslam.frontend.homing.two_view import (
    TwoPointSamples,
    TwoPointSolutions,
    solve_two_point,
)

Case = tuple[TwoPointSamples, FloatArray, FloatArray, FloatArray]


def random_cases(count: int, seed: int = 0) -> Case:
    """Samples with truth: direction, rotation (s,), and heights over distances, (s, 2, 2)."""
    rng = np.random.default_rng(seed)
    direction, rotation = rng.uniform(-np.pi, np.pi, (2, count))
    points = rng.uniform(-3.0, 3.0, (count, 2, 2))
    heights = rng.uniform(0.1, 1.0, (count, 2))
    from_b = points - unit(direction)[:, None]
    bearing_a = np.arctan2(points[..., 1], points[..., 0])
    bearing_b = wrap(np.arctan2(from_b[..., 1], from_b[..., 0]) - rotation[:, None])
    tangents = np.stack(
        [heights / np.linalg.norm(points, axis=-1), heights / np.linalg.norm(from_b, axis=-1)], -1
    )
    log_ratio = np.log(tangents[..., 0] / tangents[..., 1])
    exact = np.zeros((count, 2))
    samples = TwoPointSamples(bearing_a, bearing_b, log_ratio, exact + 1e-12, exact + 1e-12)
    return samples, direction, rotation, tangents


def errors(solutions: TwoPointSolutions, direction: FloatArray, rotation: FloatArray) -> FloatArray:
    """(s, 2) larger error of both angles; infinite where there is no solution."""
    theta = np.abs(wrap(solutions.direction - direction[:, None]))
    psi = np.abs(wrap(solutions.rotation - rotation[:, None]))
    worst = np.maximum(theta, psi)
    return np.where(solutions.valid, worst, np.inf)


def test_truth_is_among_the_solutions_of_20000_cases() -> None:
    samples, direction, rotation, _ = random_cases(20_000)
    solutions = solve_two_point(samples, least_separation=0.0)
    assert np.max(np.min(errors(solutions, direction, rotation), axis=1)) < 1e-9


def test_one_solution_where_the_features_are_nearer_to_different_cameras_else_two() -> None:
    samples, *_ = random_cases(20_000)
    counts = np.sum(solve_two_point(samples, least_separation=0.0).valid, axis=1)
    same_side = samples.log_ratio[:, 0] * samples.log_ratio[:, 1] > 0.0
    np.testing.assert_array_equal(counts, np.where(same_side, 2, 1))
    assert 9_000 < np.count_nonzero(counts == 2) < 11_000


def test_first_distance_and_ratio_are_the_truth() -> None:
    samples, direction, rotation, _ = random_cases(500)
    solutions = solve_two_point(samples, least_separation=0.0)
    best = np.argmin(errors(solutions, direction, rotation), axis=1)
    rows = np.arange(500)
    # d = sin(phi - theta) / sin(phi - delta) with R = 1
    seen_b = samples.bearing_b[:, 0] + rotation
    expected = np.sin(seen_b - direction) / np.sin(seen_b - samples.bearing_a[:, 0])
    np.testing.assert_allclose(solutions.first_distance[rows, best], expected, rtol=1e-6)


def test_agrees_with_poselib() -> None:
    samples, _, _, tangents = random_cases(500, seed=3)
    solutions = solve_two_point(samples, least_separation=0.0)
    for k in range(500):
        theirs = sorted(_poselib_solutions(samples, tangents, k))
        ours = sorted(
            zip(
                solutions.direction[k][solutions.valid[k]],
                solutions.rotation[k][solutions.valid[k]],
                strict=True,
            )
        )
        assert len(ours) == len(theirs)
        np.testing.assert_allclose(np.array(ours), np.array(theirs), atol=1e-6)


def _poselib_solutions(
    samples: TwoPointSamples, tangents: FloatArray, k: int
) -> list[tuple[float, float]]:
    """PoseLib's axes are x right, y down, z forward; its pose takes points of a to b."""
    poselib = pytest.importorskip("poselib", reason="the test oracle PoseLib is not installed")
    to_camera = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    rays = []
    for view, bearing in enumerate((samples.bearing_a[k], samples.bearing_b[k])):
        level = np.column_stack([unit(bearing), tangents[k, :, view]])
        rays.append(level / np.linalg.norm(level, axis=1, keepdims=True) @ to_camera.T)
    out = []
    for found in poselib.relpose_upright_planar_2pt(*rays):
        turn = to_camera.T @ found.R @ to_camera
        leg = -turn.T @ (to_camera.T @ found.t)
        out.append((float(np.arctan2(leg[1], leg[0])), float(np.arctan2(turn[0, 1], turn[0, 0]))))
    return out


def test_noise_beyond_the_double_root_is_clamped_or_refused() -> None:
    exact = TwoPointSamples(
        np.array([[0.0, 1.0]]), np.array([[0.2, 1.7]]), np.array([[-1.2, 0.6]]) * -1.0,
        np.zeros((1, 2)), np.zeros((1, 2)),
    )  # fmt: skip
    impossible = TwoPointSamples(
        np.array([[0.0, 1.5]]), np.array([[0.0, 1.5]]), np.array([[-0.5, -0.5]]),
        np.zeros((1, 2)), np.zeros((1, 2)),
    )  # fmt: skip
    assert solve_two_point(exact).valid.any()
    assert not solve_two_point(impossible).valid.any()
    noisy = TwoPointSamples(
        impossible.bearing_a, impossible.bearing_b, impossible.log_ratio,
        np.full((1, 2), 0.3), np.full((1, 2), 0.5),
    )  # fmt: skip
    assert np.count_nonzero(solve_two_point(noisy).valid) == 1


@pytest.mark.parametrize(
    ("bearing_a", "bearing_b", "log_ratio"),
    [
        ([0.3, 1.2], [0.3, 1.2], [0.0, 0.0]),  # both views coincide
        ([0.3, 0.32], [0.7, 0.72], [0.1, 0.2]),  # one vertical line
    ],
)
def test_degenerate_samples_have_no_solution(
    bearing_a: list[float], bearing_b: list[float], log_ratio: list[float]
) -> None:
    zero = np.zeros((1, 2))
    samples = TwoPointSamples(
        np.array([bearing_a]), np.array([bearing_b]), np.array([log_ratio]), zero, zero
    )
    assert not solve_two_point(samples).valid.any()


def test_equal_distances_of_the_second_feature_use_the_linear_equation() -> None:
    # rho_2 = 1: the second feature lies on the perpendicular bisector of the leg, A = 0.
    direction, rotation = 0.4, -0.9
    middle = 0.5 * unit(direction) + 1.3 * unit(direction + np.pi / 2)
    points = np.array([[2.0, -0.7], middle])
    from_b = points - unit(direction)
    samples = TwoPointSamples(
        np.arctan2(points[:, 1], points[:, 0])[None],
        wrap(np.arctan2(from_b[:, 1], from_b[:, 0]) - rotation)[None],
        np.log(np.linalg.norm(from_b, axis=1) / np.linalg.norm(points, axis=1))[None],
        np.zeros((1, 2)),
        np.zeros((1, 2)),
    )
    solutions = solve_two_point(samples)
    assert np.min(errors(solutions, np.array([direction]), np.array([rotation]))) < 1e-9
