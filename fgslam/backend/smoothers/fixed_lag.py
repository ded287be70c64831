"""Fixed-lag smoothing: poses and landmarks older than the lag are marginalised.

What a marginalised variable said about the others stays, as a quadratic; the variable itself can
no longer change. A landmark that comes back after the lag is a new variable: the smoother has
forgotten it, which is the price of a constant effort.
"""

from __future__ import annotations

import dataclasses
from typing import ClassVar

import numpy as np

from fgslam.backend.loops import (
    Constraint,
    constraint_factor,
)
from fgslam.backend.self_calibration import RigChange
from fgslam.backend.settings import FixedLagSettings
from fgslam.backend.smoothers.admission import Track
from fgslam.backend.smoothers.dense_cholesky import UndeterminedError
from fgslam.backend.smoothers.drift_undone import drift_undone
from fgslam.backend.smoothers.graph_builder import NewFactors, TrackedFrame
from fgslam.backend.smoothers.smoother import GraphProblem, Smoother
from fgslam.backend.smoothers.solver import (
    ClosedLoop,
    Drive,
    Smoothed,
    Solution,
    allowed_joint,
    allowed_parts,
    solver_failed,
)
from fgslam.backend.smoothers.window import Window
from fgslam.backend.smoothers.window_parts import Landmarks, Solved
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.estimates import EgoMotion, LandmarkMap, Prediction
from fgslam.core.floor import Floor
from fgslam.core.geometry import (
    adjoint,
    congruence,
    inverse,
    point_pose_jacobian,
    transform_to_camera,
)
from fgslam.core.measurements import Increment
from fgslam.core.sensors import CameraRig
from fgslam.factors.graphs import landmark_key, pose_key
from fgslam.factors.motion import pose_prior


def fixed_lag_smoother(
    sensor: CameraRig, settings: FixedLagSettings, floor: Floor, prior: Prediction
) -> LagSmoother:
    """Estimator of kind ``fixed_lag``, at the prior pose with an empty map.

    Raises:
        EstimatorError: neither lag is given.
    """
    if settings.lag_frames is None and settings.lag_s is None:
        raise EstimatorError("fixed_lag: no lag; set estimator.lag_frames or estimator.lag_s")
    problem = GraphProblem.of(sensor, settings, floor, prior, remember=False)
    return LagSmoother(problem, FixedLagSolver(problem, settings))


