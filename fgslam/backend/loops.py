"""Backward correction by submaps (Se, Lowe and Little's later work), and which loops are accepted.

A drive is a chain of steps, each as uncertain as it was tracked. Closing a loop asks for the least
weighted changes to the chain under which it meets itself: the minimum of a pose graph of the poses
at which submaps begin; within a submap the change is spread over the frames as their steps'
uncertainty has it. Filters and smoothers share it. Derivation: docs/derivations/places.md.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import adjoint, congruence, inverse, pose, reorthonormalise, se3_log, skew
from fgslam.core.sensors import Increment, LoopClosure, Odometry
from fgslam.core.store import Kept
from fgslam.core.types import EgoMotion, Prediction

_KERNEL_WIDTH = 3.0  # deviations of the whole closure; its squared residual is 6 on average
SUBMAP_FRAMES = 10
"""Enough that the pose graph of a long drive stays small, few enough that submaps are rigid."""
CLOSURE_FACTOR = 3.0
"""By which deviations of a loop closure are multiplied: its own covariance takes the map around
both frames as rigid, whose landmarks are as uncertain as the poses that saw them."""
GATE_SIGMAS = 10.0
"""A loop closure is refused where it raises the cost by more than the square of this (ekf: its
innovation squared beyond what is expected). Wide: true ones measured 0.7 to 6.1 in the rendered
rooms, and a lost closure costs more than covariances a few times too small
(docs/derivations/places.md)."""
_ITERATIONS = 100
_TOLERANCE = 1e-12  # of the cost
_EXACT_SIGMA = 1e-6  # radians and metres: a step's least deviation, for what a floor excludes
_SMALL = 1e-3  # radians: below, the formula's differences lose their digits
_STILL = 1e-12  # of a change's tangent vector: what is not to be spread
FREE_RAD, FREE_M = 3.0, 30.0
"""Deviations of a step that was not measured, as of a robot that was carried off: it pulls nothing
(a frame's own landmarks know the pose a thousand times better), yet the graph stays solvable."""
FREE = np.diag([FREE_RAD**2] * 3 + [FREE_M**2] * 3)
"""(6, 6) covariance of such a step."""
_GAP = 5.0  # usual intervals between frames
_PART = 6  # landmarks by which a later frame can be placed
_TIED_BY = 10  # landmarks of an old place that hold a frame there
_OLD = 5  # submaps
_TIE_FACTOR = 5.0
"""On the deviations of a pose tracked by old landmarks, which lie about their homes as the drift
has bent them. Measured on four rounds of the lab: up to 20 the corrected drive is as accurate,
below 5 true closures are taken for impossible (docs/results)."""


def guessed(increment: Increment, tracking: EgoMotion) -> bool:
    """Whether nothing measured a frame's pose: neither landmarks nor odometry, after the first.

    What it starts is one piece, whose place among the rest is not known. A filter has no
    correlations: with the guess's covariance on each landmark none would tell where the next frame
    is, though together they do.
    """
    odometry = increment.odometry
    return not tracking.status.measured and odometry is not None and not odometry.measured


def starts_new_part(increment: Increment, tracking: EgoMotion) -> bool:
    """Whether a frame begins another part of the map: its step is as free as of one carried off.

    It sees enough, and nothing of what its guess made expect: the guess is refuted, and with it
    its stated uncertainty.
    """
    return guessed(increment, tracking) and int(increment.observations.is_new.sum()) >= _PART


def with_unknown_step(
    increment: Increment, tracking: EgoMotion, before: FloatArray, times: Iterable[float]
) -> Increment:
    """The increment; its step free to be any other where nothing ties it to the frames before.

    It was found without a prior, or starts a part of the map. After a gap in time the guess stays,
    of the last velocity and its spread: that what was seen before is out of view refutes nothing.
    A gyroscope has felt even how a camera was carried.

    Args:
        increment: the frame.
        tracking: its pose.
        before: (4, 4) the last pose.
        times: (n,) of the frames before; looked at where the step is unknown.
    """
    if not (increment.relocalised or starts_new_part(increment, tracking)):
        return increment
    guess, stamps = increment.odometry, np.fromiter(times, np.float64)
    late = len(stamps) > 1 and not increment.relocalised
    late = late and increment.timestamp - stamps[-1] > _GAP * float(np.median(np.diff(stamps)))
    covariance = (guess.covariance if late and guess is not None else FREE).copy()
    step = Odometry(inverse(before) @ tracking.wTc, covariance, measured=False)
    if guess is not None and guess.turned:
        step.motion[:3, :3] = guess.motion[:3, :3]
        covariance[:3, :3] = guess.covariance[:3, :3]
        step = dataclasses.replace(step, turned=True, bias=guess.bias)
    return dataclasses.replace(increment, odometry=step)


@dataclass(frozen=True, slots=True, eq=False)
class Constraint:
    """A measured motion between two frames of the chain that are not neighbours.

    Attributes:
        before, after: frames.
        motion: (4, 4) pose of ``after`` in ``before``.
        covariance: (6, 6) in the tangent space at it.
        uncertain: it may be wrong: the farther off, the less it pulls (Cauchy's kernel).
        matches: landmarks that agree on it; 0 where they were not counted.
    """

    before: int
    after: int
    motion: FloatArray
    covariance: FloatArray
    uncertain: bool = False
    matches: int = 0


@dataclass(slots=True, eq=False)
class Chain:
    """A drive as it was tracked: never revised, so that corrections do not accumulate.

    Attributes:
        poses: one (4, 4) a frame, each the last one's moved on by the step as tracked.
        steps: (6, 6) covariance of the step to each frame, in the tangent space at its pose.
        constraints: what else is known, in the order in which it came.
    """

    poses: list[FloatArray] = field(default_factory=list)
    steps: list[FloatArray] = field(default_factory=list)
    constraints: list[Constraint] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.poses)

    def append(self, motion: FloatArray, covariance: FloatArray) -> None:
        """Adds a frame: its pose in the last one (of the first frame: in the world)."""
        self.poses.append(self.poses[-1] @ motion if self.poses else motion)
        self.steps.append(covariance)

    def cost(self) -> float:
        """What the constraints cost, without the poses."""
        if not self.constraints:
            return 0.0
        poses = np.array(self.poses)
        errors = as_motions_of_the_world(poses, np.array(self.steps))
        return _minimum(poses, errors, self.constraints, SUBMAP_FRAMES)[1]

    def solve(self, constraints: list[Constraint]) -> tuple[FloatArray, float]:
        """Poses and cost of the chain under these constraints; see :func:`corrected`."""
        return corrected(np.array(self.poses), np.array(self.steps), constraints)

    def steps_between(self, frames: IntArray) -> FloatArray:
        """(m, 6, 6) covariances of the steps to some frames, ascending, from the one before."""
        poses = np.array(self.poses)
        errors = as_motions_of_the_world(poses, np.array(self.steps))
        sums = [errors[a + 1 : b + 1].sum(axis=0) for a, b in itertools.pairwise([-1, *frames])]
        return congruence(adjoint(_inverses(poses[frames])), np.array(sums))


