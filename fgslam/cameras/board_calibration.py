"""Calibration of one to three cameras from images of a board: all parameters in one least squares.

The model is that of Zhang (A flexible new technique for camera calibration, 2000) with OpenCV's
lenses; corners of all cameras and images are fitted together, so that the poses of the cameras to
each other and their intrinsics come with one covariance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from fgslam.cameras.board_projection import INTRINSICS, PARAMETERS, TURN, projected
from fgslam.cameras.board_start import board_pose, camera_of, first_guess
from fgslam.cameras.boards import Board, Corners
from fgslam.cameras.lenses import RawCamera, checked_camera
from fgslam.core.arrays import FloatArray
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
LEAST_VIEWS = 5
_OUTLIER_SIGMAS = 5.0  # of one coordinate: a right corner is farther off once in 270,000
MEDIAN_OF_RAYLEIGH = 1.1774  # median distance in the plane over the deviation of a coordinate
_TRIMMINGS = 4
_MOST_OFF = 0.0025  # of the image's diagonal: corners are found to a tenth of that
_FIRST_STEPS = 30  # with fixed distortion: from a rough start it becomes non-monotonic
_STEPS = 300  # evaluations of the fit; twenty are usual
_UNCERTAIN = 0.1  # of the focal length: with a larger deviation nothing is known of a camera
_LEAST_CORNERS = 6  # of an image, for its board's pose to follow with something left

_UNDETERMINED = (
    "the board's images do not determine the cameras: take more of them, tilted in different "
    "directions, some in each corner of the image"
)
_UNFINISHED = (
    "the fit of the {model} cameras does not converge in {steps} steps; try another --lens, or "
    "leave out images in which corners were found wrongly"
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
        return turn_of_matrix(inverse(self.cameras[camera].bTc) @ self.cameras[0].bTc)

    @property
    def errors(self) -> FloatArray:
        """(views, cameras) root mean square distance in each image, pixels; NaN where unseen."""
        return np.array([[_rms(distances) for distances in view] for view in self.off])

    @property
    def rms(self) -> float:
        """Root mean square distance of all corners that were used, pixels."""
        return _rms(np.concatenate([distances for view in self.off for distances in view]))


def _rms(distances: FloatArray) -> float:
    return float(np.sqrt(np.mean(distances**2))) if len(distances) else float("nan")


def _matrix_of_turn(turn: FloatArray) -> FloatArray:
    """(4, 4) from rotation vector and translation."""
    return pose(so3_exp(turn[:3]), turn[3:])


def turn_of_matrix(matrix: FloatArray) -> FloatArray:
    """(6,) rotation vector and translation."""
    return np.concatenate([so3_log(matrix[:3, :3]), matrix[:3, 3]])


def calibrate(
    board: Board, views: Sequence[View], size: tuple[int, int], model: str
) -> BoardCalibration:
    """Cameras from what they saw of a board; images that do not fit the others are left out.

    Args:
        board: the board.
        views: of each moment what each camera saw; the first camera is the reference.
        size: width and height of all images.
        model: one of :data:`fgslam.cameras.board_projection.PARAMETERS`, of all cameras.

    Raises:
        CalibrationError: too few views, they do not determine the cameras, or no such cameras show
            a board like that.
    """
    found = _fit(*_first(board, views, model, size), size)
    for _ in range(_TRIMMINGS - 1):
        trimmed = _trimmed(views, _distances(found, board, views))
        if _count(trimmed) == _count(found.kept):
            break
        problem = _Problem(board, trimmed, model)
        found = _fit(problem, problem.start_of(found), size)
    if found.rms > _MOST_OFF * float(np.hypot(*size)):
        raise CalibrationError(
            f"the corners lie {found.rms:.1f} px (rms) off what {model} cameras show of a flat "
            "board; is --lens that of the camera, its focus fixed, and the board flat?"
        )
    return replace(found, left_out=_count(views) - _count(found.kept))


def _count(views: Sequence[View]) -> int:
    return sum(len(corners) for view in views for corners in view if corners is not None)


def _trimmed(views: Sequence[View], off: Sequence[Sequence[FloatArray]]) -> tuple[View, ...]:
    """What fits: distances (n,) beyond five robust deviations of all corners are left out.

    What an earlier, worse fit left out comes back where it fits now.
    """
    everything = np.concatenate([distance for view in off for distance in view])
    known = everything[np.isfinite(everything)]
    if not len(known):
        raise CalibrationError(_UNDETERMINED)
    limit = _OUTLIER_SIGMAS * float(np.median(known)) / MEDIAN_OF_RAYLEIGH
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
        fTb = _matrix_of_turn(turn) if known else np.full((4, 4), np.nan)
        points = transform_to_world(fTb, board.points)
        seen = zip(found.cameras, view, strict=True)
        out.append(tuple(_off(camera, points, corners) for camera, corners in seen))
    return tuple(out)


def _off(camera: RawCamera, points: FloatArray, corners: Corners | None) -> FloatArray:
    if corners is None:
        return np.empty(0)
    pixels = camera.project(transform_to_camera(camera.bTc, points[corners.ids]))
    return np.asarray(np.linalg.norm(pixels - corners.pixels, axis=1))


def _first(
    board: Board, views: Sequence[View], model: str, size: tuple[int, int]
) -> tuple[_Problem, FloatArray]:
    """The problem and first values; images in which the board has no pose are left out."""
    problem = _Problem(board, views, model)
    intrinsics = problem.guesses(size)
    cTb = problem.poses(size, intrinsics)
    if len(cTb) < len(problem.seen):
        posed = (
            tuple(corners if (v, c) in cTb else None for c, corners in enumerate(view))
            for v, view in enumerate(views)
        )
        problem = _Problem(board, tuple(posed), model)
    start = problem.start(intrinsics, cTb)
    if not np.isfinite(start).all() or not np.isfinite(problem.residuals(start)).all():
        raise CalibrationError(_UNDETERMINED)
    if model != "radtan":
        start = _least(problem.residuals, problem.jacobian_without_lens, start, _FIRST_STEPS).x
    return problem, start


def _fit(problem: _Problem, start: FloatArray, size: tuple[int, int]) -> BoardCalibration:
    """The cameras of the least residuals from a start on."""
    fit = _least(problem.residuals, problem.jacobian, start, _STEPS)
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
    problem.require_determined(size, fit.x, covariance)
    if not fit.success:
        raise CalibrationError(_UNFINISHED.format(model=problem.model, steps=_STEPS))
    found = problem.result(size, fit.x, np.sqrt(np.diag(covariance)))
    return replace(found, off=_distances(found, problem.board, problem.views))


def _least(
    residuals: Callable[[FloatArray], FloatArray],
    jacobian: Callable[[FloatArray], FloatArray],
    start: FloatArray,
    steps: int,
) -> Any:
    return least_squares(residuals, start, jacobian, method="lm", x_scale="jac", max_nfev=steps)


class _Problem:
    """Residuals and derivatives over (intrinsics, turns of the other cameras, boards)."""

    def __init__(self, board: Board, views: Sequence[View], model: str) -> None:
        self.board, self.model, self.views = board, model, tuple(views)
        self.cameras, self._points = len(views[0]), board.points
        self._own = len(INTRINSICS) + len(PARAMETERS[model])
        self._turns_at = self.cameras * self._own
        self._boards_at = self._turns_at + TURN * (self.cameras - 1)
        self.seen = [
            (v, c, corners)
            for v, view in enumerate(views)
            for c, corners in enumerate(view)
            if corners is not None
        ]
        for camera in range(self.cameras):
            count = sum(c == camera for _, c, _ in self.seen)
            if count < LEAST_VIEWS:
                which = f"{NAMES[camera]} camera" if self.cameras > 1 else "camera"
                raise CalibrationError(
                    f"the {which} shows the board in {count} images that can be "
                    f"used; {LEAST_VIEWS} are needed at least, twenty are good"
                )
        self._row_of = {v: k for k, v in enumerate(sorted({v for v, _, _ in self.seen}))}

    def guesses(self, size: tuple[int, int]) -> list[FloatArray]:
        """First intrinsics of each camera, by itself."""
        intrinsics = []
        for camera in range(self.cameras):
            own = [corners for _, c, corners in self.seen if c == camera]
            points = [self._points[corners.ids] for corners in own]
            intrinsics.append(first_guess(self.model, points, [o.pixels for o in own], size))
        return intrinsics

    def poses(
        self, size: tuple[int, int], intrinsics: Sequence[FloatArray]
    ) -> dict[tuple[int, int], FloatArray]:
        """Poses (4, 4) of the board by view and camera, of those images that give one."""
        cameras = [camera_of(self.model, size, numbers) for numbers in intrinsics]
        found = {
            (v, c): board_pose(cameras[c], self._points[corners.ids], corners.pixels)
            for v, c, corners in self.seen
        }
        return {key: cTb for key, cTb in found.items() if cTb is not None}

    def start_of(self, found: BoardCalibration) -> FloatArray:
        """First values: those of a fit to more or fewer corners of the same views."""
        intrinsics = [np.concatenate([c.intrinsics, c.distortion]) for c in found.cameras]
        turns = [found.turn(camera) for camera in range(1, self.cameras)]
        return np.concatenate([*intrinsics, *turns, *(found.boards[v] for v in self._row_of)])

    def start(
        self, intrinsics: Sequence[FloatArray], cTb: dict[tuple[int, int], FloatArray]
    ) -> FloatArray:
        """First values: the cameras' poses to the first where both see the board."""
        turns = [self._relative(cTb, camera) for camera in range(1, self.cameras)]
        boards = [self._in_first(cTb, turns, v) for v in self._row_of]
        return np.concatenate([*intrinsics, *map(turn_of_matrix, turns), *boards])

    def _relative(self, cTb: dict[tuple[int, int], FloatArray], camera: int) -> FloatArray:
        """Of the poses that single views give the one nearest to all others."""
        both = [
            cTb[v, camera] @ inverse(cTb[v, 0])
            for v in self._row_of
            if (v, camera) in cTb and (v, 0) in cTb
        ]
        if not both:
            raise CalibrationError(
                f"cameras 0 and {camera} never see the board at the same time; are the images "
                "paired rightly?"
            )
        apart = [[np.linalg.norm(a - b) for b in both] for a in both]
        return both[int(np.argmin(np.sum(apart, axis=1)))]

    def _in_first(
        self, cTb: dict[tuple[int, int], FloatArray], turns: Sequence[FloatArray], view: int
    ) -> FloatArray:
        if (view, 0) in cTb:
            return turn_of_matrix(cTb[view, 0])
        camera = next(c for c in range(1, self.cameras) if (view, c) in cTb)
        return turn_of_matrix(inverse(turns[camera - 1]) @ cTb[view, camera])

    def _intrinsics(self, x: FloatArray, camera: int) -> FloatArray:
        return x[camera * self._own : (camera + 1) * self._own]

    def _turn(self, x: FloatArray, camera: int) -> FloatArray:
        at = self._turns_at + TURN * (camera - 1)
        return x[at : at + TURN] if camera else np.zeros(TURN)

    def _board(self, x: FloatArray, view: int) -> FloatArray:
        at = self._boards_at + TURN * self._row_of[view]
        return x[at : at + TURN]

    def _looked_at(self, x: FloatArray, view: int, camera: int, corners: Corners) -> Any:
        """Residuals (2n,), derivatives by intrinsics, turn and board of one image."""
        board, turn = self._board(x, view), self._turn(x, camera)
        composed = cv2.composeRT(board[:3], board[3:], turn[:3], turn[3:])
        whole = np.concatenate([composed[0].ravel(), composed[1].ravel()])
        points = self._points[corners.ids]
        pixels, by = projected(self.model, points, whole, self._intrinsics(x, camera))
        d = [np.asarray(part) for part in composed[2:]]  # dr3 by r1, t1, r2, t2; dt3 by the same
        by_board = np.block([[d[0], d[1]], [d[4], d[5]]])
        by_turn = np.block([[d[2], d[3]], [d[6], d[7]]])
        of_pose = by[:, :TURN]
        off = (pixels - corners.pixels).ravel()
        return off, by[:, TURN:], of_pose @ by_turn, of_pose @ by_board

    def residuals(self, x: FloatArray) -> FloatArray:
        """(r,) pixels, predicted minus found."""
        return np.concatenate([self._looked_at(x, *seen)[0] for seen in self.seen])

    def jacobian(self, x: FloatArray) -> FloatArray:
        """(r, p) of the residuals."""
        out = np.zeros((2 * sum(len(corners) for _, _, corners in self.seen), len(x)))
        row = 0
        for view, camera, corners in self.seen:
            _, by_lens, by_turn, by_board = self._looked_at(x, view, camera, corners)
            rows = slice(row, row + len(by_lens))
            row = rows.stop
            out[rows, camera * self._own : (camera + 1) * self._own] = by_lens
            if camera:
                at = self._turns_at + TURN * (camera - 1)
                out[rows, at : at + TURN] = by_turn
            at = self._boards_at + TURN * self._row_of[view]
            out[rows, at : at + TURN] = by_board
        return out

    def jacobian_without_lens(self, x: FloatArray) -> FloatArray:
        """(r, p), by which the lenses' distortion stays as it is."""
        out = self.jacobian(x)
        kept = len(INTRINSICS) + (1 if self.model == "omni" else 0)
        for camera in range(self.cameras):
            out[:, camera * self._own + kept : (camera + 1) * self._own] = 0.0
        return out

    def require_determined(
        self, size: tuple[int, int], x: FloatArray, covariance: FloatArray
    ) -> None:
        """Raises CalibrationError for impossible intrinsics, or an uncertain focal length.

        The unified model's is ``f / (1 + xi)``, that around the axis: the two are nearly one.
        """
        for camera in range(self.cameras):
            own = slice(camera * self._own, (camera + 1) * self._own)
            by = np.zeros(self._own)
            by[0] = 1.0 / x[own][0]
            if self.model == "omni":
                by[len(INTRINSICS)] = -1.0 / (1.0 + x[own][len(INTRINSICS)])
            known = bool(by @ covariance[own, own] @ by <= _UNCERTAIN**2)
            try:
                checked_camera(camera_of(self.model, size, x[own]))
            except CalibrationError:
                known = False
            if not known:
                raise CalibrationError(_UNDETERMINED)

    def result(self, size: tuple[int, int], x: FloatArray, sigmas: FloatArray) -> BoardCalibration:
        """The solution in words of cameras."""
        boards = np.full((len(self.views), TURN), np.nan)
        for view in self._row_of:
            boards[view] = self._board(x, view)
        own, turns = self._turns_at, slice(self._turns_at, self._boards_at)
        cameras = tuple(
            replace(
                camera_of(self.model, size, self._intrinsics(x, c), f"cam{c}"),
                bTc=inverse(_matrix_of_turn(self._turn(x, c))),
            )
            for c in range(self.cameras)
        )
        return BoardCalibration(
            cameras=cameras,
            sigmas=sigmas[:own].reshape(self.cameras, -1),
            turn_sigmas=np.vstack([np.zeros((1, TURN)), sigmas[turns].reshape(-1, TURN)]),
            boards=boards,
            off=(),
            kept=self.views,
            left_out=0,
        )
