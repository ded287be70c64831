"""Factors on poses: prior, odometry and floor against their specification and exact solves."""

from __future__ import annotations

from functools import partial
from typing import Any

import factor_specifications as residuals
import gtsam
import numpy as np
import pytest
from factor_checks import (
    assert_as_specified,
    assert_near,
    numerical_jacobian,
    random_covariance,
    random_pose,
    values_of,
)

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import Odometry
from fgslam.core.types import DegreesOfFreedom, Floor, Prediction
from fgslam.factors.motion import (
    floor_factors,
    odometry_factor,
    pose_prior,
    step_factor,
)
from fgslam.factors.noise import STIFF_M, STIFF_RAD, positive_definite, scaled

TILTED = g.so3_exp(np.array([0.31, 0.1, -0.24])) @ np.array([0.0, 1.0, 0.0])
"""The vertical of a camera that is pitched and rolled on the robot: no axis of anything."""
VERTICALS = [*np.eye(3), *-np.eye(3), TILTED, np.array([0.6, -0.48, 0.64])]
PLANAR = np.diag([0.0, 0.01, 0.0, 0.02, 0.0, 0.02]) ** 2


def gentle(rng: np.random.Generator, size: float) -> FloatArray:
    return g.se3_exp(size * rng.standard_normal(6))


# --------------------------------------------------------------------------------------------
# Prior and odometry


@pytest.mark.parametrize("off", [1e-9, 0.05, 0.5])
def test_a_prior_is_as_specified(off: float, rng: np.random.Generator) -> None:
    """Also far from it: GTSAM's Jacobian has the logarithm's in it."""
    for _ in range(5):
        mean, covariance = random_pose(rng, 3.0), random_covariance(rng, 6, 0.1)
        factor = pose_prior(0, Prediction(mean, covariance))
        residual = partial(residuals.pose_prior, prior=mean)
        assert_as_specified(factor, residual, [mean @ gentle(rng, off)], covariance)


@pytest.mark.parametrize("off", [1e-9, 0.05, 0.5])
def test_odometry_is_as_specified(off: float, rng: np.random.Generator) -> None:
    for _ in range(5):
        before, motion = random_pose(rng, 3.0), random_pose(rng, 1.0)
        covariance = random_covariance(rng, 6, 0.1)
        factor = odometry_factor(0, 1, Odometry(motion, covariance))
        residual = partial(residuals.odometry, pTn=motion)
        after = before @ motion @ gentle(rng, off)
        assert_as_specified(factor, residual, [before, after], covariance)


@pytest.mark.parametrize("deviations", [0.1, 3.0, 30.0])
def test_a_foretold_step_pulls_like_student_with_ten_samples(deviations: float) -> None:
    """Half of what a measured one does where it is off by the root of ten, less beyond."""
    step = Odometry(g.se3_exp(np.full(6, 0.1)), 0.01 * np.eye(6), measured=False)
    off = np.array([0.0, 0.0, 0.0, 0.1 * deviations, 0.0, 0.0])
    values = values_of(np.eye(4), step.motion @ g.se3_exp(off))
    loss = 5.0 * np.log1p(deviations**2 / 10.0)
    assert step_factor(0, 1, step).error(values) == pytest.approx(loss, rel=1e-9)
    twice = scaled(step_factor(0, 1, step), 4.0)
    assert twice.error(values) == pytest.approx(5.0 * np.log1p(deviations**2 / 40.0), rel=1e-9)
    pull = step_factor(0, 1, step).linearize(values).jacobian()[1]
    bounded = deviations / np.sqrt(1.0 + deviations**2 / 10.0)
    assert np.linalg.norm(pull) == pytest.approx(bounded, rel=1e-9)


@pytest.mark.parametrize("by", [{"measured": True}, {"measured": False, "turned": True}])
def test_a_measured_step_has_no_kernel(by: dict[str, bool]) -> None:
    step = Odometry(np.eye(4), 0.01 * np.eye(6), **by)
    values = values_of(np.eye(4), g.se3_exp(np.array([0.0, 0.0, 0.0, 3.0, 0.0, 0.0])))
    assert step_factor(0, 1, step).error(values) == pytest.approx(450.0, rel=1e-9)


