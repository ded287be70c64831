"""A rig that calibrates itself from the drive: an information filter over its correction.

Windows of frames that share no image give evidence, which is added up, with the noise that the
windows themselves show by how far they disagree. Nothing is known of the truth. Derived in
docs/derivations/cameras.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.linalg import null_space

from fgslam.backend.considered import pixels_of
from fgslam.core.arrays import BoolArray, FloatArray, IntArray, chi_square_quantile
from fgslam.core.correction import (
    RigCorrection,
    displacements,
    early_terms,
    field_displacements,
    field_modes,
    prior_information,
    term_names,
)
from fgslam.core.geometry import (
    in_front,
    moved_apart,
    point_pose_jacobian,
    project,
    projection_jacobian,
    triangulate,
)
from fgslam.core.sensors import (
    CameraRig,
    Increment,
    Observations,
    SettledRig,
    pixel_covariance,
    pixel_model,
    rig_map,
    vertical_to_horizontal,
)
from fgslam.core.store import Kept

WINDOW = 6
"""Frames of one window: motion enough to see depth change, few enough to cost little."""

TRUSTED_WINDOWS = 4.0  # how many windows the stated noise is worth, next to the observed one
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


# --------------------------------------------------------------------------------------------
# An information filter over the correction: the evidence of windows of a drive, added up.
#
# The noise of that evidence is estimated from how far it lies from what is known. Terms that the
# filter does not free stay at zero, as uncertain as before the drive.


_KERNEL_FACTOR = {2: 0.61, 3: 0.49}
"""By cameras: variance under Gaussian noise as multiple of what the kernel's weights alone claim.

Sandwich of an M-estimator (Huber 1981, ch. 6): E[w] E[w^2 s / d] / E[w - 2 w^2 s / (c^2 d)]^2 with
Cauchy's weights w = 1 / (1 + s / c^2), s the squared residual of d = 2 * cameras coordinates.
"""
_KNOCK_PROBABILITY = 1e-6  # of a window so far off, by chance; two in a row are a knock
_UNOBSERVED = 1e-3  # of the prior's information: less in a direction is no evidence of the noise


class _Field(NamedTuple):
    """Modes of a field (:mod:`fgslam.core.correction`) as the same windows show them.

    Eliminated from what is known, they would need their prior at once; so they are kept next to it,
    and the prior may change with what is found. docs/derivations/cameras.md.

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
        telling = size > _UNOBSERVED * np.diagonal(axes.T @ self.prior @ axes)
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


# --------------------------------------------------------------------------------------------
# How much of the estimate is accepted: models of what is wrong with a rig, weighed.
#
# A correction of many values always fits a little better than none. Each model frees some terms and
# holds the others at zero; its evidence charges it for what it frees (MacKay 2003, ch. 28). All are
# equally likely before the drive. An exact rig is thereby left alone, without a threshold.


MODELS: dict[str, frozenset[str]] = {
    "exact": frozenset(),
    "bent": frozenset({"yaw", "pitch"}),
    "turned": frozenset({"yaw", "pitch", "roll", "focal"}),
}
"""Terms of the other cameras that are free, by name of the model; in `lens` all early ones are
(:func:`fgslam.core.correction.early_terms`), in `whole` every term is."""


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class WeighedCorrection:
    """An estimate, and what of it is worth applying.

    Attributes:
        estimated: with all terms free; its sigmas are the honest ones.
        applied: what is taken off the next frames: the mean over models of the early terms, or an
            older one that lies within the noise of it.
        settled: what the frames so far are best corrected by, all alike: the mean over all models.
            None where `whole` is not the likeliest: then each frame's own is no worse.
        probabilities: of each model.
    """

    estimated: RigCorrection
    applied: RigCorrection
    settled: RigCorrection | None
    probabilities: dict[str, float]

    @property
    def best(self) -> RigCorrection:
        """The one settled, else the one applied."""
        return self.applied if self.settled is None else self.settled


