"""Calibration of one to three cameras from images of a board: all parameters in one least squares.

The model is that of Zhang (A flexible new technique for camera calibration, 2000) with any lens of
:mod:`fgslam.cameras.lenses`; corners of all cameras and images are fitted together, so that the
poses of the cameras to each other and their intrinsics come with one covariance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from fgslam.cameras.boards import Board, Corners
from fgslam.cameras.lenses import RawCamera, checked_camera
from fgslam.cameras.trees import intrinsic_matrix
from fgslam.core.arrays import BoolArray, FloatArray, IntArray, Rows
from fgslam.core.errors import CalibrationError
from fgslam.core.geometry import inverse, pose, so3_exp, so3_log, transform_to_world

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
_STEP = 1e-6  # of the central differences: pixels, radians, metres, and parts of a lens of order 1
_CONVERGED = 1e-10  # of the sum of squares that a step may still gain
_FIRST_DAMPING, _LEAST_DAMPING = 1e-3, 1e-12
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

View: TypeAlias = tuple[Corners | None, ...]
"""What the cameras see of the board at one moment, in their order; None where it was not found."""


@dataclass(frozen=True, slots=True, eq=False)
class BoardCalibration:
    """Cameras as fitted to a board.

    Attributes:
        cameras: in their order; the first one is the body.
        turns: (cameras, 6) rotation vectors and translations that take the first camera's
            coordinates to each camera's.
        sigmas: (cameras, p) standard deviations of fx, fy, cx, cy and the model's parameters.
        turn_sigmas: (cameras, 6) of the turns, radians and metres; zero for the first.
        boards: (views, 6) pose of the board in the first camera; NaN where it was not used.
        views: as given, with corners numbered alike in all cameras.
        kept: the corners of each view that were used; None where none were.
        errors: (views, cameras) root mean square distance in each image, pixels; NaN where unused.
        rms: the same of all corners that were used.
        left_out: corners that do not fit the others.
    """

    cameras: tuple[RawCamera, ...]
    turns: FloatArray
    sigmas: FloatArray
    turn_sigmas: FloatArray
    boards: FloatArray
    views: tuple[View, ...]
    kept: tuple[View, ...]
    errors: FloatArray
    rms: float
    left_out: int


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
    seen = _sightings(board, views)
    used = np.ones(len(seen), np.bool_)
    _require_views(seen, used)
    seen, values, posed = _start(board, seen, size, model, len(views))
    used = posed[seen.image]
    lens_from = len(INTRINSICS) + (1 if model == "omni" else 0)
    values = _Fit(seen.select(used), values, size, model).least(_FIRST_STEPS, lens_from)
    for trimming in range(_TRIMMINGS):
        _require_views(seen, used)
        fit = _Fit(seen.select(used), values, size, model)
        values, sigmas = fit.solution()
        away = _away(seen, values, size, model)
        # Distances beyond five robust deviations of all are left out; what an earlier, worse fit
        # left out comes back where it fits now.
        known = away[np.isfinite(away)]
        if not len(known):
            raise CalibrationError(_UNDETERMINED)
        limit = _OUTLIER_SIGMAS * float(np.median(known)) / _MEDIAN_OF_RAYLEIGH
        near = away <= limit
        counts = np.bincount(seen.image[near], minlength=len(seen.images))
        trimmed = near & (counts >= _LEAST_CORNERS)[seen.image]
        if trimming == _TRIMMINGS - 1 or trimmed.sum() == used.sum():
            break
        used = trimmed
    rms = _rms(away[used])
    if rms > _MOST_OFF * float(np.hypot(*size)):
        raise CalibrationError(
            f"the corners lie {rms:.1f} px (rms) off what {model} cameras show of a flat "
            "board; is --lens that of the camera, its focus fixed, and the board flat?"
        )
    errors = np.full((len(views), len(views[0])), np.nan)
    numbered: list[list[Corners | None]] = [[None] * len(views[0]) for _ in views]
    kept: list[list[Corners | None]] = [[None] * len(views[0]) for _ in views]
    for image, (v, c) in enumerate(seen.images):
        own = seen.image == image
        numbered[v][c] = Corners(seen.ids[own], seen.pixels[own])
        own &= used
        if own.any():
            errors[v, c] = _rms(away[own])
            kept[v][c] = Corners(seen.ids[own], seen.pixels[own])
    places = [inverse(pose(so3_exp(turn[:3]), turn[3:])) for turn in values.turns]
    cameras = tuple(
        replace(camera_of(model, size, numbers, f"cam{c}"), bTc=bTc)
        for c, (numbers, bTc) in enumerate(zip(values.intrinsics, places, strict=True))
    )
    found = values.turns, sigmas.intrinsics, sigmas.turns, values.boards
    seen_views = tuple(map(tuple, numbered)), tuple(map(tuple, kept))
    return BoardCalibration(cameras, *found, *seen_views, errors, rms, int((~used).sum()))


# --------------------------------------------------------------------------------------------
# Corners and parameters as arrays


@dataclass(frozen=True, slots=True, eq=False)
class _Sightings(Rows):
    """All corners, a row each: view, camera, image and number, point on the board, and pixel.

    ``images`` holds view and camera of each image.
    """

    SHARED = frozenset({"images"})

    view: IntArray
    camera: IntArray
    image: IntArray
    ids: IntArray
    points: FloatArray
    pixels: FloatArray
    images: tuple[tuple[int, int], ...]


class _Values(NamedTuple):
    """Intrinsics (cameras, p), turns (cameras, 6), boards (views, 6); NaN for a view unused."""

    intrinsics: FloatArray
    turns: FloatArray
    boards: FloatArray


def _sightings(board: Board, views: Sequence[View]) -> _Sightings:
    found = [(v, c, one) for v, view in enumerate(views) for c, one in enumerate(view) if one]
    counts = [len(corners) for _, _, corners in found]
    view, camera = (np.repeat([one[k] for one in found], counts).astype(int) for k in (0, 1))
    ids = np.concatenate([corners.ids for _, _, corners in found])
    image = np.repeat(np.arange(len(found)), counts)
    pixels = np.concatenate([corners.pixels for _, _, corners in found])
    images = tuple((v, c) for v, c, _ in found)
    return _Sightings(view, camera, image, ids, board.points[ids], pixels, images)


def _require_views(seen: _Sightings, used: BoolArray) -> None:
    """Raises CalibrationError where a camera shows the board too seldom."""
    cameras = 1 + max(c for _, c in seen.images)
    for camera in range(cameras):
        count = len(np.unique(seen.image[used & (seen.camera == camera)]))
        if count < LEAST_VIEWS:
            which = f"{NAMES[camera]} camera" if cameras > 1 else "camera"
            raise CalibrationError(
                f"the {which} shows the board in {count} images that can be "
                f"used; {LEAST_VIEWS} are needed at least, twenty are good"
            )


def _rms(distances: FloatArray) -> float:
    return float(np.sqrt(np.mean(distances**2))) if len(distances) else float("nan")


def _turn_of(matrix: FloatArray) -> FloatArray:
    """(6,) rotation vector and translation."""
    return np.concatenate([so3_log(matrix[:3, :3]), matrix[:3, 3]])


# --------------------------------------------------------------------------------------------
# The least squares


def _placed(seen: _Sightings, values: _Values) -> FloatArray:
    """(n, 3) all corners in the axes of the cameras that see them."""
    points = seen.points
    for turns, which in ((values.boards, seen.view), (values.turns, seen.camera)):
        rotations = np.full((len(turns), 3, 3), np.nan)
        known = np.isfinite(turns).all(axis=1)
        rotations[known] = Rotation.from_rotvec(turns[known, :3]).as_matrix()
        points = np.einsum("nij,nj->ni", rotations[which], points) + turns[which, 3:]
    return points


def _predicted(
    seen: _Sightings, values: _Values, size: tuple[int, int], model: str, points: FloatArray
) -> FloatArray:
    """(n, 2) pixels of :func:`_placed` points (n, 3); NaN where the lens does not show them."""
    out = np.empty((len(points), 2))
    for camera, numbers in enumerate(values.intrinsics):
        own = seen.camera == camera
        out[own] = camera_of(model, size, numbers).project(points[own])
    return out


def _away(seen: _Sightings, values: _Values, size: tuple[int, int], model: str) -> FloatArray:
    """(n,) pixels from where the corners are predicted to where they were found."""
    predicted = _predicted(seen, values, size, model, _placed(seen, values))
    return np.asarray(np.linalg.norm(predicted - seen.pixels, axis=1))


class _Fit:
    """Residuals of all corners over one vector: intrinsics, turns of the others, boards."""

    def __init__(
        self, seen: _Sightings, values: _Values, size: tuple[int, int], model: str
    ) -> None:
        self.seen, self.values, self.size, self.model = seen, values, size, model
        self.shown, row = np.unique(seen.view, return_inverse=True)
        own, turns = values.intrinsics.shape[1], values.intrinsics.size
        boards = turns + 6 * (len(values.turns) - 1)
        # Which of the parameters each corner depends on (n, own + 12); -1: on none.
        six = np.arange(6)
        of_turn = np.where(
            seen.camera[:, None] > 0, turns + 6 * (seen.camera[:, None] - 1) + six, -1
        )
        self.columns = np.hstack(
            [own * seen.camera[:, None] + np.arange(own), of_turn, boards + 6 * row[:, None] + six]
        )
        self.splits = turns, boards

    def vector(self, values: _Values) -> FloatArray:
        """All parameters (p,)."""
        return np.concatenate(
            [values.intrinsics.ravel(), values.turns[1:].ravel(), values.boards[self.shown].ravel()]
        )

    def parts(self, x: FloatArray) -> _Values:
        """The parameters of a vector."""
        intrinsics, turns, boards = np.split(x, self.splits)
        every = np.full_like(self.values.boards, np.nan)
        every[self.shown] = boards.reshape(-1, 6)
        turns = np.concatenate([np.zeros(6), turns]).reshape(-1, 6)
        return _Values(intrinsics.reshape(self.values.intrinsics.shape), turns, every)

    def predicted(self, values: _Values, points: FloatArray) -> FloatArray:
        """(n, 2) pixels of points (n, 3) in the cameras' axes."""
        return _predicted(self.seen, values, self.size, self.model, points)

    def residuals(self, x: FloatArray) -> FloatArray:
        """(2n,) pixels, predicted minus found; the image's diagonal where the lens shows none."""
        values = self.parts(x)
        off = self.predicted(values, _placed(self.seen, values)) - self.seen.pixels
        return np.asarray(np.where(np.isfinite(off), off, np.hypot(*self.size))).ravel()

    def normal_equations(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Information (p, p) and its right side (p,), by central differences.

        A corner depends on one camera, its turn and one board: the k-th parameter of all cameras,
        or of all boards, is moved at once; corners of an image share their parameters. Turns and
        boards move the corner in the camera's axes, whose projection is differentiated once.
        """
        seen, values, step = self.seen, self.parts(x), _STEP * np.maximum(1.0, np.abs(x))
        points, n = _placed(seen, values), len(seen.pixels)
        slopes, by_point = np.zeros((n, 2, self.columns.shape[1])), np.empty((n, 2, 3))
        for axis, by in enumerate(_STEP * np.eye(3)):
            moved = self.predicted(values, points + by) - self.predicted(values, points - by)
            by_point[:, :, axis] = moved / (2.0 * _STEP)
        for k, column in enumerate(self.columns.T):
            of = np.flatnonzero(column >= 0)
            if not len(of):
                continue
            change = np.zeros(len(x))
            change[column[of]] = step[column[of]]
            ahead, behind = self.parts(x + change), self.parts(x - change)
            if k < values.intrinsics.shape[1]:
                moved = self.predicted(ahead, points) - self.predicted(behind, points)
            else:
                way = _placed(seen, ahead) - _placed(seen, behind)
                moved = np.einsum("nij,nj->ni", by_point, way)
            slope = moved[of] / (2.0 * step[column[of]])[:, None]
            slopes[of, :, k] = np.where(np.isfinite(slope), slope, 0.0)
        off = self.residuals(x).reshape(n, 2)
        information, right_side = np.zeros((len(x), len(x))), np.zeros(len(x))
        for rows in np.split(np.arange(n), np.flatnonzero(np.diff(self.seen.image)) + 1):
            columns = self.columns[rows[0]]
            on = columns[columns >= 0]
            jacobian = slopes[rows][:, :, columns >= 0].reshape(-1, len(on))
            information[np.ix_(on, on)] += jacobian.T @ jacobian
            right_side[on] += jacobian.T @ off[rows].ravel()
        return information, right_side

    def least(self, steps: int, fixed_from: int | None = None) -> _Values:
        """The values of the least residuals; each camera's parameters from one on may be fixed."""
        return self.parts(self._solve(steps, fixed_from)[0])

    def _solve(self, steps: int, fixed_from: int | None) -> tuple[FloatArray, bool]:
        """Parameters (p,) by Levenberg's and Marquardt's method, and whether it converged."""
        x = self.vector(self.values)
        own, each = np.arange(self.splits[0]), self.values.intrinsics.shape[1]
        fixed = own[own % each >= (each if fixed_from is None else fixed_from)]
        free = np.setdiff1d(np.arange(len(x)), fixed)
        cost, damping, growth = float(np.sum(self.residuals(x) ** 2)), _FIRST_DAMPING, 2.0
        scale = np.full(len(free), np.finfo(float).tiny)
        for _ in range(steps):
            information, right_side = self.normal_equations(x)
            scale = np.maximum(scale, np.sqrt(np.diag(information)[free]))
            information = information[np.ix_(free, free)] / np.outer(scale, scale)
            slope = right_side[free] / scale
            while True:
                step = np.linalg.solve(information + damping * np.eye(len(free)), slope)
                trial = x.copy()
                trial[free] -= step / scale
                gain = cost - float(np.sum(self.residuals(trial) ** 2))
                expected = float(step @ (damping * step + slope))
                if gain > 0.0:
                    break
                damping, growth = growth * damping, 2.0 * growth
                if expected < _CONVERGED * cost:
                    return x, True  # but for rounding nothing is less
            # Nielsen's rule: by how well the step was foreseen.
            damping *= max(1.0 / 3.0, 1.0 - (2.0 * gain / expected - 1.0) ** 3)
            damping, growth = max(damping, _LEAST_DAMPING), 2.0
            x, cost = trial, cost - gain
            if gain < _CONVERGED * cost:
                return x, True
        return x, False

    def solution(self) -> tuple[_Values, _Values]:
        """The values of the least residuals, and their standard deviations.

        Raises:
            CalibrationError: the corners do not determine them, or the fit does not converge.
        """
        x, converged = self._solve(MOST_STEPS, None)
        information, off = self.normal_equations(x)[0], self.residuals(x)
        scale = np.sqrt(np.diag(information))
        if not (np.isfinite(scale).all() and scale.all()):
            raise CalibrationError(_UNDETERMINED)
        information /= np.outer(scale, scale)
        left = len(off) - len(x)
        if left <= 0 or not converged or not np.linalg.cond(information) <= 1e14:
            raise CalibrationError(_UNDETERMINED)
        covariance = off @ off / left * np.linalg.inv(information) / np.outer(scale, scale)
        values, own = self.parts(x), self.values.intrinsics.shape[1]
        for camera, numbers in enumerate(values.intrinsics):
            at = slice(camera * own, (camera + 1) * own)
            by = np.zeros(own)
            by[0] = 1.0 / numbers[0]
            if self.model == "omni":  # f / (1 + xi), that around the axis: the two are nearly one
                by[len(INTRINSICS)] = -1.0 / (1.0 + numbers[len(INTRINSICS)])
            try:
                checked_camera(camera_of(self.model, self.size, numbers))
            except CalibrationError:
                raise CalibrationError(_UNDETERMINED) from None
            if not by @ covariance[at, at] @ by <= _UNCERTAIN**2:
                raise CalibrationError(_UNDETERMINED)
        return values, self.parts(np.sqrt(np.diag(covariance)))


# --------------------------------------------------------------------------------------------
# Where a fit starts


_HALF_VIEWS = np.radians([5.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 75.0, 90.0, 105.0, 120.0])
"""Angles from the axis that the nearest border of the image may show."""
_XIS = (0.7, 1.0, 1.5)  # of lenses, parabolic mirrors, and spheres seen from farther away
_AHEAD = 0.1  # least depth over distance, seen along the board's middle, to take a pose from
_LEAST = 4  # points from which a pose follows


def _start(
    board: Board, seen: _Sightings, size: tuple[int, int], model: str, views: int
) -> tuple[_Sightings, _Values, BoolArray]:
    """The corners, first values, and in which images (k,) the board has a pose.

    Where a board is the same after a turn, its corners are numbered alike in all cameras: with
    the wrong number each view would have other poses of the cameras to each other.
    """
    images = [seen.image == k for k in range(len(seen.images))]
    count = 1 + max(c for _, c in seen.images)
    intrinsics = []
    for camera in range(count):
        own = [at for at, (_, c) in zip(images, seen.images, strict=True) if c == camera]
        flat, pixels = ([each[at] for at in own] for each in (seen.points, seen.pixels))
        intrinsics.append(first_guess(model, flat, pixels, size))
    cameras = [camera_of(model, size, numbers) for numbers in intrinsics]
    # Of each image the board's poses, one for each way to number its corners.
    ways = board.renumberings
    cTbs: dict[tuple[int, int], list[FloatArray]] = {}
    for at, (v, c) in zip(images, seen.images, strict=True):
        poses = [board_pose(cameras[c], board.points[way[seen.ids[at]]], seen.pixels[at])
                 for way in ways]  # fmt: skip
        if known := [cTb for cTb in poses if cTb is not None]:
            cTbs[v, c] = known
    turns = [np.eye(4)]
    for camera in range(1, count):
        both = np.array(
            [[cTb @ inverse(cTbs[v, 0][0]) for cTb in found]
             for (v, c), found in cTbs.items() if c == camera and (v, 0) in cTbs]
        )  # fmt: skip
        if not len(both):
            raise CalibrationError(
                f"cameras 0 and {camera} never see the board at once; are they paired rightly?"
            )
        # Of the poses that single views give, with any numbering, the one nearest to all others.
        apart = np.linalg.norm(both[:, :, None, None] - both, axis=(4, 5)).min(axis=3).sum(axis=2)
        turns.append(both[np.unravel_index(int(np.argmin(apart)), apart.shape)])
    boards, chosen = np.full((views, 4, 4), np.nan), np.zeros(len(images), np.int64)
    for image, (v, c) in enumerate(seen.images):
        if (found := cTbs.get((v, c))) is None:
            continue
        here = [inverse(turns[c]) @ cTb for cTb in found]
        if np.isnan(boards[v, 0, 0]):  # by the first camera that sees it
            boards[v] = here[0]
        chosen[image] = int(np.argmin([np.linalg.norm(one - boards[v]) for one in here]))
    ids = ways[chosen[seen.image], seen.ids]
    seen = replace(seen, ids=ids, points=board.points[ids])
    six = np.array([np.full(6, np.nan) if np.isnan(one[0, 0]) else _turn_of(one) for one in boards])
    values = _Values(np.array(intrinsics), np.array([_turn_of(turn) for turn in turns]), six)
    if not all(np.isfinite(one).all() for one in (*values[:2], six[[v for v, _ in cTbs]])):
        raise CalibrationError(_UNDETERMINED)
    return seen, values, np.array([image in cTbs for image in seen.images])


def first_guess(
    model: str, points: Sequence[FloatArray], pixels: Sequence[FloatArray], size: tuple[int, int]
) -> FloatArray:
    """Intrinsics (p,) of one camera: fx, fy, cx, cy and the model's parameters.

    Of several angles of view without distortion, those with which the boards lie nearest to what
    was seen.

    Args:
        model: one of :data:`PARAMETERS`.
        points: of each image (n, 3), in the board's axes.
        pixels: of each image (n, 2), where they were found.
        size: width and height of the images.
    """
    centre = (size[0] - 1) / 2.0, (size[1] - 1) / 2.0
    candidates = []
    for angle in _HALF_VIEWS:
        for xi in _XIS if model == "omni" else (0.0,):
            # Radius of a ray at that angle, for a focal length of 1.
            ahead = np.cos(angle) + xi
            radius = angle if model == "equidistant" else np.sin(angle) / max(ahead, _AHEAD)
            focal = 0.5 * min(size) / radius
            lens = np.zeros(len(PARAMETERS[model]))
            lens[0] = xi
            if model == "equidistant" or ahead > _AHEAD:
                candidates.append(np.array([focal, focal, *centre, *lens]))
    off = [_misfit(camera_of(model, size, guess), points, pixels) for guess in candidates]
    return candidates[int(np.argmin(off))]


def _misfit(camera: RawCamera, points: Sequence[FloatArray], pixels: Sequence[FloatArray]) -> float:
    """Mean logarithm of how far off each image's corners are, with the boards placed.

    Of pixels the mean would follow one image that shows no such board.
    """
    off = []
    for flat, seen in zip(points, pixels, strict=True):
        cTb = board_pose(camera, flat, seen)
        if cTb is None:
            off.append(np.inf)
            continue
        distance = np.linalg.norm(camera.project(transform_to_world(cTb, flat)) - seen, axis=1)
        off.append(float(np.median(np.where(np.isfinite(distance), distance, np.inf))))
    return float(np.mean(np.log(np.clip(off, 1.0, max(camera.size)))))


def camera_of(
    model: str, size: tuple[int, int], numbers: FloatArray, name: str = "camera"
) -> RawCamera:
    """The camera of fx, fy, cx, cy and the model's parameters, at the body's origin."""
    matrix = intrinsic_matrix(*numbers[:4])
    return RawCamera(*size, matrix, numbers[4:], np.eye(4), name, model)


def board_pose(camera: RawCamera, points: FloatArray, pixels: FloatArray) -> FloatArray | None:
    """Pose (4, 4) of a board in the camera; None where too few of its corners have rays.

    The rays are turned to look along their mean first: a board may lie next to the camera.
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
_FAR = 1e-6  # radians of parallax: below it a point has no depth
DEPTH_SHARE = 0.05
"""Of the depth: where a point lies deeper than this error, it is of no use as a place."""


@dataclass(frozen=True, slots=True)
class HeldOut:
    """How a pair of cameras does on images that did not take part in its calibration.

    Attributes:
        views: how many those were.
        rows_px: deviation of the rows of one corner in both rectified images, from the median of
            their distances: a corner that was found wrongly proves nothing about the calibration.
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
    # A corner at which no ray of the camera ends is off by more than any.
    spread = np.median(np.nan_to_num(np.abs(np.concatenate(rows)), nan=np.inf))
    rows_px = _MEDIAN_TO_SIGMA * float(spread) * first.focal_px
    reach = DEPTH_SHARE * baseline * first.focal_px / max(rows_px, 1e-9)
    return HeldOut(count, rows_px, float(np.nanmedian(np.concatenate(squares))), reach)


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
            proves nothing about the calibration. The board's pose alone is fitted to each image.
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
    own = [k for k, view in enumerate(views) if view[0] is not None]
    try:
        camera = calibrate(board, [views[k] for k in own[::2]], size, model).cameras[0]
    except CalibrationError:
        return None
    seen = _sightings(board, [views[k] for k in own[1::2]])
    images = [seen.image == k for k in range(len(seen.images))]
    poses = [board_pose(camera, seen.points[at], seen.pixels[at]) for at in images]
    if all(cTb is None for cTb in poses):
        return None
    boards = np.array([np.full(6, np.nan) if cTb is None else _turn_of(cTb) for cTb in poses])
    numbers = np.concatenate([camera.intrinsics, camera.distortion])[None]
    placed = seen.select(np.isfinite(boards).all(axis=1)[seen.image])
    values = _Fit(placed, _Values(numbers, np.zeros((1, 6)), boards), size, model).least(
        _FIRST_STEPS, fixed_from=0
    )
    away = _away(placed, values, size, model)
    kept = np.unique(placed.image)
    off_px = float(np.median(away)) / _MEDIAN_OF_RAYLEIGH * np.sqrt(2.0)
    each = np.array([_rms(away[placed.image == k]) for k in kept])
    return HeldOutAlone(np.array(own[1::2])[kept], float(off_px), each)


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
