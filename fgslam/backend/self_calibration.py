"""A rig that calibrates itself from the drive: an information filter over its correction.

Windows of frames that share no image say what they show of the correction and of nuisances
together; this is added up, with the noise that the windows themselves show by how far they
disagree. Nothing is known of the truth. Derived in docs/derivations/cameras.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag

from fgslam.core.arrays import BoolArray, FloatArray, chi_square_quantile
from fgslam.core.correction import (
    BASELINE_TERMS,
    FIELD_PX,
    TERMS,
    RigCorrection,
    displacements,
    field_modes,
    nuisance_displacements,
    nuisance_information,
    prior_information,
    term_names,
)
from fgslam.core.geometry import congruence, in_front, moved_apart, point_pose_jacobian
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
from fgslam.core.types import Remark

WINDOW = 6
"""Frames of one window: motion enough to see depth change, few enough to cost little."""

TRUSTED_WINDOWS = 4  # how many windows the stated noise and shake are worth, next to those observed
_DECIDING = 2
"""Windows after a suspected knock for which both hypotheses are kept: one rig, or two."""
_RECENT = 6  # windows in which a knock is looked for
_DRIFT_S = 3600.0  # seconds in which evidence fades by a factor e


@dataclass(frozen=True, slots=True, eq=False)
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


@dataclass(frozen=True, slots=True, eq=False)
class _Window:
    """One window: what was known before it, what it shows, and its first frame."""

    before: RigFilter
    evidence: RigEvidence
    first: int


class SelfCalibration:
    """Estimates the correction of a rig while it is driven."""

    _known: Kept[RigFilter]
    _recent: Kept[list[_Window]]
    _quietest: Kept[float]
    _applied: Kept[FloatArray]
    steps: Kept[list[CalibrationStep]]
    windows: Kept[int]
    moved_at: Kept[list[int]]
    moved_before: Kept[bool]
    suspected: Kept[int | None]
    _failed: Kept[int]
    _open: Kept[FloatArray]
    _seen: Kept[int]
    _frames: Kept[list[tuple[FloatArray, Observations]]]
    _last_time: Kept[float | None]

    def __init__(
        self,
        rig: CameraRig,
        pixel_sigma: float,
        begun: Callable[[RigUnknowns], RigFilter] | None = None,
    ) -> None:
        """Begins with the calibration as stated, or as earlier drives have found it.

        Args:
            rig: the cameras.
            pixel_sigma: of one coordinate, pixels.
            begun: gives what earlier drives have shown; None: nothing.
        """
        self._unknowns = RigUnknowns(rig)
        self._begun = (begun or RigFilter.none)(self._unknowns)
        self._known = self._begun
        self._recent = []
        self._quietest = np.inf  # spread of a window
        self.found = self._known.weighed(self._unknowns)
        """As known now, and what of it is worth applying."""
        self.steps = []
        """How it became known, window by window."""
        self.windows = 0
        """How many gave evidence."""
        self.moved_at: list[int] = []
        """Frames with which the rig was found to have moved."""
        self.moved_before = False
        """Whether it was found to have moved since the drives that it began with."""
        self.suspected = None
        """Frame from which on the rig seems to be another one, while that is undecided."""
        self._failed = 0  # frame in which no landmark fitted, of the windows to come
        self._open = np.zeros((6, 6))  # of a frame's motion, by what is open of the rig
        self._applied = self.found.applied.values
        self._seen = 0
        self._sigma = pixel_sigma
        self._frames = []
        self._last_time = None

    @property
    def field_px(self) -> float:
        """What no term follows: standard deviation of one coordinate in each image, pixels."""
        return self._known.field_px

    @property
    def shake_px(self) -> float:
        """By how much images move against each other from frame to frame: deviation, pixels."""
        return float(self._known.shake * self._unknowns.rig.fx)

    @property
    def settled(self) -> SettledRig:
        """Since when the rig is as it is now, and what no term follows."""
        return SettledRig(self.knocks, self.moved_at[-1] if self.moved_at else 0, self.field_px)

    @property
    def knocks(self) -> int:
        """How often the rig was found to have moved."""
        return len(self.moved_at)

    @property
    def moves(self) -> list[int]:
        """Frames with which the rig has moved, or seems to have; several of a loose camera."""
        return [*self.moved_at, *([] if self.suspected is None else [self.suspected])]

    def remarks(self) -> tuple[Remark, ...]:
        """That the rig has moved, or seems to have."""
        if not (moves := self.moves):
            return ()
        code = "rig_loose" if len(moves) > 1 else "rig_moved" if self.moved_at else "rig_doubted"
        return (Remark(code, tuple(moves)),)

    def shown(self) -> tuple[FloatArray, FloatArray]:
        """Information (n, n) and pull (n,) of the drive, without what it began with.

        Of a rig that has moved, since then, with what is known of its nuisances.
        """
        left = self._known.remembered
        information = self._known.information - left * self._begun.information
        return information, self._known.pull - left * self._begun.pull

    def observe(self, increment: Increment, wTc: FloatArray, passes: bool = False) -> None:
        """Takes in a frame as measured and its pose; ``found`` is then as known with it.

        ``passes``: something that moves is in view; the frame is no evidence.
        """
        self._seen += 1
        old = ~increment.observations.is_new
        failed = old.sum() >= _FEWEST and bool(increment.rejected[old].all())
        if increment.relocalised or passes or failed:
            self._frames.clear()
        if failed and self._recent:  # as a knock makes them fail: known is what is stated
            self._failed, prior = self._seen - 1, self._unknowns.prior(FIELD_PX)
            stated = np.asarray(np.linalg.inv(prior)[(slice(self._unknowns.terms),) * 2])
            self._open = congruence(self._recent[-1].evidence.moves, stated)
        if passes:
            return
        self._frames.append((wTc, increment.kept))
        if len(self._frames) >= WINDOW:
            frames, self._frames = self._frames, []
            self._take(frames, increment.timestamp)

    def _take(self, frames: list[tuple[FloatArray, Observations]], timestamp: float) -> None:
        since = 0.0 if self._last_time is None else timestamp - self._last_time
        self._last_time = timestamp
        of, before = self._unknowns, self._known.faded(since / _DRIFT_S)
        alignment = RigAlignment(of, frames, self._sigma, before.shake, self._quietest)
        evidence = alignment.evidence(before.values(of), before.precision(of))
        if evidence is None:
            return
        self.windows += 1
        unlikely, judged = before.judged(of, evidence)
        unlikely &= self.windows > TRUSTED_WINDOWS or before.remembered > 0.0
        if unlikely:  # linearised where the window itself would go
            other = before.without_terms(of)
            evidence = alignment.evidence(other.values(of), other.precision(of)) or evidence
        self._quietest = min(self._quietest, evidence.spread)
        window = _Window(before, evidence, self._seen - len(frames))
        self._recent = [*self._recent[1 - _RECENT :], window]
        self._known = judged.after(of, evidence)
        moved = self._moved_in()
        if moved is not None:
            windows, self._recent = self._recent, []
            if moved < 0:
                self.moved_before = True
            else:
                self.moved_at = [*self.moved_at, windows[moved].first]
            self._known = windows[max(moved, 0)].before.without_terms(of)
            for one in windows[moved + 1 :]:  # it may have moved within one
                self._known = self._known.judged(of, one.evidence)[1].after(of, one.evidence)
        self.found, self._failed = self._held(self._known.weighed(of)), 0
        if self.moved_at:
            self._open += congruence(evidence.moves, self.found.estimated.covariance)
        self._applied = self.found.applied.values
        known = self.found.estimated.values, self.found.estimated.covariance
        self.steps.append(CalibrationStep(timestamp, *known, self._applied, self.knocks))

    def _moved_in(self) -> int | None:
        """With which of the recent windows the rig has moved; None: with none, or undecided.

        Two rigs, before and after, then explain the windows far better than one, with the same
        nuisances; better than if it had moved at another one; and they differ over the whole
        image. -1: the first windows of the drive are of another rig than it began with.
        """
        likely = chi_square_quantile(1.0 - _KNOCK_PROBABILITY, self._unknowns.terms)
        moves = [self._moved(k) for k in range(len(self._recent))]
        sure = [move.significance() * (move.rms_px() > _KNOCK_PX) for move in moves]
        terms = slice(self._unknowns.terms)
        sure[0] *= self._recent[0].before.information[terms, terms].any()  # else nothing was known
        first, self.suspected = int(np.argmax(sure)), None
        self._open = np.zeros((6, 6))
        if sure[first] > (0.0 if self.moved_at else likely):  # what has moved may be loose
            off = self._recent[-1].evidence.moves @ moves[first].values
            self._open = 0.5 * np.outer(off, off)
        if sure[first] <= likely:
            return None
        if self._known.remembered and len(self._recent) == self.windows and sure[0] > likely:
            return -1
        if len(self._recent) - first >= _DECIDING:
            return first
        self.suspected = self._recent[first].first
        return None

    def open_covariances(self, count: int) -> FloatArray:
        """(count, 6, 6) to be added to those of the last poses: what is open since the rig moved.

        One rig or two, until poses follow that; then how well the new one is known; from a frame on
        in which no landmark fitted, until a window is solved, as well as a rig is stated.
        """
        begun = self._failed or [*self.moves, 0][0]
        since = np.arange(self._seen - count, self._seen) + 1.0 - begun
        return np.asarray(np.maximum(since, 0.0)[:, None, None] ** 2 * self._open)

    def _moved(self, first: int) -> RigCorrection:
        """By how much the rig differs from a recent window on, if all before are of one rig."""
        of, start, p = self._unknowns, self._recent[0].before, self._unknowns.terms
        factor = start.noise_factor(of)
        shown = [one.evidence for one in self._recent]
        every, after = (sum(e.information for e in some) for some in (shown, shown[first:]))
        pulls, later = (sum(e.pull for e in some) for some in (shown, shown[first:]))
        one = start.precision(of) + every / factor
        mixed = np.asarray(after)[:p] / factor
        own = mixed[:, :p] + of.prior(start.field_px)[:p, :p]
        joint = np.block([[own, mixed], [mixed.T, one]])
        pull = np.append(np.asarray(later)[:p] / factor, start.pull + pulls / factor)
        covariance = np.asarray(np.linalg.inv(joint))
        return RigCorrection(of.rig, (covariance @ pull)[:p], covariance[:p, :p])

    # ----------------------------------------------------------------------------------------

    def remake(self) -> None:
        """What is applied, of the filter that was put back."""
        self.found = self._known.weighed(self._unknowns).applying(self._applied)

    def _held(self, found: WeighedCorrection) -> WeighedCorrection:
        """With the old correction where the new one lies within a standard deviation of it.

        Or while it is undecided whether the rig has moved.
        """
        old = self._applied
        change = found.applied.values - old
        undecided = self.suspected is not None
        if undecided or change @ np.linalg.solve(found.applied.covariance, change) <= 1.0:
            return found.applying(old)
        return found


# --------------------------------------------------------------------------------------------
# An information filter over terms and nuisances together: the evidence of windows, added up.
#
# The noise of that evidence is estimated from how far it lies from what is known. What was known
# before the drive stays apart, so that the size of the field can be learnt, and models can be
# compared that hold some of the terms at zero.


_KERNEL_FACTOR = {2: 0.61, 3: 0.49}
"""By cameras: variance under Gaussian noise as multiple of what the kernel's weights alone claim.

