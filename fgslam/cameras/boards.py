"""Calibration boards and where their corners are in an image: chessboard, ChArUco, AprilGrid.

Found by OpenCV's detectors; points of a board are numbered, so that a board that is seen in part
still identifies them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from fgslam.core.arrays import FloatArray, Image, IntArray, Rows
from fgslam.core.errors import CalibrationError

KINDS = ("chessboard", "charuco", "aprilgrid")
_BLACK_BORDER_BITS = 2  # Kalibr prints its tags with two
_CORNERS_OF_TAG = 4
_LEAST_TAGS = 4
_WINDOW_OF_TAG = 0.1  # of a tag's side, half the window of refinement: less than half the gap
_WINDOW_OF_SQUARE = 0.2  # of the distance to the nearest corner, half the window of refinement
_SADDLES = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_EXHAUSTIVE
_LEAST_CORNERS = 6  # of which a pose follows with something left to judge it by


@dataclass(frozen=True, slots=True, eq=False)
class Corners(Rows):
    """Corners of a board in one image: which (n,), and where (n, 2): column, row, pixels."""

    ids: IntArray
    pixels: FloatArray


@dataclass(frozen=True, slots=True)
class Board:
    """A flat board of known size.

    Attributes:
        kind: one of :data:`KINDS`.
        columns, rows: inner corners of a chessboard; squares of a ChArUco board; tags of an
            AprilGrid.
        square: side of a square, or of a tag, metres.
        spacing: of an AprilGrid, the gap between tags over a tag's side.
        dictionary: of a ChArUco board, the name of its markers in OpenCV.
    """

    kind: str
    columns: int
    rows: int
    square: float
    spacing: float = 0.3
    dictionary: str = "DICT_4X4_50"

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise CalibrationError(f"board {self.kind!r} is not known; use {', '.join(KINDS)}")
        if min(self.columns, self.rows) < 2:
            raise CalibrationError(
                f"a board of {self.columns}x{self.rows} is too small; give inner corners of a "
                "chessboard, squares of a ChArUco board, or tags of an AprilGrid"
            )
        if not 0.0 < self.square < np.inf:
            raise CalibrationError(f"the square is {self.square:g} m; give its side in metres")

    @property
    def points(self) -> FloatArray:
        """(m, 3) metres, in the board's plane, by number."""
        if self.kind == "aprilgrid":
            step = self.square * (1.0 + self.spacing)
            tag = self.square * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
            flat = (step * _grid(self.columns, self.rows)[:, None] + tag).reshape(-1, 2)
        else:
            inner = 1 if self.kind == "charuco" else 0
            flat = self.square * _grid(self.columns - inner, self.rows - inner)
        return np.column_stack([flat, np.zeros(len(flat))])

    @property
    def renumberings(self) -> IntArray:
        """(s, m) for each number the one after a turn with which the board is the same to the eye.

        The first changes none; without markers half a turn is not seen, nor of a square board a
        quarter.
        """
        ids = np.arange(len(self.points))
        if self.kind != "chessboard":
            return ids[None]
        grid = ids.reshape(self.rows, self.columns)
        turns = range(0, 4, 1 if self.rows == self.columns else 2)
        return np.array([np.rot90(grid, turn).ravel() for turn in turns])

    @property
    def neighbours(self) -> IntArray:
        """(k, 2) numbers of corners that are one :attr:`square` apart."""
        points = self.points
        apart = np.linalg.norm(points[:, None] - points, axis=2)
        first, second = np.nonzero(np.abs(apart - self.square) < 1e-6 * self.square)
        return np.column_stack([first, second])[first < second]


def _grid(columns: int, rows: int) -> FloatArray:
    row, column = np.divmod(np.arange(columns * rows), columns)
    return np.column_stack([column, row]).astype(np.float64)


def find_corners(board: Board, image: Image, mirrored: bool = False) -> Corners | None:
    """Corners of the board in a grey image (height, width) uint8; None where it is not found.

    ``mirrored``: the image may be one in a mirror, where no markers are known; a board of them is
    then looked for in its reflection as well. Reflected, a flat board is one seen from behind.
    """
    # The same corners on every run: one thread, and random trees from one seed.
    cv2.setNumThreads(1)
    cv2.setRNGSeed(0)
    finders = {"chessboard": _chessboard, "charuco": _charuco, "aprilgrid": _aprilgrid}
    found = finders[board.kind](board, image)
    if found is not None or not mirrored or board.kind == "chessboard":
        return found
    reflected = finders[board.kind](board, np.ascontiguousarray(image[:, ::-1]))
    if reflected is None:
        return None
    pixels = np.array([image.shape[1] - 1.0, 0.0]) + reflected.pixels * np.array([-1.0, 1.0])
    return Corners(reflected.ids, pixels)


