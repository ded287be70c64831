"""The final solution of a graph: what does not fit is left out, the rest solved once more.

Wrong matches go by a kernel and then a trim, or by graduated non-convexity. Either way the last
solution is plain least squares over the observations that fit, so that its covariances mean what
they say. Neither the builder nor the solver that it starts from is changed, so that asking for an
estimate in the middle of a run leaves the run as it was.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, TypeAlias

import gtsam
import numpy as np
from scipy.linalg import block_diag

from fgslam.backend.considered import fused, pixels_of, rates_of, read_late, shared_covariance
from fgslam.backend.loops import Chain, Constraint, constraint_factor, refusal
from fgslam.backend.measured import nuisance_words
from fgslam.backend.open_tracks import ENDED_AFTER, LEAST_SIGHTINGS, LONGEST, Tracks, tracks_of
from fgslam.backend.persistence import STATED, Fitted
from fgslam.backend.self_calibration import RigChange
from fgslam.backend.settings import KernelSettings
from fgslam.backend.smoothers.bundle import Descent, State, WholeGraph
from fgslam.backend.smoothers.elimination import Bordered, SolvedSystem, reduced
from fgslam.backend.smoothers.graph import (
    GraphBuilder,
    Smoothed,
    Solution,
    allowed_parts,
    first_guess,
    found_again,
    misfit,
    solved,
    solver_failed,
)
from fgslam.core.arrays import BoolArray, FloatArray, IntArray, chi_square_quantile
from fgslam.core.correction import (
    RigCorrection,
    displacements,
    field_displacements,
    field_modes,
    prior_information,
    shared_displacements,
)
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import inverse, motion_covariance, reorthonormalise
from fgslam.core.sensors import CameraRig
from fgslam.core.threads import one_blas_thread
from fgslam.core.types import LAGS, Floor, GyroscopeBias, Prediction
from fgslam.factors.graphs import number, poses_of_frame

# ------------------------------------------------------------------------------------------
# What the uncertainty of a rig's calibration adds to the covariances of a solved graph


def with_uncertain_rig(found: Refined, rig: RigCorrection) -> Bordered:
    """Marginals of a solved graph, with the uncertainty of its rig.

    Its border are the correction's terms, those that all cameras share, the field's modes, and the
    read-out of a rig whose rows are not of one moment: by how much that is still to be changed.

    Args:
        found: the graph at its minimum.
        rig: with the correction that was applied to it.

    Raises:
        EstimatorError: the measurements do not determine all variables.
    """
    graph, state, late = found.graph, found.state, late_rows(found)
    held = reduced(graph.linear(state))
    prior, shared = prior_information(rig.rig), shared_covariance(rig)
    modes = field_modes(rig.rig) if rig.field_px and not rig.rig.exact else 0
    p, count = len(prior), len(prior) + len(shared) + modes

    def moved(rows: IntArray) -> FloatArray:
        of_terms = shifts(rig.rig, graph.seen.measured[rows], modes > 0)[..., :count]
        return np.concatenate([of_terms, late[rows]], axis=2)

    pull, own = graph.pulled(state, moved)
    gain = held.solve(pull)
    information = own + pull.T @ gain[: len(pull)]
    # The read-out is estimated as if all else were as stated, and so follows what is not.
    known = np.eye(late.shape[2]) / rig.rig.readout_s**2
    read = np.asarray(np.linalg.inv(information[count:, count:] + known), np.float64)
    follows = -read @ information[count:, :count]
    information = information[:count, :count] + information[:count, count:] @ follows
    correction = rig.covariance
    if not rig.rig.stated:  # it is known by what the drive has shown
        of_terms = information[:p, :p] + prior
        correction = np.asarray(np.linalg.inv(0.5 * (of_terms + of_terms.T)), np.float64)
        # What was applied leant with the field, too: as much, but by other frames, as a graph's.
        lean = rig.field_px * correction @ information[:p, p + len(shared) :]
        correction = correction + lean @ lean.T
    covariance = np.asarray(block_diag(correction, shared, rig.field_px**2 * np.eye(modes)))
    joint = np.vstack([np.eye(count), follows])
    covariance = joint @ covariance @ joint.T + block_diag(0.0 * covariance, read)
    change = np.zeros(len(covariance))
    if len(found.read_s):
        whitened = graph.weights[:, None] * graph.seen.look(state.poses, state.points).residual
        slope = np.einsum("ki,kij,kjr->r", whitened, graph.seen.roots, late) + known @ found.read_s
        change[count:] = read @ slope
    return Bordered(held, gain, covariance, change)


def late_rows(found: Refined) -> FloatArray:
    """(k, 3, 1) by which a second from first to last row displaces what a graph has measured.

    (k, 3, 0) where all rows are of one moment.
    """
    seen, state = found.graph.seen, found.state
    if not len(found.read_s):
        return np.empty((len(seen), 3, 0))
    look = seen.look(state.poses, state.points)
    by_pose = np.asarray(np.linalg.solve(seen.roots, look.by_pose), np.float64)
    rates = rates_of(found.stamps, state.poses)[seen.poses]
    return read_late(seen.model, seen.measured, by_pose, rates)


def of_one_moment(found: Refined) -> Refined:
    """A solved graph with measurements as if all rows were of one moment, by its own poses."""
    try:
        marginals = found.marginals
    except EstimatorError:
        return found
    if not isinstance(marginals, Bordered):
        return found
    seen, more = found.graph.seen, marginals.moved[-1:]
    seen = dataclasses.replace(seen, measured=seen.measured + late_rows(found) @ more)
    graph = dataclasses.replace(found.graph, seen=seen)
    return dataclasses.replace(found, graph=graph, read_s=found.read_s - more)


def shifts(rig: CameraRig, measured: FloatArray, field: bool = False) -> FloatArray:
    """(k, 3, p + q) by which a unit of each term displaces measurements (k, 3): TERMS, SHARED.

    Then, with ``field``, by its modes.
    """
    pixels = pixels_of(rig, measured)
    of_pixels = [displacements(rig, pixels), shared_displacements(rig, pixels)]
    if field:
        of_pixels.append(field_displacements(rig, pixels))
    return fused(rig, np.concatenate(of_pixels, axis=2))


# ------------------------------------------------------------------------------------------
# Noise of measurements along a graph's solved poses


def power_ratio(graph: WholeGraph, state: State) -> float:
    """By how much tracks lean at a solution, over what the graph takes them to: a variance.

    Tracks are as :class:`~fgslam.backend.persistence.Persistence` judges them.
    """
    frame_of = np.array([number(key) for key in graph.pose_keys])
    order, tracks = _in_tracks(graph.seen.points, frame_of[graph.seen.poses], graph.weights > 0.0)
    if not len(order):
        return 1.0
    look = graph.seen.look(state.poses, state.points)
    fitted = Fitted.of(tracks, look.residual[order], look.by_point[order])
    if fitted is None:
        return 1.0
    sums = STATED[1] + fitted.powers()[1]
    return float(sums[0] / sums[1])


def _in_tracks(points: IntArray, frames: IntArray, counts: BoolArray) -> tuple[IntArray, Tracks]:
    """Rows (n,) of the sightings (k,) that count, by landmark and frame, and their tracks."""
    order = np.flatnonzero(counts)
    order = order[np.lexsort((frames[order], points[order]))]
    begins = np.ones(len(order), np.bool_)
    begins[1:] = (np.diff(points[order]) != 0) | (np.diff(frames[order]) > ENDED_AFTER)
    first = np.flatnonzero(begins)
    since = np.arange(len(order)) - np.repeat(first, np.diff(np.append(first, len(order))))
    first = np.flatnonzero(since % LONGEST == 0)
    sightings = np.diff(np.append(first, len(order)))
    long = sightings >= LEAST_SIGHTINGS
    return order[np.repeat(long, sightings)], tracks_of(sightings[long])


_GATE = float(chi_square_quantile(0.999, 3))  # 16.3, of a landmark observation's three numbers
_AGREES = chi_square_quantile(0.99, 6)  # 16.8: a loop that the graph meets as it is
_BEYOND = (4.0 / 1.538) ** 2
"""Variance over the stated one from which on most matches lie beyond the four stated deviations
within which ego-motion takes them (1.538 is the median length of three normal numbers)."""
_KEPT = 0.5  # weights end at 0 or 1
_ROUNDS = 20  # trims until the observations that fit do not change any more
_ROUGH = 1e-2  # of the cost: the minimum with the kernel only shows roughly what fits
_CONTROL_GROWS, _CONTROL_ENDS = 1.4, 1e6  # Yang et al.; with the latter all weights are 0 or 1
_NEAR_BEGINS, _NEAR_GROWS, _NEAR_ENDS = 0.3, 4.0, 20.0
"""From a robust solution the convex beginning is left out and the rest taken in larger steps: at
first what fits by half the gate's width counts in full, and nothing beyond twice of it."""
_DECIDED = 1e-4
_LEAST = 1e-12
_READINGS = 4  # of the rows' time: each from where the last has poses
_SOLUTIONS = 5  # solutions until no landmark lies behind a camera any more
_BEHIND = "came out behind a camera"
_UNSEEN = "has no observation that fits the others"