Sandwich of an M-estimator (Huber 1981, ch. 6): E[w] E[w^2 s / d] / E[w - 2 w^2 s / (c^2 d)]^2 with
Cauchy's weights w = 1 / (1 + s / c^2), s the squared residual of d = 2 * cameras coordinates.
"""
_KNOCK_PROBABILITY = 1e-6  # of a window, or of a knock, so far off by chance
_FEWEST = 20  # landmarks of a frame: all of them fit no pose by chance
_KNOCK_PX = 0.5  # root mean square over the image; less is left to the drift
_UNOBSERVED = 1e-3  # of the prior's information: less in a direction is no evidence of the noise
_SHAKE = 0.02 / 360.0
"""Radians by which images move against each other from frame to frame, before a drive shows it."""
_TRUSTED_MODES = 4.0  # how many modes the stated size of a field is worth, next to those observed
_FIELD_STEPS = 10  # of a fixed point that is near after three


class RigUnknowns:
    """The terms of a rig's correction, then its nuisances: what a drive shows together."""

    def __init__(self, rig: CameraRig) -> None:
        """Those of a rig."""
        self.rig = rig
        self.terms = len(term_names(rig))
        """Number of terms, p."""
        self.modes = field_modes(rig)
        self._prior = block_diag(prior_information(rig), nuisance_information(rig, 1.0))
        self.size = len(self._prior)
        """Of terms and nuisances, n; the field's modes come last."""

    def prior(self, field_px: float) -> FloatArray:
        """(n, n) information before the drive, about zero."""
        out: FloatArray = self._prior.copy()
        out[-self.modes :, -self.modes :] /= field_px**2
        return out

    def displacements(self, pixels: FloatArray) -> FloatArray:
        """(k, 2 * cameras, n) of pixels (k, cameras, 2) by a unit of each."""
        of_each = displacements(self.rig, pixels), nuisance_displacements(self.rig, pixels)
        return np.concatenate(of_each, axis=2)

    def models(self) -> dict[str, BoolArray]:
        """Which of all (n,) are free, by name of the model; nuisances are in each."""
        names = np.array([name.split(".")[-1] for name in term_names(self.rig)])
        free = {model: np.isin(names, terms) for model, terms in MODELS.items()}
        nuisances: BoolArray = np.ones(self.size - self.terms, np.bool_)
        return {model: np.append(own, nuisances) for model, own in free.items()}


