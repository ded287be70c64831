"""Incremental fixed-lag smoothing: poses and landmarks older than the lag are marginalised.

What a marginalised variable said about the others stays, as a linear factor; the variable itself
can no longer change. A landmark that comes back after the lag is a new variable: the smoother
has forgotten it, which is the price of a constant effort.
"""

from __future__ import annotations

from collections import deque
from typing import Any, ClassVar

import gtsam
import numpy as np

from fgslam.backend.filters.loop_correction import (
    Constraint,
    constraint_factor,
    nearest_positive,
    refusal,
)
from fgslam.backend.settings import FixedLagSettings
from fgslam.backend.smoothers.graph_builder import NewFactors
from fgslam.backend.smoothers.loop_closing import misfit
from fgslam.backend.smoothers.marginals import DenseMarginals, UndeterminedError
from fgslam.backend.smoothers.smoother import GraphProblem, Smoother
from fgslam.backend.smoothers.solver import (
    ClosedLoop,
    Drive,
    Smoothed,
    Solution,
    allowed_joint,
    allowed_parts,
    points_of,
    solver_failed,
    suspect,
)
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.estimates import LandmarkMap, Prediction
from fgslam.core.floor import Floor
from fgslam.core.geometry import (
    adjoint,
    congruence,
    inverse,
    point_pose_jacobian,
    reorthonormalise,
    se3_exp,
    se3_log,
    transform_to_camera,
    transform_to_world,
)
from fgslam.core.sensors import Sensor
from fgslam.factors.graphs import (
    is_pose,
    isam2_parameters,
    landmark_key,
    number,
    pose_key,
    poses_of_frame,
    without_gaps,
)
from fgslam.factors.motion import pose_prior

_REPAIRS = 20  # landmarks taken out in one update before the graph itself must be wrong


def fixed_lag_smoother(
    sensor: Sensor, settings: FixedLagSettings, floor: Floor, prior: Prediction
) -> Smoother:
    """Estimator of kind ``fixed_lag``, at the prior pose with an empty map.

    Raises:
        EstimatorError: neither lag is given.
    """
    if settings.lag_frames is None and settings.lag_s is None:
        raise EstimatorError("fixed_lag: no lag; set estimator.lag_frames or estimator.lag_s")
    problem = GraphProblem.of(sensor, settings, floor, prior, remember=False)
    return Smoother(problem, FixedLagSolver(problem, settings))


