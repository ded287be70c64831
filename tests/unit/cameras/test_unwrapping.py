"""Maps from one camera's picture to another's."""

from __future__ import annotations

import numpy as np

from fgslam.cameras.omni.camera import OUTSIDE, unwrap_maps
from fgslam.cameras.omni.mirrors import HyperbolicMirror
from fgslam.cameras.omni.panoramas import Cylinder, Equirectangular

MIRROR = HyperbolicMirror.with_view((320, 240), 0.92, (np.radians(-65), np.radians(25)))


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
    columns, rows = unwrap_maps(MIRROR, panorama)
    assert columns.shape == (60, 240)
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    grid = np.stack(np.meshgrid(np.arange(240), np.arange(60)), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(
        MIRROR.rays(pixels), panorama.rays(grid.astype(np.float64)), atol=2e-5
    )


def test_what_the_source_does_not_see_is_outside_its_picture() -> None:
    panorama = Equirectangular(90, 90)
    columns, rows = unwrap_maps(MIRROR, panorama)
    elevation = 90.0 - np.arange(90) * 180.0 / 89.0
    unseen = (elevation > 25.0) | (elevation < -65.0)
    assert (columns[unseen] == OUTSIDE).all()
    assert (rows[unseen] == OUTSIDE).all()
    assert (columns[~unseen] > -0.5).all()
    backward = unwrap_maps(panorama, MIRROR)
    outside = ~np.isfinite(
        MIRROR.rays(
            np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), axis=-1).reshape(-1, 2)
        )[:, 0]
    ).reshape(240, 320)
    np.testing.assert_array_equal(backward[0] == OUTSIDE, outside)
