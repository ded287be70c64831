"""Kernels and chains of motions as plain functions, beside GTSAM and differences."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from factor_specifications import constant_velocity, constant_velocity_covariance

from fgslam.factors.bearing import ChainMotion, motion_informations
from fgslam.factors.noise import KernelName, kernel_losses, kernel_weights

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
