"""Calibration from rendered pictures: rings, the mirror's circle, straight edges."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from edge_straightness import upright_edges

from fgslam.cameras.omni import Cylinder, HyperbolicMirror, MirrorFrame, OmniCamera, unwrap_maps
from fgslam.cameras.rings import (
    calibrate_from_rings,
    find_mirror_circle,
)
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import CalibrationError

FRAME = MirrorFrame(640, 480, (322.4, 236.7))
MIRROR = HyperbolicMirror(FRAME, 32.0, 232.0, xi=0.92, focal_px=127.0)


def rendered(camera: OmniCamera, levels: FloatArray, noise: float = 2.0) -> Image:
    """A noisy picture of levels at nine points a pixel (9, height * width); NaN is dark."""
    mean = np.where(np.isfinite(levels), levels, 10.0).mean(axis=0)
    noisy = mean + np.random.default_rng(0).normal(0.0, noise, len(mean))
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8).reshape(camera.height, camera.width)


def sampled_rays(camera: OmniCamera) -> FloatArray:
    """(9, height * width, 3) rays at nine points a pixel."""
    grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)
    pixels = grid.reshape(-1, 2).astype(np.float64)
    thirds = np.array([-1.0, 0.0, 1.0]) / 3.0
    return np.stack([camera.rays(pixels + np.array([a, b])) for a in thirds for b in thirds])


@pytest.fixture(scope="module")
def rays() -> FloatArray:
    return sampled_rays(MIRROR)


def test_the_papers_calibration_from_a_picture_of_rings(rays: FloatArray) -> None:
    limits = MIRROR.elevation(np.array([36.0, 227.0]))
    elevations = np.linspace(limits[0], limits[1], 21)
    band = np.searchsorted(elevations, np.arcsin(rays[..., 2]))
    levels = np.where(np.isfinite(rays[..., 2]), np.where(band % 2, 200.0, 40.0), np.nan)
    picture = rendered(MIRROR, levels)
    found = calibrate_from_rings(picture, elevations, FRAME, (33.0, 230.0))
    assert found.directions > 0.95
    np.testing.assert_allclose(found.radii, MIRROR.radius(elevations), atol=0.15)
    assert np.degrees(found.worst) < 0.1
    radius = np.linspace(36.0, 227.0, 300)
    error = np.degrees(found.camera.elevation(radius) - MIRROR.elevation(radius))
    assert np.abs(error).max() < 0.1
    with pytest.raises(CalibrationError, match="show 30 rings"):
        calibrate_from_rings(picture, np.linspace(-1, 0.4, 30), FRAME, (33.0, 230.0))


def test_the_mirrors_circle_and_a_mirror_off_its_place(rays: FloatArray) -> None:
    bearing = np.arctan2(rays[..., 1], rays[..., 0])
    wall = 120.0 + 60.0 * np.sign(np.sin(9.0 * bearing)) * np.sign(rays[..., 2] + 0.2)
    picture = rendered(MIRROR, wall)
    circle = find_mirror_circle(picture, np.random.default_rng(0))
    np.testing.assert_allclose(circle.centre, FRAME.centre, atol=0.3)
    assert circle.radius == pytest.approx(232.0, abs=0.5)
    assert circle.support > 0.8
    shifted = np.roll(picture, (3, -4), axis=(0, 1))
    near = FRAME.centre, MIRROR.outer_radius
    circle = find_mirror_circle(shifted, np.random.default_rng(0), near)
    np.testing.assert_allclose(circle.centre, np.add(FRAME.centre, (-4, 3)), atol=0.3)


def test_no_circle_in_a_picture_without_a_mirror() -> None:
    noise = np.random.default_rng(1).integers(0, 255, (120, 160), dtype=np.uint8)
    for picture in (np.zeros((120, 160), np.uint8), np.full((120, 160), 90, np.uint8), noise):
        with pytest.raises(CalibrationError, match="no mirror's circle"):
            find_mirror_circle(picture, np.random.default_rng(0))


def test_upright_edges_stay_upright_unless_the_centre_is_wrong(rays: FloatArray) -> None:
    bearing = np.arctan2(rays[..., 1], rays[..., 0])
    stripes = np.where(
        np.isfinite(bearing), 120.0 + 70.0 * np.sign(np.sin(8.0 * bearing + 0.4)), np.nan
    )
    picture = rendered(MIRROR, stripes)
    view = Cylinder(1200, 300, -1.0, 0.4)
    straight = upright_edges(unwrapped(picture, MIRROR, view), 200)
    assert len(straight) == 16
    assert np.median(straight.bow) < 0.3
    assert np.degrees(np.abs(straight.lean)).max() < 0.2
    wrong = HyperbolicMirror(
        MirrorFrame(640, 480, (326.4, 236.7)), 32.0, 232.0, xi=0.92, focal_px=127.0
    )
    leaning = upright_edges(unwrapped(picture, wrong, view), 200)
    assert np.degrees(np.abs(leaning.lean)).max() > 1.0


def unwrapped(picture: Image, source: OmniCamera, target: OmniCamera) -> Image:
    return np.asarray(cv2.remap(picture, *unwrap_maps(source, target), cv2.INTER_LINEAR))
