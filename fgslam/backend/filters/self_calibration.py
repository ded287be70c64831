"""A rig that calibrates itself from the drive: an information filter over its correction.

Windows of frames that share no image say what they show (:mod:`.rig_alignment`); their evidence is
added up, with the noise that the windows themselves show by how far they disagree. Nothing is
known of the truth. Derived in docs/derivations/self_calibration.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from fgslam.backend.filters.rig_alignment import RigAlignment, RigEvidence
from fgslam.backend.filters.rig_models import WeighedCorrection, weighed
from fgslam.core.arrays import FloatArray, StateArrays
from fgslam.core.measurements import Increment, Observations
from fgslam.core.quantiles import chi_square_quantile
from fgslam.core.rig_correction import RigCorrection, prior_information
from fgslam.core.sensors import CameraRig

WINDOW = 6
"""Frames of one window: motion enough to see depth change, few enough to cost little."""

_DRIFT_S = 3600.0  # seconds after which as much is unknown as the calibration itself leaves
_KERNEL_FACTOR = {2: 0.61, 3: 0.49}
"""By cameras: variance under Gaussian noise as multiple of what the kernel's weights alone claim.

Sandwich of an M-estimator (Huber 1981, ch. 6): E[w] E[w^2 s / d] / E[w - 2 w^2 s / (c^2 d)]^2 with
Cauchy's weights w = 1 / (1 + s / c^2), s the squared residual of d = 2 * cameras coordinates.
"""
_TRUSTED_WINDOWS = 4.0  # how many windows the stated noise is worth, beside the observed one
SETTLING = WINDOW * (int(_TRUSTED_WINDOWS) + 1)
"""Frames before which no change of the correction can be a rig that was found to have moved."""
_KNOCK_PROBABILITY = 1e-6  # of a window so far off, by chance; two in a row are a knock
_DOUBTFUL = 1e-3  # of the prior's information: less in a direction is no evidence of the noise


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class CalibrationStep:
    """What was known after one window.

    Attributes:
        timestamp: of its last frame, seconds.
        values: (p,) of the correction, all terms free.
        covariance: (p, p) of those.
        applied: (p,) what is taken off the frames after it.
        knocks: how often the rig was found to have moved, so far.
    """

    timestamp: float
    values: FloatArray
    covariance: FloatArray
    applied: FloatArray
    knocks: int

    @staticmethod
    def of(timestamp: float, found: WeighedCorrection, knocks: int) -> CalibrationStep:
        """The step after a window that ended at ``timestamp``."""
        known, applied = found.estimated, found.applied.values
        return CalibrationStep(timestamp, known.values, known.covariance, applied, knocks)


def _step_arrays(steps: Sequence[CalibrationStep], terms: int) -> StateArrays:
    return {
        "step_time": np.array([step.timestamp for step in steps], np.float64),
        "step_values": np.array([step.values for step in steps]).reshape(-1, terms),
        "step_covariance": np.array([step.covariance for step in steps]).reshape(-1, terms, terms),
        "step_applied": np.array([step.applied for step in steps]).reshape(-1, terms),
        "step_knocks": np.array([step.knocks for step in steps], np.int64),
    }


def _steps_of(state: StateArrays) -> list[CalibrationStep]:
    names = ("step_time", "step_values", "step_covariance", "step_applied", "step_knocks")
    rows = zip(*(state[name] for name in names), strict=True)
    return [CalibrationStep(float(t), v, c, a, int(k)) for t, v, c, a, k in rows]


def _accepted(increment: Increment) -> Observations:
    """What the ego-motion accepted."""
    return increment.observations.select(~increment.rejected)


class SelfCalibration:
    """Estimates the correction of a rig while it is driven."""

    def __init__(self, rig: CameraRig, pixel_sigma: float) -> None:
        """Begins with the calibration as stated; ``pixel_sigma`` of one coordinate, pixels."""
        self._known = RigCorrection.none(rig)
        self._prior = prior_information(rig)
        self.found = weighed(self._known, self._prior)
        """As known now, and what of it is worth applying."""
        self.steps: list[CalibrationStep] = []
        """How it became known, window by window."""
        self.windows = 0
        """How many gave evidence."""
        self.knocks = 0
        """How often the rig was found to have moved."""
        self._suspected = False
        self._sigma = pixel_sigma
        self._frames: list[tuple[FloatArray, Observations]] = []
        self._last_time: float | None = None
        self._misfit, self._freedom = 0.0, 0.0

    @property
    def noise_factor(self) -> float:
        """Variance of what windows say, as multiple of what their pixels alone would give."""
        stated = _TRUSTED_WINDOWS * len(self._prior)
        usual = _KERNEL_FACTOR[self._known.rig.cameras]
        return max((usual * stated + self._misfit) / (stated + self._freedom), 1e-3)

    def observe(self, increment: Increment, wTc: FloatArray) -> WeighedCorrection:
        """Takes in a frame as measured and its pose; returns the correction as known now."""
        if increment.relocalised:
            self._frames.clear()
        self._frames.append((wTc, _accepted(increment)))
        if len(self._frames) >= WINDOW:
            alignment = RigAlignment(self._known.rig, self._frames, self._sigma)
            self._frames = []
            self._take(alignment, increment.timestamp)
        return self.found

    def _take(self, alignment: RigAlignment, timestamp: float) -> None:
        known, covariance = self._known.values, self._drifted(timestamp)
        evidence = alignment.evidence(known, np.asarray(np.linalg.inv(covariance), np.float64))
        if evidence is None:
            return
        self.windows += 1
        if self._contradicts(evidence, known, covariance):
            if not self._suspected:  # once is something that passed through the view
                self._suspected = True
                return
            self.knocks += 1
            covariance = covariance + np.linalg.inv(self._prior)
        self._suspected = False
        factor = self.noise_factor
        information = evidence.information / factor
        pull = (evidence.score + evidence.information @ (evidence.at - known)) / factor
        covariance = np.asarray(np.linalg.inv(np.linalg.inv(covariance) + information), np.float64)
        covariance = (covariance + covariance.T) / 2.0
        self._known = dataclasses.replace(
            self._known, values=known + covariance @ pull, covariance=covariance
        )
        self.found = self._held(weighed(self._known, self._prior))
        self.steps.append(CalibrationStep.of(timestamp, self.found, self.knocks))

    # ----------------------------------------------------------------------------------------

    def state(self) -> StateArrays:
        """All that changes but the frames of the window in work, which the log and poses hold."""
        return {
            "values": self._known.values,
            "applied": self.found.applied.values,
            "covariance": self._known.covariance,
            "time": np.array(np.nan if self._last_time is None else self._last_time),
            "evidence": np.array([self._misfit, self._freedom]),
            "counts": np.array([self.windows, self.knocks, self._suspected, len(self._frames)]),
        } | _step_arrays(self.steps, len(self._prior))

    def restore(
        self, state: StateArrays, log: Sequence[Increment], poses: Sequence[FloatArray]
    ) -> None:
        """Continues from :meth:`state`, the log so far and the poses as first estimated."""
        self._known = dataclasses.replace(
            self._known, values=state["values"], covariance=state["covariance"]
        )
        self._last_time = None if np.isnan(state["time"]) else float(state["time"])
        self._misfit, self._freedom = map(float, state["evidence"])
        self.windows, self.knocks, suspected, waiting = map(int, state["counts"])
        self._suspected = bool(suspected)
        self.steps = _steps_of(state)
        found = weighed(self._known, self._prior)
        applied = dataclasses.replace(found.applied, values=state["applied"])
        self.found = dataclasses.replace(found, applied=applied)
        begin = len(log) - waiting
        self._frames = [
            (wTc, _accepted(increment))
            for wTc, increment in zip(poses[begin:], log[begin:], strict=True)
        ]

    # ----------------------------------------------------------------------------------------

    def _held(self, found: WeighedCorrection) -> WeighedCorrection:
        """With the old correction where the new one is no farther from it than noise goes.

        The map was measured with the old one, and contradicts the new one.
        """
        old = self.found.applied.values
        change = found.applied.values - old
        if change @ np.linalg.solve(found.estimated.covariance, change) > len(change):
            return found
        return dataclasses.replace(found, applied=dataclasses.replace(found.applied, values=old))

    def _drifted(self, timestamp: float) -> FloatArray:
        """The covariance, grown by the rig's drift since the last window."""
        since = 0.0 if self._last_time is None else timestamp - self._last_time
        self._last_time = timestamp
        drift = since / _DRIFT_S * np.linalg.inv(self._prior)
        return np.asarray(self._known.covariance + drift)

    def _contradicts(
        self, evidence: RigEvidence, known: FloatArray, covariance: FloatArray
    ) -> bool:
        """True if a window cannot be explained by what is known; else it is booked.

        Judged in the window's own principal directions, those in which it says anything: how far
        it lies from what is known, in units of its own noise and of what is known.
        """
        size, axes = np.linalg.eigh(evidence.information)
        telling = size > _DOUBTFUL * np.diagonal(axes.T @ self._prior @ axes)
        score = evidence.score + evidence.information @ (evidence.at - known)
        score = (axes.T @ score)[telling] / np.sqrt(size[telling])
        root = axes[:, telling] * np.sqrt(size[telling])
        known_share, turn = np.linalg.eigh(root.T @ covariance @ root / self.noise_factor)
        squared = (turn.T @ score) ** 2 / (1.0 + known_share)
        likely = chi_square_quantile(1.0 - _KNOCK_PROBABILITY, len(score))
        if self.windows > _TRUSTED_WINDOWS and squared.sum() / self.noise_factor > likely:
            return True
        noisy = known_share < 1.0  # elsewhere it is the prior that is judged
        self._misfit += float(squared[noisy].sum())
        self._freedom += float(np.count_nonzero(noisy))
        return False