def corrected(
    poses: FloatArray,
    steps: FloatArray,
    constraints: list[Constraint],
    every: int = SUBMAP_FRAMES,
) -> tuple[FloatArray, float]:
    """Least weighted changes to a chain under which it meets its constraints.

    Args:
        poses: (n, 4, 4) the chain; its first pose stays.
        steps: (n, 6, 6) covariances of the steps to each pose, in the tangent space at it; the
            first one is not used.
        constraints: between frames of the chain.
        every: frames to a submap; frames with a constraint begin one, too.

    Returns:
        Poses (n, 4, 4), and the cost: squared residuals, each in its own deviations, of all
        changes together.
    """
    errors = as_motions_of_the_world(poses, steps)
    at, cost = _minimum(poses, errors, constraints, every)
    out = poses.copy()
    for a, b in itertools.pairwise(sorted(at)):
        out[a : b + 1] = _between(poses[a : b + 1], errors[a : b + 1], at[a], at[b])
    return out, cost


def constraint_factor(known: Constraint) -> Any:
    """GTSAM's factor of a constraint between the poses of its frames."""
    from fgslam.factors.graphs import pose_key  # a filter alone does without GTSAM
    from fgslam.factors.motion import odometry_factor
    from fgslam.factors.noise import robust

    step = Odometry(known.motion, known.covariance)
    factor = odometry_factor(pose_key(known.before), pose_key(known.after), step)
    if not known.uncertain:
        return factor
    return robust(factor, "cauchy", _KERNEL_WIDTH)


def rotated(transforms: FloatArray, covariances: FloatArray) -> FloatArray:
    """Covariances (n, 3, 3) of points that rigid motions (n, 4, 4) take along."""
    return congruence(transforms[:, :3, :3], covariances)


def nearest_positive(covariance: FloatArray) -> FloatArray:
    """A symmetric matrix (n, n) without its negative part, as of differences of covariances."""
    variances, directions = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray((directions * np.maximum(variances, 0.0)) @ directions.T)


def transported(transforms: FloatArray, points: FloatArray) -> FloatArray:
    """Points (n, 3), each moved by its own rigid motion (n, 4, 4)."""
    moved = np.einsum("nij,nj->ni", transforms[:, :3, :3], points)
    return np.asarray(moved + transforms[:, :3, 3])