class FixedLagSolver:
    """Solves a window of the last frames by GTSAM's incremental fixed-lag smoother."""

    kind: ClassVar[str] = "fixed_lag"

    def __init__(self, problem: GraphProblem, settings: FixedLagSettings) -> None:
        """An empty window."""
        self._builder, self._floor = problem.builder, problem.floor
        self._in_seconds = settings.lag_frames is None
        self._lag = float(settings.lag_frames or settings.lag_s or 0.0)
        self._solver = self._new_solver()
        self._values = gtsam.Values()
        self._oldest = 0
        self._poses: list[FloatArray] = []
        self._covariances: list[FloatArray] = []
        self._clock: list[float] = []
        self._recent: deque[NewFactors] = deque()
        self.remarks: list[str] = []

    def add(self, new: NewFactors, landmarks: LandmarkMap, timestamp: float) -> None:
        """Takes in a frame, and lets go what is older than the lag."""
        self._clock.append(timestamp)
        self._poses.append(np.eye(4))
        self._covariances.append(np.full((6, 6), np.nan))
        self._recent.append(new)
        self._update(new)
        self._move_window(landmarks)

    def solve_if_due(self, frame: int, closes_loop: bool) -> Smoothed | None:
        """The window's solution, in every frame."""
        return self._smoothed({self._oldest, frame})  # the one that leaves next, and the last one

    def _smoothed(self, frames: set[int]) -> Smoothed:
        """Keeps the window's poses, and the covariances of some frames of it."""
        last = len(self._poses) - 1
        for frame in range(self._oldest, last + 1):
            self._poses[frame] = poses_of_frame(self._values, frame)
        marginals = self._marginals()
        for frame in frames:
            self._covariances[frame] = self._covariance(marginals, frame)
        return Smoothed(self._values, Prediction(self._poses[last], self._covariances[last]))

    def close(self, loop: Constraint, drive: Drive, what: str) -> ClosedLoop | None:
        """Moves the window as a whole to where the loop has the last pose; the past stays.

        The earlier frame's pose is known as it was when it left. What the last pose is less certain
        by than that one is drift, and the loop measures the drift: a Kalman correction of one pose,
        after which the window is solved anew from there.
        """
        if loop.before >= self._oldest:  # both poses are variables
            if not self._taken_in(loop, what):
                return None
        else:
            moved = self._drift_undone(loop, what)
            if moved is None:
                return None
            self._move_all(moved)
        return ClosedLoop(self._smoothed({loop.after}))

    def _taken_in(self, known: Constraint, what: str) -> bool:
        """Adds a loop within the lag, where hardly anything drifts, as a factor; or refuses it."""
        factor = constraint_factor(known)
        refused = refusal(what, misfit(factor, self._values))
        if refused:
            self.remarks.append(refused)
            return False
        self._recent[-1].graph.add(factor)
        self._rebuild(gtsam.Values(self._values))
        self.remarks.append(f"{what}: within the lag, a factor more")
        return True

    def _drift_undone(self, known: Constraint, what: str) -> Prediction | None:
        """The last pose by the loop; None, and a remark, where the loop is refused."""
        wTo, wTc = self._poses[known.before], self._poses[known.after]
        carried = adjoint(inverse(known.motion))
        shared = congruence(carried, self._covariances[known.before])
        drift = nearest_positive(self._covariances[known.after] - shared)
        # On a hard floor nothing drifts, and nothing is measured, in the other directions.
        basis = self._floor.basis(wTc) if self._floor.rigid_dof < 6 else np.eye(6)
        off = basis.T @ se3_log(inverse(wTc) @ wTo @ known.motion)
        drift = basis.T @ drift @ basis
        innovation = drift + basis.T @ known.covariance @ basis
        gain = np.linalg.solve(innovation, drift).T
        refused = refusal(what, float(off @ np.linalg.solve(innovation, off)))
        if refused:
            self.remarks.append(refused)
            return None
        target = wTc @ se3_exp(basis @ gain @ off)
        target = self._floor.constrain(target) if self._floor.rigid_dof < 6 else target
        covariance = shared + congruence(basis, nearest_positive(drift - gain @ drift))
        shift = float(np.linalg.norm(target[:3, 3] - wTc[:3, 3]))
        self.remarks.append(
            f"{what}: the camera moved by {shift:.2f} m, and what lies within the lag"
        )
        return Prediction(target, self._floor.allowed_part(target, covariance))

    def _move_all(self, last: Prediction) -> None:
        """Takes the window along with its last pose, as it is, and starts from there."""
        moved, values = last.wTc @ inverse(self._poses[-1]), gtsam.Values(self._values)
        for key in list(values.keys()):
            if is_pose(key):
                pose = reorthonormalise(moved @ poses_of_frame(values, number(key)))
                values.update(key, gtsam.Pose3(pose))
                self._poses[number(key)] = pose
            else:
                values.update(key, transform_to_world(moved, values.atPoint3(key)[None])[0])
        to_oldest = adjoint(inverse(self._poses[self._oldest]) @ last.wTc)
        self._covariances[self._oldest] = congruence(to_oldest, last.covariance)
        self._rebuild(values)

    def solution(self) -> Solution:
        """Poses as they left the window, and those inside with their marginals."""
        marginals = self._marginals()
        covariances = np.array(self._covariances)  # our own stay as the updates left them
        for frame in range(self._oldest, len(self._poses)):
            covariances[frame] = self._covariance(marginals, frame)
        inside = [
            track.variable
            for track in self._builder.admission.tracks.values()
            if track.variable >= 0 and self._values.exists(landmark_key(track.variable))
        ]
        found = marginals.landmarks([landmark_key(v) for v in inside])
        return Solution(
            np.array(self._poses),
            covariances,
            points_of(self._values, inside),
            dict(zip(inside, found, strict=True)),
        )

    def joint(self, variables: list[int]) -> FloatArray:
        """Joint covariance of the last pose and landmark variables of the window."""
        last = len(self._poses) - 1
        joint = self._marginals().joint(pose_key(last), [landmark_key(v) for v in variables])
        return allowed_joint(self._floor, self._poses[-1], joint)

    # ----------------------------------------------------------------------------------------

    def _new_solver(self) -> Any:
        params = isam2_parameters(gtsam.ISAM2GaussNewtonParams())
        # Without it the list of factors, and the effort, grow with the run.
        params.findUnusedFactorSlots = True
        return gtsam.IncrementalFixedLagSmoother(self._lag, params)

    def _time(self, frame: int) -> float:
        return self._clock[frame] if self._in_seconds else float(frame)

    def _update(self, new: NewFactors) -> None:
        stamp = self._time(new.frame)
        stamps = {pose_key(new.frame): stamp} | {landmark_key(v): stamp for v in new.seen}
        before = self._values
        try:
            self._solver.update(new.graph, new.values, stamps)
            self._values = self._solver.calculateEstimate()
        except RuntimeError as error:
            together = gtsam.Values(before)
            together.insert(new.values)
            self._repair(together, error)

    def _move_window(self, known: LandmarkMap) -> None:
        """Notes which poses and landmarks have left; landmarks keep their last place."""
        last = len(self._poses) - 1
        while self._time(self._oldest) < self._time(last) - self._lag:
            self._oldest += 1
        while self._recent and self._recent[0].frame < self._oldest:
            self._recent.popleft()
        left = self._builder.forget_before(self._oldest)
        rows = known.rows(np.array([identity for identity, _ in left], np.int64))
        for (_, track), row in zip(left, rows.tolist(), strict=True):
            position, covariance = known.positions[row].copy(), known.covariances[row]
            track.left_at = position, self._with_pose(track.last.frame, position, covariance)

    def _with_pose(self, frame: int, position: FloatArray, given_poses: FloatArray) -> FloatArray:
        """Covariance of a landmark that left: what was known given the poses, and of the pose."""
        wTc = self._poses[frame]
        point = transform_to_camera(wTc, position[None])
        by_pose = congruence(point_pose_jacobian(point), self._covariances[frame])
        return np.asarray(given_poses + congruence(wTc[:3, :3], by_pose)[0])

    def _marginals(self) -> DenseMarginals:
        """Of the window: all at once, faster than GTSAM's for one pose of a dense root clique."""
        while True:  # each repair takes a landmark out, and after a few it raises
            try:
                return DenseMarginals(without_gaps(self._solver.getFactors()), self._values)
            except UndeterminedError as error:
                self._repair(gtsam.Values(self._values), error)

    def _covariance(self, marginals: DenseMarginals, frame: int) -> FloatArray:
        covariance = marginals.pose(pose_key(frame))
        kept = allowed_parts(self._floor, self._poses[frame][None], covariance[None])
        return np.asarray(kept[0])

    def _repair(self, values: Any, error: Exception) -> None:
        """Builds the solver anew over the window, without the landmark that failed."""
        for _ in range(_REPAIRS):
            key = suspect(error)
            if key is None or is_pose(key) or not self._builder.in_graph(number(key)):
                break
            self.remarks.append(
                f"{self._builder.take_out(number(key))} left the system indeterminate at frame "
                f"{self._recent[-1].frame}: taken out, solver built anew over the lag"
            )
            try:
                self._rebuild(values)
                return
            except RuntimeError as another:
                error = another
        raise solver_failed(self.kind, error, self._builder.frames[-1])

    def _rebuild(self, values: Any) -> None:
        oldest = self._oldest
        graph, kept = gtsam.NonlinearFactorGraph(), gtsam.Values()
        stamps: dict[int, float] = {}
        if oldest:  # the first frame has its own prior among its factors
            covariance = self._covariances[oldest]
            if not np.isfinite(covariance).all():
                covariance = np.zeros((6, 6))
            graph.add(pose_prior(pose_key(oldest), Prediction(self._poses[oldest], covariance)))
        for new in self._recent:
            for row in range(new.graph.size()):
                factor = new.graph.at(row)
                keys = list(factor.keys())
                if all(self._is_inside(key) for key in keys):
                    graph.add(factor)
                    # A landmark is as old as its last sighting, a pose as its frame.
                    stamps |= {k: self._time(number(k) if is_pose(k) else new.frame) for k in keys}
        for key in stamps:
            kept.insert(key, values.atPose3(key) if is_pose(key) else values.atPoint3(key))
        self._solver = self._new_solver()
        self._solver.update(graph, kept, stamps)
        self._values = self._solver.calculateEstimate()

    def _is_inside(self, key: int) -> bool:
        """Whether a variable is within the lag and was not taken out."""
        return number(key) >= self._oldest if is_pose(key) else self._builder.in_graph(number(key))
