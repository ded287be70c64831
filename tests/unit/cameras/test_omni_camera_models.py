"""Panoramas, cylinders and hyperbolic mirrors as cameras."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from fgslam.cameras.omni import (
    Cylinder,
    Equirectangular,
    HyperbolicMirror,
    MirrorFrame,
    OmniCamera,
    angles_of,
)
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import wrap


def mirror(**changes: float) -> HyperbolicMirror:
    frame = MirrorFrame(640, 480, (321.5, 236.25), ahead=0.3)
    values = {"inner_radius": 20.0, "outer_radius": 225.0, "xi": 0.92, "focal_px": 120.0} | changes
    return HyperbolicMirror(
        frame,
        values["inner_radius"],
        values["outer_radius"],
        xi=values["xi"],
        focal_px=values["focal_px"],
    )


def rays_all_around(rng: np.random.Generator, count: int) -> FloatArray:
    return rng.normal(size=(count, 3)) * rng.uniform(0.1, 10.0, (count, 1))


# --------------------------------------------------------------------------------------------
# Directions


@pytest.mark.parametrize("camera", [Equirectangular(721, 361), Cylinder(721, 361, -1.0, 1.0)])
def test_columns_of_unwrapped_views_run_clockwise_from_behind(camera: OmniCamera) -> None:
    pixels = np.array([[360.0, 180.0], [180.0, 180.0], [540.0, 180.0], [0.0, 180.0]])
    forward, left, right, back = camera.rays(pixels)
    np.testing.assert_allclose(forward, [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(left, [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(right, [0, -1, 0], atol=1e-15)
    np.testing.assert_allclose(back, [-1, 0, 0], atol=1e-15)
    up = camera.rays(np.array([[360.0, 90.0]]))[0]
    assert abs(up[1]) < 1e-15
    assert up[2] > 0.4


def test_an_equirectangular_panorama_is_that_of_omni_home() -> None:
    camera = Equirectangular(2048, 1024)
    u, v = 1300.0, 200.0
    bearing, elevation = angles_of(camera.rays(np.array([[u, v]])))
    assert np.degrees(bearing[0]) == pytest.approx(-(u / 2047 * 360 - 180), abs=1e-12)
    assert np.degrees(elevation[0]) == pytest.approx(90 - v / 1023 * 180, abs=1e-12)


def test_the_raw_mirror_image_is_seen_from_below() -> None:
    camera = HyperbolicMirror.with_view((320, 240), 0.92, (-1.1, 0.4))
    ahead, left, down = camera.pixels(np.array([[2.0, 0, 0], [0, 2.0, 0], [1.0, 0, -1.0]]))
    horizon = camera.focal_px / camera.xi
    np.testing.assert_allclose(ahead, [159.5, 119.5 - horizon], atol=1e-9)
    np.testing.assert_allclose(left, [159.5 + horizon, 119.5], atol=1e-9)
    assert 119.5 - horizon < down[1] < 119.5
    flipped = HyperbolicMirror.with_view((320, 240), 0.92, (-1.1, 0.4), clockwise=False)
    np.testing.assert_allclose(
        flipped.pixels(np.array([[0, 2.0, 0]]))[0], [159.5 - horizon, 119.5], atol=1e-9
    )
    turned = HyperbolicMirror.with_view((320, 240), 0.92, (-1.1, 0.4), ahead=0.0)
    np.testing.assert_allclose(
        turned.pixels(np.array([[2.0, 0, 0]]))[0], [159.5 + horizon, 119.5], atol=1e-9
    )


# --------------------------------------------------------------------------------------------
# The hyperbolic mirror


@pytest.mark.parametrize(("a", "b"), [(28.0, 23.4), (40.0, 20.0), (10.0, 30.0)])
def test_the_unified_model_is_reflection_on_the_hyperboloid(a: float, b: float) -> None:
    """Rays of a pinhole camera at the lower focus, reflected: all through the upper focus."""
    c = np.hypot(a, b)
    focal = 400.0
    # Up to nine tenths of the asymptote, where the mirror ends at infinity.
    radius = np.linspace(1.0, 0.9 * focal * b / a, 400)
    d = np.column_stack([radius / focal, np.ones_like(radius)])
    # From (0, -2c) along d to (z + c)^2 / a^2 - r^2 / b^2 = 1: quadratic in the ray's length.
    qa = d[:, 1] ** 2 / a**2 - d[:, 0] ** 2 / b**2
    qb = -2.0 * c * d[:, 1] / a**2
    qc = c**2 / a**2 - 1.0
    t = (-qb + np.sqrt(qb**2 - 4.0 * qa * qc)) / (2.0 * qa)
    hit = t[:, None] * d + [0.0, -2.0 * c]
    normal = np.column_stack([-hit[:, 0] / b**2, (hit[:, 1] + c) / a**2])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    out = d - 2.0 * (d * normal).sum(axis=1, keepdims=True) * normal
    missed = hit[:, 0] * out[:, 1] - hit[:, 1] * out[:, 0]
    np.testing.assert_allclose(missed / np.linalg.norm(out, axis=1), 0.0, atol=1e-9 * a)
    expected = np.arctan2(out[:, 1], out[:, 0])
    assert expected[0] < 0.0 < expected[-1]  # both sides of the horizon

    size = 2 * int(radius[-1]) + 3
    frame = MirrorFrame(size, size, (size / 2.0, size / 2.0))
    both = 2.0 * a * a + b * b  # docs/derivations/omni.md
    xi, unified = 2.0 * a * float(np.hypot(a, b)) / both, focal * b * b / both
    camera = HyperbolicMirror(frame, 0.0, radius[-1], xi=xi, focal_px=unified)
    np.testing.assert_allclose(camera.elevation(radius), expected, atol=1e-9)
    np.testing.assert_allclose(camera.radius(expected), radius, rtol=1e-9)


def test_round_trip_above_and_below_the_horizon() -> None:
    rng = np.random.default_rng(1)
    camera = mirror()
    pixels = rng.uniform(0.0, 1.0, (20_000, 2)) * [640, 480] - 0.5
    rays = camera.rays(pixels)
    seen = np.isfinite(rays[:, 0])
    assert 0.4 < seen.mean() < 0.6
    assert (rays[seen, 2] > 0.1).sum() > 500
    assert (rays[seen, 2] < -0.1).sum() > 500
    np.testing.assert_allclose(np.linalg.norm(rays[seen], axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(camera.pixels(7.0 * rays[seen]), pixels[seen], atol=1e-9)
    back = camera.rays(camera.pixels(rays[seen]))
    np.testing.assert_allclose(back, rays[seen], atol=1e-12)


def test_gtsam_agrees_in_the_half_space_that_it_covers() -> None:
    """Cal3Unified looks along its z axis; a mirror's picture is about the nadir."""
    camera = HyperbolicMirror(
        MirrorFrame(640, 480, (321.5, 236.25)), 0.0, 300.0, xi=0.9, focal_px=120.0
    )
    gtsam_camera = gtsam.Cal3Unified(120.0, 120.0, 0.0, 321.5, 236.25, 0, 0, 0, 0, 0.9)
    rng = np.random.default_rng(2)
    rays = rays_all_around(rng, 500)
    rays = rays[rays[:, 2] < -0.05]
    pixels = camera.pixels(rays)
    seen = np.isfinite(pixels[:, 0])
    assert seen.sum() > 100
    for ray, pixel in zip(rays[seen], pixels[seen], strict=True):
        # Camera's axes, seen from below: columns to the robot's left, rows backward, z down.
        x, y, z = ray[1], -ray[0], -ray[2]
        np.testing.assert_allclose(
            gtsam_camera.uncalibrate(np.array([x / z, y / z])), pixel, atol=1e-9
        )


