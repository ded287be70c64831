"""Calibration of one to three cameras from images of a board: all parameters in one least squares.

The model is that of Zhang (A flexible new technique for camera calibration, 2000) with any lens of
:mod:`fgslam.cameras.lenses`; corners of all cameras and images are fitted together, so that the
poses of the cameras to each other and their intrinsics come with one covariance.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from fgslam.cameras.boards import Board, Corners
from fgslam.cameras.lenses import RawCamera, checked_camera
from fgslam.cameras.trees import intrinsic_matrix
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import (
    inverse,
    pose,
    so3_exp,
    so3_log,
    transform_to_camera,
    transform_to_world,
)

NAMES = ("left", "right", "top")
INTRINSICS = ("fx", "fy", "cx", "cy")
PARAMETERS = {
    "radtan": ("k1", "k2", "p1", "p2", "k3"),
    "equidistant": ("k1", "k2", "k3", "k4"),
    "omni": ("xi", "k1", "k2", "p1", "p2"),
}
"""Parameters of the lenses that can be calibrated; names as of the lenses."""
LEAST_VIEWS = 5
MOST_STEPS = 300
"""Of the fit; twenty are usual."""
_FIRST_STEPS = 30  # with fixed distortion: from a rough start it becomes non-monotonic
_TURN = 6  # numbers of a pose: rotation vector and translation
_STEP = 1e-6  # of the central differences: pixels, radians, metres, and parts of a lens of order 1
_OUTLIER_SIGMAS = 5.0  # of one coordinate: a right corner is farther off once in 270,000
_MEDIAN_OF_RAYLEIGH = 1.1774  # median distance in the plane over the deviation of a coordinate
_TRIMMINGS = 4
_MOST_OFF = 0.0025  # of the image's diagonal: corners are found to a tenth of that
_UNCERTAIN = 0.1  # of the focal length: with a larger deviation nothing is known of a camera
_LEAST_CORNERS = 6  # of an image, for its board's pose to follow with something left

_UNDETERMINED = (
    "the board's images do not determine the cameras: take more of them, tilted in different "
    "directions, some in each corner of the image"
)

View = tuple[Corners | None, ...]
"""What the cameras see of the board at one moment, in their order; None where it was not found."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardCalibration:
    """Cameras as fitted to a board.

    Attributes:
        cameras: in their order; the first one is the body.
        sigmas: (cameras, p) standard deviations of fx, fy, cx, cy and the model's parameters.
        turn_sigmas: (cameras, 6) of the rotation vectors and translations that take the first
            camera's coordinates to each camera's, radians and metres; zero for the first.
        boards: (views, 6) pose of the board in the first camera.
        off: of each view and camera, how far off each corner (n,) is, pixels; empty where the board
            was not found, or did not fit.
        kept: the corners of each view that were used; None where none were.
        left_out: corners that do not fit the others.
    """

    cameras: tuple[RawCamera, ...]
    sigmas: FloatArray
    turn_sigmas: FloatArray
    boards: FloatArray
    off: tuple[tuple[FloatArray, ...], ...]
    kept: tuple[View, ...]
    left_out: int

    def turn(self, camera: int) -> FloatArray:
        """(6,) rotation vector and translation from the first camera's coordinates to another's."""
        return _turn_of(inverse(self.cameras[camera].bTc) @ self.cameras[0].bTc)

    @property
    def errors(self) -> FloatArray:
        """(views, cameras) root mean square distance in each image, pixels; NaN where unseen."""
        return np.array([[_rms(distances) for distances in view] for view in self.off])

    @property
    def rms(self) -> float:
        """Root mean square distance of all corners that were used, pixels."""
        return _rms(np.concatenate([distances for view in self.off for distances in view]))