@dataclass(frozen=True, slots=True, eq=False)
class RigFilter:
    """What is known of a rig, and how noisy the windows are that tell it.

    Attributes:
        information: (n, n) of the windows on the unknowns, without what was known before.
        pull: (n,) ``information @ best``, where the windows alone would go.
        field_px: deviation of the field's modes.
        misfit: squared distances of windows from what was known, in their own deviations, added up.
        freedom: how many numbers that is of.
        shaken: squared shifts of single frames' rows, added up, radians^2.
        frames: how many frames that is of.
        remembered: share that is left of what the drive began with.
    """

    information: FloatArray
    pull: FloatArray
    field_px: float = FIELD_PX
    misfit: float = 0.0
    freedom: float = 0.0
    shaken: float = 0.0
    frames: float = 0.0
    remembered: float = 0.0

    @staticmethod
    def none(of: RigUnknowns) -> RigFilter:
        """Before the drive."""
        return RigFilter(np.zeros((of.size, of.size)), np.zeros(of.size))

    def precision(self, of: RigUnknowns) -> FloatArray:
        """(n, n) of what is known, with what was known before the drive."""
        return self.information + of.prior(self.field_px)

    def values(self, of: RigUnknowns) -> FloatArray:
        """(n,) of all unknowns."""
        return np.asarray(np.linalg.solve(self.precision(of), self.pull))

    @property
    def shake(self) -> float:
        """Deviation of a single frame's shift, radians."""
        stated = TRUSTED_WINDOWS * WINDOW
        return float(np.sqrt((stated * _SHAKE**2 + self.shaken) / (stated + self.frames)))

    def noise_factor(self, of: RigUnknowns) -> float:
        """Variance of the windows' evidence, as multiple of what their pixels alone would give."""
        stated = TRUSTED_WINDOWS * of.terms
        usual = _KERNEL_FACTOR[of.rig.cameras]
        return max((usual * stated + self.misfit) / (stated + self.freedom), 1e-3)

    def faded(self, share: float) -> RigFilter:
        """The same, after a share of the time in which it is forgotten."""
        left = float(np.exp(-share))
        return dataclasses.replace(
            self,
            information=left * self.information,
            pull=left * self.pull,
            remembered=left * self.remembered,
        )

    def adding(self, information: FloatArray, pull: FloatArray) -> RigFilter:
        """With evidence, as noisy as it is taken to be."""
        return dataclasses.replace(
            self, information=self.information + information, pull=self.pull + pull
        )

    def without_terms(self, of: RigUnknowns) -> RigFilter:
        """The same of another rig in the same place: of the terms nothing is known."""
        p = of.terms
        known = self.information[:p, :p] + of.prior(self.field_px)[:p, :p]
        gain = np.linalg.solve(known, np.column_stack([self.information[:p, p:], self.pull[:p]]))
        information, pull = np.zeros_like(self.information), np.zeros_like(self.pull)
        mixed = self.information[p:, :p]
        information[p:, p:] = self.information[p:, p:] - mixed @ gain[:, :-1]
        pull[p:] = self.pull[p:] - mixed @ gain[:, -1]
        return dataclasses.replace(self, information=information, pull=pull, remembered=0.0)

    def judged(self, of: RigUnknowns, evidence: RigEvidence) -> tuple[bool, RigFilter]:
        """Whether what is known cannot explain a window; and the filter that knows its noise.

        Judged in the window's own principal directions, those in which it has evidence: how far
        it lies from what is known, in units of its own noise and of what is known.
        """
        prior, factor = of.prior(self.field_px), self.noise_factor(of)
        covariance = np.linalg.inv(self.information + prior)
        size, axes = np.linalg.eigh(evidence.information)
        score = evidence.pull - evidence.information @ (covariance @ self.pull)
        telling = size > _UNOBSERVED * np.diagonal(axes.T @ prior @ axes)
        score = (axes.T @ score)[telling] / np.sqrt(size[telling])
        root = axes[:, telling] * np.sqrt(size[telling])
        known_share, turn = np.linalg.eigh(root.T @ covariance @ root / factor)
        squared = (turn.T @ score) ** 2 / (1.0 + known_share)
        likely = chi_square_quantile(1.0 - _KNOCK_PROBABILITY, len(score))
        unlikely = bool(squared.sum() / factor > likely)
        noisy = known_share < 1.0  # elsewhere it is the prior that is judged
        counted = dataclasses.replace(
            self,
            misfit=self.misfit + float(squared[noisy].sum()),
            freedom=self.freedom + float(np.count_nonzero(noisy)),
        )
        return unlikely, counted

    def after(self, of: RigUnknowns, evidence: RigEvidence) -> RigFilter:
        """With the evidence of a window, and the size of the field as known then."""
        factor = self.noise_factor(of)
        added = dataclasses.replace(
            self.adding(evidence.information / factor, evidence.pull / factor),
            shaken=self.shaken + evidence.shaken,
            frames=self.frames + evidence.frames,
        )
        return dataclasses.replace(added, field_px=added._size_of_field(of))

    def _size_of_field(self, of: RigUnknowns) -> float:
        """Deviation of the modes under which the windows are likeliest (MacKay 2003, ch. 28)."""
        variance = FIELD_PX**2
        for _ in range(_FIELD_STEPS):
            covariance = np.linalg.inv(self.information + of.prior(np.sqrt(variance)))
            modes = (covariance @ self.pull)[-of.modes :]
            shown = of.modes - np.diagonal(covariance)[-of.modes :].sum() / variance
            found = _TRUSTED_MODES * FIELD_PX**2 + modes @ modes
            variance = float(found / (_TRUSTED_MODES + shown))
        return float(np.sqrt(variance))

    def weighed(self, of: RigUnknowns) -> WeighedCorrection:
        """The correction and its mean over models, by their evidence; nuisances are free in all."""
        p, prior, precision = of.terms, of.prior(self.field_px), self.precision(of)
        covariance = np.asarray(np.linalg.inv(precision))
        values = covariance @ self.pull
        means, evidence = [], []
        for free in of.models().values():
            inner = np.ix_(free, free)
            mean = np.zeros(of.size)
            mean[free] = np.linalg.solve(precision[inner], self.pull[free])
            gain = np.linalg.slogdet(precision[inner])[1] - np.linalg.slogdet(prior[inner])[1]
            means.append(mean[:p])
            evidence.append(0.5 * (self.pull @ mean - gain))
        weight = np.exp(np.array(evidence) - max(evidence))
        weight /= weight.sum()
        known = RigCorrection(of.rig, values[:p], covariance[:p, :p], self.field_px)
        return WeighedCorrection(
            known,
            dataclasses.replace(known, values=weight @ np.array(means)),
            dict(zip(of.models(), weight.tolist(), strict=True)),
        )