def test_a_prior_without_variance_holds_stiffly() -> None:
    factor = pose_prior(0, Prediction(np.eye(4), np.zeros((6, 6))))
    off = 1e-3 * np.array([1.0, -2.0, 3.0, -4.0, 5.0, -6.0])
    cost = factor.error(values_of(g.se3_exp(off)))
    assert cost == pytest.approx(0.5 * float(off @ off) / 1e-6**2, rel=1e-9)


def test_planar_odometry_holds_what_it_excludes(rng: np.random.Generator) -> None:
    """A wheel's odometry says nothing moves out of the plane; that becomes stiff."""
    motion = g.se3_exp(np.array([0.0, 0.1, 0.0, 0.3, 0.0, 1.0]))
    factor = odometry_factor(0, 1, Odometry(motion, PLANAR))
    before = random_pose(rng)
    for direction, sigma in enumerate([2e-5, 0.01, 2e-5, 0.02, 2e-5, 0.02]):
        off = np.zeros(6)
        off[direction] = sigma
        values = values_of(before, before @ motion @ g.se3_exp(off))
        assert factor.error(values) == pytest.approx(0.5, rel=1e-6)


# --------------------------------------------------------------------------------------------
# Floor


def floor(dof: DegreesOfFreedom, down: FloatArray, hard: bool) -> Floor:
    return Floor(dof, down, hard, 0.02, 0.03)


def floor_sigmas(ground: Floor) -> tuple[float, float]:
    if ground.hard:
        return STIFF_M, STIFF_RAD
    return ground.height_sigma_m, ground.tilt_sigma_rad


@pytest.mark.parametrize("hard", [True, False])
@pytest.mark.parametrize("down", VERTICALS)
def test_the_floor_is_as_specified_whatever_the_vertical(
    down: FloatArray, hard: bool, rng: np.random.Generator
) -> None:
    """Height and tilt, values and Jacobian; also with the heading far from where it began."""
    ground = floor(3, down, hard)
    height_sigma, tilt_sigma = floor_sigmas(ground)
    for heading in (0.0, 0.3, -1.5, 3.0):
        start = g.pose(g.so3_exp(0.4 * down), rng.standard_normal(3))
        tilt = g.so3_exp(0.05 * rng.standard_normal(3))
        wTc = g.pose(g.so3_exp(heading * down) @ start[:3, :3] @ tilt, rng.standard_normal(3))
        upright = ground.constrain(start)[:3, :3]
        height, lean = floor_factors(0, ground, start)
        values = values_of(wTc)
        expected = residuals.height(ground, wTc) / height_sigma
        found = height.whitenedError(values)
        assert_near(found, np.array([expected, 0.0, 0.0]), 1e-10 * abs(expected))
        tilts = residuals.tilt(ground, wTc, upright) / tilt_sigma
        found = lean.whitenedError(values)
        assert_near(found, np.append(tilts, 0.0), 1e-10 * np.abs(tilts).max())
        by_height, _ = height.linearize(values).jacobian()
        by_tilt, _ = lean.linearize(values).jacobian()
        residual = partial(floor_residual, ground=ground, upright=upright)
        jacobian = numerical_jacobian(residual, [wTc], 0)
        assert_near(by_height * height_sigma, np.vstack([jacobian[0], np.zeros((2, 6))]), 1e-8)
        assert_near(by_tilt * tilt_sigma, np.vstack([jacobian[1:], np.zeros((1, 6))]), 1e-7)


def floor_residual(wTc: FloatArray, ground: Floor, upright: FloatArray) -> FloatArray:
    return np.append(residuals.height(ground, wTc), residuals.tilt(ground, wTc, upright))