def test_nothing_is_seen_outside_the_ring_or_the_picture() -> None:
    camera = mirror(outer_radius=300.0)
    centre = np.array(camera.frame.centre)
    pixels = centre + np.array([[19.9, 0.0], [20.1, 0.0], [0.0, 243.9], [0.0, 300.0], [-321.9, 0]])
    assert np.isfinite(camera.rays(pixels)[:, 0]).tolist() == [False, True, False, False, False]
    nadir = np.array([[0.0, 0.0, -1.0], [0.01, 0.0, -1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 5.0]])
    assert np.isnan(camera.pixels(nadir)).all()
    assert np.isnan(camera.pixels(np.full((1, 3), np.nan))).all()


def test_a_mirror_with_a_given_view_has_that_view() -> None:
    camera = HyperbolicMirror.with_view((320, 240), 0.92, (np.radians(-65), np.radians(25)))
    assert camera.outer_radius == 119.5
    limits = camera.elevation(np.array([camera.inner_radius, camera.outer_radius]))
    np.testing.assert_allclose(np.degrees(limits), [-65, 25], atol=1e-10)


@pytest.mark.parametrize(
    ("make", "reported"),
    [
        (lambda: mirror(inner_radius=230.0), "radii from 230 to 225"),
        (lambda: mirror(xi=1.2), "xi 1.2 must lie in"),
        (lambda: mirror(focal_px=float("nan")), "focal_px nan"),
        (lambda: MirrorFrame(320, 240, (400.0, 120.0)), "lies outside the 320x240 picture"),
        (lambda: MirrorFrame(320, 240, (float("nan"), 1.0)), "lies outside"),
        (lambda: MirrorFrame(320, 240, (9.0, 9.0), affine=(1.0, 2.0, 1.0)), "c - d e > 0"),
        (lambda: Equirectangular(1, 10), "at least 2x2"),
        (lambda: Equirectangular(10, 10, -1.0, 1.0), "they must rise"),
        (lambda: Cylinder(10, 10, 1.0, -1.0), "they must rise"),
        (lambda: HyperbolicMirror.with_view((9, 9), 0.9, (-1.0, 1.3)), "below arcsin"),
    ],
)
def test_impossible_cameras_are_refused(make: object, reported: str) -> None:
    with pytest.raises(CalibrationError, match=reported):
        make()  # type: ignore[operator]


