"""Watches the cameras of a rig: one that delivers old images, swapped, darker or knocked ones.

Each frame's images are compared with each other and with those of the frame before, whatever the
front-end makes of them. docs/derivations/cameras.md.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from typing import TypeAlias

import cv2
import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, Image, Rows, chi_square_quantile, middle
from fgslam.core.correction import (
    IMAGE_TERMS,
    IMPLAUSIBLE_PX,
    TERMS,
    camera_displacements,
    prior_information,
)
from fgslam.core.geometry import KERNEL, cauchy_fit
from fgslam.core.sensors import CAMERA_NAMES, CameraRig
from fgslam.core.store import Kept
from fgslam.core.types import Remark

# ------------------------------------------------------------------------------------------
# By how many frames one camera's image is older than another's, from the two images alone

_POINTS = 80
_CORNER_QUALITY = 0.01  # of the best corner's
_DISTANCE_PX = 8
_WINDOW_PX = 15
_LEVELS = 4
_SEARCH = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02)
_MIN_EIGENVALUE = 1e-3
_MAX_BACK_PX = 0.5  # from where a point began, followed there and back
_FEWEST = 12  # points: more than the unknowns
_LEAST_SPREAD_PX = 0.1  # of points followed on sharp images
_SIGNAL = 3.0
"""Spreads that the shift must amount to. Both sides err alike by the noise of the present image's
patch, which at a standstill seems half a frame; at three spreads it is 0.06 of one."""
_ALIKE = 0.25  # frames of lag: nearer to none than this
_KNOWN = 0.1  # and known so well, images are of one moment
_UNKNOWN_LAG = 10.0  # frames, standard deviation of its prior: none to speak of


@dataclass(frozen=True, slots=True, eq=False)
class LineRows(Rows):
    """Points of one frame: offset (n,) across the lines, shift (n,) since, place (n, 2) in pixels.

    The place is where the camera next to the reference shows the point, in the rig's own pixels.
    """

    offset: FloatArray
    shift: FloatArray
    place: FloatArray

    @staticmethod
    def none() -> LineRows:
        """No point."""
        return LineRows(np.empty(0), np.empty(0), np.empty((0, 2)))


@dataclass(frozen=True, slots=True)
class Lag:
    """Frames by which an image is old, and the standard deviation of that; NaN where unknown."""

    frames: float
    sigma: float

    @property
    def late(self) -> float:
        """Deviations by which it is nearer to one frame than to none; NaN where unknown."""
        return (self.frames - 0.5) / self.sigma

    @property
    def together(self) -> bool:
        """Whether the images are of one moment for sure.

        What is late by one camera's motion is as early by the other's: where that shows no
        difference, something else than time displaces the points.
        """
        return self.sigma < _KNOWN and abs(self.frames) < _ALIKE


class LagModel:
    """What the calibration of a rig may explain of the offsets in one of its other cameras."""

    def __init__(self, rig: CameraRig, camera: int) -> None:
        """``camera``: 1 left, 2 top."""
        self._rig, self._camera = rig, camera
        first = len(TERMS) * (camera - 1)
        self._own = slice(first, first + len(IMAGE_TERMS))
        self._prior = prior_information(rig)[self._own, self._own]

    @property
    def across(self) -> int:
        """The coordinate in which a point agrees between the images: 1 row, 0 column."""
        return 1 if self._camera == 1 else 0

    def lag(self, rows: LineRows, spread_px: float) -> Lag:
        """Robust least squares with a sandwich covariance (Huber 1981, ch. 6).

        Args:
            rows: points of one or several frames.
            spread_px: least spread of the residuals, pixels: that of exact images.
        """
        if len(rows) < _FEWEST:
            return Lag(np.nan, np.nan)
        of_place = camera_displacements(self._rig, self._camera, rows.place)
        design = np.column_stack([rows.shift, of_place[:, self.across, self._own]])
        prior = np.zeros((design.shape[1],) * 2)
        prior[0, 0], prior[1:, 1:] = _UNKNOWN_LAG**-2, self._prior
        fit = cauchy_fit(design, rows.offset, prior, spread_px)
        # Of most points: a few that slip along an edge do so alike in all images.
        if 1.4826 * middle(np.abs(rows.shift)) < _SIGNAL * fit.spread:
            return Lag(np.nan, np.nan)
        residual = rows.offset - design @ fit.found
        return Lag(float(fit.found[0]), _sigma(design, residual, fit.spread, prior))


def _sigma(design: FloatArray, residual: FloatArray, spread: float, prior: FloatArray) -> float:
    """Standard deviation of the first unknown: the sandwich of Cauchy's M-estimator."""
    squared = (residual / (KERNEL * spread)) ** 2
    weight = 1.0 / (1.0 + squared)
    slope = (1.0 - squared) * weight**2  # derivative of the influence weight * residual
    freedom = len(design) / max(len(design) - design.shape[1], 1)
    noise = freedom * np.maximum((weight * residual) ** 2, (weight * spread) ** 2 / KERNEL**2)
    bread = np.linalg.inv((design.T * slope) @ design + spread**2 * prior)
    meat = (design.T * noise) @ design + spread**4 * prior
    return float(np.sqrt((bread @ meat @ bread)[0, 0]))


