"""Camera models: each inverts itself, and agrees with OpenCV where it has the model."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from fgslam.cameras.lenses import LENSES, RawCamera
from fgslam.core.arrays import FloatArray

SIZE = (640, 400)
MATRIX = np.array([[300.0, 0.0, 317.0], [0.0, 301.0, 203.0], [0.0, 0.0, 1.0]])
TILTED = [-0.2, 0.05, 1e-3, -5e-4, 0.01, 0, 0, 0, 1e-3, 0, 0, 1e-3, 0.02, -0.01]
PARAMETERS = {
    "radtan": [-0.28, 0.07, 2e-4, 2e-5],
    "rational": [0.5, 0.1, 1e-3, -5e-4, 0.01, 0.7, 0.15, 0.002],
    "tilted": TILTED,
    "equidistant": [-0.0138, 0.0217, -0.02, 0.0094],
    "fov": [0.93],
    "ds": [-0.2786, 0.5607],
    "eucm": [0.5799, 1.1833],
    "omni": [2.0011, 0.2625, -0.8542, 5.0e-3, 4e-4],
    "omni inside": [0.81, -0.34, 0.17, -6.7e-4, 7.2e-4],
    "ocam": [-209.2, 0.0, 0.0021374, -4.22e-6, 1.77e-8],
}
MODELS = {"rational": "radtan", "tilted": "radtan", "omni inside": "omni"}
FOCAL = {"omni": 2.8, "omni inside": 2.2, "ds": 0.7, "ocam": 1.0 / 300.0}


def camera(kind: str) -> RawCamera:
    matrix = np.diag([FOCAL.get(kind, 1.0)] * 2 + [1.0]) @ MATRIX
    matrix[:2, 2] = MATRIX[:2, 2]
    model = MODELS.get(kind, kind)
    return RawCamera(*SIZE, matrix, np.array(PARAMETERS[kind], float), np.eye(4), kind, model)


def rays(widest_deg: float, n: int = 500) -> FloatArray:
    """Unit rays up to an angle from the axis, of any direction around it."""
    rng = np.random.default_rng(3)
    angle = np.radians(rng.uniform(0.0, widest_deg, n))
    around = rng.uniform(0.0, 2.0 * np.pi, n)
    return np.column_stack(
        [np.sin(angle) * np.cos(around), np.sin(angle) * np.sin(around), np.cos(angle)]
    )


@pytest.mark.parametrize("kind", PARAMETERS)
def test_every_pixel_comes_back(kind: str) -> None:
    found = camera(kind)
    columns, rows = np.meshgrid(np.arange(0.0, SIZE[0], 7.0), np.arange(0.0, SIZE[1], 7.0))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    seen = found.unproject(pixels)
    assert np.isfinite(seen).all()
    np.testing.assert_allclose(np.linalg.norm(seen, axis=1), 1.0, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(found.project(seen), pixels, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(found.project(3.0 * seen), pixels, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize("kind", ["radtan", "rational", "tilted", "equidistant"])
def test_it_is_opencvs_model(kind: str) -> None:
    found, points = camera(kind), rays(40.0)
    parameters = np.array(PARAMETERS[kind], float)
    if kind == "equidistant":
        expected = cv2.fisheye.projectPoints(
            points[:, None], np.zeros(3), np.zeros(3), MATRIX, parameters
        )[0]
    else:
        expected = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, parameters)[0]
    pixels = np.asarray(expected).reshape(-1, 2)
    np.testing.assert_allclose(found.project(points), pixels, rtol=0.0, atol=1e-9)


def test_a_fisheye_sees_behind_itself() -> None:
    found = camera("equidistant")
    behind = np.array([[np.sin(1.65), 0.0, np.cos(1.65)]])
    assert behind[0, 2] < 0.0
    np.testing.assert_allclose(found.unproject(found.project(behind)), behind, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("kind", PARAMETERS)
def test_what_it_cannot_see_is_nan(kind: str) -> None:
    backward = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]])
    if kind not in ("equidistant", "ocam"):
        assert np.isnan(camera(kind).project(backward)[0]).all()
    assert np.isnan(camera(kind).project(backward)[1]).all()


def test_distortion_that_turns_back_shows_no_place_twice() -> None:
    """r (1 - 0.28 r^2 + ...) has its largest value at 1.35: what lies beyond is not seen."""
    found = RawCamera(*SIZE, MATRIX, np.array([-0.28, 0.0, 0.0, 0.0]), np.eye(4))
    turning = 1.0 / np.sqrt(3 * 0.28)
    tangents = np.array([0.5, 0.99, 1.02, 3.0]) * turning
    pixels = found.project(np.column_stack([tangents, np.zeros(4), np.ones(4)]))
    np.testing.assert_array_equal(np.isfinite(pixels[:, 0]), [True, True, False, False])
    beyond = MATRIX[:2, 2] + [300.0 * turning, 0.0]
    assert np.isnan(found.unproject(beyond[None])).all()


def test_the_field_of_view_ends_where_the_model_does() -> None:
    """An equidistant lens of 300 px a radian over 640 px: 122.2 degrees."""
    found = RawCamera(*SIZE, MATRIX, np.zeros(4), np.eye(4), model="equidistant")
    np.testing.assert_allclose(
        np.degrees(found.field_of_view()[:2]),
        np.degrees([640 / 300, 400 / 301]),
        rtol=0.0,
        atol=0.01,
    )
    assert found.focal_px == pytest.approx(300.5, abs=0.01)


def test_a_scaled_camera_sees_the_same_rays() -> None:
    found = camera("radtan")
    half = found.scaled((320, 200))
    corner = np.array([[-0.5, -0.5]])  # of the image, at any size
    np.testing.assert_allclose(half.unproject(corner), found.unproject(corner), atol=1e-12)
    np.testing.assert_allclose(
        half.unproject(np.array([[99.75, 49.75]])),
        found.unproject(np.array([[200.0, 100.0]])),
        rtol=0.0,
        atol=1e-12,
    )


def test_all_models_are_tried() -> None:
    assert {MODELS.get(kind, kind) for kind in PARAMETERS} == set(LENSES)