def test_without_a_floor_there_are_no_factors_and_height_alone_leaves_rotations() -> None:
    assert floor_factors(0, floor(6, TILTED, True), np.eye(4)) == []
    only = floor_factors(0, floor(5, TILTED, True), np.eye(4))
    assert len(only) == 1
    turned = g.pose(
        g.so3_exp(np.array([1.0, -0.4, 0.3])), 7.0 * floor(5, TILTED, True).horizontal[:, 0]
    )
    assert only[0].error(values_of(turned)) < 1e-16


@pytest.mark.parametrize("heading", [0.0, 1.0, np.pi, 5.0])
def test_upright_poses_cost_nothing_at_any_heading(heading: float) -> None:
    """Half a turn away, where the logarithm jumps, too: it jumps along the vertical."""
    ground = floor(3, TILTED, False)
    wTc = g.pose(g.so3_exp(heading * TILTED), ground.horizontal @ [3.0, -2.0])
    for factor in floor_factors(0, ground, np.eye(4)):
        assert factor.error(values_of(wTc)) < 1e-12
        jacobian, rhs = factor.linearize(values_of(wTc)).jacobian()
        assert np.isfinite(jacobian).all()
        assert np.isfinite(rhs).all()


# --------------------------------------------------------------------------------------------
# The floor in a solve


def measured_pair(
    rng: np.random.Generator,
) -> tuple[list[FloatArray], FloatArray, FloatArray, Odometry]:
    """Two poses off the floor; a prior and an odometry that pull off it, with full covariances."""
    start = gentle(rng, 0.05)
    motion = g.se3_exp(np.array([0.001, 0.3, -0.002, 0.2, 0.01, 0.9]))
    guess = [start, start @ motion @ gentle(rng, 0.02)]
    size = np.diag(np.repeat([0.02, 0.2], 3))
    prior_covariance = size @ random_covariance(rng, 6) @ size
    odometry = Odometry(motion, size @ random_covariance(rng, 6) @ size)
    return guess, gentle(rng, 0.01), prior_covariance, odometry


def optimise(graph: Any, values: Any) -> list[FloatArray]:
    """Gauss-Newton by GTSAM's linear solver, whatever the cost does on the way."""
    for _ in range(30):
        values = values.retract(graph.linearize(values).optimize())
    return [values.atPose3(key).matrix() for key in (0, 1)]


@pytest.mark.parametrize("down", [TILTED, np.array([0.0, 1.0, 0.0])])
@pytest.mark.parametrize("dof", [5, 3])
def test_a_hard_floor_is_the_exact_constrained_solve(
    dof: DegreesOfFreedom, down: FloatArray, rng: np.random.Generator
) -> None:
    """Up to the square of its stiffness: half as stiff, four times as far off.

    Against a Gauss-Newton that moves only along the directions that the floor allows.
    """
    ground = floor(dof, down, True)
    half = Floor(dof, down, False, 2.0 * STIFF_M, 2.0 * STIFF_RAD)
    for _ in range(3):
        guess, mean, prior_covariance, odometry = measured_pair(rng)
        start = [ground.constrain(wTc) for wTc in guess]
        graph = gtsam.NonlinearFactorGraph()
        graph.add(pose_prior(0, Prediction(mean, prior_covariance)))
        graph.add(odometry_factor(0, 1, odometry))
        exact = np.array(reduced_solve(graph, start, ground))
        assert_near(np.array([ground.constrain(wTc) for wTc in exact]), exact, 1e-12)
        off = [np.array(with_floor(graph, start, kind)) - exact for kind in (ground, half)]
        assert np.abs(off[0]).max() < 2e-7  # metres, of pulls of centimetres
        assert_near(4.0 * off[0], off[1], 0.02 * np.abs(off[1]).max() + 1e-10)


def with_floor(graph: Any, start: list[FloatArray], ground: Floor) -> list[FloatArray]:
    """The minimum with the floor's factors."""
    both = gtsam.NonlinearFactorGraph(graph)
    for key, wTc in enumerate(start):
        for factor in floor_factors(key, ground, wTc):
            both.add(factor)
    return optimise(both, values_of(*start))