Minimum: TypeAlias = Callable[[WholeGraph, State], State]
Minimise: TypeAlias = Callable[[WholeGraph, State], tuple[State, WholeGraph]]
"""From a graph and initial values to those at the minimum and the factors that count there."""


ITERATIONS = 100  # a bound, for graphs that do not settle
TOLERANCE = 1e-9  # of the cost: the estimate then moves by less than a micrometre


def graduated(
    graph: WholeGraph, state: State, noise_factor: float = 1.0
) -> tuple[State, WholeGraph]:
    """Graduated non-convexity (Yang et al. 2020, eqs. 12 to 14) with truncated least squares.

    Landmark observations are the possible outliers.

    Args:
        graph: factors without kernels.
        state: initial values.
        noise_factor: by which the factors' deviations exceed the stated ones.

    Returns:
        Values at the minimum, and the graph without the observations that were rejected.
    """
    gate = _GATE / noise_factor**2
    state = graph.minimum(state, ITERATIONS, _ROUGH)
    ratio = graph.squared(state) / gate
    worst = 2.0 * float(ratio.max(initial=0.0)) - 1.0
    control = 1.0 / worst if worst > 0.0 else np.inf
    weights = np.ones(len(ratio))
    while worst > 0.0 and control < _CONTROL_ENDS:
        weights = truncated_weights(graph.squared(state) / gate, control)
        state = graph.weighed(weights).minimum(state, 1, TOLERANCE)
        if np.minimum(weights, 1.0 - weights).max() < _DECIDED:
            break
        control *= _CONTROL_GROWS
    kept = graph.weighed(weights > _KEPT)
    return kept.minimum(state, ITERATIONS, TOLERANCE), kept