# --------------------------------------------------------------------------------------------
# How much of the estimate is accepted: models of what is wrong with a rig, weighed.
#
# A correction of many values always fits a little better than none. Each model frees some terms and
# holds the others at zero; its evidence charges it for what it frees (MacKay 2003, ch. 28). All are
# equally likely before the drive. An exact rig is thereby left alone, without a threshold.


MODELS: dict[str, tuple[str, ...]] = {
    "exact": (),
    "displaced": BASELINE_TERMS,
    "bent": ("yaw", "pitch"),
    "turned": ("yaw", "pitch", "roll", "focal"),
    "whole": TERMS,
}
"""Terms of the cameras that are free, by name of the model."""


@dataclass(frozen=True, slots=True, eq=False)
class WeighedCorrection:
    """An estimate, and what of it is worth applying.

    Attributes:
        estimated: with all terms free; its sigmas are the honest ones.
        applied: what is taken off the next frames: the mean over models, or an older one that lies
            within the noise of it.
        probabilities: of each model.
    """

    estimated: RigCorrection
    applied: RigCorrection
    probabilities: dict[str, float]

    def applying(self, values: FloatArray) -> WeighedCorrection:
        """The same with another correction applied (p,)."""
        applied = dataclasses.replace(self.applied, values=values)
        return dataclasses.replace(self, applied=applied)