class Shrunk:
    """The images of one frame, made small, of equal contrast, and their corners."""

    def __init__(self, images: tuple[Image, ...], factor: int) -> None:
        """Shrinks by a whole ``factor``."""
        self.factor = factor
        self.grey = [_shrunk(image, factor) for image in images]
        spread = [max(float(cv2.meanStdDev(image)[1][0, 0]), 1.0) for image in self.grey]
        self.images: list[Image] = [
            np.asarray(cv2.convertScaleAbs(image, alpha=min(spread[0] / own, 4.0)), np.uint8)
            for image, own in zip(self.grey, spread, strict=True)
        ]

    def corners(self) -> FloatArray:
        """Points (n, 2) of the reference image that can be followed."""
        found = cv2.goodFeaturesToTrack(self.images[0], _POINTS, _CORNER_QUALITY, _DISTANCE_PX)
        return np.empty((0, 2)) if found is None else np.asarray(found, np.float64).reshape(-1, 2)


def _shrunk(image: Image, factor: int) -> Image:
    if factor == 1:
        return image
    size = (image.shape[1] // factor, image.shape[0] // factor)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


Followed: TypeAlias = tuple[FloatArray, BoolArray]
"""Where points (n, 2) are in another image, and which (n,) of them are there."""


def followed(a: Image, b: Image, points: FloatArray) -> Followed:
    """Where points (n, 2) of image ``a`` are in ``b``, and which (n,) come back when followed back.

    Pyramidal Lucas-Kanade (Bouguet 2000).
    """
    if not len(points):
        return points, np.zeros(0, np.bool_)
    start, window = points.astype(np.float32), (_WINDOW_PX, _WINDOW_PX)
    found, good, _ = cv2.calcOpticalFlowPyrLK(
        a, b, start, start.copy(), None, None, window, _LEVELS, _SEARCH, 0, _MIN_EIGENVALUE
    )
    # The way back starts at its end, so that the finest level alone does.
    back, good_back, _ = cv2.calcOpticalFlowPyrLK(
        b, a, found, start.copy(), None, None, window, 0, _SEARCH,
        cv2.OPTFLOW_USE_INITIAL_FLOW, _MIN_EIGENVALUE,
    )  # fmt: skip
    missed = np.abs(back - start).max(axis=1)
    kept = (good.ravel() == 1) & (good_back.ravel() == 1) & (missed <= _MAX_BACK_PX)
    return np.asarray(found, np.float64), np.asarray(kept)


def spread_of(factor: int) -> float:
    """Least spread of points followed on images made small, in the rig's own pixels."""
    return factor * _LEAST_SPREAD_PX


# ------------------------------------------------------------------------------------------
# A camera that is knocked during a drive: which one, about when and by how much

WINDOW = 6
"""Frames that are judged together."""

_AGREEING = 3
"""Windows in a row that agree on a new state: what lasts no longer than two windows fills one of
three at most, and gives another turn in each of the others."""

_AXES = ("pitch", "yaw", "roll")  # about a camera's x, y and z axis
_COLUMNS = [TERMS.index(name) for name in _AXES]
_FEWEST_OF_TURN = 20  # points of a frame
_CHANCE = 1e-7  # of a window that contradicts those before
_CHANCE_APART = 1e-3  # of one that disagrees with others of the same state
_SETTLED = 2  # windows before which none can contradict them
_PRIOR_WINDOWS = 4.0  # of the noise that is stated
_STATED_NOISE = float(WINDOW)
"""Of the points' own: a window's frames show the same points, with the same errors."""
_LEAST_DEG = 0.1  # turns below are followed by the self-calibration
_UNKNOWN_RAD = 0.05  # deviation of a turn's prior: none to speak of
_LAG_OF_TURN = 0.5
"""Frames, deviation of the prior of the time between the cameras' images: at more than half a frame
a camera is nearer to one frame late than to none, and its images are refused."""
_REPORTED_SIGMAS = 3.0
_REPORTED_DEG = 0.05  # about an axis next to the largest
_FEW = 2  # knocks that are reported one by one


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """Evidence of how far each camera next to the reference is turned.

    ``information`` (c, 3, 3) and ``score`` (c, 3), about the axes x, y and z, radians.
    """

    information: FloatArray
    score: FloatArray

    @staticmethod
    def none(cameras: int) -> Turns:
        """No evidence."""
        return Turns(np.zeros((cameras, 3, 3)), np.zeros((cameras, 3)))

    def plus(self, other: Turns) -> Turns:
        """Both."""
        return Turns(self.information + other.information, self.score + other.score)

    def known(self) -> tuple[FloatArray, FloatArray]:
        """The turns (c, 3), and their covariance (c, 3, 3) by the points' own noise."""
        covariance = np.linalg.inv(self.information + np.eye(3) / _UNKNOWN_RAD**2)
        turns = np.einsum("cij,cj->ci", covariance, self.score)
        return np.asarray(turns, np.float64), np.asarray(covariance, np.float64)


def turns_of(rig: CameraRig, seen: Sequence[LineRows], spread_px: float) -> Turns:
    """What one frame shows, by Cauchy's M-estimator, whatever the time between the images is.

    Args:
        rig: as calibrated.
        seen: for each camera next to the reference, the points of the frame.
        spread_px: least deviation of an offset.
    """
    shown = [_turn_of(rig, camera, rows, spread_px) for camera, rows in enumerate(seen, 1)]
    return Turns(np.array([a for a, _ in shown]), np.array([b for _, b in shown]))


def _turn_of(
    rig: CameraRig, camera: int, rows: LineRows, spread_px: float
) -> tuple[FloatArray, FloatArray]:
    """Information (3, 3) and score (3,) of the turn; the lag of the frame is marginalised."""
    across = 1 if camera == 1 else 0
    columns = [len(TERMS) * (camera - 1) + column for column in _COLUMNS]
    unit = camera_displacements(rig, camera, rows.place)[:, across, columns]
    design = np.column_stack([unit, rows.shift])
    prior = np.diag([_UNKNOWN_RAD**-2] * 3 + [_LAG_OF_TURN**-2])
    fit = cauchy_fit(design, rows.offset, prior, spread_px)
    information, score = fit.normal / fit.spread**2, fit.moment / fit.spread**2
    gain = information[:3, 3] / (information[3, 3] + prior[3, 3])
    return information[:3, :3] - np.outer(gain, information[3, :3]), score[:3] - gain * score[3]


@dataclass(frozen=True, slots=True)
class Knock:
    """The frame from which on all windows ``before`` it are contradicted."""

    frame: int
    before: Turns


@dataclass(frozen=True, slots=True)
class _Change:
    """A knock as it is reported: of which camera (0: right), by how much, radians.

    ``turn`` and ``sigma`` (3,); ``axes`` are those that are sure, the largest first.
    """

    frame: int
    camera: int
    turn: FloatArray
    sigma: FloatArray
    axes: list[int]

    @property
    def degrees(self) -> float:
        """About the axis of the largest turn."""
        return float(np.rad2deg(abs(self.turn[self.axes[0]])))


class TurnWatch:
    """Finds knocks from the offsets of points across their lines, window by window."""

    _window: Kept[Turns]
    _shown: Kept[int]
    _begins: Kept[int]
    _known: Kept[Turns]
    _windows: Kept[int]
    _suspected: Kept[Turns]
    _agreed: Kept[int]
    _since: Kept[int]
    _noise: Kept[FloatArray]
    knocks: Kept[list[Knock]]

    def __init__(self, rig: CameraRig, spread_px: float) -> None:
        """``spread_px``: least deviation of an offset, pixels."""
        self._rig, self._spread = rig, spread_px
        others = rig.cameras - 1
        self._window, self._shown, self._begins = Turns.none(others), 0, 0
        self._known, self._windows = Turns.none(others), 0
        self._suspected, self._agreed, self._since = Turns.none(others), 0, -1
        self._noise = np.array([_PRIOR_WINDOWS * _STATED_NOISE, _PRIOR_WINDOWS])
        self.knocks = []

    def take(self, frame: int, seen: Sequence[LineRows]) -> None:
        """Takes in a frame by its number; as :func:`turns_of`."""
        if min(map(len, seen)) < _FEWEST_OF_TURN:
            return
        if not self._shown:
            self._begins = frame
        self._window = self._window.plus(turns_of(self._rig, seen, self._spread))
        self._shown += 1
        if self._shown == WINDOW:
            self._judge(self._window)
            self._window, self._shown = Turns.none(len(seen)), 0

    def _judge(self, window: Turns) -> None:
        """Adds a window to those before, or to a suspected new state, which the last one proves."""
        if self._windows < _SETTLED or not self._contradicts(window):
            self._known = self._known.plus(window)  # what was suspected has passed
            self._windows, self._agreed = self._windows + 1, 0
            return
        if not (self._agreed and self._agrees(window)):
            self._suspected, self._agreed = Turns.none(len(window.score)), 0
            self._since = self._begins
        self._suspected, self._agreed = self._suspected.plus(window), self._agreed + 1
        if self._agreed == _AGREEING:
            self.knocks.append(Knock(self._since, self._known))
            self._known, self._windows, self._agreed = self._suspected, _AGREEING, 0

    def _contradicts(self, window: Turns) -> bool:
        """Whether a window is apart from the known state; one that is not is learnt from.

        A change that is significant and small enters the noise as the largest that chance gives.
        """
        change, covariance = _change(self._known, window)
        squared = _squared(change, covariance)
        largest = self._factor * float(chi_square_quantile(1.0 - _CHANCE, change.size))
        least = np.rad2deg(np.linalg.norm(change, axis=1).max()) > _LEAST_DEG
        if least and squared > largest:
            return True
        self._noise = self._noise + np.array([min(squared, largest) / change.size, 1.0])
        return False

    def _agrees(self, window: Turns) -> bool:
        """Whether a window shows the suspected state."""
        change, covariance = _change(self._suspected, window)
        largest = self._factor * float(chi_square_quantile(1.0 - _CHANCE_APART, change.size))
        return _squared(change, covariance) <= largest

    @property
    def _factor(self) -> float:
        """Of the noise of windows, over that of their points."""
        return max(float(self._noise[0] / self._noise[1]), 1.0)

    def remarks(self) -> tuple[Remark, ...]:
        """One for each knock: which camera, by how much about which axis, since when.

        Of more than two, one for each camera. Knocks without a sure axis are left out.
        """
        changes = self._changes()
        grouped = [[x for x in changes if x.camera == k] for k in range(self._rig.cameras)]
        if len(changes) <= _FEW:
            grouped = [[x] for x in changes]
        against = " against the right one (or that one by the opposite)"
        out = []
        for own in filter(None, grouped):
            frames = tuple(change.frame for change in own)
            values: dict[str, float | str] = {
                "camera": CAMERA_NAMES[own[0].camera],
                "against": against if self._rig.cameras == 2 else "",
                "degrees": max(change.degrees for change in own),
                "turns": ", ".join(
                    f"{np.rad2deg(own[0].turn[k]):.2f} degrees in {_AXES[k]} "
                    f"({abs(own[0].turn[k]) / own[0].sigma[k]:.0f} sigma)"
                    for k in own[0].axes
                ),
            }
            code = "camera_turned" if len(own) == 1 else "camera_loose"
            out.append(Remark(code, frames, values))
        return tuple(out)

    def _changes(self) -> list[_Change]:
        """The knocks that have a sure axis."""
        after = [*(knock.before for knock in self.knocks), self._known][1:]
        out = []
        for knock, then in zip(self.knocks, after, strict=True):
            change, covariance = _change(knock.before, then)
            camera, turn, spread = _who(change, self._factor * covariance)
            sigma = np.sqrt(np.diag(spread))
            least = np.maximum(_REPORTED_SIGMAS * sigma, np.deg2rad(_REPORTED_DEG))
            axes = [k for k in np.argsort(-np.abs(turn)).tolist() if abs(turn[k]) > least[k]]
            if axes:
                out.append(_Change(knock.frame, camera, turn, sigma, axes))
        return out

    # ----------------------------------------------------------------------------------------


def _change(before: Turns, after: Turns) -> tuple[FloatArray, FloatArray]:
    """By how much the turns (c, 3) differ, and the covariance (c, 3, 3) of that."""
    (old, old_covariance), (new, new_covariance) = before.known(), after.known()
    return new - old, new_covariance + old_covariance


def _squared(change: FloatArray, covariance: FloatArray) -> float:
    """Mahalanobis' distance squared of changes (c, 3) from none."""
    return float(np.sum(change * np.linalg.solve(covariance, change[..., None])[..., 0]))


def _who(change: FloatArray, covariance: FloatArray) -> tuple[int, FloatArray, FloatArray]:
    """The one camera (0: right) whose turn explains all changes best, its turn and covariance.

    A turn of the reference shows in all others as the opposite; of two cameras the left is named.
    """
    information = np.linalg.inv(covariance)
    shared = np.linalg.inv(information.sum(axis=0))
    common = shared @ np.einsum("cij,cj->i", information, change)
    if len(change) == 1:
        return 1, change[0], covariance[0]
    left = [_squared(change - common, covariance)]
    left += [_squared(np.delete(change, k, 0), np.delete(covariance, k, 0)) for k in (0, 1)]
    camera = int(np.argmin(left))
    if camera == 0:
        return 0, -common, shared
    return camera, change[camera - 1], covariance[camera - 1]


_WIDE_PX = 400  # wider images are made smaller
_SURE = 5.0  # deviations: by chance once in three million frames
_WINDOW = 5  # frames that are judged together where one alone does not tell
_STOP = 2.0 ** (1.0 / 3.0)
"""Ratio of grey values: a third of a stop, the step in which exposures are set. Two cameras of one
rig that differ by it do not have the same exposure."""
FEW_DISPLACED = 3
"""Frames whose pair does not show the map, from which on it begins none."""
_DARKEST = 8.0  # grey value below which a ratio is noise
_FEWEST_COMPARED = 20  # points


@dataclass(slots=True)
class _Pair:
    """What is kept of the reference and one other camera.

    ``rows[0]``: the last frames' points by the reference's own motion, which tell a late other
    camera; ``rows[1]``: by the other's, which tell a late reference.
    """

    model: LagModel
    rows: Kept[tuple[list[LineRows], list[LineRows]]]
    ratios: Kept[list[float]]
    unequal: Kept[int] = 0
    swapped: Kept[bool] = False


class CameraWatch:
    """Says of each frame whether its images can be used."""

    _pairs: Kept[list[_Pair]]
    _turns: Kept[TurnWatch]
    _late: Kept[list[bool]]
    _before: Kept[Sequence[Image]]
    _sums: Kept[list[int]]
    _frames: Kept[int]
    _doubled: Kept[int]
    displaced: Kept[int]

    def __init__(self, rig: CameraRig) -> None:
        """Nothing seen yet."""
        self._rig = rig
        self._factor = max(1, math.ceil(rig.width / _WIDE_PX))
        self._spread = spread_of(self._factor)
        self._pairs = [_Pair(LagModel(rig, c), ([], []), []) for c in range(1, rig.cameras)]
        self._turns = TurnWatch(rig, self._spread)
        self._late = [False] * rig.cameras
        self._before = []
        self._sums = [-1] * rig.cameras
        self._frames = self._doubled = 0
        self.displaced = 0  # frames in a row in which one image shows the map and the pair does not
        self._same = np.zeros(rig.cameras, np.bool_)
        self.alone: int | None = None
        """Of the last frame, if it is refused: the first camera whose image is usable."""

    def look(
        self,
        images: tuple[Image, ...],
        number: int | None = None,
        moved: bool = False,
        tracked: tuple[FloatArray, FloatArray] | None = None,
    ) -> str:
        """Takes in a frame; what is wrong with its images, in words; empty where nothing is.

        Args:
            images: right, left[, top].
            number: of the frame, as remarks give it; None counts the frames taken in.
            moved: odometry has measured motion since the last frame.
            tracked: landmarks in the last frame's reference image (n, 2), and in all of this one
                (n, 3, 2), pixels. Where these show all images to be of one moment, no others
                are looked for.
        """
        now, repeated = Shrunk(images, self._factor), self._repeated(images, moved)
        seen = self._by_landmarks(now, *tracked) if tracked and not repeated else []
        fault = ""
        if not seen:
            fault, seen = self._by_corners(now, repeated)
        if not fault:
            self._turns.take(self._frames if number is None else number, seen)
        self._before, self._frames = now.images, self._frames + 1
        return fault

    def _by_landmarks(self, now: Shrunk, before: FloatArray, pixels: FloatArray) -> list[LineRows]:
        """Points of each other camera where they tell that it is of this moment; else none."""
        if any(self._late) or any(pair.swapped for pair in self._pairs):
            return []
        seen, here = [], pixels[:, 0]
        for camera, pair in enumerate(self._pairs, 1):
            along, there = pair.model.across, pixels[:, camera]
            rows = LineRows((there - here)[:, along], (before - here)[:, along], there)
            if not pair.model.lag(rows, self._spread).together:
                return []
            seen.append(rows)
        for camera, (pair, rows) in enumerate(zip(self._pairs, seen, strict=True), 1):
            pair.rows = ([*pair.rows[0], rows][-_WINDOW:], [])
            shown = here / self._factor, rows.place / self._factor
            self._weigh(pair, now.grey[0], now.grey[camera], *shown)
        return seen

    def _by_corners(self, now: Shrunk, repeated: str) -> tuple[str, list[LineRows]]:
        """What is wrong, as :meth:`look`, by corners followed across and in time; and the corners.

        Those of each other camera, where nothing is wrong.
        """
        swapped, seen = "", list[LineRows]()
        points = now.corners()
        across = [followed(now.images[0], other, points) for other in now.images[1:]]
        shown = np.logical_or.reduce([kept for _, kept in across])
        flow: Followed | None = None
        for camera, (pair, (found, kept)) in enumerate(zip(self._pairs, across, strict=True), 1):
            here, there = points[kept], found[kept]
            if not repeated:  # else they are of two moments
                self._order(pair, self._factor * (there - here)[:, camera - 1])
            if pair.swapped and not swapped:
                swapped = (
                    f"the images of the right and the {CAMERA_NAMES[camera]} camera are swapped"
                )
            self._weigh(pair, now.grey[0], now.grey[camera], here, there)
            if repeated or swapped:
                continue
            if self._before:
                if flow is None:  # of points that no other image shows, nowhere
                    flow = points.copy(), np.zeros(len(points), np.bool_)
                    flow[0][shown], flow[1][shown] = followed(
                        now.images[0], self._before[0], points[shown]
                    )
                since = flow[0][kept], flow[1][kept]
                seen.append(self._judge(camera, now, (here, there), since))
            else:  # as if at rest: how far points moved is not known
                since, off = (here, np.ones(len(here), np.bool_)), there - here
                seen.append(self._shifted(since, here, off[:, pair.model.across], there, pair))
        old = f"{_named(self._late)} old images" if any(self._late) else ""
        fault = repeated or swapped or old
        good = np.flatnonzero(~(np.array(self._late) | (self._same & bool(repeated))))
        self.alone = int(good[0]) if fault and not swapped and len(good) else None
        return fault, seen

    def in_place(self, expected: FloatArray, measured: FloatArray) -> bool:
        """Whether a pair's disparities (n,) are those of landmarks that one image locates.

        As nearly as any calibration leaves them; NaN of what has no partner.
        """
        near = np.abs(measured - expected) <= IMPLAUSIBLE_PX
        fits = bool(2 * near.sum() > len(near))
        self.displaced = 0 if fits else self.displaced + 1
        return fits

    @property
    def knocked(self) -> bool:
        """Whether remarks report that a camera was turned during the drive."""
        return bool(self._turns.remarks())

    def remarks(self) -> tuple[Remark, ...]:
        """On images that are used all the same."""
        unequal = [
            Remark(
                "unequal_exposure",
                values={"camera": CAMERA_NAMES[k], "count": pair.unequal, "all": self._frames},
            )
            for k, pair in enumerate(self._pairs, 1)
            if pair.unequal
        ]
        doubled = [Remark("images_doubled", values={"count": self._doubled})]
        return (*self._turns.remarks(), *unequal, *doubled * (self._doubled > _FEW))

    # ----------------------------------------------------------------------------------------

    def _repeated(self, images: tuple[Image, ...], moved: bool) -> str:
        """That an image is the last one's to the bit, while another is not, or the robot moved."""
        before = self._sums
        self._sums = [zlib.crc32(image.tobytes()) for image in images]
        same = [a == b for a, b in zip(before, self._sums, strict=True)]
        self._doubled += all(same) and not self._same.any()  # of a robot that stands all are
        self._same = np.array(same)
        black = np.array([(image[::4, ::4] >= _DARKEST).mean() <= 0.01 for image in images])
        if black.any() and not black.all():
            self._same = black
            return f"the {_names(black.tolist())} camera's image is black"
        if not any(same) or (all(same) and not (moved and images[0].std() > _DARKEST)):
            return ""
        return f"{_named(same)} the image of the frame before once more"

    def _order(self, pair: _Pair, disparity: FloatArray) -> None:
        """Whether disparities (n,) have the wrong sign, beyond what a calibration explains."""
        if len(disparity) < _FEWEST_COMPARED:
            return
        centre = middle(disparity)
        spread = 1.4826 * middle(np.abs(disparity - centre))
        allowed = _SURE * 1.2533 * spread / math.sqrt(len(disparity))  # 1.25: of a median
        if abs(centre) > allowed + IMPLAUSIBLE_PX:
            pair.swapped = centre < 0.0

    def _weigh(
        self, pair: _Pair, right: Image, other: Image, here: FloatArray, there: FloatArray
    ) -> None:
        """Compares the grey values of the same points (n, 2); a few frames tell."""
        a, b = _grey(right, here), _grey(other, there)
        bright = np.minimum(a, b) >= _DARKEST
        if bright.sum() >= _FEWEST_COMPARED:
            ratio = middle(np.log(b[bright] / a[bright]))
            pair.ratios = [*pair.ratios, ratio][-_WINDOW:]
        settled = len(pair.ratios) == _WINDOW
        pair.unequal += settled and abs(middle(np.array(pair.ratios))) > math.log(_STOP)

    def _judge(
        self, camera: int, now: Shrunk, places: tuple[FloatArray, FloatArray], moved: Followed
    ) -> LineRows:
        """Judges whether the other camera, or the reference, shows an earlier moment.

        Of points in the reference and the other image; and where the reference saw them before.
        Gives the points by the reference's motion.
        """
        pair, (here, there) = self._pairs[camera - 1], places
        offset = (there - here)[:, pair.model.across]
        rows = self._shifted(moved, here, offset, there, pair)
        newest, by_reference = self._take(pair, 0, rows)
        if not newest.together or any(self._late):
            moved = followed(now.images[camera], self._before[camera], there)
            of_other = self._shifted(moved, there, -offset, there, pair)
            _, by_other = self._take(pair, 1, of_other)
            for suspect, way, lag, opposite in (
                (camera, 0, by_reference, by_other),
                (0, 1, by_other, by_reference),
            ):
                late = lag.late > 0.0
                if abs(lag.late) > _SURE and self._late[suspect] != late:
                    if late and opposite.together:
                        continue
                    self._late[suspect] = late
                    pair.rows[way].clear()
        else:
            pair.rows[1].clear()
        return rows

    def _shifted(
        self,
        moved: Followed,
        points: FloatArray,
        offset: FloatArray,
        place: FloatArray,
        pair: _Pair,
    ) -> LineRows:
        """Offsets of the points that one camera's last image shows, too, and their shift since."""
        then, kept = moved
        shift = (then - points)[:, pair.model.across]
        size = float(self._factor)
        return LineRows(size * offset[kept], size * shift[kept], size * place[kept])

    def _take(self, pair: _Pair, way: int, rows: LineRows) -> tuple[Lag, Lag]:
        """The lag by a frame's points; and that, or where it does not tell, by the last frames."""
        newest = pair.model.lag(self._signed(rows, way), self._spread)
        window = pair.rows[way]
        if math.isnan(newest.late):
            return newest, newest
        window.append(rows)
        del window[:-_WINDOW]
        if abs(newest.late) > _SURE or len(window) == 1:
            return newest, newest
        together = self._signed(reduce(LineRows.join, window), way)
        return newest, pair.model.lag(together, self._spread)

    def _signed(self, rows: LineRows, way: int) -> LineRows:
        """The calibration displaces the other camera's points, from whichever it is looked at."""
        return LineRows(-rows.offset, -rows.shift, rows.place) if way else rows

    # ----------------------------------------------------------------------------------------


def _named(which: list[bool]) -> str:
    verb = "camera delivers" if sum(which) == 1 else "cameras deliver"
    return f"the {_names(which)} {verb}"


def _names(which: Sequence[bool]) -> str:
    return " and ".join(CAMERA_NAMES[k] for k, one in enumerate(which) if one)


def _grey(image: Image, points: FloatArray) -> FloatArray:
    """Grey values (n,) at the points (n, 2)."""
    at = np.rint(points).astype(np.int64)
    rows = np.clip(at[:, 1], 0, image.shape[0] - 1)
    return image[rows, np.clip(at[:, 0], 0, image.shape[1] - 1)].astype(np.float64)