def truncated_weights(ratio: FloatArray, control: float) -> FloatArray:
    """Weights (k,) of squared residuals over the gate's square (k,): Yang et al., eq. 14."""
    middle = np.sqrt(control * (control + 1.0) / np.maximum(ratio, _LEAST)) - control
    return np.asarray(np.clip(middle, 0.0, 1.0))


def trimmed(graph: WholeGraph, state: State, noise_factor: float = 1.0) -> tuple[State, WholeGraph]:
    """Minimises roughly with the graph's own kernel, then without it over what fits.

    In between the weights go from the kernel's to 0 and 1 by the last part of the graduation: cut
    at once, what the kernel has let go a little too far would stay out. The sum of squares, each at
    most the gate's, ends lower than after a cut at a closely followed minimum with the kernel, in
    a third of the steps (docs/derivations/smoothers.md). Loops keep their kernels: they are too few
    to be separated by a trim.

    Args:
        graph: factors, landmark observations with a kernel.
        state: initial values.
        noise_factor: by which the factors' deviations exceed the stated ones, which judge.

    Returns:
        Values at the minimum, and the plain factors that were kept.
    """
    gate, descent = _GATE / noise_factor**2, Descent()
    if graph.weights.all():  # else it is known already what fits, but for a few
        state = graph.minimum(state, ITERATIONS, _ROUGH, descent=descent)
        control = _NEAR_BEGINS
        while control < _NEAR_ENDS:
            weights = truncated_weights(graph.squared(state) / gate, control)
            weighed = graph.weighed(weights)
            state = weighed.minimum(state, 1, TOLERANCE, descent=descent)
            control *= _NEAR_GROWS
    return _settled(graph, state, gate, descent)


def _settled(
    graph: WholeGraph, state: State, gate: float, descent: Descent
) -> tuple[State, WholeGraph]:
    """The minimum over what fits there: chosen and solved for by turns, until that is the same."""
    fits, kept = graph.weights > 0.0, graph.weighed(graph.weights)
    for _ in range(_ROUNDS):
        before, fits = fits, graph.squared(state) <= gate
        if (fits == before).all():
            break
        kept = graph.weighed(fits)
        state = kept.minimum(state, 1, TOLERANCE, descent=descent)
    return kept.minimum(state, ITERATIONS, TOLERANCE, descent=descent), kept


