"""Landmark factors and robust kernels."""

from __future__ import annotations

from functools import partial
from typing import Any

import factor_specifications as residuals
import gtsam
import numpy as np
import pytest
from factor_checks import (
    UNEVEN_RIG,
    assert_as_specified,
    assert_near,
    random_covariance,
    random_pose,
    values_of,
)
from factor_specifications import RawPixelFactors, constant_velocity, constant_velocity_covariance
from simulated import RIG

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import CameraRig, measurement_map, pixel_model, vertical_to_horizontal
from fgslam.factors.bearing import ChainMotion, motion_informations
from fgslam.factors.landmark import FROM_MEASUREMENT, StereoFactors
from fgslam.factors.noise import KernelName, Whitening, kernel_losses, kernel_weights

# ------------------------------------------------------------------------------------------
# Stereo, raw pair and top camera factors against their specification, and where they are singular


RIGS = [RIG, UNEVEN_RIG]
MEASURED = np.array([170.0, 131.0, 9.0])


def point_before(rng: np.random.Generator, wTc: FloatArray, depth: float) -> FloatArray:
    """A world point at a depth, somewhere in the image."""
    local = depth * np.append(rng.uniform(-0.4, 0.4, 2), 1.0)
    return g.transform_to_world(wTc, local[None, :])[0]


def image(rig: CameraRig, wTc: FloatArray, point: FloatArray) -> FloatArray:
    return rig.predict(g.transform_to_camera(wTc, point[None, :]))[0]


def stereo(rig: CameraRig, measured: FloatArray, covariance: FloatArray) -> Any:
    return StereoFactors(rig, Whitening()).factor(0, 1, measured, covariance)


# --------------------------------------------------------------------------------------------
# As specified


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("depth", [0.3, 2.0, 40.0])
def test_a_stereo_factor_is_as_specified(
    rig: CameraRig, depth: float, rng: np.random.Generator
) -> None:
    for _ in range(10):
        wTc, covariance = random_pose(rng, 3.0), random_covariance(rng, 3)
        point = point_before(rng, wTc, depth)
        measured = image(rig, wTc, point) + 3.0 * rng.standard_normal(3)
        mapped = FROM_MEASUREMENT @ covariance @ FROM_MEASUREMENT.T
        residual = partial(residuals.stereo_coordinates, rig, measured=measured)
        factor = stereo(rig, measured, covariance)
        assert_as_specified(factor, residual, [wTc, point], mapped)
        ours = residuals.stereo(rig, wTc, point, measured)
        cost = 0.5 * float(ours @ np.linalg.solve(covariance, ours))
        assert factor.error(values_of(wTc, point)) == pytest.approx(cost, rel=1e-10)


def test_the_pose_is_the_right_cameras() -> None:
    """A landmark worked out by hand: 2 m ahead, 0.4 m right and 0.2 m below the right camera."""
    wTc = g.pose(g.so3_exp(np.array([0.0, np.pi / 2, 0.0])), np.array([1.0, 2.0, 3.0]))
    point = np.array([1.0 + 2.0, 2.0 + 0.2, 3.0 - 0.4])  # ahead is the world's x, right its -z
    disparity = 277.0 * 0.1 / 2.0
    seen = np.array([159.5 + 277.0 * 0.2, 119.5 + 277.0 * 0.1, disparity])
    assert_near(residuals.stereo(RIG, wTc, point, seen), np.zeros(3), 1e-12)
    factor = stereo(RIG, seen, np.eye(3))
    assert_near(factor.unwhitenedError(values_of(wTc, point)), np.zeros(3), 1e-12)
    # GTSAM's own stereo camera is the left one: given its pose, without the bridge, it agrees.
    bare = gtsam.StereoCamera(
        gtsam.Pose3(g.right_from_left_camera(wTc, -0.1)),
        gtsam.Cal3_S2Stereo(277.0, 277.0, 0.0, 159.5, 119.5, 0.1),
    ).project(point)
    assert_near(np.array([bare.uL(), bare.uR(), bare.v()]), FROM_MEASUREMENT @ seen, 1e-12)


# --------------------------------------------------------------------------------------------
# Fused or raw


def information(factors: list[Any], values: Any) -> tuple[FloatArray, FloatArray]:
    """Information matrix and gradient of a sum of factors on the same variables."""
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph.linearize(values).hessian()


@pytest.mark.parametrize("rig", RIGS)
def test_fused_measurement_has_the_information_of_all_raw_pixels(
    rig: CameraRig, rng: np.random.Generator
) -> None:
    """Six numbers and three: information and gradient are equal, at and away from the optimum."""
    sigma, ratio = 0.35, vertical_to_horizontal(rig)
    fuse = measurement_map("fused", 3, ratio)
    raw = RawPixelFactors(rig, sigma, Whitening())
    for _ in range(20):
        wTc = random_pose(rng, 3.0)
        point = point_before(rng, wTc, rng.uniform(0.5, 20.0))
        pixels = pixel_model(3, ratio) @ image(rig, wTc, point) + rng.standard_normal(6)
        right, left, top = pixels.reshape(3, 2)
        values = values_of(wTc, point)
        one = information([stereo(rig, fuse @ pixels, sigma**2 * fuse @ fuse.T)], values)
        two = information([raw.pair(0, 1, right, left), raw.top(0, 1, top)], values)
        for a, b in zip(one, two, strict=True):
            assert_near(a, b, 1e-9 * np.abs(b).max())


