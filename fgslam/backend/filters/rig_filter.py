"""An information filter over a rig's correction: the evidence of windows of a drive, added up.

The noise of that evidence is estimated from how far they lie from what is known. Terms that the
filter does not free stay at zero, as uncertain as before the drive. Derived in
docs/derivations/self_calibration.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fgslam.backend.filters.rig_alignment import RigAlignment, RigEvidence
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.measurements import Observations
from fgslam.core.quantiles import chi_square_quantile
from fgslam.core.rig_correction import RigCorrection, prior_information
from fgslam.core.rig_field import field_modes
from fgslam.core.sensors import CameraRig
from fgslam.core.store import Kept

TRUSTED_WINDOWS = 4.0  # how many windows the stated noise is worth, beside the observed one
_KERNEL_FACTOR = {2: 0.61, 3: 0.49}
"""By cameras: variance under Gaussian noise as multiple of what the kernel's weights alone claim.

Sandwich of an M-estimator (Huber 1981, ch. 6): E[w] E[w^2 s / d] / E[w - 2 w^2 s / (c^2 d)]^2 with
Cauchy's weights w = 1 / (1 + s / c^2), s the squared residual of d = 2 * cameras coordinates.
"""
_KNOCK_PROBABILITY = 1e-6  # of a window so far off, by chance; two in a row are a knock
_DOUBTFUL = 1e-3  # of the prior's information: less in a direction is no evidence of the noise


class _Field(NamedTuple):
    """Modes of a field (:mod:`fgslam.core.rig_field`) as the same windows show them.

    Eliminated from what is known, they would need their prior at once; so they are kept beside it,
    and the prior may change with what is found. docs/derivations/self_calibration.md.

    Attributes:
        lean: (p, q) how the correction known changes with the modes.
        information: (q, q) of the modes, the correction being unknown.
        score: (q,) where they would go.
    """

    lean: FloatArray
    information: FloatArray
    score: FloatArray

    @staticmethod
    def none(rig: CameraRig, terms: int) -> _Field:
        """Before the drive."""
        q = field_modes(rig)
        return _Field(np.zeros((terms, q)), np.zeros((q, q)), np.zeros(q))

    def after(self, evidence: RigEvidence, before: FloatArray, covariance: FloatArray) -> _Field:
        """With a window of the noise that it states.

        Args:
            evidence: of the window.
            before: (p,) the correction known before it.
            covariance: (p, p) of the correction known after it.
        """
        off = evidence.at - before
        score = evidence.score + evidence.information @ off
        mixed = evidence.information @ self.lean + evidence.lean
        gain = covariance @ mixed
        own = self.lean.T @ mixed + evidence.lean.T @ self.lean + evidence.field
        pull = evidence.pull + evidence.lean.T @ off + self.lean.T @ score
        return _Field(
            self.lean - gain,
            self.information + own - mixed.T @ gain,
            self.score + pull - gain.T @ score,
        )


@dataclass(frozen=True, slots=True, eq=False)
class RigFilter:
    """What is known of a rig's correction, and how noisy the windows are that tell it.

    Attributes:
        known: the correction so far, as if there were no field.
        free: (p,) terms that windows inform; the others are held at zero.
        prior: (p, p) information before the drive, about zero.
        field: its modes, as unknowns of the same windows.
        misfit: squared distances of windows from what was known, in their own deviations, added up.
        freedom: how many numbers that is of.
    """

    known: Kept[RigCorrection]
    free: BoolArray
    prior: FloatArray
    field: Kept[_Field]
    misfit: Kept[float] = 0.0
    freedom: Kept[float] = 0.0

    @staticmethod
    def of(rig: CameraRig, free: BoolArray) -> RigFilter:
        """Before the drive; terms that are held tell nothing of the free ones."""
        prior = prior_information(rig, free=free)
        covariance = np.asarray(np.linalg.inv(prior), np.float64)
        none = dataclasses.replace(RigCorrection.none(rig), covariance=covariance)
        return RigFilter(none, free, prior, _Field.none(rig, len(prior)))

    @property
    def information(self) -> FloatArray:
        """(p, p) of what is known."""
        return np.asarray(np.linalg.inv(self.known.covariance), np.float64)

    @property
    def noise_factor(self) -> float:
        """Variance of the windows' evidence, as multiple of what their pixels alone would give."""
        stated = TRUSTED_WINDOWS * int(self.free.sum())
        usual = _KERNEL_FACTOR[self.known.rig.cameras]
        return max((usual * stated + self.misfit) / (stated + self.freedom), 1e-3)

    def grown(self, share: float) -> RigFilter:
        """The same, less certain by a share of the prior's covariance."""
        covariance = self.known.covariance + share * np.linalg.inv(self.prior)
        return dataclasses.replace(
            self, known=dataclasses.replace(self.known, covariance=covariance)
        )

    def judged(self, evidence: RigEvidence) -> tuple[bool, RigFilter]:
        """Whether what is known cannot explain a window; and the filter that knows its noise.

        Judged in the window's own principal directions, those in which it has evidence: how far
        it lies from what is known, in units of its own noise and of what is known.
        """
        size, axes = np.linalg.eigh(evidence.information)
        score = evidence.score + evidence.information @ (evidence.at - self.known.values)
        telling = size > _DOUBTFUL * np.diagonal(axes.T @ self.prior @ axes)
        score = (axes.T @ score)[telling] / np.sqrt(size[telling])
        root = axes[:, telling] * np.sqrt(size[telling])
        known = root.T @ self.known.covariance @ root / self.noise_factor
        known_share, turn = np.linalg.eigh(known)
        squared = (turn.T @ score) ** 2 / (1.0 + known_share)
        likely = chi_square_quantile(1.0 - _KNOCK_PROBABILITY, len(score))
        unlikely = bool(squared.sum() / self.noise_factor > likely)
        noisy = known_share < 1.0  # elsewhere it is the prior that is judged
        counted = dataclasses.replace(
            self,
            misfit=self.misfit + float(squared[noisy].sum()),
            freedom=self.freedom + float(np.count_nonzero(noisy)),
        )
        return unlikely, counted

    def after(self, evidence: RigEvidence) -> RigFilter:
        """With the evidence of a window."""
        factor, added = self.noise_factor, evidence.information
        score = evidence.score + added @ (evidence.at - self.known.values)
        covariance = np.asarray(np.linalg.inv(self.information + added / factor), np.float64)
        covariance = (covariance + covariance.T) / 2.0
        values = self.known.values + covariance @ (score / factor)
        known = dataclasses.replace(self.known, values=values, covariance=covariance)
        field = self.field.after(evidence.over(factor), self.known.values, covariance)
        return dataclasses.replace(self, known=known, field=field)

    def under(self, field_px: float) -> RigCorrection:
        """What is known where a field of this standard deviation is not; pixels, 0: there is none.

        Its modes are unknowns that all windows share, with that prior, and are eliminated.
        """
        if field_px == 0.0:
            return self.known
        known, lean, information, score = self.known, *self.field
        modes = np.linalg.inv(information + np.eye(len(score)) / field_px**2)
        return dataclasses.replace(
            known,
            values=known.values + lean @ (modes @ score),
            covariance=known.covariance + lean @ modes @ lean.T,
        )

    def evidence_of(
        self, rig: CameraRig, frames: Sequence[tuple[FloatArray, Observations]], sigma_px: float
    ) -> RigEvidence | None:
        """Of a window (wTc, what the ego-motion accepted) on the free terms; None without any."""
        alignment = RigAlignment(rig, frames, sigma_px, self.free)
        return alignment.evidence(self.known.values, self.information)
