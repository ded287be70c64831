"""Boards in images: chessboards, AprilGrids, and ChArUco boards drawn through a known camera."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

from fgslam.cameras.boards import Board, find_corners, sizes_that_fit
from fgslam.cameras.calibrate import (
    View,
    calibrate,
)
from fgslam.cameras.lenses import RawCamera
from fgslam.cameras.trees import intrinsic_matrix
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import so3_exp


def chessboard(columns: int, rows: int) -> np.ndarray:
    squares = np.indices((rows + 1, columns + 1)).sum(axis=0) % 2
    drawn = np.kron(squares, np.ones((24, 24))) * 220.0
    return np.pad(drawn, 40, constant_values=220.0).astype(np.uint8)


def test_a_chessboard_is_found_and_another_size_is_named() -> None:
    image = chessboard(7, 5)
    found = find_corners(Board("chessboard", 7, 5, 0.02), image)
    assert found is not None
    assert len(found) == 35
    wrong = Board("chessboard", 8, 5, 0.02)
    assert find_corners(wrong, image) is None
    assert sizes_that_fit(wrong, image) == ["7x5"]


SEEN_AT = np.array([[60, 50], [400, 90], [380, 320], [90, 280]], np.float32)


def slanted(image: np.ndarray) -> tuple[np.ndarray, FloatArray]:
    """An image of a printed board seen from the side, and the homography."""
    height, width = image.shape
    edge = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    turn = cv2.getPerspectiveTransform(edge, SEEN_AT)
    seen = cv2.warpPerspective(image, turn, (480, 360), borderValue=120)
    return np.asarray(seen, np.uint8), np.asarray(turn, np.float64)


def cluttered(image: np.ndarray) -> np.ndarray:
    """Squares of other sizes around the board: no finder of saddles alone tells them apart."""
    white, _ = slanted(np.full((248, 296), 255, np.uint8))
    noise = np.random.default_rng(0).integers(0, 2, (36, 48), np.uint8) * 255
    around = cv2.resize(noise, (480, 360), interpolation=cv2.INTER_NEAREST)
    return np.where(white > 250, image, around)


def strung(image: np.ndarray) -> np.ndarray:
    """A white string before the board, which joins its squares."""
    return cv2.line(image.copy(), (0, 200), (480, 150), 255, 8)


def blurred(image: np.ndarray) -> np.ndarray:
    """Far out of focus."""
    return cv2.GaussianBlur(image, (0, 0), 9)


@pytest.mark.parametrize("spoilt", [cluttered, strung, blurred])
def test_a_chessboard_is_found_where_one_finder_of_opencv_finds_it(
    spoilt: Callable[[np.ndarray], np.ndarray],
) -> None:
    printed = chessboard(8, 6)
    image, turn = slanted(printed)
    board = Board("chessboard", 8, 6, 0.02)
    found = find_corners(board, spoilt(image))
    assert found is not None
    # Squares of 24 pixels, the first corner after 40 of margin and one square.
    true = cv2.perspectiveTransform(24.0 * board.points[None, :, :2] / 0.02 + 63.5, turn)[0]
    ways = [found.pixels[np.argsort(way)] for way in board.renumberings]
    off = min(np.median(np.linalg.norm(pixels - true, axis=1)) for pixels in ways)
    assert off < (2.0 if spoilt is blurred else 0.2)


def test_boards_look_the_same_after_some_turns() -> None:
    """Half a turn of any chessboard, a quarter of a square one; none of boards with markers."""
    half = Board("chessboard", 3, 2, 0.1).renumberings
    np.testing.assert_array_equal(half, [np.arange(6), np.arange(6)[::-1]])
    square = Board("chessboard", 3, 3, 0.1)
    assert len(square.renumberings) == 4
    for way in square.renumberings:
        origin, right, down = square.points[way[[0, 1, 3]], :2]
        assert np.linalg.det([right - origin, down - origin]) == pytest.approx(0.01)
    assert len(Board("charuco", 4, 4, 0.1).renumberings) == 1


def test_corners_do_not_depend_on_threads_or_on_what_was_found_before() -> None:
    image = strung(slanted(chessboard(8, 6))[0])
    found = []
    for threads in (1, 4):
        cv2.setNumThreads(threads)
        corners = find_corners(Board("chessboard", 8, 6, 0.02), image)
        assert corners is not None
        found.append(corners.pixels)
    np.testing.assert_array_equal(found[0], found[1])


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


# --------------------------------------------------------------------------------------------
# ChArUco boards, drawn through a known camera


CHARUCO = Board("charuco", 7, 5, 0.05, dictionary="DICT_5X5_100")
_CELL = 60  # pixels of a square of the print


def print_of_charuco() -> np.ndarray:
    markers = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
    print_ = cv2.aruco.CharucoBoard((7, 5), 0.05, 0.0375, markers)
    return np.asarray(print_.generateImage((7 * _CELL, 5 * _CELL), marginSize=0))


def rays_of_all(seen_by: RawCamera) -> FloatArray:
    columns, rows = np.meshgrid(np.arange(seen_by.width), np.arange(seen_by.height))
    return seen_by.unproject(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))


def drawn(
    rays: FloatArray, size: tuple[int, int], turn: FloatArray, away: FloatArray
) -> np.ndarray:
    """The printed board as a camera sees it, by the ray of every pixel."""
    width, height = size
    normal = turn[:, 2]
    depth = (normal @ away) / (rays @ normal)
    depth = np.where(depth > 0.0, depth, np.nan)
    flat = (rays * depth[:, None] - away) @ turn
    # Half a square's corner: the print's pixels are at their centres.
    at = ((flat[:, :2] + CHARUCO.square) / CHARUCO.square * _CELL - 0.5).astype(np.float32)
    maps = np.nan_to_num(at, nan=-1e4).reshape(height, width, 2)
    image = cv2.remap(
        print_of_charuco(), maps[..., 0], maps[..., 1], cv2.INTER_LINEAR, borderValue=150
    )
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.7), np.uint8)


def charuco_images(seen_by: RawCamera, count: int) -> list[np.ndarray]:
    rng, rays = np.random.default_rng(4), rays_of_all(seen_by)
    images = []
    for _ in range(count):
        turn = so3_exp(rng.uniform(-0.5, 0.5, 3))
        away = np.array([*rng.uniform(-0.12, 0.12, 2), rng.uniform(0.3, 0.42)])
        images.append(drawn(rays, seen_by.size, turn, away - turn @ CHARUCO.points.mean(axis=0)))
    return images


PERSPECTIVE = RawCamera(
    640, 480, intrinsic_matrix(450, 452, 325, 236), np.array([-0.2, 0.05, 0.001, 0, 0]), np.eye(4)
)


def test_a_charuco_board_gives_the_camera_that_drew_it() -> None:
    images = charuco_images(PERSPECTIVE, 12)
    views: list[View] = [(find_corners(CHARUCO, image),) for image in images]
    found = calibrate(CHARUCO, views, PERSPECTIVE.size, "radtan")
    assert sum(len(corners) for (corners,) in views if corners is not None) > 12 * 20
    assert found.rms < 0.2
    np.testing.assert_allclose(found.cameras[0].intrinsics, [450, 452, 325, 236], rtol=0, atol=1.0)
    columns, rows = np.meshgrid(np.arange(20.0, 640, 40), np.arange(20.0, 480, 40))
    pixels = np.column_stack([columns.ravel(), rows.ravel()])
    off = found.cameras[0].project(PERSPECTIVE.unproject(pixels)) - pixels
    # What all have in common is a turn of the camera, of which boards say little.
    assert np.median(np.linalg.norm(off - off.mean(axis=0), axis=1)) < 0.1


def test_a_charuco_board_is_read_in_a_mirror() -> None:
    (image,) = charuco_images(PERSPECTIVE, 1)
    reflected = np.ascontiguousarray(image[:, ::-1])
    direct, found = find_corners(CHARUCO, image), find_corners(CHARUCO, reflected, mirrored=True)
    assert find_corners(CHARUCO, reflected) is None
    assert direct is not None
    assert found is not None
    np.testing.assert_array_equal(found.ids, direct.ids)
    expected = np.column_stack([639.0 - direct.pixels[:, 0], direct.pixels[:, 1]])
    np.testing.assert_allclose(found.pixels, expected, rtol=0, atol=1e-3)


def test_markers_of_an_unknown_dictionary_are_refused() -> None:
    unknown = Board("charuco", 7, 5, 0.05, dictionary="DICT_9X9")
    with pytest.raises(CalibrationError, match="markers 'DICT_9X9' are not known to OpenCV"):
        find_corners(unknown, np.zeros((48, 64), np.uint8))
