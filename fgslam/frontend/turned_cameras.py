"""A camera that is knocked during a drive: which one, about when and by how much.

In a rectified rig a point lies in one line of both images. How far it does not (for left and right
camera the vertical disparity) is linear in the turn of the camera and known from the point's place
(:mod:`fgslam.core.rig_correction`). Windows of frames tell that turn, whatever is matched or
tracked; two in a row that contradict all those before tell a knock.
docs/derivations/camera_faults.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray, StateArrays
from fgslam.core.quantiles import chi_square_quantile, middle
from fgslam.core.rig_correction import TERMS, camera_displacements
from fgslam.core.sensors import CAMERA_NAMES, CameraRig

WINDOW = 6
"""Frames that are judged together."""

_AXES = ("pitch", "yaw", "roll")  # about a camera's x, y and z axis
_COLUMNS = [TERMS.index(name) for name in _AXES]
_FEWEST = 20  # points of a frame
_ROUNDS = 5  # of robust least squares
_KERNEL = 2.0  # spreads of the residuals at which Cauchy's kernel bends
_CHANCE = 1e-7
_SETTLED = 2  # windows before which none can contradict them
_PRIOR_WINDOWS = 4.0  # of the noise that is stated
_STATED_NOISE = float(WINDOW)
"""Of the points' own: a window's frames show the same points, with the same errors."""
_LEAST_DEG = 0.1  # turns below are followed by the self-calibration
_UNKNOWN_RAD = 0.05  # deviation of a turn's prior: none to speak of
_TOLD_SIGMAS = 3.0
_TOLD_DEG = 0.05  # about an axis beside the largest


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


def turns_of(
    rig: CameraRig, offsets: Sequence[FloatArray], places: Sequence[FloatArray], spread_px: float
) -> Turns:
    """What one frame shows, by Cauchy's M-estimator.

    Args:
        rig: as calibrated.
        offsets: for each camera beside the reference (n,), how far points are off their lines.
        places: (n, 2) of each, where that camera shows them, pixels.
        spread_px: least deviation of an offset.
    """
    shown = [
        _turn_of(rig, camera, offset, place, spread_px)
        for camera, (offset, place) in enumerate(zip(offsets, places, strict=True), 1)
    ]
    return Turns(np.array([a for a, _ in shown]), np.array([b for _, b in shown]))


def _turn_of(
    rig: CameraRig, camera: int, offset: FloatArray, place: FloatArray, spread_px: float
) -> tuple[FloatArray, FloatArray]:
    across = 1 if camera == 1 else 0
    first = len(TERMS) * (camera - 1)
    unit = camera_displacements(rig, camera, place)[:, across, first : first + len(TERMS)]
    design = unit[:, _COLUMNS]
    found: FloatArray = np.zeros(3)
    for _ in range(_ROUNDS):
        residual = offset - design @ found
        spread = max(spread_px, 1.4826 * middle(np.abs(residual)))
        weighted = design.T / (spread**2 * (1.0 + (residual / (_KERNEL * spread)) ** 2))
        information = weighted @ design
        known = information + np.eye(3) / _UNKNOWN_RAD**2
        found = np.asarray(np.linalg.solve(known, weighted @ offset), np.float64)
    return information, weighted @ offset


@dataclass(frozen=True, slots=True)
class Knock:
    """The frame from which on all windows ``before`` it are contradicted."""

    frame: int
    before: Turns


class TurnWatch:
    """Finds knocks from the offsets of points across their lines, window by window."""

    def __init__(self, rig: CameraRig, spread_px: float) -> None:
        """``spread_px``: least deviation of an offset, pixels."""
        self._rig, self._spread = rig, spread_px
        others = rig.cameras - 1
        self._window, self._shown, self._begins = Turns.none(others), 0, 0
        self._known, self._windows = Turns.none(others), 0
        self._suspected, self._since = Turns.none(others), -1
        self._noise = np.array([_PRIOR_WINDOWS * _STATED_NOISE, _PRIOR_WINDOWS])
        self.knocks: list[Knock] = []

    def take(self, frame: int, offsets: Sequence[FloatArray], places: Sequence[FloatArray]) -> None:
        """Takes in a frame by its number; as :func:`turns_of`."""
        if min(map(len, offsets)) < _FEWEST:
            return
        if not self._shown:
            self._begins = frame
        self._window = self._window.plus(turns_of(self._rig, offsets, places, self._spread))
        self._shown += 1
        if self._shown == WINDOW:
            self._judge(self._window)
            self._window, self._shown = Turns.none(len(offsets)), 0

    def _judge(self, window: Turns) -> None:
        """Adds a window to those before, or suspects a knock, or finds one at the second."""
        if self._windows < _SETTLED or not self._contradicts(window):
            self._known = self._known.plus(window)  # what was suspected once has passed
            self._windows, self._since = self._windows + 1, -1
        elif self._since < 0:
            self._suspected, self._since = window, self._begins
        else:
            self.knocks.append(Knock(self._since, self._known))
            self._known, self._windows, self._since = window, 1, -1

    def _contradicts(self, window: Turns) -> bool:
        change, covariance = _change(self._known, window)
        squared = _squared(change, covariance)
        noise = max(self._noise[0] / self._noise[1], 1.0)
        least = np.rad2deg(np.linalg.norm(change, axis=1).max()) > _LEAST_DEG
        if least and squared > noise * float(chi_square_quantile(1.0 - _CHANCE, change.size)):
            return True
        self._noise = self._noise + np.array([squared / change.size, 1.0])
        return False

    def remarks(self) -> tuple[str, ...]:
        """A line for each knock: which camera, by how much about which axis, since when."""
        noise = max(self._noise[0] / self._noise[1], 1.0)
        after = [*(knock.before for knock in self.knocks), self._known][1:]
        return tuple(
            self._told(knock, *_change(knock.before, then), noise)
            for knock, then in zip(self.knocks, after, strict=True)
        )

    def _told(self, knock: Knock, change: FloatArray, covariance: FloatArray, noise: float) -> str:
        camera, turn, spread = _who(change, noise * covariance)
        sigma = np.sqrt(np.diag(spread))
        order = np.argsort(-np.abs(turn)).tolist()
        least = np.maximum(_TOLD_SIGMAS * sigma, np.deg2rad(_TOLD_DEG))
        sure = [k for k in order if abs(turn[k]) > least[k]] or order[:1]
        parts = ", ".join(
            f"{np.rad2deg(turn[k]):.2f} degrees in {_AXES[k]} ({abs(turn[k]) / sigma[k]:.0f} sigma)"
            for k in sure
        )
        against = " against the right one (or that one by the opposite)" * (len(change) == 1)
        return (
            f"the {CAMERA_NAMES[camera]} camera was turned by {parts}{against} at about frame "
            f"{knock.frame} of the run, as points off their lines show: fasten it and calibrate "
            "the rig again; what is measured from there on may be wrong"
        )

    # ----------------------------------------------------------------------------------------

    def state(self) -> StateArrays:
        """All that is needed to continue to the bit."""
        sums = (self._window, self._known, self._suspected, *(k.before for k in self.knocks))
        return {
            "information": np.array([one.information for one in sums]),
            "score": np.array([one.score for one in sums]),
            "counts": np.array([self._shown, self._begins, self._windows, self._since]),
            "noise": self._noise,
            "knocks": np.array([knock.frame for knock in self.knocks], np.int64),
        }

    def restore(self, state: StateArrays) -> None:
        """Continues from :meth:`state`."""
        pairs = zip(state["information"], state["score"], strict=True)
        self._window, self._known, self._suspected, *before = (Turns(a, b) for a, b in pairs)
        self._shown, self._begins, self._windows, self._since = state["counts"].tolist()
        self._noise = state["noise"]
        frames = state["knocks"].tolist()
        self.knocks = [Knock(*one) for one in zip(frames, before, strict=True)]


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
