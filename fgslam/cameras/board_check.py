"""What a calibration is good for: checked on images of the board that it has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from fgslam.cameras.board_calibration import (
    MEDIAN_OF_RAYLEIGH,
    BoardCalibration,
    View,
    calibrate,
    turn_of_matrix,
)
from fgslam.cameras.board_projection import TURN, projected
from fgslam.cameras.board_start import board_pose
from fgslam.cameras.boards import Board, Corners
from fgslam.cameras.lenses import RawCamera
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import CalibrationError

_CELLS = 10  # of the image, along each side, that corners may cover
_MEDIAN_TO_SIGMA = 1.4826  # of a normal distribution
_HUBER_PX = 0.5  # beyond which a corner counts less in the board's place
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


@dataclass(frozen=True, slots=True)
class HeldOutAlone:
    """How one camera does on images that did not take part in its calibration.

    Attributes:
        views: (k,) which of all views those were.
        off_px: deviation of a corner's distance, from the median of all: one that was found wrongly
            says nothing of the calibration. The board's pose alone is fitted to each image.
        each_px: (k,) root mean square distance in each image.
    """

    views: IntArray
    off_px: float
    each_px: FloatArray


def held_out_alone(
    board: Board, views: Sequence[View], size: tuple[int, int], model: str
) -> HeldOutAlone | None:
    """Every second view calibrates a camera, the others judge it.

    None where half of the views are not enough to calibrate with.
    """
    own = np.array([k for k, view in enumerate(views) if view[0] is not None], np.int64)
    try:
        camera = calibrate(board, [views[k] for k in own[::2]], size, model).cameras[0]
    except CalibrationError:
        return None
    kept, off = [], []
    for k in own[1::2].tolist():
        corners = views[k][0]
        distances = None if corners is None else _off_when_placed(board, camera, corners)
        if distances is not None:
            kept.append(k)
            off.append(distances)
    if not kept:
        return None
    off_px = float(np.median(np.concatenate(off))) / MEDIAN_OF_RAYLEIGH * np.sqrt(2.0)
    each = np.array([np.sqrt(np.mean(distances**2)) for distances in off])
    return HeldOutAlone(np.array(kept), float(off_px), each)


def _off_when_placed(board: Board, camera: RawCamera, corners: Corners) -> FloatArray | None:
    """Distances (n,) in pixels with the board where they are least; None where it has no place."""
    points = board.points[corners.ids]
    cTb = board_pose(camera, points, corners.pixels)
    if cTb is None:
        return None
    intrinsics = np.concatenate([camera.intrinsics, camera.distortion])

    def off(turn: FloatArray) -> FloatArray:
        return projected(camera.model, points, turn, intrinsics)[0].ravel() - corners.pixels.ravel()

    def slope(turn: FloatArray) -> FloatArray:
        return projected(camera.model, points, turn, intrinsics)[1][:, :TURN]

    fit = least_squares(off, turn_of_matrix(cTb), slope, loss="huber", f_scale=_HUBER_PX)
    return np.asarray(np.linalg.norm(off(fit.x).reshape(-1, 2), axis=1))


def coverage_of_circle(views: Sequence[View], camera: RawCamera) -> float:
    """Share of the cells (ten by ten) of the widest circle in the image with a corner.

    The circle is that around the principal point: a fisheye's or a mirror's image is black beyond.
    """
    centre = camera.matrix[:2, 2]
    radius = float(np.min([*centre, *(np.array(camera.size) - 1 - centre)]))
    seen = [corners.pixels for view in views if (corners := view[0]) is not None]
    pixels = np.concatenate([np.empty((0, 2)), *seen])
    found = np.floor(((pixels - centre) / radius + 1.0) * 0.5 * _CELLS).astype(int)
    middles = (np.arange(_CELLS) + 0.5) / _CELLS * 2.0 - 1.0
    within = np.hypot(middles[:, None], middles) < 1.0
    found = np.unique(found[((found >= 0) & (found < _CELLS)).all(axis=1)], axis=0)
    return float(within[found[:, 0], found[:, 1]].sum() / within.sum())


def farthest_from_axis(views: Sequence[View], camera: RawCamera) -> float:
    """Largest angle from the axis, radians, at which a corner was found."""
    seen = [corners.pixels for view in views if (corners := view[0]) is not None]
    rays = camera.unproject(np.concatenate([np.empty((0, 2)), *seen]))
    return float(np.nanmax(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]), initial=0.0))


def coverage(views: Sequence[View], camera: int, size: tuple[int, int]) -> float:
    """Share of the cells of the image (ten by ten) in which a corner was found."""
    seen = [corners.pixels for view in views if (corners := view[camera]) is not None]
    pixels = np.concatenate([np.empty((0, 2)), *seen])
    cells = np.floor(pixels / np.array(size) * _CELLS).clip(0, _CELLS - 1).astype(int)
    return len(np.unique(cells, axis=0)) / _CELLS**2