class FixedLagSolver:
    """Solves a window of the last frames anew with each of them."""

    kind: ClassVar[str] = "fixed_lag"

    def __init__(self, problem: GraphProblem, settings: FixedLagSettings) -> None:
        """An empty window."""
        self.builder, self._floor = problem.builder, problem.floor
        self._in_seconds = settings.lag_frames is None
        self._lag = float(settings.lag_frames or settings.lag_s or 0.0)
        self.window = Window(problem.sensor, problem.builder.kernel)
        self._solved: Solved | None = None
        self._oldest = 0
        self.poses: list[FloatArray] = []
        self._covariances: list[FloatArray] = []
        self._clock: list[float] = []
        self.remarks: list[str] = []

    def pose(self, frame: int) -> Prediction:
        """A frame's pose; final before the lag."""
        return Prediction(self.poses[frame], self._covariances[frame])

    def add(self, new: NewFactors, landmarks: LandmarkMap, timestamp: float) -> None:
        """Takes in a frame, and lets go what is older than the lag."""
        self._clock.append(timestamp)
        self.poses.append(np.eye(4))
        self._covariances.append(np.full((6, 6), np.nan))
        self._take(new)
        self._solve()
        self._move_window(landmarks)

    def recalibrate(self, change: RigChange) -> None:
        """Corrects the window's observations anew; what has left it is what it was."""
        self.window.remeasure(change.measured)

    def solve_if_due(self, frame: int, closes_loop: bool) -> Smoothed | None:
        """The window's solution, in every frame."""
        return self._smoothed({self._oldest, frame})  # the one that leaves next, and the last one

    def _smoothed(self, frames: set[int]) -> Smoothed:
        """Keeps the covariances of some frames of the window."""
        last = len(self.poses) - 1
        for frame in frames:
            self._covariances[frame] = self._covariance(frame)
        return Smoothed(self.window.values(), Prediction(self.poses[last], self._covariances[last]))

    def close(self, loop: Constraint, drive: Drive, what: str) -> ClosedLoop | None:
        """Moves the window as a whole to where the loop has the last pose; the past stays.

        After that the window is solved anew from there. A loop within the lag is a factor more.
        """
        inside = loop.before >= self._oldest  # both poses are variables
        if inside:
            self._covariances[loop.before] = self._covariance(loop.before)
        earlier, last = (
            Prediction(self.poses[frame], self._covariances[frame])
            for frame in (loop.before, loop.after)
        )
        found = drift_undone(self._floor, earlier, last, loop, what)
        if found.last is None:
            self.remarks.append(found.remark)
            return None
        if inside:
            self.window.factors.add(constraint_factor(loop))
            self._solve()
            self.remarks.append(f"{found.remark}; within the lag, it is a factor more")
        else:
            self.remarks.append(f"{found.remark}, and what lies within the lag")
            self._move_all(found.last)
        return ClosedLoop(self._smoothed({loop.after}))

    def _move_all(self, last: Prediction) -> None:
        """Takes the window along with its last pose, as it is, and starts from there."""
        oldest = self._oldest
        moved = last.wTc @ inverse(self.poses[-1])
        to_oldest = adjoint(inverse(self.poses[oldest]) @ last.wTc)
        self._covariances[oldest] = congruence(to_oldest, last.covariance)
        there = Prediction(moved @ self.poses[oldest], self._covariances[oldest])
        self.window.carried_along(moved, pose_prior(pose_key(oldest), there))
        self._solve()

    def solution(self) -> Solution:
        """Poses as they left the window, and those inside with their marginals."""
        covariances = np.array(self._covariances)  # our own stay as the updates left them
        for frame in range(self._oldest, len(self.poses)):
            covariances[frame] = self._covariance(frame)
        solved, landmarks = self._at_last(), self.window.landmarks
        inside = [track.variable for _, track in self.builder.admission.in_graph()]
        places = landmarks.points[np.searchsorted(landmarks.variables, inside)]
        found = solved.eliminated.landmarks()[solved.rows(inside)]
        return Solution(
            np.array(self.poses),
            covariances,
            dict(zip(inside, places, strict=True)),
            dict(zip(inside, found, strict=True)),
        )

    def joint(self, variables: list[int]) -> FloatArray:
        """Joint covariance of the last pose and landmark variables of the window."""
        solved = self._at_last()
        joint = solved.eliminated.joint(len(solved.frames) - 1, solved.rows(variables))
        return allowed_joint(self._floor, self.poses[-1], joint)

    # ----------------------------------------------------------------------------------------

    def _time(self, frame: int) -> float:
        return self._clock[frame] if self._in_seconds else float(frame)

    def _take(self, new: NewFactors) -> None:
        """A frame's pose, landmarks and observations into the window."""
        pose = new.values.atPose3(pose_key(new.frame)).matrix()
        self.window.add_pose(new.frame, pose, new.graph)
        self.window.kernel = self.builder.kernel
        known = self.window.landmarks.variables
        before = int(known[-1]) if len(known) else -1
        entered = sorted({v for v, _ in new.sightings if v > before})
        if entered:
            self.window.add_landmarks(_landmarks(new, entered))
        if new.sightings:
            self.window.observe(
                np.array([s.frame for _, s in new.sightings], np.int64),
                np.array([v for v, _ in new.sightings], np.int64),
                np.array([s.measurement for _, s in new.sightings]),
                self.builder.noise.power * np.array([s.covariance for _, s in new.sightings]),
            )

    def _solve(self) -> None:
        """Solves the window, without landmarks on which it fails."""
        self._solved = self.window.repaired(self._take_out, self._failed)
        for frame, pose in zip(self.window.frames, self.window.poses, strict=True):
            self.poses[frame] = pose.copy()  # a view would keep the whole window's array

    def _failed(self, error: Exception) -> Exception:
        return solver_failed(self.kind, error, self.builder.frames[-1])

    def _take_out(self, variable: int) -> None:
        self.window.take_out(variable)
        self.remarks.append(
            f"{self.builder.take_out(variable)} left the system indeterminate at frame "
            f"{self.builder.frames[-1]}: taken out"
        )

    def _move_window(self, known: LandmarkMap) -> None:
        """Notes which poses and landmarks have left; landmarks keep their last place."""
        last = len(self.poses) - 1
        while self._time(self._oldest) < self._time(last) - self._lag:
            self._oldest += 1
        try:
            self.window.let_go_before(self._oldest)
        except (UndeterminedError, np.linalg.LinAlgError) as error:
            raise self._failed(error) from None
        last_seen: dict[int, list[tuple[int, Track]]] = {}
        for identity, track in self.builder.forget_before(self._oldest):
            last_seen.setdefault(track.last.frame, []).append((identity, track))
        for frame, left in last_seen.items():
            rows = known.rows(np.array([identity for identity, _ in left], np.int64))
            places = known.positions[rows]
            found = self._with_pose(frame, places, known.covariances[rows])
            for (_, track), *left_at in zip(left, places, found, strict=True):
                track.left_at = left_at[0], left_at[1]

    def _with_pose(self, frame: int, places: FloatArray, given_poses: FloatArray) -> FloatArray:
        """Covariances (k, 3, 3) of landmarks that left: given the poses, and of the last pose."""
        wTc = self.poses[frame]
        jacobians = point_pose_jacobian(transform_to_camera(wTc, places))
        by_pose = congruence(jacobians, self._covariances[frame])
        return np.asarray(given_poses + congruence(wTc[:3, :3], by_pose))

    def _at_last(self) -> Solved:
        """The window as it was solved last."""
        if self._solved is None:
            raise EstimatorError("fixed_lag: no frame yet")
        return self._solved

    def _covariance(self, frame: int) -> FloatArray:
        solved = self._at_last()
        covariance = solved.eliminated.pose(solved.frames.index(frame))
        kept = allowed_parts(self._floor, self.poses[frame][None], covariance[None])
        return np.asarray(kept[0])


