"""Noise models: full covariances, the cache, and robust kernels on whole measurements."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from factor_checks import assert_near, random_covariance, root_information, values_of
from simulated import RIG

from fgslam.factors.graphs import is_pose, landmark_key, number, pose_key
from fgslam.factors.landmark import FROM_MEASUREMENT, StereoFactors
from fgslam.factors.noise import KernelName, Whitening

WIDTH = 1.7
WEIGHTS: dict[KernelName, Callable[[float], float]] = {
    "none": lambda e: 1.0,
    "huber": lambda e: 1.0 if e <= WIDTH else WIDTH / e,
    "cauchy": lambda e: 1.0 / (1.0 + (e / WIDTH) ** 2),
    "geman_mcclure": lambda e: 1.0 / (1.0 + (e / WIDTH) ** 2) ** 2,
    "tukey": lambda e: (1.0 - (e / WIDTH) ** 2) ** 2 if e <= WIDTH else 0.0,
}
LOSSES: dict[KernelName, Callable[[float], float]] = {
    "none": lambda e: e**2 / 2,
    "huber": lambda e: e**2 / 2 if e <= WIDTH else WIDTH * (e - WIDTH / 2),
    "cauchy": lambda e: WIDTH**2 / 2 * np.log(1.0 + (e / WIDTH) ** 2),
    "geman_mcclure": lambda e: e**2 / 2 / (1.0 + (e / WIDTH) ** 2),
    "tukey": lambda e: WIDTH**2 / 6 * (1.0 - max(0.0, 1.0 - (e / WIDTH) ** 2) ** 3),
}
"""After Barron, Zhang and the textbooks: the loss of the whitened norm e, its weight rho'(e) / e.

Geman-McClure in the scaling whose weight at zero is one.
"""


@pytest.mark.parametrize("name", WEIGHTS)
@pytest.mark.parametrize("deviations", [0.0, 0.3, 1.69, 1.71, 3.0, 30.0])
def test_a_kernel_sees_the_norm_of_the_whole_measurement(
    name: KernelName, deviations: float, rng: np.random.Generator
) -> None:
    """In any direction of a correlated three-vector: cost and weight by its norm alone."""
    covariance = random_covariance(rng, 3)
    point = np.array([0.2, -0.1, 3.0])
    seen = RIG.predict(point[None, :])[0]
    values = values_of(np.eye(4), point)
    plain, robust = StereoFactors(RIG, Whitening()), StereoFactors(RIG, Whitening(name, WIDTH))
    for _ in range(5):
        direction = rng.standard_normal(3)
        direction /= np.linalg.norm(direction)
        measured = seen - deviations * np.linalg.cholesky(covariance) @ direction
        without = plain.factor(0, 1, measured, covariance)
        factor = robust.factor(0, 1, measured, covariance)
        assert np.linalg.norm(without.whitenedError(values)) == pytest.approx(deviations, abs=1e-9)
        assert factor.error(values) == pytest.approx(LOSSES[name](deviations), abs=1e-9)
        root = np.sqrt(WEIGHTS[name](deviations))
        for a, b in zip(
            factor.linearize(values).jacobian(), without.linearize(values).jacobian(), strict=True
        ):
            assert_near(a, root * b, 1e-9 * max(1.0, np.abs(b).max()))


def test_a_covariance_is_whitened_in_full(rng: np.random.Generator) -> None:
    whitening = Whitening()
    for n in (2, 3, 6):
        covariance, error = random_covariance(rng, n), rng.standard_normal(n)
        found = whitening.model(covariance).whiten(error)
        assert_near(found, root_information(covariance) @ error, 1e-12 * np.abs(found).max())


def test_a_mapped_covariance_is_that_of_the_mapped_measurement(rng: np.random.Generator) -> None:
    covariance = random_covariance(rng, 3)
    model = Whitening().model(covariance, FROM_MEASUREMENT)
    error = rng.standard_normal(3)
    squared = float(np.sum(model.whiten(FROM_MEASUREMENT @ error) ** 2))
    assert squared == pytest.approx(float(error @ np.linalg.solve(covariance, error)), rel=1e-10)


def test_equal_covariances_share_a_model_and_different_ones_never(
    rng: np.random.Generator,
) -> None:
    whitening = Whitening("cauchy", 2.0)
    first = random_covariance(rng, 3)
    model = whitening.model(first)
    assert whitening.model(first.copy()) is model
    assert whitening.model(np.asfortranarray(first)) is model
    last_bit = first.copy()
    last_bit[2, 2] = np.nextafter(last_bit[2, 2], np.inf)
    assert whitening.model(last_bit) is not model
    assert whitening.model(first[:2, :2]) is not model


def test_a_covariance_changed_in_place_afterwards_is_another(rng: np.random.Generator) -> None:
    whitening = Whitening()
    covariance = random_covariance(rng, 3)
    before = whitening.model(covariance)
    error = np.array([1.0, 0.0, 0.0])
    first = before.whiten(error)
    covariance *= 4.0
    assert_near(whitening.model(covariance).whiten(error), 0.5 * first, 1e-12)
    assert_near(before.whiten(error), first, 0.0)


def test_keys_hold_kind_and_number() -> None:
    for n in (0, 1, 255, 2**31, 2**40):
        assert is_pose(pose_key(n))
        assert not is_pose(landmark_key(n))
        assert number(pose_key(n)) == number(landmark_key(n)) == n
    assert pose_key(0) > landmark_key(2**40)  # landmarks come first in every list of keys
