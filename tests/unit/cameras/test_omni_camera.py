"""What all omnidirectional cameras share: bearings of pixels, and unwrapped views."""

from __future__ import annotations

import numpy as np
import pytest

from fgslam.cameras.omni import (
    OUTSIDE,
    Cylinder,
    Equirectangular,
    HyperbolicMirror,
    MirrorFrame,
    OmniCamera,
    angles_of,
    measure,
    unwrap_maps,
)
from fgslam.core.geometry import wrap

MIRROR = HyperbolicMirror.with_view((640, 480), 0.92, (np.radians(-70), np.radians(25)))


def test_a_panoramas_covariance_is_its_pixel_size() -> None:
    camera = Equirectangular(1025, 513)
    pixels = np.array([[100.0, 100.0], [512.0, 256.0], [1000.3, 400.7]])
    bearing, elevation, covariance = measure(camera, pixels, 0.5)
    np.testing.assert_allclose(bearing, np.pi - pixels[:, 0] * 2 * np.pi / 1024, atol=1e-12)
    np.testing.assert_allclose(elevation, np.pi / 2 - pixels[:, 1] * np.pi / 512, atol=1e-12)
    pixel = np.array([2 * np.pi / 1024, np.pi / 512])
    expected = np.broadcast_to(np.diag((0.5 * pixel) ** 2), (3, 2, 2))
    np.testing.assert_allclose(covariance, expected, rtol=1e-9, atol=1e-15)


def test_a_mirrors_covariance_is_its_radial_slope() -> None:
    """Across the radius a pixel is 1 / r; along it the slope of elevation over radius."""
    frame = MIRROR.frame
    radius = np.array([30.0, 90.0, 150.0, 230.0])
    bearing = np.array([0.2, 1.7, -2.0, 3.0])
    _, _, covariance = measure(MIRROR, frame.pixels(radius, bearing), np.array([0.3, 1, 2, 0.5]))
    slope = (MIRROR.elevation(radius + 1e-4) - MIRROR.elevation(radius - 1e-4)) / 2e-4
    sigma = np.array([0.3, 1.0, 2.0, 0.5])
    np.testing.assert_allclose(np.sqrt(covariance[:, 0, 0]), sigma / radius, rtol=1e-5)
    np.testing.assert_allclose(np.sqrt(covariance[:, 1, 1]), sigma * slope, rtol=1e-5)
    np.testing.assert_allclose(covariance[:, 0, 1], 0.0, atol=1e-8)


@pytest.mark.parametrize(
    "camera",
    [
        MIRROR,
        Cylinder(640, 200, -1.0, 0.6),
        HyperbolicMirror(
            MirrorFrame(640, 480, (320.0, 240.0), affine=(0.8, 0.1, -0.05)),
            20.0,
            200.0,
            xi=0.9,
            focal_px=90.0,
        ),
    ],
)
def test_monte_carlo(camera: OmniCamera) -> None:
    rng = np.random.default_rng(4)
    sigma = 0.4
    pixel = camera.pixels(np.array([[1.0, -0.6, -0.3]]))
    bearing, elevation, covariance = measure(camera, pixel, sigma)
    noisy = pixel + rng.normal(0.0, sigma, (40_000, 2))
    b, e = angles_of(camera.rays(noisy))
    sample = np.cov(np.stack([wrap(b - bearing), e - elevation]))
    scale = np.sqrt(np.outer(np.diag(covariance[0]), np.diag(covariance[0])))
    # Standard error of a sample variance: 0.7 %.
    np.testing.assert_allclose(sample / scale, covariance[0] / scale, atol=0.03)


def test_outside_and_at_the_border() -> None:
    ring = MIRROR.outer_radius
    at = MIRROR.frame.pixels(np.array([ring - 1e-6, ring + 5.0]), np.array([0.5, 0.5]))
    bearing, _, covariance = measure(MIRROR, at, 1.0)
    assert np.isfinite(bearing).tolist() == [True, False]
    assert np.isfinite(covariance).all(axis=(1, 2)).tolist() == [True, False]
    near = MIRROR.frame.pixels(np.array([ring - 1.0]), np.array([0.5]))
    _, _, within = measure(MIRROR, near, 1.0)
    np.testing.assert_allclose(covariance[0], within[0], rtol=0.05, atol=1e-7)


def test_measuring_no_pixels_gives_empty_arrays() -> None:
    bearing, elevation, covariance = measure(MIRROR, np.empty((0, 2)), 1.0)
    assert bearing.shape == elevation.shape == (0,)
    assert covariance.shape == (0, 2, 2)


def test_the_seam_behind_the_robot_is_no_jump() -> None:
    camera = Equirectangular(1025, 513)
    _, _, covariance = measure(camera, np.array([[0.0, 256.0], [1024.0, 256.0]]), 1.0)
    np.testing.assert_allclose(covariance[:, 0, 0], (2 * np.pi / 1024) ** 2, rtol=1e-9)


# --------------------------------------------------------------------------------------------
# Maps from one camera's picture to another's


UPRIGHT = HyperbolicMirror.with_view((320, 240), 0.92, (np.radians(-65), np.radians(25)))


def test_a_camera_on_itself_is_the_identity() -> None:
    camera = Cylinder(60, 40, -1.0, 1.0)
    columns, rows = unwrap_maps(camera, camera)
    assert columns.dtype == rows.dtype == np.float32
    expected = np.broadcast_to(np.arange(60.0), (40, 60))
    # The first column and the last one look the same way.
    np.testing.assert_allclose(columns[:, 1:-1], expected[:, 1:-1], atol=1e-4)
    np.testing.assert_allclose(rows, np.arange(40.0)[:, None] + np.zeros(60), atol=1e-4)


def test_unwrapped_pixels_lie_along_the_same_ray() -> None:
    panorama = Equirectangular(240, 60, np.radians(20), np.radians(-60))
    columns, rows = unwrap_maps(UPRIGHT, panorama)
    assert columns.shape == (60, 240)
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    grid = np.stack(np.meshgrid(np.arange(240), np.arange(60)), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(
        UPRIGHT.rays(pixels), panorama.rays(grid.astype(np.float64)), atol=2e-5
    )


def test_what_the_source_does_not_see_is_outside_its_picture() -> None:
    panorama = Equirectangular(90, 90)
    columns, rows = unwrap_maps(UPRIGHT, panorama)
    elevation = 90.0 - np.arange(90) * 180.0 / 89.0
    unseen = (elevation > 25.0) | (elevation < -65.0)
    assert (columns[unseen] == OUTSIDE).all()
    assert (rows[unseen] == OUTSIDE).all()
    assert (columns[~unseen] > -0.5).all()
    backward = unwrap_maps(panorama, UPRIGHT)
    outside = ~np.isfinite(
        UPRIGHT.rays(
            np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1).reshape(-1, 2)
        )[:, 0]
    ).reshape(240, 320)
    np.testing.assert_array_equal(backward[0] == OUTSIDE, outside)