def weighed(
    estimated: RigCorrection, early: RigCorrection, priors: tuple[FloatArray, FloatArray]
) -> WeighedCorrection:
    """Both estimates averaged over models.

    Args:
        estimated: with all terms free.
        early: with the early ones free, the others held at zero.
        priors: (p, p) information of each before the drive, about zero.
    """
    models = _free_terms(estimated)
    names = list(models)
    applied, _ = _mean(early, [models[name] for name in names[:-1]], priors[1])
    settled, shares = _mean(estimated, list(models.values()), priors[0])
    whole = bool(shares.argmax() == len(shares) - 1)
    return WeighedCorrection(
        estimated,
        applied,
        settled if whole else None,
        dict(zip(names, shares.tolist(), strict=True)),
    )


def _mean(
    known: RigCorrection, models: list[BoolArray], prior: FloatArray
) -> tuple[RigCorrection, FloatArray]:
    """The mean over models, by which terms (p,) each frees, and their probabilities (n,)."""
    information = np.linalg.inv(known.covariance)
    pull = information @ known.values
    means, evidence = [], []
    for free in models:
        inner = np.ix_(free, free)
        mean = np.zeros(len(pull))
        mean[free] = np.linalg.solve(information[inner], pull[free])
        gain = np.linalg.slogdet(information[inner])[1] - np.linalg.slogdet(prior[inner])[1]
        means.append(mean)
        evidence.append(0.5 * (pull @ mean - gain))
    weight = np.exp(np.array(evidence) - max(evidence))
    weight /= weight.sum()
    return dataclasses.replace(known, values=weight @ np.array(means)), weight


def _free_terms(correction: RigCorrection) -> dict[str, BoolArray]:
    """Which values (p,) are free, by name of the model."""
    names, early = term_names(correction.rig), early_terms(correction.rig)
    out = {
        model: early & np.array([name.split(".")[-1] in terms for name in names], np.bool_)
        for model, terms in MODELS.items()
    }
    return out | {"lens": early, "whole": np.ones(len(names), np.bool_)}


# --------------------------------------------------------------------------------------------
# The evidence of a few frames: their poses and points are eliminated.
#
# Bundle adjustment of one short window with errors in all images at both ends of every track. The
# residuals are linear in the correction; poses and points are minimised over, then eliminated by
# Schur complements (Triggs et al. 2000, Bundle adjustment, 6.1).


_KERNEL_WIDTH = 2.0  # of Cauchy's kernel, standard deviations, as the ego-motion's
_GROSS = 50.0  # standard deviations: no error of a point seen once, but another point
_ITERATIONS = 3  # more change the correction by a tenth of its sigma
_TOLERANCE = 1e-4  # relative change of the cost at which a window has come to rest
_LEAST_DAMPING = 1e-9
_NEAREST_M = 1e-2
_LEAST_DISPARITY_PX = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class RigEvidence:
    """Quadratic cost of a correction: half its Hessian and gradient at ``at``.

    Attributes:
        information: (p, p), poses and points eliminated.
        score: (p,) ``information @ (best - at)``: where this window alone would go.
        at: (p,) the correction at which both are taken.
        landmarks: that were seen in two frames or more.
        lean: (p, q) Hessian of the correction against the modes of a field
            (:mod:`fgslam.core.correction`), which are zero at ``at``.
        field: (q, q) Hessian of those.
        pull: (q,) where they would go.
    """

    information: FloatArray
    score: FloatArray
    at: FloatArray
    landmarks: int
    lean: FloatArray
    field: FloatArray
    pull: FloatArray

    def over(self, factor: float) -> RigEvidence:
        """The same with a variance that is larger by a factor."""
        scaled = ("information", "score", "lean", "field", "pull")
        parts = {name: getattr(self, name) / factor for name in scaled}
        return dataclasses.replace(self, **parts)


