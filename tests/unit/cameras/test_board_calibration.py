"""Cameras found from corners of a board: simulated ones against the truth, real ones by size."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fgslam.cameras.boards import Board, Corners, find_corners, sizes_that_fit
from fgslam.cameras.calibrate import BoardCalibration, View, calibrate, coverage, held_out, judged
from fgslam.cameras.lenses import RawCamera
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import inverse, se3_exp, so3_exp

BOARD = Board("chessboard", 9, 6, 0.04)
SIZE = (640, 480)
NOISE_PX = 0.1
PARAMETERS = {
    "radtan": np.array([-0.3, 0.1, 0.001, -0.0005, -0.01]),
    "equidistant": np.array([0.02, -0.01, 0.004, -0.001]),
}
POSES = (
    np.zeros(6),
    np.array([0.01, -0.02, 0.015, 0.1, 0.002, 0.001]),
    np.array([-0.02, 0.01, 0.0, 0.05, -0.09, 0.0]),
)


def rig(model: str, cameras: int) -> list[RawCamera]:
    focal = 450.0 if model == "radtan" else 210.0
    return [
        RawCamera(
            *SIZE,
            np.array([[focal + k, 0.0, 320.0 + 5 * k], [0.0, focal - k, 240.0], [0, 0, 1.0]]),
            PARAMETERS[model],
            se3_exp(turn),
            model=model,
        )
        for k, turn in enumerate(POSES[:cameras])
    ]


def seen_by(cameras: list[RawCamera], rng: np.random.Generator, count: int = 14) -> list[View]:
    """Boards at random before the cameras; corners outside an image are not seen by it."""
    views: list[View] = []
    centred = BOARD.points - BOARD.points.mean(axis=0)
    while len(views) < count:
        away = np.array([*rng.uniform(-0.25, 0.25, 2), rng.uniform(0.3, 0.7)])
        points = centred @ so3_exp(rng.uniform(-0.5, 0.5, 3)).T + away
        views.append(tuple(_corners(camera, points, rng) for camera in cameras))
    return views


def _corners(camera: RawCamera, points: FloatArray, rng: np.random.Generator) -> Corners | None:
    cTf = inverse(camera.bTc)
    pixels = camera.project(points @ cTf[:3, :3].T + cTf[:3, 3])
    inside = ((pixels >= 0) & (pixels <= np.array(SIZE) - 1)).all(axis=1)
    if inside.sum() < 20:
        return None
    noisy = pixels + rng.normal(0.0, NOISE_PX, pixels.shape)
    return Corners(np.flatnonzero(inside), noisy[inside])


def normalised_error(found: BoardCalibration, true: list[RawCamera]) -> float:
    """Mean squared error over the stated variance, of all intrinsics and positions."""
    parts = []
    for k, (camera, exact) in enumerate(zip(found.cameras, true, strict=True)):
        rows = ((0, 0), (1, 1), (0, 2), (1, 2))
        intrinsics = [camera.matrix[at] - exact.matrix[at] for at in rows]
        off = np.concatenate([intrinsics, camera.distortion - exact.distortion])
        parts.append(off / found.sigmas[k])
        if k:
            shift = inverse(camera.bTc)[:3, 3] - inverse(exact.bTc)[:3, 3]
            parts.append(shift / found.turn_sigmas[k, 3:])
    return float(np.mean(np.concatenate(parts) ** 2))


@pytest.mark.parametrize(
    ("model", "cameras"),
    [pytest.param("radtan", 3, marks=pytest.mark.slow), ("equidistant", 2)],
)
def test_cameras_are_found_and_their_uncertainty_is_honest(model: str, cameras: int) -> None:
    errors = []
    for seed in range(6):
        true = rig(model, cameras)
        views = seen_by(true, np.random.default_rng(seed))
        found = calibrate(BOARD, views, SIZE, model)
        assert found.rms == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.1)
        assert found.left_out == 0
        errors.append(normalised_error(found, true))
    assert 0.6 < np.mean(errors) < 1.6  # 130 to 200 numbers, of which those of a lens correlate


def test_corners_that_were_found_wrongly_are_left_out() -> None:
    rng = np.random.default_rng(3)
    true = rig("radtan", 2)
    views = seen_by(true, rng)
    spoilt = 0
    for k in range(0, 14, 2):
        corners = views[k][1]
        if corners is None:
            continue
        pixels = corners.pixels.copy()
        pixels[:4] += 5.0
        spoilt += 4
        views[k] = (views[k][0], Corners(corners.ids, pixels))
    assert spoilt >= 12
    found = calibrate(BOARD, views, SIZE, "radtan")
    assert spoilt <= found.left_out <= spoilt + 3
    assert normalised_error(found, true) < 2.0


def test_held_out_images_show_rows_and_squares() -> None:
    true = rig("radtan", 2)
    views = seen_by(true, np.random.default_rng(5), count=20)
    held = held_out(BOARD, views, SIZE, "radtan")
    assert held is not None
    assert held.rows_px == pytest.approx(np.sqrt(2.0) * NOISE_PX, rel=0.3)
    assert held.square == pytest.approx(0.04, rel=2e-3)
    found = calibrate(BOARD, views, SIZE, "radtan")
    turned = replace(
        found.cameras[1], bTc=found.cameras[1].bTc @ se3_exp(np.array([0.01, 0, 0, 0, 0, 0]))
    )
    knocked = judged(BOARD, replace(found, cameras=(found.cameras[0], turned)), views, 1)
    assert knocked is not None
    assert knocked.rows_px > 10 * held.rows_px
    assert 0.5 < coverage(views, 0, SIZE) <= 1.0


def test_too_few_images_and_cameras_that_never_see_the_board_together_are_refused() -> None:
    views = seen_by(rig("radtan", 2), np.random.default_rng(0))
    with pytest.raises(CalibrationError, match="the left camera shows the board in 4 images"):
        calibrate(BOARD, views[:4], SIZE, "radtan")
    apart: list[View] = [(a, None) if k % 2 else (None, b) for k, (a, b) in enumerate(views)]
    with pytest.raises(CalibrationError, match="never see the board at the same time"):
        calibrate(BOARD, apart, SIZE, "radtan")


# --------------------------------------------------------------------------------------------
# Boards in images


def chessboard(columns: int, rows: int) -> np.ndarray:
    squares = np.indices((rows + 1, columns + 1)).sum(axis=0) % 2
    drawn = np.kron(squares, np.ones((24, 24))) * 220.0
    return np.pad(drawn, 40, constant_values=220.0).astype(np.uint8)


def test_boards_that_no_camera_saw_are_refused_in_one_line() -> None:
    """Corners at perspectives of which no two have the same focal length."""
    rng = np.random.default_rng(6)
    flat = (BOARD.points[None, :, :2] * 1000.0 + 100.0).astype(np.float32)
    edge = np.array([[0, 0], [400, 0], [400, 320], [0, 320]], np.float32)
    views: list[View] = []
    for _ in range(8):
        there = edge + rng.uniform(-40.0, 40.0, (4, 2)).astype(np.float32)
        pixels = cv2.perspectiveTransform(flat, cv2.getPerspectiveTransform(edge, there))
        views.append((Corners(np.arange(len(BOARD.points)), pixels[0].astype(np.float64)),))
    with pytest.raises(CalibrationError, match="off what radtan cameras show of a flat board"):
        calibrate(BOARD, views, SIZE, "radtan")


def test_a_chessboard_is_found_and_another_size_is_named() -> None:
    image = chessboard(7, 5)
    found = find_corners(Board("chessboard", 7, 5, 0.02), image)
    assert found is not None
    assert len(found) == 35
    wrong = Board("chessboard", 8, 5, 0.02)
    assert find_corners(wrong, image) is None
    assert sizes_that_fit(wrong, image) == ["7x5"]


def test_corners_of_an_aprilgrid_lie_on_its_plane_whatever_way_the_tags_are_turned() -> None:
    board = Board("aprilgrid", 3, 2, 0.1, spacing=0.3)
    tag, gap = 80, 24
    image = np.full((2 * tag + 3 * gap, 3 * tag + 4 * gap), 255, np.uint8)
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    for number in range(6):
        row, column = divmod(number, 3)
        y, x = image.shape[0] - (row + 1) * (tag + gap), gap + column * (tag + gap)
        drawn = cv2.aruco.generateImageMarker(markers, number, tag, borderBits=2)
        image[y : y + tag, x : x + tag] = drawn
    found = find_corners(board, image)
    assert found is not None
    assert len(found) == 24
    flat = board.points[found.ids, :2]
    homography = cv2.findHomography(flat, found.pixels)[0]
    shown = cv2.perspectiveTransform(flat[None], homography)[0]
    assert np.linalg.norm(shown - found.pixels, axis=1).max() < 1.5


def test_boards_that_cannot_be_are_refused() -> None:
    for wrong in (("circles", 9, 6, 0.1), ("chessboard", 1, 6, 0.1), ("chessboard", 9, 6, 0.0)):
        with pytest.raises(CalibrationError):
            Board(*wrong)
