"""The cylindrical view: its equations, what displaces its pixels, and files that name it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgslam.core import cylindrical
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.rig_checks import rig_fault
from fgslam.core.rig_correction import RigCorrection, displacements, term_names
from fgslam.core.sensors import CameraRig, pixel_model

RIG = CameraRig(400, 300, 120.0, 118.0, 199.5, 149.0, 0.1, None, np.eye(4), view="cylindrical")
PLANE = replace(RIG, view="perspective")
LEFT = np.array([RIG.baseline, 0.0, 0.0])


@pytest.fixture
def points(rng: np.random.Generator) -> FloatArray:
    """Up to 80 degrees to every side."""
    angles = np.radians(rng.uniform(-80.0, 80.0, (2, 300)))
    return cylindrical.view_rays(*angles) * rng.uniform(0.5, 6.0, (300, 1))


def numerical(function: Callable[[FloatArray], FloatArray], at: FloatArray) -> FloatArray:
    """Central differences (n, m, k) of a function of (n, k) rows."""
    step = 1e-6
    axes = np.eye(at.shape[1])
    columns = [(function(at + step * e) - function(at - step * e)) / (2 * step) for e in axes]
    return np.stack(columns, axis=2)


def test_rows_are_planes_through_the_baseline_and_columns_angles_within_them() -> None:
    right_down = np.array([[1.0, 2.0, 2.0], [0.0, 0.0, 3.0]])
    measured = g.project(RIG, right_down)
    across, apart = np.arctan2([1.0, 1.1], np.sqrt(8.0))
    np.testing.assert_allclose(
        measured[0],
        [199.5 + 120.0 * across, 149.0 + 118.0 * np.pi / 4, 120.0 * (apart - across)],
        rtol=0,
        atol=1e-10,
    )
    np.testing.assert_allclose(measured[1, :2], [199.5, 149.0], rtol=0, atol=1e-10)


def test_both_cameras_see_a_point_in_one_row(points: FloatArray) -> None:
    """The left one, 0.1 m to the left, as a reference of its own."""
    seen = g.project(RIG, points)
    from_left = g.project(RIG, points + LEFT)
    np.testing.assert_allclose(from_left[:, 1], seen[:, 1], rtol=0, atol=1e-10)
    np.testing.assert_allclose(from_left[:, 0], seen[:, 0] + seen[:, 2], rtol=0, atol=1e-10)


def test_triangulation_inverts_projection(points: FloatArray) -> None:
    back = g.triangulate(RIG, g.project(RIG, points))
    np.testing.assert_allclose(back, points, rtol=0, atol=1e-10)


def test_jacobians_are_those_of_finite_differences(points: FloatArray) -> None:
    slopes = g.projection_jacobian(RIG, points)
    expected = numerical(lambda p: g.project(RIG, p), points)
    np.testing.assert_allclose(slopes, expected, rtol=1e-6, atol=1e-5)
    one = np.broadcast_to(np.eye(3), slopes.shape)
    measured = g.project(RIG, points)
    back = cylindrical.point_jacobian(RIG, measured)
    np.testing.assert_allclose(back @ slopes, one, rtol=0, atol=1e-9)
    covariance = g.triangulation_covariance(RIG, measured, one)
    np.testing.assert_allclose(covariance, back @ np.swapaxes(back, 1, 2), rtol=1e-9, atol=1e-12)


def test_a_perspective_camera_would_measure_the_same_points(points: FloatArray) -> None:
    measured = g.project(RIG, points)
    planes, slopes = cylindrical.as_perspective(RIG, measured)
    np.testing.assert_allclose(planes, g.project(PLANE, points), rtol=1e-10, atol=1e-9)
    back = g.projection_jacobian(PLANE, points) @ cylindrical.point_jacobian(RIG, measured)
    np.testing.assert_allclose(slopes, back, rtol=1e-8, atol=1e-8)
    again = cylindrical.from_perspective(RIG, planes)
    np.testing.assert_allclose(again, measured, rtol=0, atol=1e-9)


def test_sizes_shrink_by_the_mean_of_both_directions() -> None:
    """A little square across the ray: its area in the image is as that of its distance."""
    point = np.array([[2.0, 1.0, 1.5]])
    sight = point[0] / np.linalg.norm(point)
    sides = np.linalg.svd(sight[None])[2][1:]
    image = g.projection_jacobian(replace(RIG, fy=RIG.fx), point)[0, :2] @ sides.T
    (distance,) = cylindrical.size_distances(RIG, point)
    assert np.sqrt(abs(np.linalg.det(image))) == pytest.approx(RIG.fx / distance, rel=1e-12)
    np.testing.assert_array_equal(cylindrical.size_distances(PLANE, point), [1.5])


# --------------------------------------------------------------------------------------------
# What a calibration leaves


def test_a_turn_of_the_left_camera_displaces_pixels_as_stated(points: FloatArray) -> None:
    """Yaw, pitch and roll as they are for a perspective rig: the same turns of the camera."""
    names = term_names(RIG)
    small = 1e-6
    for term, axis in (("yaw", (0, 1, 0)), ("pitch", (-1, 0, 0)), ("roll", (0, 0, 1))):
        turn = g.so3_exp(small * np.array(axis, np.float64))
        for rig in (RIG, PLANE):
            exact = (g.project(rig, points) @ pixel_model(2, 1.0).T).reshape(-1, 2, 2)
            local = (points + LEFT) @ turn.T
            moved = (g.project(rig, local)[:, :2] - exact[:, 1]) / small
            unit = displacements(rig, exact)[:, 2:, names.index(f"left.{term}")]
            np.testing.assert_allclose(unit, moved, rtol=1e-3, atol=1e-3)


def test_lens_terms_displace_an_equidistant_fisheye() -> None:
    angles = np.radians(np.random.default_rng(2).uniform(-80.0, 80.0, (50, 2)))
    angles[0] = 0.0
    points, slopes = cylindrical.on_fisheye(angles)
    np.testing.assert_allclose(slopes[0], np.eye(2), rtol=0, atol=1e-12)

    def seen(places: FloatArray) -> FloatArray:
        off = np.linalg.norm(places, axis=1)
        share = np.sinc(off / np.pi)
        rays = np.column_stack([share[:, None] * places, np.cos(off)])
        return np.column_stack([np.arcsin(rays[:, 0]), np.arctan2(rays[:, 1], rays[:, 2])])

    np.testing.assert_allclose(seen(points), angles, rtol=0, atol=1e-12)
    np.testing.assert_allclose(slopes, numerical(seen, points), rtol=0, atol=1e-6)


def test_a_calibration_leaves_a_pixel_in_the_mean_over_the_cylinder() -> None:
    """All terms can be told apart: the prior has an inverse, and its spread is as expected."""
    prior = RigCorrection.none(RIG)
    grid = np.stack(np.meshgrid(np.linspace(0, 399, 7), np.linspace(0, 299, 7)), axis=2)
    pixels = np.repeat(grid.reshape(-1, 1, 2), 2, axis=1)
    _, sigma = prior.at(pixels)
    left = np.sqrt((sigma[:, 2:] ** 2).sum(axis=1).mean())
    # Of its own terms and of those that all share a pixel each, in both directions.
    assert left == pytest.approx(2.0, rel=1e-6)


# --------------------------------------------------------------------------------------------
# Named in files


def test_a_log_says_that_its_view_is_cylindrical(tmp_path: Path) -> None:
    for rig in (RIG, PLANE):
        MeasurementLog(rig, {}).save(tmp_path / "measurements.npz")
        loaded = MeasurementLog.load(tmp_path / "measurements.npz").rig
        assert isinstance(loaded, CameraRig)
        assert loaded.view == rig.view


def test_three_cameras_and_unknown_views_are_no_rig() -> None:
    assert rig_fault(RIG) == ""
    for rig in (replace(RIG, vertical_baseline=0.1), replace(RIG, view="round")):  # type: ignore[arg-type]
        assert "give perspective, or of two cameras cylindrical" in rig_fault(rig)