def calibrate(
    board: Board, views: Sequence[View], size: tuple[int, int], model: str
) -> BoardCalibration:
    """Cameras from what they saw of a board; images that do not fit the others are left out.

    Args:
        board: the board.
        views: of each moment what each camera saw; the first camera is the reference.
        size: width and height of all images.
        model: one of :data:`PARAMETERS`, of all cameras.

    Raises:
        CalibrationError: too few views, they do not determine the cameras, or no such cameras show
            a board like that.
    """
    problem, start = _first(board, views, model, size)
    found = _fit(problem, start)
    for _ in range(_TRIMMINGS - 1):
        trimmed = _trimmed(views, _distances(found, board, views))
        if _count(trimmed) == _count(found.kept):
            break
        problem = _Problem(board, trimmed, model, size)
        found = _fit(problem, problem.start_of(found))
    if found.rms > _MOST_OFF * float(np.hypot(*size)):
        raise CalibrationError(
            f"the corners lie {found.rms:.1f} px (rms) off what {model} cameras show of a flat "
            "board; is --lens that of the camera, its focus fixed, and the board flat?"
        )
    return replace(found, left_out=_count(views) - _count(found.kept))


def _rms(distances: FloatArray) -> float:
    return float(np.sqrt(np.mean(distances**2))) if len(distances) else float("nan")


def _matrix_of(turn: FloatArray) -> FloatArray:
    """(4, 4) from rotation vector and translation."""
    return pose(so3_exp(turn[:3]), turn[3:])


def _turn_of(matrix: FloatArray) -> FloatArray:
    """(6,) rotation vector and translation."""
    return np.concatenate([so3_log(matrix[:3, :3]), matrix[:3, 3]])


def _count(views: Sequence[View]) -> int:
    return sum(len(corners) for view in views for corners in view if corners is not None)


# --------------------------------------------------------------------------------------------
# What fits


def _trimmed(views: Sequence[View], off: Sequence[Sequence[FloatArray]]) -> tuple[View, ...]:
    """What fits: distances (n,) beyond five robust deviations of all corners are left out.

    What an earlier, worse fit left out comes back where it fits now.
    """
    everything = np.concatenate([distance for view in off for distance in view])
    known = everything[np.isfinite(everything)]
    if not len(known):
        raise CalibrationError(_UNDETERMINED)
    limit = _OUTLIER_SIGMAS * float(np.median(known)) / _MEDIAN_OF_RAYLEIGH
    out = []
    for view, distances in zip(views, off, strict=True):
        kept = (
            None if corners is None else corners.select(distance <= limit)
            for corners, distance in zip(view, distances, strict=True)
        )
        out.append(tuple(c if c is not None and len(c) >= _LEAST_CORNERS else None for c in kept))
    return tuple(out)


def _distances(
    found: BoardCalibration, board: Board, views: Sequence[View]
) -> tuple[tuple[FloatArray, ...], ...]:
    """Of each view and camera how far off each corner (n,) is, pixels; NaN without a board's pose.

    Empty where the camera does not see the board.
    """
    out = []
    for turn, view in zip(found.boards, views, strict=True):
        known = np.isfinite(turn).all()
        fTb = _matrix_of(turn) if known else np.full((4, 4), np.nan)
        points = transform_to_world(fTb, board.points)
        off = []
        for camera, corners in zip(found.cameras, view, strict=True):
            away = np.empty((0, 2))
            if corners is not None:
                shown = camera.project(transform_to_camera(camera.bTc, points[corners.ids]))
                away = shown - corners.pixels
            off.append(np.asarray(np.linalg.norm(away, axis=1)))
        out.append(tuple(off))
    return tuple(out)


# --------------------------------------------------------------------------------------------
# The least squares


def _first(
    board: Board, views: Sequence[View], model: str, size: tuple[int, int]
) -> tuple[_Problem, FloatArray]:
    """The problem and first values; images in which the board has no pose are left out."""
    problem = _Problem(board, views, model, size)
    images = [
        (v, c, e) for v, view in enumerate(views) for c, e in enumerate(view) if e is not None
    ]
    cameras = []
    for camera in range(problem.cameras):
        own = [corners for _, c, corners in images if c == camera]
        points = [board.points[corners.ids] for corners in own]
        numbers = first_guess(model, points, [corners.pixels for corners in own], size)
        cameras.append(camera_of(model, size, numbers))
    cTb = {
        (v, c): found
        for v, c, corners in images
        if (found := board_pose(cameras[c], board.points[corners.ids], corners.pixels)) is not None
    }
    if len(cTb) < len(images):
        posed = [
            tuple(corners if (v, c) in cTb else None for c, corners in enumerate(view))
            for v, view in enumerate(views)
        ]
        problem = _Problem(board, posed, model, size)
    start = problem.start(cameras, cTb)
    if not np.isfinite(start).all():
        raise CalibrationError(_UNDETERMINED)
    if model != "radtan":
        start = problem.least(start, _FIRST_STEPS, with_lens=False).x
    return problem, start


