"""Readers and calibrations on real panoramas and mirror images (`shared/data`)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from fgslam.cameras.omni import Cylinder, Equirectangular, RadialCamera, unwrap_maps
from fgslam.cameras.rings import find_mirror_circle
from fgslam.cameras.settings import OCamCalibSettings
from fgslam.core.arrays import FloatArray, Image
from fgslam.datasets.omni import OmniRecording
from fgslam.datasets.opening import open_omni
from fgslam.datasets.settings import OmniPathSettings, OmniVideoSettings, PanoramasSettings

pytestmark = pytest.mark.data

BOARD = (6, 9)


def present(root: Path, name: str) -> Path:
    if not (root / name).exists():
        pytest.skip(f"no {name} in {root}: this test needs it")
    return root / name


# --------------------------------------------------------------------------------------------
# Panoramas


def test_omni_home(shared_data: Path) -> None:
    folder = present(shared_data, "omni_home")
    recording = open_omni(PanoramasSettings(path=str(folder), width=1024))
    assert recording.ids.tolist() == list(range(2, 18))
    assert recording.camera == Equirectangular(1024, 512)
    assert recording.notes == ()
    assert recording.rooms is not None
    assert recording.rooms.count("living room") == 4
    assert recording.poses is not None
    np.testing.assert_allclose(
        recording.poses[0], [-0.0041, -0.1195, np.radians(-90.535)], atol=1e-12
    )
    assert recording.image(15).shape == (512, 1024, 3)
    full = open_omni(PanoramasSettings(path=str(folder)))
    difference = full.image(3).mean(axis=(0, 1)) - recording.image(3).mean(axis=(0, 1))
    assert np.abs(difference).max() < 1.0


# --------------------------------------------------------------------------------------------
# Mirror images


def test_the_mirror_video(shared_data: Path) -> None:
    video = present(shared_data, "omni_mirror/bloggie_walk.mp4")
    recording = open_omni(OmniVideoSettings(path=str(video)))
    assert len(recording) == 391
    assert recording.timestamps[390] == pytest.approx(390 / 29.97, abs=1e-3)
    camera = recording.camera
    assert isinstance(camera, RadialCamera)
    near, rng = (camera.frame.centre, camera.outer_radius), np.random.default_rng(0)
    circle = find_mirror_circle(recording.image(0), rng, near)
    assert np.hypot(*np.subtract(circle.centre, near[0])) < 1.5
    assert circle.radius == pytest.approx(camera.outer_radius, abs=1.5)
    assert circle.support > 0.7
    # Thirteen seconds later the loose accessory has not moved in the picture.
    later = find_mirror_circle(recording.image(390), rng, near)
    assert np.hypot(*np.subtract(later.centre, near[0])) < 1.5


def ocamcalib(shared_data: Path) -> OmniRecording:
    folder = present(shared_data, "omni_mirror")
    camera = OCamCalibSettings(file="omniunwarp_calib_results.txt")
    return open_omni(
        OmniPathSettings(path=str(folder), pattern="omniunwarp_example.jpg", camera=camera)
    )


def unwrapped(recording: OmniRecording, view: Cylinder) -> Image:
    maps = unwrap_maps(recording.camera, view)
    return np.asarray(cv2.remap(recording.image(0), *maps, cv2.INTER_LINEAR))


VIEW = Cylinder(2400, 530, float(np.tan(np.radians(-40.4))), float(np.tan(np.radians(27.0))))


def test_a_chessboard_in_the_mirror_is_a_plane(shared_data: Path) -> None:
    """Its corners' rays, over 34 degrees of elevation, map to a grid by one homography."""
    recording = ocamcalib(shared_data)
    board = unwrapped(recording, VIEW)[:, 220:530]
    found, corners = cv2.findChessboardCornersSB(
        cv2.resize(cv2.cvtColor(board, cv2.COLOR_RGB2GRAY), None, fx=2, fy=2),
        BOARD,
        flags=cv2.CALIB_CB_EXHAUSTIVE,
    )
    assert found
    pixels = recording.camera.pixels(
        VIEW.rays((corners.reshape(-1, 2).astype(np.float64) + 0.5) / 2.0 - 0.5 + [220.0, 0.0])
    )
    right = plane_error(recording.camera.rays(pixels))
    assert np.degrees(right) < 0.06
    # A calibration of another place in the picture is noticed.
    wrong = recording.camera.rays(pixels + np.array([30.0, 0.0]))
    assert plane_error(wrong) > 1.3 * right


def plane_error(rays: FloatArray) -> float:
    """Root mean square angle by which rays of a board's corners miss a plane grid, radians."""
    middle = rays.mean(axis=0) / np.linalg.norm(rays.mean(axis=0))
    across = np.cross([0.0, 0.0, 1.0], middle)
    across /= np.linalg.norm(across)
    down = np.cross(middle, across)
    image = np.column_stack([rays @ across, rays @ down]) / (rays @ middle)[:, None]
    grid = np.array([[i, j] for j in range(BOARD[1]) for i in range(BOARD[0])], np.float64)
    homography, _ = cv2.findHomography(grid, image)
    mapped = np.column_stack([grid, np.ones(len(grid))]) @ homography.T
    away = mapped[:, :2] / mapped[:, 2:] - image
    return float(np.sqrt((away**2).sum(axis=1).mean()))
