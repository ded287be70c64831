"""Predicted orientations of features where the camera rolls and pitches."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import transform_to_camera, wrap
from fgslam.core.sensors import CameraRig
from fgslam.frontend.features.settings import SiftSettings
from fgslam.frontend.features.sift import SiftExtractor
from fgslam.frontend.tracking.map_matching import lean


def rig_of(width: int, height: int) -> CameraRig:
    return CameraRig(
        fx=float(width), fy=float(width), cx=(width - 1) / 2, cy=(height - 1) / 2, width=width,
        height=height, baseline=0.2, vertical_baseline=None, bTc=np.eye(4),
    )  # fmt: skip


RIG = rig_of(320, 240)
GATE = np.deg2rad(20.0)


def turned(euler_deg: tuple[float, float, float]) -> FloatArray:
    """(4, 4) pose of a camera that yaws, pitches and rolls about its axes (y, x, z), degrees."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("YXZ", euler_deg, degrees=True).as_matrix()
    return pose


def pixels(points: FloatArray) -> FloatArray:
    return np.asarray(points[:, :2] / points[:, 2:] * RIG.fx)


def test_level_cameras_see_no_lean() -> None:
    points = np.random.default_rng(0).uniform([-2, -2, 1], [2, 2, 5], (20, 3))
    for yaw in (-170.0, 0.0, 40.0):
        assert np.array_equal(lean(RIG, turned((yaw, 0.0, 0.0)), points), np.zeros(20))


@pytest.mark.parametrize("angles", [(0, 0, 25), (30, 0, 25), (20, -15, -40), (-60, 30, 10)])
def test_lean_is_how_a_short_upright_line_is_turned(angles: tuple[float, float, float]) -> None:
    wTc = turned(angles)
    points = np.random.default_rng(1).uniform([-1, -1, 2], [1, 1, 5], (20, 3))
    ends = points + 1e-5 * wTc[1, :3]  # a little down in the world
    along = pixels(ends) - pixels(points)
    expected = np.arctan2(along[:, 1], along[:, 0]) - 0.5 * np.pi
    np.testing.assert_allclose(wrap(lean(RIG, wTc, points) - expected), 0.0, rtol=0, atol=1e-4)


@pytest.mark.data
@pytest.mark.parametrize("roll_deg", [-45.0, -25.0, 25.0, 45.0])
def test_a_rolled_view_keeps_its_features_within_the_gate(
    shared_data: Path, roll_deg: float
) -> None:
    """A view of the chess grid, and the same turned about its middle: a camera that rolls."""
    path = shared_data / "stanford_chess_grid" / "r08_c08.png"
    if not path.is_file():
        pytest.skip(f"no picture {path}: this test needs it")
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    height, width = image.shape
    rig = rig_of(width, height)
    extractor = SiftExtractor(SiftSettings(), "descriptor")
    wTc = turned((0.0, 0.0, roll_deg))
    level = extractor.extract(image)
    # What the camera sees turns the other way.
    seen = cv2.warpAffine(
        image, cv2.getRotationMatrix2D((rig.cx, rig.cy), roll_deg, 1.0), (width, height)
    )
    rolled = extractor.extract(seen)
    rays = np.column_stack([(level.xy - [rig.cx, rig.cy]) / width, np.ones(len(level.xy))])
    points = transform_to_camera(wTc, rays)
    places = points[:, :2] / points[:, 2:] * width + [rig.cx, rig.cy]
    apart = np.linalg.norm(places[:, None] - rolled.xy, axis=2)
    like = np.abs(np.log(level.scale[:, None] / rolled.scale)) < np.log(1.2)
    i, j = np.nonzero((apart < 1.0) & like)  # one place may have features of several orientations
    turn = rolled.orientation[j] - level.orientation[i]
    within = np.abs(wrap(turn - lean(rig, wTc, points)[i])) < GATE
    unturned = np.abs(wrap(turn)) < GATE
    found = len(np.unique(i))
    assert found > 100
    assert len(np.unique(i[within])) > 0.9 * found
    assert len(np.unique(i[unturned])) < 0.25 * found
