"""The paper's polynomial of elevation over radius."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.cameras.omni import (
    HyperbolicMirror,
    MirrorFrame,
    RadialPolynomial,
    fit_radial_polynomial,
)
from fgslam.core.errors import CalibrationError

FRAME = MirrorFrame(320, 240, (159.5, 119.5))


def exact_mirror(xi: float) -> HyperbolicMirror:
    return HyperbolicMirror.with_view((320, 240), xi, (np.radians(-60), np.radians(20)))


@pytest.mark.parametrize("xi", [0.85, 0.9, 0.92, 0.95, 0.97])
def test_degree_five_fits_the_hyperbolic_mirror_within_a_tenth_of_a_degree(xi: float) -> None:
    camera = exact_mirror(xi)
    radii = (camera.inner_radius, camera.outer_radius)
    radius = np.linspace(*radii, 500)
    worst = {}
    for degree in (4, 5):
        fit = fit_radial_polynomial(FRAME, radii, (radius, camera.elevation(radius)), degree)
        worst[degree] = np.degrees(fit.worst)
    assert worst[5] <= 0.1
    assert worst[5] < 0.5 * worst[4]


def test_inverse_is_exact() -> None:
    camera = exact_mirror(0.92)
    radii = (camera.inner_radius, camera.outer_radius)
    radius = np.linspace(*radii, 300)
    fitted = fit_radial_polynomial(FRAME, radii, (radius, camera.elevation(radius))).camera
    np.testing.assert_allclose(fitted.radius(fitted.elevation(radius)), radius, atol=1e-10)
    assert np.isnan(fitted.radius(np.radians([-70.0, 30.0]))).all()
    pixels = FRAME.pixels(radius, np.linspace(-3, 3, 300))
    np.testing.assert_allclose(fitted.pixels(fitted.rays(pixels)), pixels, atol=1e-9)


def test_elevation_may_fall_with_the_radius() -> None:
    camera = RadialPolynomial(FRAME, 30.0, 110.0, coefficients=(0.2, -0.6))
    np.testing.assert_allclose(camera.elevation(np.array([30.0, 70.0, 110.0])), [0.8, 0.2, -0.4])
    np.testing.assert_allclose(camera.radius(np.array([0.8, 0.2, -0.4])), [30.0, 70.0, 110.0])


def test_noise_of_25_points_gives_the_designs_error() -> None:
    """25 points at 0.3 pixels of noise calibrate to 0.15 degrees rms."""
    camera = exact_mirror(0.92)
    radii = (camera.inner_radius, camera.outer_radius)
    dense = np.linspace(*radii, 300)
    rng = np.random.default_rng(5)
    errors = []
    for _ in range(50):
        radius = np.linspace(*radii, 25)
        samples = (radius + rng.normal(0.0, 0.3, 25), camera.elevation(radius))
        fitted = fit_radial_polynomial(FRAME, radii, samples).camera
        errors.append(fitted.elevation(dense) - camera.elevation(dense))
    assert np.degrees(np.sqrt(np.mean(np.square(errors)))) < 0.25


@pytest.mark.parametrize(
    ("samples", "reported"),
    [
        ((np.linspace(20, 110, 5), np.linspace(-1, 0.3, 5)), "5 different radii cannot fix degree"),
        ((np.full(9, 30.0), np.linspace(-1, 0.3, 9)), "1 different radii"),
        ((np.linspace(20, 110, 9), np.full(9, np.nan)), "not finite"),
        (
            (np.linspace(20, 110, 9), np.abs(np.linspace(-1, 1, 9))),
            "elevation turns back near radius 6",
        ),
    ],
)
def test_bad_samples(samples: tuple[np.ndarray, np.ndarray], reported: str) -> None:
    with pytest.raises(CalibrationError, match=reported):
        fit_radial_polynomial(FRAME, (20.0, 110.0), samples)