@dataclass(frozen=True, eq=False)
class Refined:
    """A solved graph.

    Attributes:
        graph: the factors that count.
        state: of all variables that are left.
        remarks: what was left out, in words.
        uncertain_rig: what was applied last to a rig that calibrates itself; None for a known one.
        stamps: (n,) of the graph's poses, seconds.
        read_s: (1,) seconds from an image's first row to its last, which measurements are corrected
            for; (0,) where all rows are of one moment.
        noise_ratio: variance of the measurements over what the builder takes it to be.
    """

    graph: WholeGraph
    state: State
    remarks: tuple[str, ...] = ()
    uncertain_rig: RigCorrection | None = None
    stamps: FloatArray = field(default_factory=lambda: np.empty(0))
    read_s: FloatArray = field(default_factory=lambda: np.empty(0))
    noise_ratio: float = 1.0

    @property
    def variables(self) -> list[int]:
        """Landmark variables that are left, ascending."""
        return [number(key) for key in self.graph.landmark_keys]

    @property
    def values(self) -> Any:
        """GTSAM values of all variables."""
        return self.graph.values(self.state)

    def points(self) -> dict[int, FloatArray]:
        """Positions (3,) of the landmark variables."""
        return dict(zip(self.variables, self.state.points, strict=True))

    def poses(self) -> FloatArray:
        """(n, 4, 4) by frame, up to the last; NaN for those that are no variables."""
        frames = [number(key) for key in self.graph.pose_keys]
        out = np.full((frames[-1] + 1, 4, 4), np.nan)
        out[frames] = self.state.poses
        return out

    @cached_property
    def marginals(self) -> SolvedSystem:
        """Of all variables.

        Raises:
            EstimatorError: the measurements do not determine all variables.
        """
        if self.uncertain_rig is not None and len(self.graph.seen):
            return with_uncertain_rig(self, self.uncertain_rig)
        return reduced(self.graph.linear(self.state))

    @property
    def gyroscope(self) -> GyroscopeBias | None:
        """Its bias at the end; None where it is no variable, raises as :meth:`marginals`."""
        found = self.marginals
        if self.graph.rest.turns is None or not isinstance(found, Bordered):
            return None
        last = slice(len(self.graph.rest.turns.known) - 3, len(self.graph.rest.turns.known))
        return GyroscopeBias(self.state.bias[last], found.estimated[last, last])

    @property
    def nuisance(self) -> dict[str, FloatArray]:
        """Nuisance parameters (3,) of each kind of measurement that has any."""
        found = self.graph.rest.nuisances(self.state.bias)
        return {one.model.kind: values for one, known, values in found if len(known)}


def refine(builder: GraphBuilder, values: Any, minimise: Minimise) -> Refined:
    """Solves; where poses were tracked by the fewer matches, weighs these by what they err now.

    Not where only key frames are variables, whose tracks were judged in all frames.
    The observations alone are weighed again: guessed steps and the translations of a gyroscope's
    keep the noise of the way, and which landmarks lie behind a camera is not asked again.
    """
    graph, state = builder.whole_graph(values)
    rig, stamps = builder.uncertain_rig, np.array(builder.stamps)[builder.frames]
    rolls = int(rig is not None and rig.rig.readout_s > 0.0)
    found = _solved(builder, Refined(graph, state, (), rig, stamps, np.zeros(rolls)), minimise)
    for _ in range(_READINGS * rolls):
        found = _solved(builder, of_one_moment(found), minimise)
    if builder.noise.spread < _BEYOND or len(builder.frames) <= builder.frames[-1]:
        return found
    ratio = power_ratio(found.graph, found.state)
    weighed = dataclasses.replace(found.graph, weights=found.graph.weights / ratio)
    state = weighed.minimum(found.state, ITERATIONS, TOLERANCE)
    return dataclasses.replace(found, graph=weighed, state=state, noise_ratio=ratio)


def _solved(builder: GraphBuilder, found: Refined, minimise: Minimise) -> Refined:
    """Without landmarks that come out behind a camera or that nothing supports."""
    graph, state, remarks = found.graph, found.state, list(found.remarks)
    for _ in range(_SOLUTIONS):
        state, kept = minimise(graph, state)
        found = dataclasses.replace(found, graph=kept, state=state, remarks=tuple(remarks))
        lost = lost_landmarks(builder, found)
        if not lost:
            return found
        remarks += [f"{builder.describe(v)} {why}: left out" for v, why in lost.items()]
        rows = np.searchsorted(found.variables, sorted(lost)).astype(np.int64)
        graph, state = kept.without(rows, state)
    state, kept = minimise(graph, state)
    return dataclasses.replace(found, graph=kept, state=state, remarks=tuple(remarks))