def reduced_solve(graph: Any, start: list[FloatArray], ground: Floor) -> list[FloatArray]:
    """Steps in the floor's own coordinates; nothing is stiff."""
    poses = list(start)
    for _ in range(30):
        information, vector = graph.linearize(values_of(*poses)).hessian()
        basis = np.zeros((12, 2 * ground.dof))
        basis[:6, : ground.dof] = ground.basis(poses[0])
        basis[6:, ground.dof :] = ground.basis(poses[1])
        step = basis @ np.linalg.solve(basis.T @ information @ basis, basis.T @ vector)
        poses = [
            ground.constrain(wTc @ g.se3_exp(xi))
            for wTc, xi in zip(poses, step.reshape(2, 6), strict=True)
        ]
    assert np.abs(step).max() < 1e-12
    return poses


@pytest.mark.parametrize("dof", [5, 3])
def test_a_blind_drive_with_a_pitched_camera_stays_solvable(
    dof: DegreesOfFreedom, rng: np.random.Generator
) -> None:
    """Thirty steps of 5 cm and a degree each, the vertical no axis of the camera.

    A floor of a micrometre made GTSAM call the last pose indeterminate within a few steps.
    """
    ground = floor(dof, TILTED, True)
    step = ground.constrain(g.pose(g.so3_exp(0.03 * TILTED), ground.horizontal @ [0.1, 0.2]))
    noise = np.repeat([0.02, 0.05], 3)
    params = gtsam.ISAM2Params()
    params.setRelinearizeThreshold(1e-6)
    params.relinearizeSkip = 1
    solver, wTc = gtsam.ISAM2(params), np.eye(4)
    for frame in range(30):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if frame == 0:
            graph.add(pose_prior(0, Prediction(wTc, np.zeros((6, 6)))))
        else:
            drawn = step @ g.se3_exp(noise * rng.standard_normal(6))
            graph.add(odometry_factor(frame - 1, frame, Odometry(drawn, np.diag(noise**2))))
            wTc = ground.constrain(wTc @ step)
        for factor in floor_factors(frame, ground, wTc):
            graph.add(factor)
        values.insert(frame, gtsam.Pose3(wTc))
        solver.update(graph, values)
    for _ in range(5):
        solver.update()
    last = solver.calculateEstimatePose3(29).matrix()
    assert_near(ground.constrain(last), last, 1e-3)
    spread = solver.marginalCovariance(29)[3:, 3:]
    assert np.sqrt(np.linalg.eigvalsh(spread)[1]) > 0.1  # it is lost, and knows it


def both(a: float, b: float) -> float:
    """Variance of what is known twice, with standard deviations a and b."""
    return 1.0 / (a**-2 + b**-2)


# --------------------------------------------------------------------------------------------
# Covariances that are not definite


@pytest.mark.parametrize(("largest", "stiff"), [(9e-4, 3e-5), (1e-8, 1e-6)])
def test_what_is_known_exactly_becomes_stiff_and_the_rest_stays(
    largest: float, stiff: float, rng: np.random.Generator
) -> None:
    """A micrometre, or a thousandth of the largest deviation; rounding below zero is no matter."""
    basis = np.linalg.qr(rng.standard_normal((6, 6)))[0]
    variances = largest * np.array([0.0, 0.0, -1e-15, 0.1, 0.5, 1.0])
    singular = (basis * variances) @ basis.T
    before = singular.copy()
    found = positive_definite(singular)
    np.testing.assert_array_equal(singular, before)
    expected = (basis * np.maximum(variances, stiff**2)) @ basis.T
    assert_near(found, expected, 1e-13 * largest)
    np.linalg.cholesky(found)


def test_a_definite_covariance_is_left_alone(rng: np.random.Generator) -> None:
    covariance = random_covariance(rng, 6, 0.01)
    covariance = 0.5 * (covariance + covariance.T)
    np.testing.assert_array_equal(positive_definite(covariance), covariance)
