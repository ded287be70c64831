"""What a calibration is good for: checked on images of the board that it has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgslam.cameras.board_calibration import BoardCalibration, View, calibrate
from fgslam.cameras.boards import Board, Corners
from fgslam.cameras.raw_cameras import RawCamera
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import CalibrationError

_CELLS = 10  # of the image, along each side, that corners may cover
_MEDIAN_TO_SIGMA = 1.4826  # of a normal distribution
_FAR = 1e-6  # radians of parallax: below it a point has no depth
DEPTH_SHARE = 0.05
"""Of the depth: where a point lies deeper than this error, it is of no use as a place."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """How a pair of cameras does on images that did not take part in its calibration.

    Attributes:
        views: how many those were.
        rows_px: deviation of the rows of one corner in both rectified images, from the median of
            their distances: a corner that was found wrongly says nothing of the calibration.
        square: median side of the board's squares as triangulated, metres.
        reach_m: depth at which an error of ``rows_px`` in disparity is :data:`DEPTH_SHARE` of it.
    """

    views: int
    rows_px: float
    square: float
    reach_m: float


def held_out(
    board: Board, views: Sequence[View], size: tuple[int, int], model: str, camera: int = 1
) -> HeldOut | None:
    """Every second view calibrates, the others judge the first camera and ``camera`` of them.

    None where half of the views are not enough to calibrate with.
    """
    common = [v for v in views if v[0] is not None and v[camera] is not None]
    try:
        found = calibrate(board, common[::2], size, model)
    except CalibrationError:
        return None
    return judged(board, found, common[1::2], camera)


def judged(
    board: Board, found: BoardCalibration, views: Sequence[View], camera: int
) -> HeldOut | None:
    """Rows and sizes that a calibration gives of boards; None where no view shows both cameras."""
    first, second = found.cameras[0], found.cameras[camera]
    seen = [_both(first, second, *_common(view[0], view[camera])) for view in views]
    seen = [part for part in seen if len(part.ids)]
    if not seen:
        return None
    rows = np.concatenate([part.rows for part in seen])
    squares = np.concatenate([_squares(board, part) for part in seen])
    rows_px = _MEDIAN_TO_SIGMA * float(np.median(np.abs(rows))) * first.focal_px
    baseline = float(np.linalg.norm(second.bTc[:3, 3]))
    reach = DEPTH_SHARE * baseline * first.focal_px / max(rows_px, 1e-9)
    return HeldOut(len(seen), rows_px, float(np.median(squares)), reach)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    ids: IntArray
    rows: FloatArray
    points: FloatArray


def _common(a: Corners | None, b: Corners | None) -> tuple[Corners, Corners]:
    if a is None or b is None:
        nothing = Corners(np.empty(0, np.int64), np.empty((0, 2)))
        return nothing, nothing
    _, first, second = np.intersect1d(a.ids, b.ids, return_indices=True)
    return a.select(first), b.select(second)


def _both(first: RawCamera, second: RawCamera, a: Corners, b: Corners) -> _Seen:
    """Corners in both cameras: difference of their rows (n,), radians, and points (n, 3)."""
    offset = second.bTc[:3, 3]
    along = offset / np.linalg.norm(offset)
    ahead = first.bTc[:3, 2] + second.bTc[:3, 2]
    across = np.cross(ahead, along)
    across /= np.linalg.norm(across)
    axes = np.array([along, across, np.cross(along, across)])  # the baseline is the first
    rays = [
        camera.unproject(corners.pixels) @ (axes @ camera.bTc[:3, :3]).T
        for camera, corners in ((first, a), (second, b))
    ]
    # On the cylinder around the baseline rows are angles, whatever the field of view.
    rows = [np.arctan2(ray[:, 1], ray[:, 2]) for ray in rays]
    slopes = [ray[:, 0] / np.hypot(ray[:, 1], ray[:, 2]) for ray in rays]
    parallax = slopes[0] - slopes[1]
    depth = np.linalg.norm(offset) / np.where(np.abs(parallax) > _FAR, parallax, np.nan)
    middle = 0.5 * (rows[0] + rows[1])
    points = np.column_stack([slopes[0], np.sin(middle), np.cos(middle)]) * depth[:, None]
    return _Seen(a.ids, rows[0] - rows[1], points)


def _squares(board: Board, seen: _Seen) -> FloatArray:
    """Distances (k,) of corners that are a square apart, metres."""
    row = np.full(len(board.points), -1)
    row[seen.ids] = np.arange(len(seen.ids))
    ends = row[board.neighbours]
    ends = ends[(ends >= 0).all(axis=1)]
    return np.asarray(np.linalg.norm(seen.points[ends[:, 0]] - seen.points[ends[:, 1]], axis=1))


def coverage(views: Sequence[View], camera: int, size: tuple[int, int]) -> float:
    """Share of the cells of the image (ten by ten) in which a corner was found."""
    seen = [corners.pixels for view in views if (corners := view[camera]) is not None]
    pixels = np.concatenate([np.empty((0, 2)), *seen])
    cells = np.floor(pixels / np.array(size) * _CELLS).clip(0, _CELLS - 1).astype(int)
    return len(np.unique(cells, axis=0)) / _CELLS**2