def _chessboard(board: Board, image: Image) -> Corners | None:
    """By OpenCV's finder of squares, else of saddles: each finds boards that the other does not.

    Corners are refined in windows as small as the squares: the finder of saddles expects straight
    lines, and is off by pixels far from the axis of a fisheye.
    """
    size = board.columns, board.rows
    found, corners = cv2.findChessboardCorners(image, size)
    for flags in (_SADDLES | cv2.CALIB_CB_NORMALIZE_IMAGE, _SADDLES):
        if not found:
            found, corners = cv2.findChessboardCornersSB(image, size, None, flags)
    if not found:
        return None
    pixels = np.asarray(corners, np.float64).reshape(-1, 2)
    apart = np.linalg.norm(pixels[:, None] - pixels, axis=2)
    nearest = (apart + np.diag(np.full(len(apart), np.inf))).min(axis=1)
    return Corners(np.arange(len(pixels)), _refined(image, pixels, _WINDOW_OF_SQUARE * nearest))


def _charuco(board: Board, image: Image) -> Corners | None:
    aruco: Any = cv2.aruco
    number = getattr(aruco, board.dictionary, None)
    if number is None:
        raise CalibrationError(
            f"markers {board.dictionary!r} are not known to OpenCV; names begin with DICT_"
        )
    markers = aruco.getPredefinedDictionary(number)
    # Markers only tell corners apart: their printed size need not be known.
    printed = aruco.CharucoBoard((board.columns, board.rows), 1.0, 0.75, markers)
    pixels, ids, _, _ = aruco.CharucoDetector(printed).detectBoard(image)
    if ids is None or len(ids) < _LEAST_CORNERS:
        return None
    return Corners(np.ravel(ids).astype(np.int64), np.asarray(pixels, float).reshape(-1, 2))


def _aprilgrid(board: Board, image: Image) -> Corners | None:
    aruco: Any = cv2.aruco
    settings = aruco.DetectorParameters()
    settings.markerBorderBits = _BLACK_BORDER_BITS
    markers = aruco.getPredefinedDictionary(aruco.DICT_APRILTAG_36h11)
    corners, ids, _ = aruco.ArucoDetector(markers, settings).detectMarkers(image)
    if ids is None:
        return None
    tags = np.ravel(ids).astype(np.int64)
    own = (tags < board.columns * board.rows) & (np.bincount(tags)[tags] == 1)
    if own.sum() < _LEAST_TAGS:
        return None
    pixels = np.asarray(corners, float).reshape(-1, _CORNERS_OF_TAG, 2)[own]
    sides = np.linalg.norm(pixels - np.roll(pixels, 1, axis=1), axis=2).min(axis=1)
    windows = np.repeat(_WINDOW_OF_TAG * sides, _CORNERS_OF_TAG)
    refined = _refined(image, pixels.reshape(-1, 2), windows).reshape(pixels.shape)
    return _turned_tags(board, tags[own], refined)


def _refined(image: Image, pixels: FloatArray, windows: FloatArray) -> FloatArray:
    """Corners (n, 2) to a fraction of a pixel: saddles, since dark squares touch there.

    ``windows``: (n,) half the side of the window that each is looked for in, pixels.
    """
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
    out = pixels.astype(np.float32)
    for k, window in enumerate(windows):
        half = int(np.clip(round(window), 2, 10))
        near = out[k][None, None].copy()
        out[k] = cv2.cornerSubPix(image, near, (half, half), (-1, -1), stop)[0, 0]
    return np.asarray(out, np.float64)


def _turned_tags(board: Board, tags: IntArray, pixels: FloatArray) -> Corners:
    """Corners in the board's order: of the eight ways to begin and turn, that which is flat."""
    ids = _CORNERS_OF_TAG * tags[:, None] + np.arange(_CORNERS_OF_TAG)
    flat = board.points[ids.ravel(), :2]
    best, least = pixels, np.inf
    around = np.arange(_CORNERS_OF_TAG)
    turns = (np.roll(turn, k) for turn in (around, around[::-1]) for k in range(_CORNERS_OF_TAG))
    for order in turns:
        turned = pixels[:, order].reshape(-1, 2)
        homography = cv2.findHomography(flat, turned)[0]
        if homography is not None:
            shown = cv2.perspectiveTransform(flat[None], homography)[0]
            error = float(np.median(np.linalg.norm(shown - turned, axis=1)))
            if error < least:
                best, least = pixels[:, order], error
    return Corners(ids.ravel(), best.reshape(-1, 2))


def sizes_that_fit(board: Board, image: Image) -> list[str]:
    """Chessboards of other sizes that are found in an image, as `9x6`: what may have been meant."""
    if board.kind != "chessboard":
        return []
    around = [(c, r) for c in range(4, 13) for r in range(3, c + 1) if (c, r) != (4, 3)]
    others = [(c, r) for c, r in around if {c, r} != {board.columns, board.rows}]
    nearest = sorted(others, key=lambda s: abs(s[0] - board.columns) + abs(s[1] - board.rows))
    tried = (Board("chessboard", c, r, board.square) for c, r in nearest[:12])
    return [f"{b.columns}x{b.rows}" for b in tried if _chessboard(b, image) is not None]
