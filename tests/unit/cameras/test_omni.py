"""Omnidirectional cameras: panoramas, mirrors, the polynomial of elevation, and OCamCalib."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.polynomial import polynomial

from fgslam.cameras.omni import (
    OUTSIDE,
    Cylinder,
    Equirectangular,
    HyperbolicMirror,
    LensCamera,
    MirrorFrame,
    OmniCamera,
    RadialPolynomial,
    angles_of,
    fit_radial_polynomial,
    measure,
    read_ocamcalib,
    unwrap_maps,
)
from fgslam.cameras.omni_files import make_camera
from fgslam.cameras.settings import OCamCalibSettings
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


def test_the_raw_mirror_image_is_seen_from_below() -> None:
    camera = HyperbolicMirror.with_view((320, 240), 0.92, (-1.1, 0.4))
    ahead, left, down = camera.pixels(np.array([[2.0, 0, 0], [0, 2.0, 0], [1.0, 0, -1.0]]))
    horizon = camera.focal_px / camera.xi
    np.testing.assert_allclose(ahead, [159.5, 119.5 - horizon], atol=1e-9)
    np.testing.assert_allclose(left, [159.5 + horizon, 119.5], atol=1e-9)
    assert 119.5 - horizon < down[1] < 119.5
    flipped = replace(camera, frame=replace(camera.frame, clockwise=False))
    np.testing.assert_allclose(
        flipped.pixels(np.array([[0, 2.0, 0]]))[0], [159.5 - horizon, 119.5], atol=1e-9
    )
    turned = replace(camera, frame=replace(camera.frame, ahead=0.0))
    np.testing.assert_allclose(
        turned.pixels(np.array([[2.0, 0, 0]]))[0], [159.5 + horizon, 119.5], atol=1e-9
    )


# --------------------------------------------------------------------------------------------
# The hyperbolic mirror


@pytest.mark.parametrize(("a", "b"), [(28.0, 23.4), (10.0, 30.0)])
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
        (lambda: MirrorFrame(320, 240, (400.0, 120.0)), "lies outside the 320x240 picture"),
        (lambda: MirrorFrame(320, 240, (9.0, 9.0), float("inf")), "ahead is inf"),
        (lambda: Equirectangular(1, 10), "at least 2x2"),
        (lambda: Equirectangular(10, 10, -1.0, 1.0), "they must rise"),
        (lambda: HyperbolicMirror.with_view((9, 9), 0.9, (-1.0, 1.3)), "below arcsin"),
    ],
)
def test_impossible_cameras_are_refused(make: object, reported: str) -> None:
    with pytest.raises(CalibrationError, match=reported):
        make()  # type: ignore[operator]


# --------------------------------------------------------------------------------------------
# Unwrapped views


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


# --------------------------------------------------------------------------------------------
# Covariances of pixels, and maps from one picture to another


MIRROR = HyperbolicMirror.with_view((640, 480), 0.92, (np.radians(-70), np.radians(25)))


@pytest.mark.parametrize(
    "camera",
    [
        MIRROR,
        Cylinder(640, 200, -1.0, 0.6),
        HyperbolicMirror(
            MirrorFrame(640, 480, (320.0, 240.0), 0.3, False),
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


# --------------------------------------------------------------------------------------------
# Maps from one camera's picture to another's


UPRIGHT = HyperbolicMirror.with_view((320, 240), 0.92, (np.radians(-65), np.radians(25)))


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


# --------------------------------------------------------------------------------------------
# The paper's polynomial of elevation over radius


FRAME = MirrorFrame(320, 240, (159.5, 119.5))


def exact_mirror(xi: float) -> HyperbolicMirror:
    return HyperbolicMirror.with_view((320, 240), xi, (np.radians(-60), np.radians(20)))


@pytest.mark.parametrize("xi", [0.85, 0.97])
def test_degree_five_fits_the_hyperbolic_mirror_within_a_tenth_of_a_degree(xi: float) -> None:
    camera = exact_mirror(xi)
    radii = (camera.inner_radius, camera.outer_radius)
    radius = np.linspace(*radii, 500)
    worst = {}
    for degree in (4, 5):
        _, off = fit_radial_polynomial(FRAME, radii, (radius, camera.elevation(radius)), degree)
        worst[degree] = np.degrees(off)
    assert worst[5] <= 0.1
    assert worst[5] < 0.5 * worst[4]


def test_inverse_is_exact() -> None:
    camera = exact_mirror(0.92)
    radii = (camera.inner_radius, camera.outer_radius)
    radius = np.linspace(*radii, 300)
    fitted = fit_radial_polynomial(FRAME, radii, (radius, camera.elevation(radius)))[0]
    np.testing.assert_allclose(fitted.radius(fitted.elevation(radius)), radius, atol=1e-10)
    assert np.isnan(fitted.radius(np.radians([-70.0, 30.0]))).all()
    pixels = FRAME.pixels(radius, np.linspace(-3, 3, 300))
    np.testing.assert_allclose(fitted.pixels(fitted.rays(pixels)), pixels, atol=1e-9)


def test_elevation_may_fall_with_the_radius() -> None:
    camera = RadialPolynomial(FRAME, 30.0, 110.0, coefficients=(0.2, -0.6))
    np.testing.assert_allclose(camera.elevation(np.array([30.0, 70.0, 110.0])), [0.8, 0.2, -0.4])
    np.testing.assert_allclose(camera.radius(np.array([0.8, 0.2, -0.4])), [30.0, 70.0, 110.0])


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


# --------------------------------------------------------------------------------------------
# OCamCalib's polynomial camera and its result file


DIRECT = (-266.588, 0.0, 1.220001e-3, -5.78173e-7, 2.003631e-9)
RING = (235.0, 530.0)


def inverse_polynomial(degree: int = 12) -> np.ndarray:
    """Radius over the angle atan(f / rho), as OCamCalib fits it."""
    radius = np.linspace(*RING, 400)
    angle = np.arctan2(polynomial.polyval(radius, DIRECT), radius)
    return polynomial.polyfit(angle, radius, degree)


def text(**changes: str) -> str:
    inverse = inverse_polynomial()
    entries = {
        "direct": f"{len(DIRECT)} " + " ".join(f"{a:.9e}" for a in DIRECT),
        "inverse": f"{len(inverse)} " + " ".join(f"{a:.9f}" for a in inverse),
        "centre": "545.872616 674.318875",
        "affine": "0.999 0.003 0.002",
        "size": "1080 1300",
        "ring": "530 235",
        "crop": "300 320",
    } | changes
    comments = {"ring": "#ROI max min radius", "crop": "#left right cropped pixel"}
    return "\n\n".join(f"{comments.get(k, '#' + k)}\n\n{v}" for k, v in entries.items() if v)


def written(folder: Path, content: str) -> Path:
    path = folder / "calib_results.txt"
    path.write_text(content, encoding="utf-8")
    return path


def read(
    folder: Path,
    content: str = text(),
    size: tuple[int, int] | None = None,
    **settings: Any,
) -> LensCamera:
    path = written(folder, content)
    camera = make_camera(OCamCalibSettings(file=str(path), **settings), size)
    assert isinstance(camera, LensCamera)
    return camera


def test_calibration_file_is_read_in_full(tmp_path: Path) -> None:
    raw, ring, cropped = read_ocamcalib(written(tmp_path, text()))
    assert raw.model == "ocam"
    assert tuple(raw.distortion) == DIRECT
    assert raw.matrix[:2].tolist() == [[1.0, 0.002, 674.318875], [0.003, 0.999, 545.872616]]
    assert raw.size == (1300, 1080)
    assert ring == RING
    assert cropped == (300, 320)


def test_comments_stand_beside_values_too(tmp_path: Path) -> None:
    camera = read(tmp_path)
    noted = text(centre="545.872616, 674.318875  # row, column", affine="0.999 0.003 0.002 % c d e")
    assert read(tmp_path, noted.replace("#ROI", "% ROI")) == camera
    assert read(tmp_path, noted.replace("#", "#\n#")) == camera  # an empty one is none


def test_pixels_are_exact_where_the_inverse_polynomial_is_not(tmp_path: Path) -> None:
    camera = read(tmp_path)
    rng = np.random.default_rng(6)
    pixels = rng.uniform(0.0, 1.0, (20_000, 2)) * [1299, 1079]
    rays = camera.rays(pixels)
    seen = np.isfinite(rays[:, 0])
    assert 0.4 < seen.mean() < 0.7
    np.testing.assert_allclose(camera.pixels(2.0 * rays[seen]), pixels[seen], atol=1e-9)


def test_rays_follow_the_toolboxs_definition(tmp_path: Path) -> None:
    """(x, y) by the inverse of [[c, d], [e, 1]] on rows and columns, then (x, y, f(rho))."""
    pixels = np.array([[900.0, 300.0], [300.0, 800.0], [674.0, 100.0]])
    c, d, e = 0.999, 0.003, 0.002
    offset = pixels[:, ::-1] - (545.872616, 674.318875)
    x, y = np.linalg.solve(np.array([[c, d], [e, 1.0]]), offset.T)
    rho = np.hypot(x, y)
    f = polynomial.polyval(rho, DIRECT)
    bearing, elevation = angles_of(read(tmp_path, ahead_deg=0.0).rays(pixels))
    np.testing.assert_allclose(elevation, np.arctan2(f, rho), atol=1e-12)
    np.testing.assert_allclose(bearing, np.arctan2(x, y), atol=1e-12)


def test_an_uncropped_picture_has_its_centre_further_right(tmp_path: Path) -> None:
    cropped, whole = read(tmp_path), read(tmp_path, size=(1920, 1080))
    pixels = np.array([[900.0, 300.0], [300.0, 800.0]])
    np.testing.assert_array_equal(cropped.rays(pixels), whole.rays(pixels + np.array([300.0, 0.0])))
    with pytest.raises(CalibrationError, match=r"1300x1080 \(or 1920x1080 uncropped\).*640x480"):
        read(tmp_path, size=(640, 480))


def test_a_ring_over_which_the_polynomial_turns_back_is_refused() -> None:
    numbers = (320, 240, "ocam", (1.0, 0.0, 160.0, 0.0, 1.0, 120.0, 0.0, 0.0, 1.0))
    direct = (-60.0, 0.0, 0.006, -4e-5)
    assert LensCamera(*numbers, direct, (20.0, 100.0)).ring == (20.0, 100.0)
    with pytest.raises(CalibrationError, match=r"turns back near radius 1[0-9.]+ px .* narrow"):
        LensCamera(*numbers, direct, (20.0, 200.0))


def test_without_a_ring_the_largest_circle_is_taken(tmp_path: Path) -> None:
    plain = text(ring="", crop="")
    assert read(tmp_path, plain).ring == pytest.approx((0.0, 1079 - 545.872616))
    assert read(tmp_path, plain, ring_px=(240.0, 300.0)).ring == (240.0, 300.0)
    with pytest.raises(CalibrationError, match="pictures of 1300x1080, but"):
        read(tmp_path, plain, (1920, 1080))


@pytest.mark.parametrize(
    ("content", "reported"),
    [
        (text(direct="5 -266 0 1e-3 -5e-7"), "line 3: direct.*states 5 .* has 4"),
        (text(affine="0 1 1"), "c - d e > 0"),
        (text(size="1080.5 1300"), "line 19: size.*whole numbers"),
        (text(centre="5450 674"), "principal point .* is far from the image of 1300x1080"),
        (text(ring="235 530"), "line 23: ring: largest radius 235"),
        (text(extra="1 2 3"), "line 31: an entry that is not known"),
        (text(direct="5 266 0 -1e-3 5e-7 -2e-9"), "turns back|inverse polynomial is"),
        (text(inverse="2 400.0 300.0"), "inverse polynomial is .* px off"),
        ("#only a comment\n", "has 0 entries"),
    ],
)
def test_malformed_files_name_the_line(tmp_path: Path, content: str, reported: str) -> None:
    with pytest.raises(CalibrationError, match=reported) as caught:
        read_ocamcalib(written(tmp_path, content))
    assert "calib_results.txt" in str(caught.value)
    assert "\n" not in str(caught.value)