@dataclass(slots=True, eq=False)
class _State:
    poses: FloatArray
    points: FloatArray
    correction: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Prediction:
    """What is measured at a state.

    Attributes:
        local: (m, 3) points in the cameras that see them.
        residual: (m, 2 * cameras) predicted less raw pixels, whitened: of one sigma, independent.
        unit: (m, 2 * cameras, p) displacements of the predicted pixels.
        exact: (m, cameras, 2) those pixels.
    """

    state: _State
    local: FloatArray
    residual: FloatArray
    unit: FloatArray
    exact: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations with the points eliminated; poses 1.. first, then the correction."""

    hessian: FloatArray
    gradient: FloatArray
    point_inverse: FloatArray
    coupling: FloatArray
    point_gradient: FloatArray


def _of_last(normal: _Normal, count: int) -> tuple[FloatArray, FloatArray]:
    """Information and score of the last unknowns, poses eliminated. Raises LinAlgError."""
    poses, mixed = normal.hessian[:-count, :-count], normal.hessian[:-count, -count:]
    gain = np.linalg.solve(poses, np.column_stack([mixed, normal.gradient[:-count]]))
    information = normal.hessian[-count:, -count:] - mixed.T @ gain[:, :-1]
    score = -(normal.gradient[-count:] - mixed.T @ gain[:, -1])
    return (information + information.T) / 2.0, score


def _without_last(normal: _Normal, count: int) -> _Normal:
    """The same with the last unknowns held where they are."""
    kept = slice(None, len(normal.gradient) - count)
    hessian, gradient = normal.hessian[kept, kept], normal.gradient[kept]
    return dataclasses.replace(normal, hessian=hessian, gradient=gradient)


class RigAlignment:
    """One window of frames: a list of observations, by landmark and then by frame."""

    def __init__(
        self,
        rig: CameraRig,
        frames: Sequence[tuple[FloatArray, Observations]],
        pixel_sigma: float,
        free: BoolArray,
    ) -> None:
        """Frames are (wTc, what the ego-motion accepted), in order of time.

        Of the correction's terms (p,) those that are not ``free`` are held at zero.
        """
        self._rig, self._sigma, self._free = rig, pixel_sigma, free
        self._last: _Prediction | None = None
        self._poses = np.array([wTc for wTc, _ in frames])
        ids = np.concatenate([seen.ids for _, seen in frames])
        frame = np.repeat(np.arange(len(frames)), [len(seen) for _, seen in frames])
        pixels = np.concatenate([seen.pixels[:, : rig.cameras] for _, seen in frames])
        order = np.lexsort((frame, ids))
        self._landmark, self._frame = ids[order], frame[order]
        self._pixels = pixels[order]
        # What one image does not show is little evidence, and would take a model of its own.
        self._keep(np.isfinite(self._pixels).all(axis=(1, 2)))
        ratio = vertical_to_horizontal(rig)
        self._model = pixel_model(rig.cameras, ratio)
        self._white = np.linalg.inv(np.linalg.cholesky(pixel_covariance(rig.cameras, rig.places)))
        self._fuse = rig_map(rig)

    def evidence(self, correction: FloatArray, prior: FloatArray) -> RigEvidence | None:
        """The window's evidence on the correction; None where it shows too little.

        Args:
            correction: (p,) as known so far; the minimisation starts and is held there.
            prior: (p, p) its information.
        """
        state = self._start(correction)
        if state is None:
            return None
        state = self._minimise(state, correction, prior)
        if state is None:
            return None
        p, modes = len(correction), field_modes(self._rig)
        normal = self._with_field(state)
        try:
            information, score = _of_last(_without_last(normal, modes), p)
            joint, pull = _of_last(normal, p + modes)
        except np.linalg.LinAlgError:
            return None
        lean, field = joint[:p, p:], joint[p:, p:]
        count = len(self._first)
        return RigEvidence(information, score, state.correction, count, lean, field, pull[p:])

    # ----------------------------------------------------------------------------------------

    def _keep(self, which: BoolArray) -> None:
        """Drops the other observations, and landmarks of which less than two are left."""
        landmark = self._landmark[which]
        _, at, count = np.unique(landmark, return_inverse=True, return_counts=True)
        often = count[at] >= 2
        self._landmark = np.unique(landmark[often], return_inverse=True)[1]
        self._frame, self._pixels = self._frame[which][often], self._pixels[which][often]
        self._first = np.flatnonzero(np.diff(self._landmark, prepend=-1))

    def _start(self, correction: FloatArray) -> _State | None:
        """Points from their first sighting; landmarks that fit none of it are left out."""
        self._keep(self._measured(correction)[:, 2] > _LEAST_DISPARITY_PX)
        if not self._first.size:
            return None
        local = triangulate(self._rig, self._measured(correction)[self._first])
        turn, place = self._poses[:, :3, :3], self._poses[:, :3, 3]
        at = self._frame[self._first]
        points = np.einsum("lij,lj->li", turn[at], local) + place[at]
        found = self._predicted(_State(self._poses, points, correction))
        wild = (np.abs(found.residual).max(axis=1) > _GROSS) | (found.local[:, 2] < _NEAREST_M)
        usable = ~np.logical_or.reduceat(wild, self._first)
        self._keep(usable[self._landmark])
        if usable.sum() < len(correction):
            return None
        return _State(self._poses, points[usable], correction)

    def _measured(self, correction: FloatArray) -> FloatArray:
        """(column, row, disparity) (m, 3), corrected."""
        moved = displacements(self._rig, self._pixels) @ correction
        return np.asarray((self._raw() - moved) @ self._fuse.T)

    def _raw(self) -> FloatArray:
        return self._pixels.reshape(-1, 2 * self._rig.cameras)

    def _local(self, state: _State) -> FloatArray:
        """Points (m, 3) in the cameras that see them."""
        turn, place = state.poses[:, :3, :3], state.poses[:, :3, 3]
        off = state.points[self._landmark] - place[self._frame]
        return np.asarray((off[:, None] @ turn[self._frame])[:, 0])

    def _predicted(self, state: _State) -> _Prediction:
        """What is measured at a state; of the last one it is known.

        Displacements are taken at the prediction: a measured pixel's noise would correlate with
        them, and windows without end would agree on a wrong lens.
        """
        if self._last is not None and self._last.state is state:
            return self._last
        local = self._local(state)
        safe = np.where(local[:, 2:] > _NEAREST_M, local, [0.0, 0.0, 1.0])
        exact = project(self._rig, safe) @ self._model.T
        pixels = exact.reshape(-1, self._rig.cameras, 2)
        unit = displacements(self._rig, pixels)
        unit *= self._free
        off = exact + unit @ state.correction - self._raw()
        residual = off @ self._white.T / self._sigma
        self._last = _Prediction(state, local, residual, unit, pixels)
        return self._last

    def _cost(self, state: _State, around: FloatArray, prior: FloatArray) -> float:
        found = self._predicted(state)
        if (found.local[:, 2] < _NEAREST_M).any():
            return np.inf
        off = state.correction - around
        squared = (found.residual**2).sum(axis=1) / _KERNEL_WIDTH**2
        return float(_KERNEL_WIDTH**2 * np.log1p(squared).sum() + off @ prior @ off)

    def _minimise(self, state: _State, around: FloatArray, prior: FloatArray) -> _State | None:
        damping, best = 1e-6, self._cost(state, around, prior)
        for _ in range(_ITERATIONS):
            normal = self._normal(self._predicted(state))
            moved = self._step(state, normal, around, prior, damping)
            if moved is None:
                return None
            cost = self._cost(moved, around, prior)
            if cost > best:
                damping *= 100.0
                continue
            rested = best - cost <= _TOLERANCE * best
            state, best, damping = moved, cost, max(damping / 10.0, _LEAST_DAMPING)
            if rested:
                break
        return state

    def _with_field(self, state: _State) -> _Normal:
        """Normal equations with the modes of a field as further unknowns, at zero."""
        found = self._predicted(state)
        modes = field_displacements(self._rig, found.exact)
        unit = np.concatenate([found.unit, modes], axis=2)
        return self._normal(dataclasses.replace(found, unit=unit))

    def _normal(self, found: _Prediction) -> _Normal:
        state = found.state
        local, residual, unit = found.local, found.residual, self._white @ found.unit
        squared = (residual**2).sum(axis=1)
        root = 1.0 / (self._sigma * np.sqrt(1.0 + squared / _KERNEL_WIDTH**2))
        by_local = root[:, None, None] * (
            self._white @ self._model @ projection_jacobian(self._rig, local)
        )
        by_pose = by_local @ point_pose_jacobian(local)
        by_point = by_local @ np.swapaxes(state.poses[:, :3, :3], 1, 2)[self._frame]
        joint = np.concatenate([by_pose, root[:, None, None] * unit], axis=2)
        weighted = self._sigma * root[:, None] * residual
        hessian, gradient = self._of_frames(joint, weighted)
        point_left = np.swapaxes(by_point, 1, 2)
        curvature = np.add.reduceat(point_left @ by_point, self._first)
        curvature += 1e-9 * np.trace(curvature, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        pull = np.add.reduceat((point_left @ weighted[:, :, None])[..., 0], self._first)
        coupling = self._coupling(np.swapaxes(joint, 1, 2) @ by_point)
        inverse = np.linalg.inv(curvature)
        eliminated = coupling @ inverse
        flat = np.swapaxes(coupling, 1, 2).reshape(-1, len(gradient))
        hessian -= np.swapaxes(eliminated, 1, 2).reshape(-1, len(gradient)).T @ flat
        gradient = gradient - np.einsum("lnj,lj->n", eliminated, pull)
        return _Normal(hessian, gradient, inverse, coupling, pull)

    def _of_frames(self, joint: FloatArray, weighted: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Joint Hessian and gradient before points are eliminated; the first pose is held."""
        frames, p = len(self._poses), joint.shape[2] - 6
        size = 6 * (frames - 1)
        hessian, out = np.zeros((size + p, size + p)), np.zeros(size + p)
        for k in range(frames):
            own = self._frame == k
            jacobian = joint[own].reshape(-1, 6 + p)
            block, gradient = jacobian.T @ jacobian, jacobian.T @ weighted[own].ravel()
            hessian[size:, size:] += block[6:, 6:]
            out[size:] += gradient[6:]
            if k:
                at = slice(6 * k - 6, 6 * k)
                hessian[at, at], out[at] = block[:6, :6], gradient[:6]
                hessian[at, size:], hessian[size:, at] = block[:6, 6:], block[6:, :6]
        return hessian, out

    def _coupling(self, crossing: FloatArray) -> FloatArray:
        """Points against poses 1.. and correction (l, n, 3), from observations (m, 6 + p, 3)."""
        landmarks, later = len(self._first), len(self._poses) - 1
        poses = np.zeros((landmarks, later, 6, 3))
        moving = self._frame > 0
        poses[self._landmark[moving], self._frame[moving] - 1] = crossing[moving, :6]
        rig = np.add.reduceat(crossing[:, 6:], self._first)
        return np.concatenate([poses.reshape(landmarks, 6 * later, 3), rig], axis=1)

    def _step(
        self, state: _State, normal: _Normal, around: FloatArray, prior: FloatArray, damping: float
    ) -> _State | None:
        p = len(around)
        hessian, gradient = normal.hessian.copy(), normal.gradient.copy()
        hessian[-p:, -p:] += prior
        gradient[-p:] += prior @ (state.correction - around)
        hessian.flat[:: len(hessian) + 1] *= 1.0 + damping
        try:
            step = np.asarray(-np.linalg.solve(hessian, gradient), np.float64)
        except np.linalg.LinAlgError:
            return None
        pull = normal.point_gradient + np.einsum("lnj,n->lj", normal.coupling, step)
        points = state.points - np.einsum("lij,lj->li", normal.point_inverse, pull)
        moves = step[:-p].reshape(-1, 6)
        poses = np.stack(
            [state.poses[0]]
            + [moved_apart(T, xi) for T, xi in zip(state.poses[1:], moves, strict=True)]
        )
        return _State(poses, points, state.correction + step[-p:])


