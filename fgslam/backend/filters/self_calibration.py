"""A rig that calibrates itself from the drive: an information filter over its correction.

Windows of frames that share no image give evidence (:mod:`.rig_alignment`), which is
added up, with the noise that the windows themselves show by how far they disagree. Nothing is
known of the truth. Derived in docs/derivations/self_calibration.md.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from fgslam.backend.filters.field_size import FieldSize
from fgslam.backend.filters.rig_filter import TRUSTED_WINDOWS, RigFilter
from fgslam.backend.filters.rig_models import WeighedCorrection, weighed
from fgslam.core.arrays import FloatArray
from fgslam.core.measurements import Increment, Observations, SettledRig
from fgslam.core.rig_correction import early_terms
from fgslam.core.sensors import CameraRig
from fgslam.core.store import Kept

WINDOW = 6
"""Frames of one window: motion enough to see depth change, few enough to cost little."""

_DRIFT_S = 3600.0  # seconds after which as much is unknown as the calibration itself leaves
SETTLING = WINDOW * (int(TRUSTED_WINDOWS) + 1)
"""Frames before which no change of the correction can be a rig that was found to have moved."""


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


def _accepted(increment: Increment) -> Observations:
    """What the ego-motion accepted."""
    return increment.observations.select(~increment.rejected)


class SelfCalibration:
    """Estimates the correction of a rig while it is driven."""

    _whole: Kept[RigFilter]
    _early: Kept[RigFilter]
    _field: Kept[FieldSize]
    _applied: Kept[FloatArray]
    steps: Kept[list[CalibrationStep]]
    windows: Kept[int]
    knocks: Kept[int]
    _suspected: Kept[bool]
    _frames: Kept[list[tuple[FloatArray, Observations]]]
    _last_time: Kept[float | None]

    def __init__(self, rig: CameraRig, pixel_sigma: float) -> None:
        """Begins with the calibration as stated; ``pixel_sigma`` of one coordinate, pixels."""
        self._rig, early = rig, early_terms(rig)
        self._whole = RigFilter.of(rig, np.ones_like(early))
        self._early = RigFilter.of(rig, early)
        self._field = FieldSize(rig, pixel_sigma)
        self.found = self._weighed()
        """As known now, and what of it is worth applying."""
        self.steps = []
        """How it became known, window by window."""
        self.windows = 0
        """How many gave evidence."""
        self.knocks = 0
        """How often the rig was found to have moved."""
        self._applied = self.found.applied.values
        self._suspected = False
        self._sigma = pixel_sigma
        self._frames = []
        self._last_time = None

    @property
    def noise_factor(self) -> float:
        """Variance of the windows' evidence, as multiple of what their pixels alone would give."""
        return self._whole.noise_factor

    @property
    def field_px(self) -> float:
        """What no term follows: standard deviation of one coordinate in each image, pixels."""
        return self._field.px

    @property
    def settled(self) -> SettledRig:
        """What all frames since the rig was moved last are best corrected by, as known now."""
        settled = self.found.settled
        return SettledRig(None if settled is None else settled.values, self.knocks, self.field_px)

    def observe(self, increment: Increment, wTc: FloatArray) -> WeighedCorrection:
        """Takes in a frame as measured and its pose; returns the correction as known now."""
        if increment.relocalised:
            self._frames.clear()
        accepted = _accepted(increment)
        self._field.observe(accepted)
        self._frames.append((wTc, accepted))
        if len(self._frames) >= WINDOW:
            frames, self._frames = self._frames, []
            self._take(frames, increment.timestamp)
        return self.found

    def _take(self, frames: list[tuple[FloatArray, Observations]], timestamp: float) -> None:
        since = 0.0 if self._last_time is None else timestamp - self._last_time
        self._last_time = timestamp
        filters = [of.grown(since / _DRIFT_S) for of in (self._early, self._whole)]
        found = [of.evidence_of(self._rig, frames, self._sigma) for of in filters]
        evidence = [one for one in found if one is not None]
        if len(evidence) < len(filters):
            return
        self.windows += 1
        judged = [of.judged(one) for of, one in zip(filters, evidence, strict=True)]
        if judged[0][0] and self.windows > TRUSTED_WINDOWS:
            if not self._suspected:  # once is something that passed through the view
                self._suspected = True
                return
            self.knocks += 1
            filters = [of.grown(1.0) for of in filters]
        else:
            filters = [of for _, of in judged]
        self._suspected = False
        pairs = zip(filters, evidence, strict=True)
        self._early, self._whole = (of.after(one) for of, one in pairs)
        self.found = self._held(self._weighed())
        self._applied = self.found.applied.values
        self.steps.append(CalibrationStep.of(timestamp, self.found, self.knocks))

    # ----------------------------------------------------------------------------------------

    # ----------------------------------------------------------------------------------------

    def remake(self) -> None:
        """What is applied, of the filters that were put back."""
        found = self._weighed()
        applied = dataclasses.replace(found.applied, values=self._applied)
        self.found = dataclasses.replace(found, applied=applied)

    def _weighed(self) -> WeighedCorrection:
        """As known now, under the field found so far."""
        whole, early = self._whole.under(self.field_px), self._early.under(self.field_px)
        return weighed(whole, early, (self._whole.prior, self._early.prior))

    def _held(self, found: WeighedCorrection) -> WeighedCorrection:
        """With the old correction where the new one is no farther from it than noise goes.

        The map was measured with the old one, and contradicts the new one.
        """
        old = self.found.applied.values
        change = found.applied.values - old
        noise = found.applied.covariance
        if change @ np.linalg.solve(noise, change) > self._early.free.sum():
            return found
        return dataclasses.replace(found, applied=dataclasses.replace(found.applied, values=old))
