"""Loops in a smoother's graph: a first guess that keeps every place as it is, then the solution.

The graph as solved before the loop and as it must be with it lie far apart. Linearised in between,
landmarks would fly and kernels drop what is right: so poses and landmarks are first brought to
where backward correction (:mod:`fgslam.backend.loops`) has them, each landmark
along with the frame that saw it first. There every observation fits as before, and what is left is
small.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeAlias

import gtsam
import numpy as np

from fgslam.backend.loops import (
    Chain,
    Constraint,
    changes,
    constraint_factor,
    corrected,
    refusal,
)
from fgslam.backend.settings import KernelSettings
from fgslam.backend.smoothers.graph_builder import GraphBuilder
from fgslam.backend.smoothers.solver import Drive
from fgslam.backend.smoothers.whole_graph import State, WholeGraph
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.estimates import EgoMotion, Prediction
from fgslam.core.geometry import adjoint, congruence, inverse, transform_to_world
from fgslam.core.measurements import LoopClosure
from fgslam.core.quantiles import chi_square_quantile
from fgslam.factors.graphs import landmark_key, pose_key, poses_of_frame

_AGREES = chi_square_quantile(0.99, 6)  # 16.8: a loop that the graph meets as it is
_OBSERVED = float(chi_square_quantile(0.999, 3))  # of an observation that fits
LONG_UNSEEN = 60  # frames, as the front-end's LoopGates.forgotten_after
_ITERATIONS = 20
_ENOUGH = 2.0  # the last iteration's gain, half squared deviations: far below the gate's square
_TOLERANCE = 1e-6  # of the cost, where that is small
_EXACT = 1e-4  # radians and metres: a pose that is given

Minimum: TypeAlias = Callable[[WholeGraph, State], State]


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class Acceptance:
    """What became of a loop closure in a graph that keeps every pose.

    Attributes:
        closed: it was accepted, and its factor is in the builder's graph.
        values: of all variables with the loop closed; None where nothing had to move.
        remark: in words.
    """

    closed: bool
    values: Any | None
    remark: str


class GraphLoops:
    """The loops of a graph that keeps every pose: which were accepted, and at what cost."""

    def __init__(self, builder: GraphBuilder, kernel: KernelSettings | None = None) -> None:
        """No loop yet; the kernel is that of the observations where the graph is solved."""
        self.builder, self._kernel = builder, kernel
        self.accepted: list[Constraint] = []

    def judge(
        self,
        known: Constraint,
        drive: Drive,
        values: Any,
        minimum: Minimum,
        what: str,
    ) -> Acceptance:
        """Whether the measurements allow a loop closure, which is then a factor of the graph.

        One that the graph meets anyway is a factor more. Otherwise the graph is solved with it, and
        it is refused where that raises the cost by more than measurement noise explains: a true
        loop's rise is chi-square with six degrees of freedom, whatever the drift.

        Args:
            known: the loop, between two frames of the graph.
            drive: as tracked, without it.
            values: of all variables, as they are now.
            minimum: gives the graph's minimum without the loop, from these values.
            what: begins the remark.
        """
        if misfit(constraint_factor(known), values) <= _AGREES:
            self.accept(known)
            return Acceptance(True, None, f"{what}: as expected, nothing moved")
        graph, state = self.builder.whole_graph(values, self._kernel)
        state = minimum(graph, state)
        loops = [*self.accepted, known]
        guess = first_guess(self.builder, graph.values(state), drive.chain, loops)
        closed = graph.plus(constraint_factor(known))
        solution = solved(closed, dataclasses.replace(State.of(guess), bias=state.bias))
        refused = refusal(what, 2.0 * (closed.cost(solution) - graph.cost(state)))
        competing = self._competing(closed.squared(solution))
        if refused and 0 < competing.sum() < known.matches:
            graph, closed = graph.heeding(~competing), closed.heeding(~competing)
            solution = solved(closed, solution)
            rise = 2.0 * (closed.cost(solution) - graph.cost(solved(graph, state)))
            refused = refusal(what, rise)
        if refused:
            return Acceptance(False, None, refused)
        self.accept(known)
        found = closed.values(solution)
        here = poses_of_frame(found, known.after)[:3, 3]
        shift = float(np.linalg.norm(here - drive.wTc[:3, 3]))
        remark = f"{what}: the camera moved by {shift:.2f} m, the graph with it"
        return Acceptance(True, found, remark)

    def _competing(self, squared: FloatArray) -> BoolArray:
        """(k,) observations that claim another return than the loop's, by their residuals with it.

        A landmark that was long out of view was found again by its looks and by where the drifted
        camera expected it. That is a loop closure, too, of a few matches, and false where the
        drift is large; so the larger number of matches says which of both is believed.
        """
        gate = _OBSERVED / self.builder.noise_factor**2
        frames, variables, *_ = self.builder.kept_observed()
        return found_again(frames, variables) & (squared > gate)

    def accept(self, known: Constraint) -> None:
        """Believed now, it is doubted when later ones contradict it."""
        known = dataclasses.replace(known, doubted=True)
        self.builder.add_factor(constraint_factor(known))
        self.accepted.append(known)

    def last_factor(self) -> Any:
        """The factor of the loop accepted last."""
        return constraint_factor(self.accepted[-1])


def found_again(frames: IntArray, variables: IntArray) -> BoolArray:
    """(k,) which observations, by frame and landmark, are of landmarks that were long unseen."""
    order = np.lexsort((frames, variables))
    same = np.diff(variables[order], prepend=-1) == 0
    returns = np.cumsum(same & (np.diff(frames[order], prepend=0) >= LONG_UNSEEN))
    starts = np.flatnonzero(~same)
    before = np.repeat(returns[starts], np.diff(np.append(starts, len(returns))))
    out = np.zeros(len(frames), np.bool_)
    out[order] = returns > before
    return out


def misfit(factor: Any, values: Any) -> float:
    """Squared residual of a factor, in its deviations."""
    return 2.0 * float(factor.error(values))


def carried_to(
    frame: int, loop: LoopClosure, tracked: Callable[[int], Prediction | EgoMotion], last: int
) -> Constraint:
    """The closure as one to a neighbour of the earlier frame, by how both were tracked.

    Args:
        frame: of the neighbour, tracked against the same map; may be the earlier frame itself.
        loop: the closure.
        tracked: gives a frame's pose as it was tracked.
        last: the present frame.
    """
    matches = len(loop.observations)
    if frame == loop.frame:
        return Constraint(frame, last, loop.oTc, loop.covariance, matches=matches)
    neighbour, earlier = tracked(frame), tracked(loop.frame)
    kTo = inverse(neighbour.wTc) @ earlier.wTc
    own = earlier.covariance + congruence(adjoint(inverse(kTo)), neighbour.covariance)
    covariance = loop.covariance + congruence(adjoint(inverse(loop.oTc)), own)
    return Constraint(frame, last, kTo @ loop.oTc, covariance, matches=matches)


def first_guess(builder: GraphBuilder, values: Any, chain: Chain, loops: list[Constraint]) -> Any:
    """Values of all variables with the last of ``loops`` closed, each place moved as a whole.

    Args:
        builder: the graph so far.
        values: its solution without that loop.
        chain: the drive as tracked, for the uncertainty of its steps and for what ties it.
        loops: all that are closed; those before the last are held as the values have them.
    """
    frames = np.array(builder.frames)
    poses = np.array([poses_of_frame(values, frame) for frame in builder.frames])
    ends = [_row(frames, loops[-1].before), _row(frames, loops[-1].after)]
    new = dataclasses.replace(loops[-1], before=ends[0], after=ends[1])
    found = _closed(frames, poses, chain, loops[:-1], new)
    return _moved(builder, values, frames, found, changes(poses, found))


def closed_chain(
    poses: FloatArray, chain: Chain, loops: list[Constraint], last: FloatArray
) -> FloatArray:
    """Poses (n, 4, 4) of all frames where the last of ``loops`` has brought the last one.

    Args:
        poses: (n, 4, 4) before.
        chain: as for :func:`first_guess`, as is ``loops``.
        loops: all that are closed.
        last: (4, 4) where the last pose is now.
    """
    before = loops[-1].before
    motion = inverse(poses[before]) @ last
    new = Constraint(before, len(poses) - 1, motion, _EXACT**2 * np.eye(6))
    return _closed(np.arange(len(poses)), poses, chain, loops[:-1], new)


def _closed(
    frames: IntArray, poses: FloatArray, chain: Chain, loops: list[Constraint], new: Constraint
) -> FloatArray:
    held = [_as_solved(known, frames, poses) for known in (*chain.constraints, *loops)]
    constraints = [known for known in held if known.before != known.after]
    return corrected(poses, chain.steps_between(frames), [*constraints, new])[0]


def solved(graph: WholeGraph, state: State) -> State:
    """The minimum of a graph with its kernels."""
    return graph.minimum(state, _ITERATIONS, _TOLERANCE, _ENOUGH)


def _row(frames: IntArray, frame: int) -> int:
    """Row of the graph's frame that is nearest to a frame."""
    return int(np.argmin(np.abs(frames - frame)))


def _as_solved(known: Constraint, frames: IntArray, poses: FloatArray) -> Constraint:
    """A constraint between rows of the graph's frames, met as the solution meets it."""
    before, after = _row(frames, known.before), _row(frames, known.after)
    motion = inverse(poses[before]) @ poses[after]
    return Constraint(before, after, motion, known.covariance)


def _moved(
    builder: GraphBuilder, values: Any, frames: IntArray, poses: FloatArray, by: FloatArray
) -> Any:
    """Values with these poses (m, 4, 4), each landmark moved as the frame that saw it first."""
    out = gtsam.Values(values)
    for frame, pose in zip(frames.tolist(), poses, strict=True):
        out.update(pose_key(frame), gtsam.Pose3(pose))
    homes = np.searchsorted(frames, builder.first_frames())
    for variable, home in enumerate(homes.tolist()):
        key = landmark_key(variable)
        if out.exists(key):
            point = transform_to_world(by[home], out.atPoint3(key)[None])[0]
            out.update(key, point)
    return out