# --------------------------------------------------------------------------------------------
# How large a field of displacements the images show against each other.
#
# What a point's images contradict each other by (a pair: its rows) is seen in every frame, without
# motion or truth. What of it depends on the place in the image, and is none of the terms of the
# correction, is the field; its columns are taken to be as large. Landmarks are put into groups, and
# only what different groups agree on counts, so that noise does not, were it a landmark's own for
# good. docs/derivations/measurements.md.


_GROUPS = 8  # of landmarks; a deviation from them is known to a quarter
_LEAST_GROUPS = 4
_TOGETHER = 64  # identities, given one after the other: neighbours share the noise of their texture
_EVERY = 6  # frames between two estimates
_FREE_PX = 100.0  # prior of the terms, so wide that none of them is left to the modes
_SURE = 2.0  # standard errors above zero from which a field is one


class FieldSize:
    """Normal equations of rig terms and field, by group of landmarks; and the field's size."""

    _normal: Kept[FloatArray]
    _rows: Kept[IntArray]
    _frames: Kept[int]
    px: Kept[float]

    def __init__(self, rig: CameraRig, pixel_sigma: float) -> None:
        """Nothing seen yet; ``pixel_sigma`` of one coordinate, pixels."""
        self._rig = rig
        self._contradicting = null_space(
            pixel_model(rig.cameras, vertical_to_horizontal(rig)).T
        )  # (2 * cameras, 2 * cameras - 3) pixels that no point has
        self._prior = pixel_sigma**2 * prior_information(rig, _FREE_PX)
        size = len(self._prior) + field_modes(rig) + 1
        self._normal = np.zeros((_GROUPS, size, size))
        self._rows = np.zeros(_GROUPS, np.int64)
        self._frames = 0
        self.px = 0.0
        """Standard deviation of one coordinate in each image, pixels; 0: none is seen."""

    def observe(self, seen: Observations) -> None:
        """Takes in what a frame's pose accepted."""
        pixels = seen.pixels[:, : self._rig.cameras]
        whole = np.asarray(np.isfinite(pixels).all(axis=(1, 2)), np.bool_)
        if whole.any():
            self._add(seen.select(whole))
        self._frames += 1
        if self._frames % _EVERY == 0:
            variance, error = self._variance()
            self.px = float(np.sqrt(variance)) if variance > _SURE * error else 0.0

    # ----------------------------------------------------------------------------------------

    def _add(self, seen: Observations) -> None:
        """At the predicted pixels, whose noise is not that of the contradiction.

        The contradictions are raw. Less what was applied, which changes on the way, no one value
        of the terms would follow them, and the rest would be taken for a field.
        """
        rig, exact = self._rig, pixels_of(self._rig, seen.measurement)
        terms = displacements(rig, exact)
        off = seen.pixels[:, : rig.cameras].reshape(len(seen), -1)
        columns = np.concatenate([terms, field_displacements(rig, exact), off[..., None]], axis=2)
        columns = self._contradicting.T @ columns
        group = seen.ids // _TOGETHER % _GROUPS
        for k in range(_GROUPS):
            own = columns[group == k].reshape(-1, columns.shape[2])
            self._normal[k] += own.T @ own
            self._rows[k] += len(own)

    def _variance(self) -> tuple[float, float]:
        """The field's variance without bias, pixels^2, and its standard error.

        Products of what different groups show of the modes, over what a field of variance one
        would make of them; the error by leaving out group by group (jackknife).
        """
        normal = self._normal[self._rows > self._normal.shape[1]]
        if len(normal) < _LEAST_GROUPS:
            return 0.0, np.inf
        information, pull = self._of_field(normal)
        whole = information.sum(axis=0)
        # Modes count by how they show, each as far as it stands out of the noise.
        shrunk = np.linalg.inv(whole + np.eye(len(whole)))
        weighed = shrunk @ whole @ shrunk
        found, found_without = _sums_over_pairs(pull @ weighed @ pull.T)
        by_group = weighed @ information
        unit, unit_without = _sums_over_pairs(np.einsum("gij,hji->gh", by_group, information))
        without = found_without / unit_without
        spread = ((without - without.mean()) ** 2).sum() * (len(normal) - 1) / len(normal)
        return found / unit, float(np.sqrt(spread))

    def _of_field(self, normal: FloatArray) -> tuple[FloatArray, FloatArray]:
        """By group, information (g, m, m) and gradient (g, m) of the modes, terms eliminated."""
        p = len(self._prior)
        gain = np.linalg.solve(normal[:, :p, :p] + self._prior, normal[:, :p, p:])
        left = normal[:, p:, p:] - normal[:, p:, :p] @ gain
        return left[:, :-1, :-1], left[:, :-1, -1]