def _fit(problem: _Problem, start: FloatArray) -> BoardCalibration:
    """The cameras of the least residuals from a start on."""
    fit = problem.least(start, MOST_STEPS)
    jacobian = problem.jacobian(fit.x)
    rows = len(fit.fun)
    scale = np.linalg.norm(jacobian, axis=0)
    if not (np.isfinite(scale).all() and scale.all()):
        raise CalibrationError(_UNDETERMINED)
    information = (jacobian / scale).T @ (jacobian / scale)
    if rows <= len(fit.x) or not np.linalg.cond(information) <= 1e14:
        raise CalibrationError(_UNDETERMINED)
    variance = 2.0 * fit.cost / (rows - len(fit.x))
    covariance = variance * np.linalg.inv(information) / np.outer(scale, scale)
    problem.require_determined(fit.x, covariance)
    if not fit.success:
        raise CalibrationError(
            f"the fit of the {problem.model} cameras does not converge in {MOST_STEPS} steps; try "
            "another --lens, or leave out images in which corners were found wrongly"
        )
    found = problem.result(fit.x, np.sqrt(np.diag(covariance)))
    return replace(found, off=_distances(found, problem.board, problem.views))


class _Problem:
    """Residuals of all corners over (intrinsics, turns of the other cameras, boards)."""

    def __init__(
        self, board: Board, views: Sequence[View], model: str, size: tuple[int, int]
    ) -> None:
        self.board, self.views, self.model, self.size = board, tuple(views), model, size
        self.cameras = len(views[0])
        for camera in range(self.cameras):
            count = sum(view[camera] is not None for view in views)
            if count < LEAST_VIEWS:
                which = f"{NAMES[camera]} camera" if self.cameras > 1 else "camera"
                raise CalibrationError(
                    f"the {which} shows the board in {count} images that can be "
                    f"used; {LEAST_VIEWS} are needed at least, twenty are good"
                )
        self._shown = [v for v, view in enumerate(views) if any(c is not None for c in view)]
        images = [
            (row, camera, corners)
            for row, v in enumerate(self._shown)
            for camera, corners in enumerate(views[v])
            if corners is not None
        ]
        counts = [len(corners) for _, _, corners in images]
        self._row, self._camera = (np.repeat([one[k] for one in images], counts) for k in (0, 1))
        self._points = board.points[np.concatenate([corners.ids for _, _, corners in images])]
        self._pixels = np.concatenate([corners.pixels for _, _, corners in images])
        self._own = len(INTRINSICS) + len(PARAMETERS[model])
        self._turns_at = self.cameras * self._own
        self._boards_at = self._turns_at + _TURN * (self.cameras - 1)

    def _parts(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Intrinsics (cameras, p), turns (cameras, 6) and boards (views, 6)."""
        turns = np.concatenate([np.zeros(_TURN), x[self._turns_at : self._boards_at]])
        intrinsics, boards = x[: self._turns_at], x[self._boards_at :]
        return (
            intrinsics.reshape(-1, self._own),
            turns.reshape(-1, _TURN),
            boards.reshape(-1, _TURN),
        )

    def predicted(self, x: FloatArray) -> FloatArray:
        """(n, 2) pixels of all corners; NaN where the lens does not show them."""
        intrinsics, turns, boards = self._parts(x)
        points = _moved(turns, _moved(boards, self._points, self._row), self._camera)
        out = np.empty((len(points), 2))
        for camera, numbers in enumerate(intrinsics):
            own = self._camera == camera
            out[own] = camera_of(self.model, self.size, numbers).project(points[own])
        return out

    def residuals(self, x: FloatArray) -> FloatArray:
        """(2n,) pixels, predicted minus found; the image's diagonal where the lens shows none."""
        off = self.predicted(x) - self._pixels
        return np.asarray(np.where(np.isfinite(off), off, np.hypot(*self.size))).ravel()

    def jacobian(self, x: FloatArray) -> FloatArray:
        """(2n, p) of the residuals, by central differences.

        A corner depends on one camera, its turn and one board: the k-th parameter of all cameras,
        or of all boards, is moved at once.
        """
        n, step = len(self._pixels), _STEP * np.maximum(1.0, np.abs(x))
        out = np.zeros((n, 2, len(x)))
        for column in self._columns():
            of = np.flatnonzero(column >= 0)
            change = np.zeros(len(x))
            change[column[of]] = step[column[of]]
            moved = self.predicted(x + change) - self.predicted(x - change)
            slope = moved[of] / (2.0 * step[column[of]])[:, None]
            out[of, :, column[of]] = np.where(np.isfinite(slope), slope, 0.0)
        return out.reshape(2 * n, len(x))

    def _columns(self) -> Iterator[IntArray]:
        """(n,) which of the parameters each corner depends on, one after another; -1: on none."""
        for k in range(self._own):
            yield self._camera * self._own + k
        for k in range(_TURN if self.cameras > 1 else 0):
            of_turn = self._turns_at + _TURN * (self._camera - 1) + k
            yield np.where(self._camera > 0, of_turn, -1)
        for k in range(_TURN):
            yield self._boards_at + _TURN * self._row + k

    def least(self, start: FloatArray, steps: int, with_lens: bool = True) -> Any:
        """The fit from a start on; the lenses' distortion may stay as it is."""
        fixed = np.zeros(0, np.int64)
        if not with_lens:
            kept = len(INTRINSICS) + (1 if self.model == "omni" else 0)
            own = np.arange(self._turns_at)
            fixed = own[own % self._own >= kept]

        def jacobian(x: FloatArray) -> FloatArray:
            out = self.jacobian(x)
            out[:, fixed] = 0.0
            return out

        return least_squares(
            self.residuals, start, jacobian, method="lm", x_scale="jac", max_nfev=steps
        )

    def start_of(self, found: BoardCalibration) -> FloatArray:
        """First values: those of a fit to more or fewer corners of the same views."""
        turns = [found.turn(camera) for camera in range(1, self.cameras)]
        boards = [found.boards[v] for v in self._shown]
        return np.concatenate([*map(_numbers_of, found.cameras), *turns, *boards])

    def start(
        self, cameras: Sequence[RawCamera], cTb: Mapping[tuple[int, int], FloatArray]
    ) -> FloatArray:
        """First values: the cameras' poses to the first where both see the board."""
        turns = [np.eye(4), *(self._relative(cTb, camera) for camera in range(1, self.cameras))]
        boards = []
        for v in self._shown:
            camera = next(c for c in range(self.cameras) if (v, c) in cTb)
            boards.append(inverse(turns[camera]) @ cTb[v, camera] if camera else cTb[v, 0])
        intrinsics = map(_numbers_of, cameras)
        return np.concatenate([*intrinsics, *map(_turn_of, turns[1:]), *map(_turn_of, boards)])

    def _relative(self, cTb: Mapping[tuple[int, int], FloatArray], camera: int) -> FloatArray:
        """Of the poses that single views give the one nearest to all others."""
        both = [
            cTb[v, camera] @ inverse(cTb[v, 0])
            for v in self._shown
            if (v, camera) in cTb and (v, 0) in cTb
        ]
        if not both:
            raise CalibrationError(
                f"cameras 0 and {camera} never see the board at the same time; are the images "
                "paired rightly?"
            )
        apart = [[np.linalg.norm(a - b) for b in both] for a in both]
        return both[int(np.argmin(np.sum(apart, axis=1)))]

    def require_determined(self, x: FloatArray, covariance: FloatArray) -> None:
        """Raises CalibrationError for impossible intrinsics, or an uncertain focal length.

        The unified model's is ``f / (1 + xi)``, that around the axis: the two are nearly one.
        """
        for camera, numbers in enumerate(self._parts(x)[0]):
            own = slice(camera * self._own, (camera + 1) * self._own)
            by = np.zeros(self._own)
            by[0] = 1.0 / numbers[0]
            if self.model == "omni":
                by[len(INTRINSICS)] = -1.0 / (1.0 + numbers[len(INTRINSICS)])
            known = bool(by @ covariance[own, own] @ by <= _UNCERTAIN**2)
            try:
                checked_camera(camera_of(self.model, self.size, numbers))
            except CalibrationError:
                known = False
            if not known:
                raise CalibrationError(_UNDETERMINED)

    def result(self, x: FloatArray, sigmas: FloatArray) -> BoardCalibration:
        """The solution in words of cameras."""
        intrinsics, turns, found = self._parts(x)
        boards = np.full((len(self.views), _TURN), np.nan)
        boards[self._shown] = found
        cameras = tuple(
            replace(
                camera_of(self.model, self.size, numbers, f"cam{c}"), bTc=inverse(_matrix_of(turn))
            )
            for c, (numbers, turn) in enumerate(zip(intrinsics, turns, strict=True))
        )
        of_intrinsics, of_turns, _ = self._parts(sigmas)
        return BoardCalibration(cameras, of_intrinsics, of_turns, boards, (), self.views, 0)


def _moved(turns: FloatArray, points: FloatArray, which: IntArray) -> FloatArray:
    """Points (n, 3), each by one of the turns (k, 6)."""
    rotations = np.asarray(Rotation.from_rotvec(turns[:, :3]).as_matrix())
    return np.asarray(np.einsum("nij,nj->ni", rotations[which], points) + turns[which, 3:])


# --------------------------------------------------------------------------------------------
# Where a fit starts


_HALF_VIEWS = np.radians([20.0, 30.0, 40.0, 50.0, 60.0, 75.0, 90.0, 105.0, 120.0])
"""Angles from the axis that the nearest border of the image may show."""
_XIS = (0.7, 1.0, 1.5)  # of lenses, parabolic mirrors, and spheres seen from farther away
_AHEAD = 0.1  # least depth over distance, seen along the board's middle, to take a pose from
_LEAST = 4  # points from which a pose follows


def first_guess(
    model: str,
    points: Sequence[FloatArray],
    pixels: Sequence[FloatArray],
    size: tuple[int, int],
) -> FloatArray:
    """Intrinsics (p,) of one camera: fx, fy, cx, cy and the model's parameters.

    Of a perspective camera by OpenCV from its own images; of others, of several angles of view
    without distortion, those with which the boards lie nearest to what was seen.

    Args:
        model: one of :data:`PARAMETERS`.
        points: of each image (n, 3), in the board's axes.
        pixels: of each image (n, 2), where they were found.
        size: width and height of the images.

    Raises:
        CalibrationError: the images do not determine a camera.
    """
    if model != "radtan":
        candidates = list(_undistorted(model, size))
        off = [_misfit(camera_of(model, size, guess), points, pixels) for guess in candidates]
        return candidates[int(np.argmin(off))]
    flat, seen = ([one.astype(np.float32)[:, None] for one in each] for each in (points, pixels))
    try:
        _, matrix, distortion, *_ = cv2.calibrateCamera(flat, seen, size, np.eye(3), np.zeros(5))
    except cv2.error as error:
        raise CalibrationError(
            f"the board's images do not determine a camera ({error.err}); take more of them, "
            "tilted and filling the image"
        ) from error
    numbers = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    return np.array([*numbers, *np.ravel(distortion)[: len(PARAMETERS[model])]])


def _undistorted(model: str, size: tuple[int, int]) -> Iterator[FloatArray]:
    centre = (size[0] - 1) / 2.0, (size[1] - 1) / 2.0
    for angle in _HALF_VIEWS:
        if model == "equidistant":
            focal = 0.5 * min(size) / angle
            yield np.array([focal, focal, *centre, 0.0, 0.0, 0.0, 0.0])
            continue
        for xi in _XIS:
            below = np.cos(angle) + xi
            if below > _AHEAD:
                focal = 0.5 * min(size) * below / np.sin(angle)
                yield np.array([focal, focal, *centre, xi, 0.0, 0.0, 0.0, 0.0])


def _misfit(camera: RawCamera, points: Sequence[FloatArray], pixels: Sequence[FloatArray]) -> float:
    """Median over all images of how far off their corners are, pixels, with the boards placed."""
    off = []
    for flat, seen in zip(points, pixels, strict=True):
        cTb = board_pose(camera, flat, seen)
        if cTb is None:
            off.append(np.inf)
            continue
        distance = np.linalg.norm(camera.project(transform_to_world(cTb, flat)) - seen, axis=1)
        off.append(float(np.median(np.where(np.isfinite(distance), distance, np.inf))))
    return float(np.mean(np.minimum(off, max(camera.size))))


def camera_of(
    model: str, size: tuple[int, int], numbers: FloatArray, name: str = "camera"
) -> RawCamera:
    """The camera of fx, fy, cx, cy and the model's parameters, at the body's origin."""
    matrix = intrinsic_matrix(*numbers[:4])
    return RawCamera(*size, matrix, numbers[4:], np.eye(4), name, model)


def _numbers_of(camera: RawCamera) -> FloatArray:
    return np.concatenate([camera.intrinsics, camera.distortion])


def board_pose(camera: RawCamera, points: FloatArray, pixels: FloatArray) -> FloatArray | None:
    """Pose (4, 4) of a board in the camera; None where too few of its corners have rays.

    The rays are turned to look along their mean first: a board may lie beside the camera.
    """
    rays = camera.unproject(pixels)
    known = np.isfinite(rays).all(axis=1)
    if not known.any():
        return None
    mean = rays[known].mean(axis=0)
    forward = mean / np.linalg.norm(mean)
    side = np.cross(np.eye(3)[int(np.argmin(np.abs(forward)))], forward)
    side /= np.linalg.norm(side)
    turn = np.array([side, np.cross(forward, side), forward])
    rays = rays @ turn.T
    usable = known & (np.nan_to_num(rays[:, 2]) > _AHEAD)
    if usable.sum() < _LEAST:
        return None
    flat = rays[usable, :2] / rays[usable, 2:]
    found, vector, shift = cv2.solvePnP(
        points[usable], flat, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    if not found or not (np.isfinite(vector).all() and np.isfinite(shift).all()):
        return None
    rotation = so3_exp(np.asarray(vector, np.float64).ravel())
    return pose(turn.T @ rotation, turn.T @ np.asarray(shift, np.float64).ravel())


# --------------------------------------------------------------------------------------------
# What a calibration is good for: checked on images of the board that it has not seen


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
    baseline = float(np.linalg.norm(second.bTc[:3, 3]))
    count, rows, squares = 0, [], []
    for view in views:
        a, b = view[0], view[camera]
        if a is None or b is None:
            continue
        ids, of_a, of_b = np.intersect1d(a.ids, b.ids, return_indices=True)
        if not len(ids):
            continue
        off, points = _triangulated(first, second, a.pixels[of_a], b.pixels[of_b])
        at = np.full(len(board.points), -1)
        at[ids] = np.arange(len(ids))
        ends = at[board.neighbours]
        ends = ends[(ends >= 0).all(axis=1)]
        count += 1
        rows.append(off)
        squares.append(np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1))
    if not count:
        return None
    spread = np.median(np.abs(np.concatenate(rows)))
    rows_px = _MEDIAN_TO_SIGMA * float(spread) * first.focal_px
    reach = DEPTH_SHARE * baseline * first.focal_px / max(rows_px, 1e-9)
    return HeldOut(count, rows_px, float(np.median(np.concatenate(squares))), reach)


def _triangulated(
    first: RawCamera, second: RawCamera, a: FloatArray, b: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Differences of rows (n,), radians, and points (n, 3) of pixels (n, 2) in both cameras."""
    offset = second.bTc[:3, 3]
    along = offset / np.linalg.norm(offset)
    across = np.cross(first.bTc[:3, 2] + second.bTc[:3, 2], along)
    across /= np.linalg.norm(across)
    axes = np.array([along, across, np.cross(along, across)])  # the baseline is the first
    rays = [
        camera.unproject(pixels) @ (axes @ camera.bTc[:3, :3]).T
        for camera, pixels in ((first, a), (second, b))
    ]
    # As angles around the baseline, rows agree whatever the field of view.
    rows = [np.arctan2(ray[:, 1], ray[:, 2]) for ray in rays]
    slopes = [ray[:, 0] / np.hypot(ray[:, 1], ray[:, 2]) for ray in rays]
    parallax = slopes[0] - slopes[1]
    depth = np.linalg.norm(offset) / np.where(np.abs(parallax) > _FAR, parallax, np.nan)
    middle = 0.5 * (rows[0] + rows[1])
    points = np.column_stack([slopes[0], np.sin(middle), np.cos(middle)]) * depth[:, None]
    return rows[0] - rows[1], points


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
    off_px = float(np.median(np.concatenate(off))) / _MEDIAN_OF_RAYLEIGH * np.sqrt(2.0)
    return HeldOutAlone(np.array(kept), float(off_px), np.array([_rms(one) for one in off]))


def _off_when_placed(board: Board, camera: RawCamera, corners: Corners) -> FloatArray | None:
    """Distances (n,) in pixels with the board where they are least; None where it has no place."""
    points = board.points[corners.ids]
    cTb = board_pose(camera, points, corners.pixels)
    if cTb is None:
        return None

    def off(turn: FloatArray) -> FloatArray:
        away = camera.project(transform_to_world(_matrix_of(turn), points)) - corners.pixels
        return np.asarray(np.where(np.isfinite(away), away, np.hypot(*camera.size))).ravel()

    fit = least_squares(off, _turn_of(cTb), "3-point", loss="huber", f_scale=_HUBER_PX)
    return np.asarray(np.linalg.norm(off(fit.x).reshape(-1, 2), axis=1))


def _pixels_of(views: Sequence[View], camera: int) -> FloatArray:
    seen = [corners.pixels for view in views if (corners := view[camera]) is not None]
    return np.concatenate([np.empty((0, 2)), *seen])


def coverage(views: Sequence[View], camera: int, size: tuple[int, int]) -> float:
    """Share of the cells of the image (ten by ten) in which a corner was found."""
    cells = np.floor(_pixels_of(views, camera) / np.array(size) * _CELLS)
    return len(np.unique(cells.clip(0, _CELLS - 1).astype(int), axis=0)) / _CELLS**2


def coverage_of_circle(views: Sequence[View], camera: RawCamera) -> float:
    """Share of the cells (ten by ten) of the widest circle in the image with a corner.

    The circle is that around the principal point: a fisheye's or a mirror's image is black beyond.
    """
    centre = camera.matrix[:2, 2]
    radius = float(np.min([*centre, *(np.array(camera.size) - 1 - centre)]))
    found = np.floor(((_pixels_of(views, 0) - centre) / radius + 1.0) * 0.5 * _CELLS).astype(int)
    middles = (np.arange(_CELLS) + 0.5) / _CELLS * 2.0 - 1.0
    within = np.hypot(middles[:, None], middles) < 1.0
    found = np.unique(found[((found >= 0) & (found < _CELLS)).all(axis=1)], axis=0)
    return float(within[found[:, 0], found[:, 1]].sum() / within.sum())


def farthest_from_axis(views: Sequence[View], camera: RawCamera) -> float:
    """Largest angle from the axis, radians, at which a corner was found."""
    rays = camera.unproject(_pixels_of(views, 0))
    return float(np.nanmax(np.arctan2(np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2]), initial=0.0))