def changes(before: FloatArray, after: FloatArray) -> FloatArray:
    """Motions (n, 4, 4) of the world that take poses (n, 4, 4) ``before`` to those ``after``."""
    return np.asarray(after @ _inverses(before))


# --------------------------------------------------------------------------------------------


def _minimum(
    poses: FloatArray, errors: FloatArray, constraints: list[Constraint], every: int
) -> tuple[dict[int, FloatArray], float]:
    """Poses (4, 4) at which submaps begin, by frame, at the least cost; and that cost."""
    import gtsam

    from fgslam.factors.graphs import pose_key, poses_of_frame, solver_parameters
    from fgslam.factors.motion import odometry_factor, pose_prior

    ends = {frame for known in constraints for frame in (known.before, known.after)}
    begins = sorted({*range(0, len(poses), every), len(poses) - 1, *ends})
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(pose_prior(pose_key(0), Prediction(poses[0], np.zeros((6, 6)))))
    for frame in begins:
        values.insert(pose_key(frame), gtsam.Pose3(poses[frame]))
    for a, b in itertools.pairwise(begins):
        whole = errors[a + 1 : b + 1].sum(axis=0)
        motion = inverse(poses[a]) @ poses[b]
        step = Odometry(motion, congruence(adjoint(inverse(poses[b])), whole))
        graph.add(odometry_factor(pose_key(a), pose_key(b), step))
    for known in constraints:
        graph.add(constraint_factor(known))
    params = solver_parameters(_ITERATIONS, _TOLERANCE)
    params.setLinearSolverType("MULTIFRONTAL_QR")  # a tight loop on a loose chain defeats Cholesky
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    at = {frame: reorthonormalise(poses_of_frame(found, frame)) for frame in begins}
    return at, 2.0 * float(graph.error(found))


def _inverses(poses: FloatArray) -> FloatArray:
    """Inverses (n, 4, 4) of rigid motions."""
    out = np.zeros_like(poses)
    out[:, :3, :3] = np.swapaxes(poses[:, :3, :3], 1, 2)
    out[:, :3, 3] = -np.einsum("nij,nj->ni", out[:, :3, :3], poses[:, :3, 3])
    out[:, 3, 3] = 1.0
    return out


def rigid_motions(twists: FloatArray) -> FloatArray:
    """Rigid motions (n, 4, 4) of tangent vectors (n, 6), as ``se3_exp`` of each."""
    angle = np.linalg.norm(twists[:, :3], axis=1)[:, None, None]
    cross = skew(twists[:, :3])
    square = cross @ cross
    first, second = np.sinc(angle / np.pi), 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    small = angle < _SMALL
    cubed = np.where(small, 1.0, angle) ** 3
    third = np.where(small, 1.0 / 6.0 - angle**2 / 120.0, (angle - np.sin(angle)) / cubed)
    rotation = np.eye(3) + (first * cross + second * square)
    along = np.eye(3) + second * cross + third * square
    return pose(rotation, np.einsum("nij,nj->ni", along, twists[:, 3:]))


def as_motions_of_the_world(poses: FloatArray, steps: FloatArray) -> FloatArray:
    """Covariances (n, 6, 6) of each step's error as a motion of the world.

    The error ``xi`` of the step to pose T moves all that follows by ``Ad(T) xi``: to first order
    these motions add up, and so do their covariances.
    """
    return congruence(adjoint(poses), steps + _EXACT_SIGMA**2 * np.eye(6))


def _between(
    poses: FloatArray, errors: FloatArray, first: FloatArray, last: FloatArray
) -> FloatArray:
    """A submap's poses (m, 4, 4) when its ends have moved to ``first`` and ``last``.

    Given the change of the whole, that of a part is the share of the part's covariance: the
    conditional mean of a chain of independent steps.
    """
    begun = first @ inverse(poses[0])
    change = se3_log(inverse(begun) @ last @ inverse(poses[-1]))
    if np.abs(change).max() < _STILL:
        out = begun @ poses
    else:
        spread = np.cumsum(errors[1:], axis=0)
        shares = spread @ np.linalg.solve(spread[-1], change)
        out = begun @ rigid_motions(np.concatenate([np.zeros((1, 6)), shares])) @ poses
    out[0], out[-1] = first, last
    return np.asarray(out)


def home_changes(homes: IntArray, moved: FloatArray) -> FloatArray:
    """Motion (n, 4, 4) of each landmark: that of its home frame; none where that is -1."""
    return np.asarray(np.concatenate([moved, np.eye(4)[None]])[homes])


def within_gate(squared: float) -> bool:
    """Whether a loop closure is accepted by the rise of the cost by it, or innovation squared."""
    return bool(squared <= GATE_SIGMAS**2)


