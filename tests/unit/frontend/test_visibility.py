"""Which landmarks are in view: the quick selection is that of a full scan, at any size of map."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import RIG
from test_database import database_of, landmark_map

from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.sensors import CameraRig
from fgslam.frontend.settings import DatabaseSettings
from fgslam.frontend.tracking.map_matching import BORDER_PX, CONE_DEG, FieldOfView, directions_to

MAX_DISPARITY = 40.0
TWO_CAMERAS = dataclasses.replace(RIG, vertical_baseline=None)
LOOKS = 90 * np.eye(3, 128, dtype=np.uint8)
SETTINGS = {
    "image": DatabaseSettings(),
    "cone": DatabaseSettings(field_of_view="cone"),
}


def full_scan(
    rig: CameraRig, settings: DatabaseSettings, points: FloatArray
) -> tuple[BoolArray, BoolArray]:
    """Points (n, 3) of the camera's frame that may be and that are in view, one by one."""
    possible, certain = np.zeros(len(points), np.bool_), np.zeros(len(points), np.bool_)
    for k, point in enumerate(points):
        if point[2] <= 0.1:
            continue
        column, row, disparity = g.project(rig, point[None])[0]
        top = disparity if rig.vertical_baseline is not None else 0.0
        if disparity > MAX_DISPARITY:
            continue
        if settings.field_of_view == "cone":
            tangent = np.tan(np.deg2rad(CONE_DEG))
            possible[k] = certain[k] = bool((np.abs(point[:2]) < tangent * point[2]).all())
            continue
        for out, border in ((possible, -BORDER_PX), (certain, BORDER_PX)):
            out[k] = (
                column >= border
                and column + disparity <= rig.width - 1 - border
                and row >= border
                and row + top <= rig.height - 1 - border
            )
    return possible, certain


@pytest.mark.parametrize("rig", [RIG, TWO_CAMERAS], ids=["three cameras", "two"])
@pytest.mark.parametrize("how", SETTINGS)
def test_the_selection_is_that_of_a_full_scan(how: str, rig: CameraRig) -> None:
    rng = np.random.default_rng(4)
    settings = SETTINGS[how]
    for _ in range(5):
        wTc = g.se3_exp(rng.standard_normal(6))
        # Half of them anywhere, half around the edges of the images, where it matters.
        edge = np.column_stack(
            [
                rng.choice([-8.0, 0.0, 8.0, 311.0, 319.0, 327.0], 400) + rng.normal(0, 0.5, 400),
                rng.uniform(-20.0, 260.0, 400),
                rng.uniform(0.5, 45.0, 400),
            ]
        )
        local = np.concatenate([rng.uniform(-6.0, 6.0, (400, 3)), g.triangulate(rig, edge)])
        positions = g.transform_to_world(wTc, local)
        found = FieldOfView(rig, settings, MAX_DISPARITY).select(wTc, positions)
        seen_from_there = g.transform_to_camera(wTc, positions)
        possible, certain = full_scan(rig, settings, seen_from_there)
        np.testing.assert_array_equal(found.rows, np.flatnonzero(possible))
        np.testing.assert_array_equal(found.certain, certain[possible])
        np.testing.assert_array_equal(found.points, seen_from_there[possible])
        np.testing.assert_array_equal(found.measurement, g.project(rig, found.points))
        assert 10 < len(found.rows) < 700  # a cone is a small part of a cylinder


def test_an_edge_of_the_image_is_inside() -> None:
    """Exactly on the border: neither test may lose it to rounding."""
    at = np.array([[-8.0, 100.0, 10.0], [100.0, -8.0, 10.0], [8.0, 100.0, 10.0]])
    rig = dataclasses.replace(RIG, fx=256.0, fy=256.0, cx=160.0, cy=120.0, baseline=0.125)
    found = FieldOfView(rig, SETTINGS["image"], MAX_DISPARITY).select(
        np.eye(4), g.triangulate(rig, at)
    )
    assert found.rows.tolist() == [0, 1, 2]
    assert found.certain.tolist() == [False, False, True]


def test_what_is_too_small_to_be_found_is_not_expected() -> None:
    points = g.triangulate(RIG, np.array([[100.0, 80.0, 10.0], [200.0, 120.0, 10.0]]))
    database = database_of(points, DatabaseSettings(least_scale_px=1.0))
    first_scale = 3.0  # pixels, seen from the origin
    for back in (0.0, 2.0, 6.0, 9.0):
        wTc = g.pose(np.eye(3), np.array([0.0, 0.0, -back]))
        scale = first_scale * points[:, 2] / (points[:, 2] + back)
        found = database.expected(landmark_map(points), wTc)
        assert found.ids.tolist() == np.flatnonzero(scale >= 1.0).tolist()
        np.testing.assert_allclose(found.scale, scale[found.ids])


def test_directions_are_unit_vectors_in_the_world() -> None:
    rng = np.random.default_rng(6)
    wTc = g.se3_exp(rng.standard_normal(6))
    positions = rng.standard_normal((20, 3))
    found = directions_to(wTc, g.transform_to_camera(wTc, positions))
    from_camera = positions - wTc[:3, 3]
    np.testing.assert_allclose(
        found * np.linalg.norm(from_camera, axis=1)[:, None], from_camera, atol=1e-12
    )