class WholeGraphSolver:
    """What solvers of a graph that keeps every pose share: loops, and the answer for the whole run.

    The answer is solved for once, until the graph changes.
    """

    kind: ClassVar[str]

    def __init__(
        self, builder: GraphBuilder, floor: Floor, kernel: KernelSettings | None = None
    ) -> None:
        """Nothing to solve yet; loops are judged with the builder's kernel or with another."""
        self.builder, self._floor = builder, floor
        self._kernel = kernel
        self.accepted: list[Constraint] = []
        self.values = gtsam.Values()
        self._answer: Refined | None = None
        self.remarks: list[str] = []

    def recalibrate(self, change: RigChange) -> None:
        """The next answer is that of the new measurements."""
        self._answer = None

    @one_blas_thread()
    def solution(self) -> Solution:
        """All poses and landmarks at the minimum over all that was measured, with marginals."""
        return solution(self.refined(), self.builder.frames, self._floor)

    def refined(self) -> Refined:
        """The graph's last solution."""
        if self._answer is None:
            try:
                self._answer = self.solve_whole()
            except RuntimeError as error:
                raise self._failed(error, "after") from None
        return self._answer

    def solve_whole(self) -> Refined:
        """The minimum of the whole graph from the values of now."""
        return refine(self.builder, self.values, self._minimise)

    def _minimise(self, graph: WholeGraph, state: State) -> tuple[State, WholeGraph]:
        """Values at the minimum, and the factors that count there."""
        return trimmed(graph, state, self.builder.noise_factor)

    @one_blas_thread()
    def _judge(
        self, known: Constraint, chain: Chain, wTc: FloatArray, what: str, minimum: Minimum
    ) -> tuple[bool, Any | None]:
        """Whether the measurements allow a loop closure, which is then a factor of the graph.

        One that the graph meets anyway is a factor more. Otherwise the graph is solved with it, and
        it is refused where that raises the cost by more than measurement noise explains: a true
        loop's rise is chi-square with six degrees of freedom, whatever the drift.

        Args:
            known: the loop, between two frames of the graph.
            chain: the drive's steps as tracked, without it.
            wTc: (4, 4) the present pose as tracked.
            what: begins the remark.
            minimum: gives the graph's minimum without the loop, from the values of now.

        Returns:
            True if it was accepted; all variables with the loop closed, None where nothing moved.
        """
        if misfit(constraint_factor(known), self.values) <= _AGREES:
            self.accept(known)
            self.remarks.append(f"{what}: as expected, nothing moved")
            return True, None
        graph, state = self.builder.whole_graph(self.values, self._kernel)
        state = minimum(graph, state)
        loops = [*self.accepted, known]
        guess = first_guess(self.builder, graph.values(state), chain, loops)
        closed = graph.plus(constraint_factor(known))
        solution = solved(closed, dataclasses.replace(State.of(guess), bias=state.bias))
        refused = refusal(what, 2.0 * (closed.cost(solution) - graph.cost(state)))
        competing = self._competing(closed.squared(solution))
        if refused and 0 < competing.sum() < known.matches:
            graph, closed = graph.masked(~competing), closed.masked(~competing)
            solution = solved(closed, solution)
            rise = 2.0 * (closed.cost(solution) - graph.cost(solved(graph, state)))
            refused = refusal(what, rise)
        if refused:
            self.remarks.append(refused)
            return False, None
        self.accept(known)
        found = closed.values(solution)
        here = poses_of_frame(found, known.after)[:3, 3]
        shift = float(np.linalg.norm(here - wTc[:3, 3]))
        self.remarks.append(f"{what}: the camera moved by {shift:.2f} m, the graph with it")
        return True, found

    def _competing(self, squared: FloatArray) -> BoolArray:
        """(k,) observations that claim another return than the loop's, by their residuals with it.

        A landmark long out of view was found again by its appearance and by where the drifted
        camera expected it. That is a loop closure, too, of a few matches, and false where the
        drift is large; so the larger number of matches decides between both.
        """
        gate = _GATE / self.builder.noise_factor**2
        frames, variables, *_ = self.builder.kept_observed()
        return found_again(frames, variables) & (squared > gate)

    def accept(self, known: Constraint) -> None:
        """Adds a loop to the graph; accepted now, it counts less when later ones contradict it."""
        known = dataclasses.replace(known, uncertain=True)
        self.builder.graph.add(constraint_factor(known))
        self.accepted.append(known)
        self._answer = None  # it may have been solved in this very frame, without the loop

    def _after_loop(self, covariance: FloatArray) -> Smoothed:
        """The values that a loop has moved, and the covariance (6, 6) of their last pose."""
        here = reorthonormalise(poses_of_frame(self.values, self.builder.frames[-1]))
        return Smoothed(self.values, Prediction(here, covariance), by_loop=True)

    def _failed(self, error: Exception, when: str = "at") -> Exception:
        return solver_failed(self.kind, error, self.builder.frames[-1], when)