def _sums_over_pairs(products: FloatArray) -> tuple[float, FloatArray]:
    """Products (g, g) summed over different groups; (g,) the same without each group in turn."""
    off = products - np.diag(np.diagonal(products))
    whole = float(off.sum())
    return whole, np.asarray(whole - off.sum(axis=0) - off.sum(axis=1))


# --------------------------------------------------------------------------------------------
# What measurements and landmarks become where the correction changes between two frames.
#
# A map measured with one correction contradicts what is measured with the next: every landmark is
# as far off as its disparity was. So it moves to where the new correction would have put it, seen
# from the pose that saw it last: to first order, as corrections are fractions of a disparity.


_LEAST_SHARE = 0.5  # of a disparity that is left: below, it is no first-order change


@dataclass(frozen=True, slots=True, eq=False)
class RigChange:
    """A change of the correction of a rig's pixels.

    Attributes:
        rig: the cameras.
        values: (p,) the new correction less the old one
            (:func:`fgslam.core.correction.term_names`).
    """

    rig: CameraRig
    values: FloatArray

    def measured(self, measurement: FloatArray) -> FloatArray:
        """Measurements (k, 3) (column, row, disparity) of all images, by the new correction."""
        ratio, cameras = vertical_to_horizontal(self.rig), self.rig.cameras
        pixels = measurement @ pixel_model(cameras, ratio).T
        moved = displacements(self.rig, pixels.reshape(-1, cameras, 2)) @ self.values
        return np.asarray(measurement - moved @ rig_map(self.rig).T)

    def moved(self, poses: FloatArray, positions: FloatArray) -> tuple[FloatArray, float]:
        """Landmarks (k, 3) in the world, each measured again from a pose (k, 4, 4) that saw it.

        Returns:
            Where they are then, one that its pose does not see where it was; and by how many
            pixels of disparity they were off, root mean square.
        """
        turn, place = poses[:, :3, :3], poses[:, :3, 3]
        local = np.einsum("kji,kj->ki", turn, positions - place)
        ahead = in_front(local)
        before = project(self.rig, np.where(ahead[:, None], local, [0.0, 0.0, 1.0]))
        after = self.measured(before)
        size = np.array([self.rig.width, self.rig.height])
        seen = ahead & ((before[:, :2] >= 0.0) & (before[:, :2] < size)).all(axis=1)
        seen &= after[:, 2] > _LEAST_SHARE * before[:, 2]
        again = triangulate(self.rig, np.where(seen[:, None], after, before))
        again = np.einsum("kij,kj->ki", turn, again) + place
        off = (after - before)[seen, 2]
        rms = float(np.sqrt(np.mean(off**2))) if len(off) else 0.0
        return np.where(seen[:, None], again, positions), rms


