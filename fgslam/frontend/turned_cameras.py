"""A camera that is knocked during a drive: which one, about when and by how much.

In a rectified rig a point lies in one line of both images. How far it does not (for left and right
camera the vertical disparity) is linear in the turn of the camera and known from the point's place
(:mod:`fgslam.core.rig_correction`), and in the time by which one camera is late
(:mod:`fgslam.frontend.image_lag`). Windows of frames give that turn, whatever is matched or
tracked; three in a row that contradict all those before, and agree, are a knock.
docs/derivations/camera_faults.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.quantiles import chi_square_quantile
from fgslam.core.rig_correction import TERMS, camera_displacements
from fgslam.core.robust import cauchy_fit
from fgslam.core.sensors import CAMERA_NAMES, CameraRig
from fgslam.core.store import Kept
from fgslam.frontend.image_lag import LineRows

WINDOW = 6
"""Frames that are judged together."""

_AGREEING = 3
"""Windows in a row that agree on a new state: what lasts no longer than two windows fills one of
three at most, and gives another turn in each of the others."""

_AXES = ("pitch", "yaw", "roll")  # about a camera's x, y and z axis
_COLUMNS = [TERMS.index(name) for name in _AXES]
_FEWEST = 20  # points of a frame
_CHANCE = 1e-7  # of a window that contradicts those before
_CHANCE_APART = 1e-3  # of one that disagrees with others of the same state
_SETTLED = 2  # windows before which none can contradict them
_PRIOR_WINDOWS = 4.0  # of the noise that is stated
_STATED_NOISE = float(WINDOW)
"""Of the points' own: a window's frames show the same points, with the same errors."""
_LEAST_DEG = 0.1  # turns below are followed by the self-calibration
_UNKNOWN_RAD = 0.05  # deviation of a turn's prior: none to speak of
_UNKNOWN_LAG = 0.5
"""Frames, deviation of the prior of the time between the cameras' images: at more than half a frame
a camera is nearer to one frame late than to none, and its images are refused."""
_REPORTED_SIGMAS = 3.0
_REPORTED_DEG = 0.05  # about an axis beside the largest
_FEW = 2  # knocks that are reported one by one


@dataclass(frozen=True, slots=True, eq=False)
class Turns:
    """Evidence of how far each camera beside the reference is turned.

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
        seen: for each camera beside the reference, the points of the frame.
        spread_px: least deviation of an offset.
    """
    shown = [_turn_of(rig, camera, rows, spread_px) for camera, rows in enumerate(seen, 1)]
    return Turns(np.array([a for a, _ in shown]), np.array([b for _, b in shown]))


def _turn_of(
    rig: CameraRig, camera: int, rows: LineRows, spread_px: float
) -> tuple[FloatArray, FloatArray]:
    """Information (3, 3) and score (3,) of the turn; the lag of the frame is marginalised."""
    across = 1 if camera == 1 else 0
    first = len(TERMS) * (camera - 1)
    unit = camera_displacements(rig, camera, rows.place)[:, across, first : first + len(TERMS)]
    design = np.column_stack([unit[:, _COLUMNS], rows.shift])
    prior = np.diag([_UNKNOWN_RAD**-2] * 3 + [_UNKNOWN_LAG**-2])
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
        if min(map(len, seen)) < _FEWEST:
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

    def remarks(self) -> tuple[str, ...]:
        """A line for each knock: which camera, by how much about which axis, since when.

        Of more than two, a line for each camera. Knocks without a sure axis are left out.
        """
        changes = self._changes()
        if len(changes) <= _FEW:
            return tuple(map(self._of_one, changes))
        of_camera = [[x for x in changes if x.camera == k] for k in range(self._rig.cameras)]
        return tuple(
            self._of_many(own) if len(own) > 1 else self._of_one(own[0]) for own in of_camera if own
        )

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

    def _of_one(self, change: _Change) -> str:
        parts = ", ".join(
            f"{np.rad2deg(change.turn[k]):.2f} degrees in {_AXES[k]} "
            f"({abs(change.turn[k]) / change.sigma[k]:.0f} sigma)"
            for k in change.axes
        )
        return (
            f"the {CAMERA_NAMES[change.camera]} camera was turned by {parts}{self._against} at "
            f"about frame {change.frame} of the run, as points off their lines show: fasten it and "
            "calibrate the rig again; what is measured from there on may be wrong"
        )

    def _of_many(self, changes: list[_Change]) -> str:
        largest = max(change.degrees for change in changes)
        return (
            f"the {CAMERA_NAMES[changes[0].camera]} camera is loose: it turned {len(changes)} "
            f"times, by up to {largest:.2f} degrees{self._against}, from about frame "
            f"{changes[0].frame} to {changes[-1].frame} of the run, as points off their lines "
            "show: fasten it and calibrate the rig again; what is measured from there on may be "
            "wrong"
        )

    @property
    def _against(self) -> str:
        pair = self._rig.cameras == 2
        return " against the right one (or that one by the opposite)" * pair

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