# --------------------------------------------------------------------------------------------
# The evidence of a few frames: their poses, shakes and points are eliminated.
#
# Bundle adjustment of one short window with errors in all images at both ends of every track. The
# residuals are linear in the unknowns of the rig; poses and points are minimised over, and by how
# much each frame's images are shifted against each other; then these are eliminated by Schur
# complements (Triggs et al. 2000, Bundle adjustment, 6.1).


_KERNEL_WIDTH = 2.0  # of Cauchy's kernel, standard deviations, as the ego-motion's
_GROSS = 50.0  # standard deviations: no error of a point seen once, but another point
_SCENE = 4.0
"""Times the least spread of a window: errors twice as large are the scene's. A blurred image has
ten to eighty times that, and is so much less evidence; else the rig would seem knocked. On
recordings that it was not chosen on sound windows have 2.8 at most, blurred ones 9 to 25."""
_LANDMARKS = 300  # of a window: all that a street shows, 500, make it surer by a tenth
_CELLS = np.array([8, 6])  # of the image, across and down, over which they are spread
_DAMPING = 1e-6
_NEAREST_M = 1e-2
_LEAST_DISPARITY_PX = 0.5


_SHAKEN = [TERMS.index(name) for name in ("column", "row", "roll", "focal")]
"""Of each other camera, from frame to frame; the second one's size is learnt, and is all of theirs:
rows show it without motion."""
_ROW = 1