@dataclass(slots=True, eq=False)
class KnownCorrections:
    """Which correction the measurements of which frames contain, and what became known later.

    Attributes:
        begins: first frame of each segment with one correction and one rig, ascending.
        applied: (p,) of each, the correction that its measurements contain.
        knocks: of each, how often the rig was found to have moved before.
        settled: after so many knocks, what was known last for all frames alike, if anything.
        field_px: what no term follows, as known last.
    """

    begins: list[int] = field(default_factory=list)
    applied: list[FloatArray] = field(default_factory=list)
    knocks: list[int] = field(default_factory=list)
    settled: dict[int, FloatArray | None] = field(default_factory=dict)
    field_px: float = 0.0

    def note(self, frame: int, increment: Increment) -> None:
        """Takes in one more frame; one without a correction changes nothing."""
        applied, known = increment.rig_correction, increment.settled_rig
        if applied is None:
            return
        knocks = 0 if known is None else known.knocks
        if known is not None:
            self.settled[knocks] = known.values
            self.field_px = known.field_px
        if not (self.begins and knocks == self.knocks[-1] and (applied == self.applied[-1]).all()):
            self.begins.append(frame)
            self.applied.append(applied)
            self.knocks.append(knocks)

    def recalibrate(self, change: RigChange) -> None:
        """All measurements so far were corrected by a change."""
        self.applied = [then + change.values for then in self.applied]

    def settle(self, rig: CameraRig, frames: IntArray, measurement: FloatArray) -> FloatArray:
        """Measurements (k, 3) of frames (k,) by what was known last of the rig as it was then."""
        out = measurement.copy()
        segment = np.searchsorted(self.begins, frames, side="right") - 1
        for k, (applied, knocks) in enumerate(zip(self.applied, self.knocks, strict=True)):
            settled, rows = self.settled.get(knocks), segment == k
            if settled is not None and rows.any():
                out[rows] = RigChange(rig, settled - applied).measured(measurement[rows])
        return out