def solution(refined: Refined, frames: list[int], floor: Floor) -> Solution:
    """Everything about frames of a solved graph and its landmark variables."""
    poses, points, variables = refined.poses(), refined.points(), refined.variables
    ratio = refined.noise_ratio
    kept = np.full((len(poses), 6, 6), np.nan)
    try:
        marginals = refined.marginals
        covariances = dict(zip(variables, marginals.landmarks(), strict=True))
        own = marginals.poses()
        kept[frames] = allowed_parts(floor, poses[frames], own)
        relative = relative_covariances(marginals, own, poses, frames, floor)
    except EstimatorError as error:
        missing = {v: np.full((3, 3), np.nan) for v in variables}
        remarks = (*refined.remarks, str(error))
        nuisance = refined.nuisance
        return Solution(poses, kept, points, missing, remarks, noise_ratio=ratio, nuisance=nuisance)
    bias, nuisance = refined.gyroscope, refined.nuisance
    remarks = refined.remarks if bias is None else (*refined.remarks, bias.words)
    if len(refined.read_s) and isinstance(marginals, Bordered):
        found = 1e3 * refined.read_s[0], 1e3 * np.sqrt(marginals.covariance[-1, -1])
        remarks = (*remarks, "rolling shutter: rows are read in {:.1f} +- {:.1f} ms".format(*found))
    if nuisance and isinstance(marginals, Bordered):
        spread = np.diagonal(marginals.estimated)[-3 * len(nuisance) :].reshape(-1, 3)
        for (kind, values), variances in zip(nuisance.items(), spread, strict=True):
            remarks = (*remarks, nuisance_words(kind, values, variances))
    return Solution(
        poses, kept, points, covariances, remarks, True, ratio, bias, relative, nuisance
    )


_MOTIONS = 50  # that are judged, evenly spread: each costs a solution of the graph
_AT_ONCE = 50_000  # blocks of covariances, 300 bytes each, that are solved for together


def relative_covariances(
    marginals: SolvedSystem, own: FloatArray, poses: FloatArray, frames: list[int], floor: Floor
) -> dict[int, FloatArray]:
    """Covariances of motions between poses, by :data:`~fgslam.core.types.LAGS`: (n - lag, 6, 6).

    NaN but of some, evenly spread, both ends of which are in the graph.

    Args:
        marginals: of the solved graph.
        own: (k, 6, 6) covariances of its poses.
        poses: (n, 4, 4) by frame.
        frames: (k) that the graph's poses are.
        floor: what it holds exactly is left out.
    """
    row_of = np.full(len(poses) + max(LAGS), -1)
    row_of[frames] = np.arange(len(frames))
    out = {lag: np.full((max(len(poses) - lag, 0), 6, 6), np.nan) for lag in LAGS}
    rows = np.unique(np.linspace(0, len(frames) - 1, _MOTIONS).astype(np.int64))
    for some in np.array_split(rows, len(rows) * len(frames) // _AT_ONCE + 1):
        columns = marginals.pose_columns(some).reshape(len(frames), 6, len(some), 6)
        for k, row in enumerate(some.tolist()):
            start, cross = frames[row], np.swapaxes(columns[:, :, k], 1, 2)
            for lag in LAGS:
                end, other = start + lag, row_of[start + lag]
                if other >= 0:
                    motion = inverse(poses[start]) @ poses[end]
                    found = motion_covariance(motion, own[row], own[other], cross[other])
                    out[lag][start] = floor.allowed_part(poses[end], found)
    return out


def lost_landmarks(builder: GraphBuilder, found: Refined) -> dict[int, str]:
    """Landmark variables behind a camera or without an observation that counts, and why."""
    behind = dict.fromkeys(builder.behind(found.poses(), found.points()), _BEHIND)
    variables = found.variables
    return behind | {variables[row]: _UNSEEN for row in found.graph.unseen().tolist()}