@dataclass(frozen=True, slots=True, eq=False)
class RigEvidence:
    """Quadratic cost of a rig's unknowns: half its Hessian, and minus half its gradient at zero.

    Attributes:
        information: (n, n), poses, shakes and points eliminated.
        pull: (n,) ``information @ best``, where this window alone would go.
        shaken: squared shifts of the frames' rows, added up, as expected: radians^2.
        frames: how many they are.
        spread: median of the squared residuals, in stated variances.
        moves: (6, p) by which a unit of each term moves the last pose, per frame of the window.
    """

    information: FloatArray
    pull: FloatArray
    shaken: float
    frames: int
    spread: float = 0.0
    moves: FloatArray = field(default_factory=lambda: np.zeros((6, 0)))


@dataclass(slots=True, eq=False)
class _State:
    poses: FloatArray
    shakes: FloatArray
    points: FloatArray
    rig: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Prediction:
    """What is measured at a state.

    Attributes:
        local: (m, 3) points in the cameras that see them.
        residual: (m, 2 * cameras) predicted less raw pixels, whitened: of one sigma, independent.
        unit: (m, 2 * cameras, n) displacements of the predicted pixels.
        shaken: (m, 2 * cameras, q) the same by a unit of each of their frame's shakes.
    """

    state: _State
    local: FloatArray
    residual: FloatArray
    unit: FloatArray
    shaken: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations with the points eliminated: frames, but for the first pose; then the rig."""

    hessian: FloatArray
    gradient: FloatArray
    point_inverse: FloatArray
    coupling: FloatArray
    point_gradient: FloatArray


class RigAlignment:
    """One window of frames: a list of observations, by landmark and then by frame."""

    def __init__(
        self,
        of: RigUnknowns,
        frames: Sequence[tuple[FloatArray, Observations]],
        pixel_sigma: float,
        shake: float,
        quietest: float,
    ) -> None:
        """Frames are (wTc, what the ego-motion accepted), in order of time.

        ``shake``: deviation of a frame's shifts, radians. ``quietest``: least spread of a window
        before, in stated variances.
        """
        self._quietest = quietest
        self._of, self._rig, self._sigma, self._shake = of, of.rig, pixel_sigma, shake
        rig = of.rig
        self._shaken = [k * len(TERMS) + term for k in range(rig.cameras - 1) for term in _SHAKEN]
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

    def evidence(self, known: FloatArray, precision: FloatArray) -> RigEvidence | None:
        """The window's evidence on the rig; None where it shows too little.

        Args:
            known: (n,) of the rig so far; the adjustment starts and is held there.
            precision: (n, n) of that.
        """
        state = self._start(known)
        if state is None:
            return None
        cost, moved = self._cost(state, known, precision), self._step(state, known, precision)
        if moved is None:
            return None
        state = moved if self._cost(moved, known, precision) <= cost else state
        normal, n = self._normal(self._predicted(state)), len(known)
        hessian, mixed = normal.hessian[:-n, :-n], normal.hessian[:-n, -n:]
        whole = normal.hessian.copy()
        whole[-n:, -n:] += precision
        try:
            gain = np.linalg.solve(hessian, np.column_stack([mixed, normal.gradient[:-n]]))
            spread = np.linalg.inv(whole)
        except np.linalg.LinAlgError:
            return None
        information = normal.hessian[-n:, -n:] - mixed.T @ gain[:, :-1]
        information = (information + information.T) / 2.0
        score = -(normal.gradient[-n:] - mixed.T @ gain[:, -1])
        pull = score + information @ state.rig
        own = 6 + state.shakes.shape[1]
        rows = np.arange(6 + _ROW, own, len(_SHAKEN))
        at = own * np.arange(len(self._poses))[:, None] + rows
        shifts = state.shakes[:, rows - 6] ** 2 + np.diagonal(spread)[at - 6]
        squared = float(np.median((self._predicted(state).residual ** 2).sum(axis=1)))
        noise = squared / self._quietest
        noise = noise if noise > _SCENE else 1.0
        shaken = float(shifts.sum())
        moves = -gain[-own : 6 - own, : self._of.terms] / (len(self._poses) - 1)
        return RigEvidence(information / noise, pull / noise, shaken, shifts.size, squared, moves)

    # ----------------------------------------------------------------------------------------

    def _keep(self, which: BoolArray) -> None:
        """Drops the other observations, and landmarks of which less than two are left."""
        landmark = self._landmark[which]
        _, at, count = np.unique(landmark, return_inverse=True, return_counts=True)
        often = count[at] >= 2
        self._landmark = np.unique(landmark[often], return_inverse=True)[1]
        self._frame, self._pixels = self._frame[which][often], self._pixels[which][often]
        self._first = np.flatnonzero(np.diff(self._landmark, prepend=-1))

    def _keep_some(self) -> None:
        """Drops landmarks where there are many: in each cell of the image those seen least."""
        size = [self._rig.width, self._rig.height]
        at = np.clip(self._pixels[self._first, 0] * _CELLS // size, 0, _CELLS - 1)
        seldom, cell = -np.bincount(self._landmark), at @ [_CELLS[1], 1.0]
        order = np.lexsort((seldom, cell))
        rank = np.arange(len(cell)) - np.searchsorted(cell[order], cell[order])
        kept = order[np.lexsort((seldom[order], rank))][:_LANDMARKS]
        self._keep(np.isin(self._landmark, kept))

    def _start(self, rig: FloatArray) -> _State | None:
        """Points from their first sighting; landmarks that fit none of it are left out."""
        self._keep_some()
        pixels = self._pixels[self._first]
        moved = self._of.displacements(pixels) @ rig
        measured = (pixels.reshape(moved.shape) - moved) @ rig_map(self._rig).T
        near = measured[:, 2] > _LEAST_DISPARITY_PX
        if not near.any():
            return None
        self._keep(near[self._landmark])
        local = self._rig.triangulate(measured[near])
        turn, place = self._poses[:, :3, :3], self._poses[:, :3, 3]
        at = self._frame[self._first]
        points = np.einsum("lij,lj->li", turn[at], local) + place[at]
        still = np.zeros((len(self._poses), len(self._shaken)))
        found = self._predicted(_State(self._poses, still, points, rig))
        wild = (np.abs(found.residual).max(axis=1) > _GROSS) | (found.local[:, 2] < _NEAREST_M)
        usable = ~np.logical_or.reduceat(wild, self._first)
        self._keep(usable[self._landmark])
        if usable.sum() < self._of.terms:
            return None
        return _State(self._poses, still, points[usable], rig)

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
        exact = self._rig.predict(safe) @ self._model.T
        pixels = exact.reshape(-1, self._rig.cameras, 2)
        unit = self._of.displacements(pixels)
        shaken = unit[:, :, self._shaken]
        moved = unit @ state.rig + (shaken @ state.shakes[self._frame, :, None])[..., 0]
        residual = (exact + moved - self._pixels.reshape(moved.shape)) @ self._white.T / self._sigma
        self._last = _Prediction(state, local, residual, unit, shaken)
        return self._last

    def _cost(self, state: _State, around: FloatArray, prior: FloatArray) -> float:
        found = self._predicted(state)
        if (found.local[:, 2] < _NEAREST_M).any():
            return np.inf
        off = state.rig - around
        squared = (found.residual**2).sum(axis=1) / _KERNEL_WIDTH**2
        shaken = float((state.shakes**2).sum()) / self._shake**2
        return float(_KERNEL_WIDTH**2 * np.log1p(squared).sum() + shaken + off @ prior @ off)

    def _normal(self, found: _Prediction) -> _Normal:
        state, local, residual = found.state, found.local, found.residual
        squared = (residual**2).sum(axis=1)
        root = 1.0 / (self._sigma * np.sqrt(1.0 + squared / _KERNEL_WIDTH**2))[:, None, None]
        by_local = root * (self._white @ self._model @ self._rig.jacobian(local))
        by_pose = by_local @ point_pose_jacobian(local)
        by_point = by_local @ np.swapaxes(state.poses[:, :3, :3], 1, 2)[self._frame]
        of_pixels = np.concatenate([found.shaken, found.unit], axis=2)
        of_pixels = root * np.einsum("ab,mbn->man", self._white, of_pixels)
        joint = np.concatenate([by_pose, of_pixels], axis=2)
        weighted = self._sigma * root[..., 0] * residual
        hessian, gradient = self._of_frames(state, joint, weighted)
        point_left = np.swapaxes(by_point, 1, 2)
        curvature = np.add.reduceat(point_left @ by_point, self._first)
        curvature += 1e-9 * np.trace(curvature, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        pull = np.add.reduceat((point_left @ weighted[:, :, None])[..., 0], self._first)
        coupling, inverse = self._coupling(point_left @ joint), np.linalg.inv(curvature)
        eliminated, flat = (of.reshape(-1, len(gradient)) for of in (inverse @ coupling, coupling))
        hessian -= eliminated.T @ flat
        gradient = gradient - pull.ravel() @ eliminated
        return _Normal(hessian, gradient, inverse, coupling, pull)

    def _of_frames(
        self, state: _State, joint: FloatArray, weighted: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Joint Hessian and gradient before points are eliminated; the first pose is held."""
        frames, own = len(self._poses), 6 + len(self._shaken)
        size, rig = frames * own, frames * own + np.arange(self._of.size)
        hessian, out = np.zeros((size + len(rig),) * 2), np.zeros(size + len(rig))
        for k in range(frames):
            at = np.append(np.arange(k * own, k * own + own), rig)
            seen = self._frame == k
            jacobian = joint[seen].reshape(-1, len(at))
            hessian[np.ix_(at, at)] += jacobian.T @ jacobian
            out[at] += jacobian.T @ weighted[seen].ravel()
            shakes = at[6:own]
            hessian[shakes, shakes] += 1.0 / self._shake**2
            out[shakes] += state.shakes[k] / self._shake**2
        return hessian[6:, 6:], out[6:]

    def _coupling(self, crossing: FloatArray) -> FloatArray:
        """Points against frames and rig (l, 3, n), from observations (m, 3, q + n)."""
        landmarks, frames, own = len(self._first), len(self._poses), 6 + len(self._shaken)
        of_frames = np.zeros((landmarks, 3, frames, own))
        of_frames[self._landmark, :, self._frame] = crossing[..., :own]
        rig = np.add.reduceat(crossing[..., own:], self._first)
        return np.concatenate([of_frames.reshape(landmarks, 3, -1)[..., 6:], rig], axis=2)

    def _step(self, state: _State, around: FloatArray, prior: FloatArray) -> _State | None:
        """After a step of Gauss and Newton; another one changes a tenth of a sigma."""
        normal, p = self._normal(self._predicted(state)), len(around)
        hessian, gradient = normal.hessian, normal.gradient
        hessian[-p:, -p:] += prior
        gradient[-p:] += prior @ (state.rig - around)
        hessian.flat[:: len(hessian) + 1] *= 1.0 + _DAMPING
        try:
            step = np.asarray(-np.linalg.solve(hessian, gradient), np.float64)
        except np.linalg.LinAlgError:
            return None
        pull = normal.point_gradient + normal.coupling @ step
        points = state.points - np.einsum("lij,lj->li", normal.point_inverse, pull)
        moves = np.append(np.zeros(6), step[:-p]).reshape(len(state.poses), -1)
        poses = [moved_apart(T, xi[:6]) for T, xi in zip(state.poses, moves, strict=True)]
        return _State(np.stack(poses), state.shakes + moves[:, 6:], points, state.rig + step[-p:])


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
        since: first frame whose measurements change.
    """

    rig: CameraRig
    values: FloatArray
    since: int = 0

    def measured(self, measurement: FloatArray) -> FloatArray:
        """Measurements (k, 3) (column, row, disparity) of all images, by the new correction."""
        ratio, cameras = vertical_to_horizontal(self.rig), self.rig.cameras
        pixels = measurement @ pixel_model(cameras, ratio).T
        moved = displacements(self.rig, pixels.reshape(-1, cameras, 2)) @ self.values
        return np.asarray(measurement - moved @ rig_map(self.rig).T)

    def moved(self, poses: FloatArray, positions: FloatArray) -> FloatArray:
        """Landmarks (k, 3) in the world, each measured again from a pose (k, 4, 4) that saw it.

        One that its pose does not see is where it was.
        """
        turn, place = poses[:, :3, :3], poses[:, :3, 3]
        local = np.einsum("kji,kj->ki", turn, positions - place)
        ahead = in_front(local)
        before = self.rig.predict(np.where(ahead[:, None], local, [0.0, 0.0, 1.0]))
        after = self.measured(before)
        size = np.array([self.rig.width, self.rig.height])
        seen = ahead & ((before[:, :2] >= 0.0) & (before[:, :2] < size)).all(axis=1)
        seen &= after[:, 2] > _LEAST_SHARE * before[:, 2]
        again = self.rig.triangulate(np.where(seen[:, None], after, before))
        again = np.einsum("kij,kj->ki", turn, again) + place
        return np.where(seen[:, None], again, positions)