# --------------------------------------------------------------------------------------------
# Singular places


def all_three(rig: CameraRig) -> list[Any]:
    raw = RawPixelFactors(rig, 1.0, Whitening())
    right, left = MEASURED[:2], np.array([179.0, 131.0])
    return [stereo(rig, MEASURED, np.eye(3)), raw.pair(0, 1, right, left), raw.top(0, 1, right)]


@pytest.mark.parametrize("depth", [0.0, -0.5])
@pytest.mark.parametrize("which", [0, 1, 2])
def test_behind_the_camera_the_residual_is_constant_without_gradient(
    depth: float, which: int
) -> None:
    values = values_of(np.eye(4), np.array([0.1, -0.2, depth]))
    factor = all_three(RIG)[which]
    constant = np.full(factor.dim(), 2.0 * RIG.fx)
    np.testing.assert_array_equal(factor.unwhitenedError(values), constant)
    jacobian, _ = factor.linearize(values).jacobian()
    np.testing.assert_array_equal(jacobian, np.zeros((factor.dim(), 9)))


@pytest.mark.parametrize("disparity", [0.0, -0.4])
def test_a_disparity_of_zero_or_less_is_an_ordinary_measurement_of_a_far_point(
    disparity: float, rng: np.random.Generator
) -> None:
    """It has no triangulation; as a factor it is linear in the pixels, like any other."""
    measured = np.array([150.0, 100.0, disparity])
    point = np.array([0.3, -0.7, 10.0])
    residual = partial(residuals.stereo_coordinates, RIG, measured=measured)
    covariance = random_covariance(rng, 3)
    mapped = FROM_MEASUREMENT @ covariance @ FROM_MEASUREMENT.T
    assert_as_specified(stereo(RIG, measured, covariance), residual, [np.eye(4), point], mapped)
    values = values_of(np.eye(4), point)
    error = stereo(RIG, measured, covariance).unwhitenedError(values)
    assert error[0] - error[1] == pytest.approx(27.7 / 10.0 - disparity, rel=1e-10)


# ------------------------------------------------------------------------------------------
# Kernels and chains of motions as plain functions, beside GTSAM and differences


NAMES: list[KernelName] = ["none", "huber", "cauchy", "geman_mcclure", "tukey"]


@pytest.mark.parametrize("name", NAMES)
def test_kernels_are_those_of_gtsam(name: KernelName) -> None:
    made = gtsam.noiseModel.mEstimator
    known = {
        "none": made.Null.Create(),
        "huber": made.Huber.Create(1.7),
        "cauchy": made.Cauchy.Create(1.7),
        "geman_mcclure": made.GemanMcClure.Create(1.7),
        "tukey": made.Tukey.Create(1.7),
    }[name]
    errors = np.array([0.0, 0.3, 1.5, 1.8, 6.0])
    weights, losses = (f(name, 1.7, errors**2) for f in (kernel_weights, kernel_losses))
    np.testing.assert_allclose(weights, [known.weight(e) for e in errors], rtol=1e-12)
    np.testing.assert_allclose(losses, [known.loss(e) for e in errors], rtol=1e-12)


@pytest.mark.parametrize("size", [0.0, 1e-3, 1.0])
def test_chains_of_motions_are_their_specification(size: float) -> None:
    rng = np.random.default_rng(3)
    poses = np.cumsum(size * rng.standard_normal((5, 3)), axis=0)
    speeds, steps = rng.standard_normal((5, 3)), rng.uniform(0.1, 0.4, 4)
    motion = ChainMotion(poses, speeds, steps)
    residual, (before, after) = motion.residual, motion.derivatives()
    for k in range(4):
        ends = (poses[k], speeds[k], poses[k + 1], speeds[k + 1])
        np.testing.assert_allclose(residual[k], constant_velocity(*ends, steps[k]), atol=1e-12)
        state = np.concatenate(ends)
        shifts = 1e-6 * np.eye(12)
        by = np.column_stack(
            [
                constant_velocity(*np.split(state + d, 4), steps[k])
                - constant_velocity(*np.split(state - d, 4), steps[k])
                for d in shifts
            ]
        )
        np.testing.assert_allclose(np.hstack([before[k], after[k]]), by / 2e-6, atol=1e-7)


def test_informations_of_motions() -> None:
    steps, density = np.array([0.1, 0.5]), np.array([0.2, 0.3, 0.7])
    for step, information in zip(steps, motion_informations(steps, density), strict=True):
        expected = constant_velocity_covariance(density, float(step))
        np.testing.assert_allclose(information @ expected, np.eye(6), atol=1e-9)