_HOLD_A_POSE = 6
"""Landmarks in three dimensions: twice as many as determine a pose."""


class LagSmoother(Smoother):
    """A smoother of a bounded lag: nothing revises what the lag has left, not even a closure."""

    def __init__(self, problem: GraphProblem, solver: FixedLagSolver) -> None:
        """Starts at the problem's prior pose with an empty map."""
        super().__init__(problem, solver)
        self._lag = solver

    def _admitted(self, increment: Increment, tracking: EgoMotion) -> TrackedFrame:
        """The frame; one that was found without a prior is where a map that has left has it."""
        tracked = super()._admitted(increment, tracking)
        observed = increment.observations
        matched = observed.ids[~observed.is_new][tracking.inliers]
        if not increment.relocalised or self._within(matched) >= _HOLD_A_POSE:
            return tracked
        return dataclasses.replace(tracked, located=self._located(matched, tracking))

    def _within(self, ids: IntArray) -> int:
        """How many of them are variables of the lag: those hold a frame by their factors."""
        tracks = self.builder.admission.tracks
        return sum(i in tracks and tracks[i].variable >= 0 for i in ids.tolist())

    def _located(self, matched: IntArray, tracking: EgoMotion) -> FloatArray:
        """(6, 6) of a pose in a map that has left: as tracked, and as the map is known itself.

        Its landmarks are as uncertain as the pose of the frame that began them, in the middle.
        """
        known = self.tracker.landmarks()
        homes = self.tracker.homes[known.rows(matched[np.isin(matched, known.ids)])]
        if not len(homes):
            return tracking.covariance
        home = self._lag.pose(int(np.sort(homes)[len(homes) // 2]))
        there = adjoint(inverse(tracking.wTc) @ home.wTc)
        return tracking.covariance + congruence(there, home.covariance)


def _landmarks(new: NewFactors, entered: list[int]) -> Landmarks:
    """Landmarks that enter with a frame, at their initial values."""
    points = np.array([new.values.atPoint3(landmark_key(v)) for v in entered])
    mean, information = points.copy(), np.zeros((len(entered), 3, 3))
    for variable, known, covariance in new.priors:
        row = entered.index(variable)
        mean[row], information[row] = known, np.linalg.inv(covariance)
    return Landmarks(np.array(entered, np.int64), points, mean, information)