def refusal(what: str, squared: float) -> str:
    """Why a loop closure is refused, beginning with ``what``; empty where it is accepted.

    Args:
        what: names the closure.
        squared: the rise of the cost by it, or its innovation squared.
    """
    if within_gate(squared):
        return ""
    off = np.sqrt(max(squared, 0.0))
    return f"{what} refused: {off:.1f} standard deviations off, {GATE_SIGMAS:g} allowed"


class DriveRecord:
    """The chain of steps of a filter's drive, the constraints on it, and which loops were accepted.

    The filter's own covariance of a pose is relative to the map around it,
    and never grows: drift is not in it. What drifts is the chain of steps, each as uncertain as its
    frame was tracked; where no landmark was matched, as uncertain as the odometry; where the robot
    was carried off, unknown.
    """

    _chain: Kept[Chain]
    _tied: Kept[int]
    _coherent: Kept[bool]
    remarks: Kept[list[str]]

    def __init__(self) -> None:
        """An empty drive."""
        self._chain = Chain()
        self._tied = -1
        self._coherent = True
        self.remarks = []

    @property
    def chain(self) -> Chain:
        """The steps, and the constraints between frames that are no neighbours."""
        return self._chain

    def step(
        self, motion: FloatArray, tracking: EgoMotion, known: Odometry | None, free: bool
    ) -> None:
        """Adds the step (4, 4) to a frame.

        Two frames that were tracked well lie next to the same landmarks. Where most of what a frame
        matched contradicts its pose, as at a return to places that the drift has displaced, old
        landmarks and new ones pull apart: nothing measures the step to that pose, nor the one back
        from it, but the odometry.

        Args:
            motion: the frame's pose as tracked, in the last one's.
            tracking: how the frame was tracked.
            known: what the frame was predicted with; :func:`with_unknown_step` where it is free.
            free: the frame was found without a prior, or starts a part of the map.
        """
        before, self._coherent = self._coherent, tracking.coherent
        measured = before and self._coherent and tracking.status.measured
        if known is None or (measured and not free):
            covariance = tracking.covariance
        elif free:
            covariance = known.covariance
        else:
            motion, covariance = known.motion, known.covariance
        self._chain.append(motion, covariance)

    def tie(
        self, homes: IntArray, poses: list[FloatArray], tracking: EgoMotion, free: bool
    ) -> None:
        """Adds a constraint if the last frame was placed by landmarks of an old part of the drive.

        Once a submap; a frame found without a prior depends on nothing else.

        Args:
            homes: (k,) home frames of the landmarks that placed it; -1 of those that never move.
            poses: of all frames before, as they are now.
            tracking: how it was tracked.
            free: it was found without a prior.
        """
        frame, every = len(self._chain) - 1, SUBMAP_FRAMES
        homes = np.maximum(homes, 0)  # a saved map's landmarks stay, and so does the first pose
        old = homes[homes < (frame if free else frame - _OLD * every)]
        due = self._coherent and (self._tied < 0 or frame - self._tied >= every)
        # A few old ones among many new, far ones as a rule, do not tell where the frame is.
        if len(old) < _TIED_BY or 2 * len(old) < len(homes) or not (free or due):
            return
        self._tied = frame
        home = int(np.sort(old)[len(old) // 2])
        covariance = _TIE_FACTOR**2 * tracking.covariance
        motion = inverse(poses[home]) @ tracking.wTc
        self._chain.constraints.append(Constraint(home, frame, motion, covariance, uncertain=True))

    def close(self, loop: LoopClosure, here: FloatArray, where: str) -> FloatArray | None:
        """All poses (n, 4, 4) with the loop closed; None, and a remark, where it is refused.

        It is refused where it would cost more than the drive's own uncertainty explains: the rise
        of the cost is chi-square with six degrees of freedom for a true one.

        Args:
            loop: the closure, of the last frame.
            here: (4, 4) that frame's pose without it.
            where: names the frame.

        Raises:
            EstimatorError: it leads to no earlier frame.
        """
        last = len(self._chain) - 1
        what = f"{where}: loop closure to frame {loop.frame} of the log"
        if not 0 <= loop.frame < last:
            raise EstimatorError(f"{what}, which does not come before it; correct the log")
        covariance = CLOSURE_FACTOR**2 * loop.covariance
        known = Constraint(loop.frame, last, loop.oTc, covariance)
        poses, cost = self._chain.solve([*self._chain.constraints, known])
        refused = refusal(what, cost - self._chain.cost())
        if refused:
            self.remarks.append(refused)
            return None
        self._chain.constraints.append(dataclasses.replace(known, uncertain=True))
        shift = poses[-1, :3, 3] - here[:3, 3]
        self.remarks.append(
            f"{what}: the camera moved by {np.linalg.norm(shift):.2f} m, the drive with it"
        )
        return poses