# --------------------------------------------------------------------------------------------
# Unwrapped views


@pytest.mark.parametrize(
    "camera",
    [
        Equirectangular(512, 256),
        Equirectangular(512, 100, np.radians(30), np.radians(-50)),
        Cylinder(512, 200, -0.7, 1.3),
    ],
)
def test_round_trip_of_unwrapped_views(camera: OmniCamera) -> None:
    rng = np.random.default_rng(3)
    pixels = rng.uniform(0.0, 1.0, (2000, 2)) * [camera.width - 1.001, camera.height - 1]
    pixels[:, 0] += 1e-3  # the first and the last column are one direction
    rays = camera.rays(pixels)
    np.testing.assert_allclose(camera.pixels(3.0 * rays), pixels, atol=1e-9)


def test_a_vertical_segment_scales_about_the_horizon_alone_when_its_distance_changes() -> None:
    """Rows of a cylinder are proportional to height over distance."""
    camera = Cylinder(800, 401, -1.0, 1.0)
    horizon = camera.pixels(np.array([[1.0, 0.0, 0.0]]))[0, 1]
    heights = np.linspace(-0.9, 1.4, 12)
    rows = {}
    for distance in (1.5, 2.0, 6.0):
        points = np.column_stack(
            [np.full(12, distance * np.cos(0.7)), np.full(12, distance * np.sin(0.7)), heights]
        )
        pixels = camera.pixels(points)
        np.testing.assert_allclose(pixels[:, 0], pixels[0, 0], atol=1e-9)
        rows[distance] = pixels[:, 1] - horizon
    np.testing.assert_allclose(rows[1.5] * 1.5, rows[6.0] * 6.0, atol=1e-9)
    np.testing.assert_allclose(rows[1.5] * 1.5, rows[2.0] * 2.0, atol=1e-9)
    # A panorama has no such property: that is why column segments live on a cylinder.
    panorama = Equirectangular(800, 401)
    middle = panorama.pixels(np.array([[1.0, 0.0, 0.0]]))[0, 1]
    near = panorama.pixels(np.array([[1.5, 0.0, 1.4]]))[0, 1] - middle
    far = panorama.pixels(np.array([[6.0, 0.0, 1.4]]))[0, 1] - middle
    assert abs(near * 1.5 - far * 6.0) > 5.0


def test_bearings_do_not_jump_but_wrap() -> None:
    camera = mirror()
    around = np.linspace(-np.pi, np.pi, 1001)
    rays = np.column_stack([np.cos(around), np.sin(around), np.full(1001, -0.3)])
    bearing, _ = angles_of(camera.rays(camera.pixels(rays)))
    np.testing.assert_allclose(wrap(bearing - around), 0.0, atol=1e-12)
