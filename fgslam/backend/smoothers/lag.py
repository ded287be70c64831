"""Sliding window over a drive that is kept: online the last frames, for the answer all of them.

Poses that leave the window are marginalised as the fixed lag's are. But what has left is not
forgotten: each landmark keeps its place and what was known of it given the poses, and comes back
with that into the window, off by the drift of the frame that saw it last. So a drive that returns
is pulled to where it has been, as far as that is known better, though what lies in between stays
where it is until a loop closure moves it. The answer is the minimum over everything that was
measured, as batch's. Derivation: docs/derivations/smoothers.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any, ClassVar

import gtsam
import numpy as np

from fgslam.backend.loops import Chain, Constraint, changes, constraint_factor, nearest_positive
from fgslam.backend.measured import nuisance_words
from fgslam.backend.self_calibration import RigChange
from fgslam.backend.settings import FixedLagSettings, SlidingWindowSettings
from fgslam.backend.smoothers.admission import Track
from fgslam.backend.smoothers.elimination import UndeterminedError
from fgslam.backend.smoothers.final import WholeGraphSolver
from fgslam.backend.smoothers.graph import (
    NewFactors,
    Smoothed,
    Solution,
    TrackedFrame,
    allowed_parts,
    closed_chain,
    drift_undone,
    sighting_columns,
    solver_failed,
)
from fgslam.backend.smoothers.smoother import GraphProblem, MapSmoother, Smoother
from fgslam.backend.smoothers.window import (
    LEAST,
    HeldLandmarks,
    Landmarks,
    SeenAgain,
    Solved,
    Tie,
    Window,
    WindowValues,
)
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import (
    adjoint,
    congruence,
    inverse,
    point_pose_jacobian,
    reorthonormalise,
    transform_to_camera,
)
from fgslam.core.sensors import CameraRig, Increment
from fgslam.core.types import LAGS, EgoMotion, Floor, LandmarkMap, Prediction
from fgslam.factors.graphs import is_pose, landmark_key, pose_key
from fgslam.factors.motion import pose_prior

# ------------------------------------------------------------------------------------------
# Fixed-lag smoothing: poses and landmarks older than the lag are marginalised


_NO_MOTIONS = "covariances of motions between final poses are not known: past the lag none is kept"


def fixed_lag_smoother(
    sensor: CameraRig, settings: FixedLagSettings, floor: Floor, prior: Prediction
) -> LagSmoother:
    """Estimator of kind ``fixed_lag``, at the prior pose with an empty map."""
    problem = GraphProblem.of(sensor, settings, floor, prior, remember=False)
    return LagSmoother(problem, FixedLagSolver(problem, settings))


class FixedLagSolver:
    """Solves a window of the last frames again with each of them."""

    kind: ClassVar[str] = "fixed_lag"

    def __init__(self, problem: GraphProblem, settings: FixedLagSettings) -> None:
        """An empty window."""
        self.builder, self._floor = problem.builder, problem.floor
        self._lag, self._tracker = settings.lag_frames, problem.tracker
        self.window = Window(problem.sensor, problem.builder.kernel)
        self._solved: Solved | None = None
        self._oldest = 0
        self.poses: list[FloatArray] = []
        self._covariances: list[FloatArray] = []
        self.remarks: list[str] = []

    def pose(self, frame: int) -> Prediction:
        """A frame's pose; final before the lag."""
        return Prediction(self.poses[frame], self._covariances[frame])

    def add(self, new: NewFactors, landmarks: LandmarkMap) -> None:
        """Takes in a frame, and lets go what is older than the lag."""
        self.poses.append(np.eye(4))
        self._covariances.append(np.full((6, 6), np.nan))
        self._take(new)
        self._solve()
        for found in self._nuisances():
            self._tracker.know_nuisance(*found)
        self._move_window(landmarks)

    def recalibrate(self, change: RigChange) -> None:
        """Corrects the window's observations again; what has left it is what it was."""
        self.window.remeasure(change)

    def solve_if_due(self, frame: int, closes_loop: bool) -> Smoothed | None:
        """The window's solution, in every frame."""
        return self._smoothed({self._oldest, frame})  # the one that leaves next, and the last one

    def _smoothed(self, frames: set[int]) -> Smoothed:
        """Keeps the covariances of some frames of the window."""
        last = len(self.poses) - 1
        for frame in frames:
            self._covariances[frame] = self._covariance(frame)
        here = Prediction(self.poses[last], self._covariances[last])
        return Smoothed(self.window.values(), here, earlier=earlier_poses(self._at_last()))

    def close(self, loop: Constraint, chain: Chain, wTc: FloatArray, what: str) -> Smoothed | bool:
        """Moves the window as a whole to where the loop has the last pose; the past stays.

        After that the window is solved again from there. A loop within the lag is a factor more.
        """
        inside = loop.before >= self._oldest  # both poses are variables
        if inside:
            self._covariances[loop.before] = self._covariance(loop.before)
        earlier, last = (
            Prediction(self.poses[frame], self._covariances[frame])
            for frame in (loop.before, loop.after)
        )
        found, remark = drift_undone(self._floor, earlier, last, loop, what)
        if found is None:
            self.remarks.append(remark)
            return False
        if inside:
            self.window.factors.add(constraint_factor(loop))
            self._solve()
            self.remarks.append(f"{remark}; within the lag, it is a factor more")
        else:
            self.remarks.append(f"{remark}, and what lies within the lag")
            self._move_all(found)
        return self._smoothed({loop.after})

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
        nuisances = (nuisance_words(k, x, np.diagonal(known)) for k, x, known in self._nuisances())
        return Solution(
            np.array(self.poses),
            covariances,
            dict(zip(inside, places, strict=True)),
            dict(zip(inside, found, strict=True)),
            (_NO_MOTIONS, *nuisances),
        )

    # ----------------------------------------------------------------------------------------

    def _nuisances(self) -> Iterator[tuple[str, FloatArray, FloatArray]]:
        """Of each kind that has any nuisance parameters (3,), as solved, and their covariance."""
        for kind, one in self.window.measured.items():
            if len(at := self.window.nuisance(one.model)):
                yield kind, *self._at_last().eliminated.hidden_numbers(at)

    def _take(self, new: NewFactors) -> None:
        """A frame's pose, landmarks and observations into the window."""
        pose = new.values.atPose3(pose_key(new.frame)).matrix()
        self.window.add_pose(new.frame, pose, new.graph)
        self.window.kernel = self.builder.kernel
        known = self.window.landmarks.variables
        before = int(known[-1]) if len(known) else -1
        seen = [v for v, _ in new.sightings]
        seen += [v for one in new.measured for v in (one.points - landmark_key(0)).tolist()]
        entered = sorted({v for v in seen if v > before})
        if entered:
            self.window.add_landmarks(_landmarks(new, entered))
        if new.sightings:
            frame, variable, measured, noise = sighting_columns(new.sightings).values()
            self.window.observe(frame, variable, measured, self.builder.noise.power * noise)
        for one in new.measured:
            self.window.measure(one)

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
        self._oldest = max(self._oldest, len(self.poses) - 1 - self._lag)
        try:
            self.window.let_go_before(self._oldest, self.builder.admission.staying)
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


def earlier_poses(solved: Solved) -> dict[int, FloatArray]:
    """Joint covariances (12, 12) of poses so many frames before the window's last, and of that."""
    *_, last = frames = list(solved.frames)
    rows = {lag: frames.index(last - lag) for lag in LAGS if last - lag in frames}
    return {lag: solved.eliminated.poses([row, len(frames) - 1]) for lag, row in rows.items()}


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


_PLACE = 20  # frames: what they saw last comes back as one
_SECOND = 2  # frame of the second solution: every fifth, the builder judges the noise
_STIFF = 1e-4  # radians and metres: the least deviation between two places


def sliding_window_smoother(
    sensor: CameraRig, settings: SlidingWindowSettings, floor: Floor, prior: Prediction
) -> MapSmoother:
    """Estimator of kind ``sliding_window``, at the prior pose with an empty map."""
    problem = GraphProblem.of(sensor, settings, floor, prior)
    return MapSmoother(problem, SlidingWindowSolver(problem, settings))


class SlidingWindowSolver(WholeGraphSolver):
    """Solves the last frames every few frames; everything for the answer."""

    kind: ClassVar[str] = "sliding_window"

    def __init__(self, problem: GraphProblem, settings: SlidingWindowSettings) -> None:
        """An empty window."""
        super().__init__(problem.builder, problem.floor)
        self._settings, self._sensor = settings, problem.sensor
        self.window = Window(problem.sensor, problem.builder.kernel)
        self.held = HeldLandmarks()
        self._new: list[NewFactors] = []
        self._solved_at = 0
        self._leaving: Solved | None = None  # the solution, until what is too old has left
        self._taken = 0  # observations of the builder's that were looked at
        self._waiting = np.empty(0, np.int64)  # of them, those of landmarks that may be back
        self.poses: list[FloatArray] = []
        self.drift: list[FloatArray] = []  # (6, 6) covariances, as motions of the world
        self._sizes: list[float] = []  # m^2, variance of each place
        self._last_id, self._busy = -1, False  # of the landmarks; with new ones, not twice in a row

    # -- a frame -----------------------------------------------------------------------------

    def add(self, new: NewFactors, landmarks: LandmarkMap) -> None:
        """Keeps a frame for the window's next solution."""
        self._answer = None
        last, self._last_id = self._last_id, int(landmarks.ids.max(initial=-1))
        self._busy = self._last_id > last and not self._busy
        self._new.append(new)
        self.poses.append(new.values.atPose3(pose_key(new.frame)).matrix())
        self.drift.append(self.drift[-1] if self.drift else np.zeros((6, 6)))
        self._sizes.append(np.inf)
        fresh = map(landmark_key, range(len(self.held), self.builder.variables))
        self.held.enter(np.array([new.values.atPoint3(key) for key in fresh]).reshape(-1, 3))

    def solve_if_due(self, frame: int, closes_loop: bool) -> Smoothed | None:
        """Solves the window where the last solution lies `update_every` frames back.

        What a solution leaves to do is done in the frames between, as what they bring; not in one
        with new landmarks, which has enough to do.
        """
        if closes_loop:
            return None
        if frame and frame - self._solved_at < self._settings.update_every:
            if not self._busy:
                self._let_go()
                self._take_in()
            return None
        self._leaving = solved = self._solve()
        if not frame:
            self._solved_at = min(_SECOND - self._settings.update_every, 0)
        last = self._measured(solved, len(solved.frames) - 1)
        earlier = earlier_poses(solved)
        return Smoothed(self.window.values(), last, self.window.frames[0], earlier=earlier)

    def recalibrate(self, change: RigChange) -> None:
        """Looks again at the window; what has left it moves with where it was seen last.

        It is solved with the next frame.
        """
        super().recalibrate(change)
        self._let_go()
        due = len(self.poses) - self._settings.update_every
        self._solved_at = min(self._solved_at, due)  # with the next frame
        self.window.remeasure(change)
        self._take_in()  # the builder has corrected these already
        frames, variables, *_ = self.builder.kept_observed()
        if len(frames):
            last = np.zeros(len(self.held), np.int64)
            np.maximum.at(last, variables, frames)
            own, poses = ~self.held.saved, np.array(self.poses)[last]
            self.held.points[own] = change.moved(poses[own], self.held.points[own])

    # -- into the window and out of it -------------------------------------------------------

    def _take_in(self) -> None:
        """The frames since the last solution, and what they saw."""
        window, new, self._new = self.window, self._new, []
        window.kernel = self.builder.kernel
        for frame in new:
            factors = gtsam.NonlinearFactorGraph()
            for row in range(frame.graph.size()):
                factor = frame.graph.at(row)
                (key, *_) = factor.keys()
                if is_pose(key):
                    factors.add(factor)
                else:
                    known = factor.prior(), factor.noiseModel().covariance()
                    variable = key - landmark_key(0)
                    saved = self.builder.of_saved_map(variable)
                    self.held.know(variable, *known, saved)
            window.add_pose(frame.frame, self.poses[frame.frame], factors)
        self._observe()

    def _observe(self) -> None:
        seen, new = self.builder.observed, np.arange(self._taken, len(self.builder.observed))
        self._taken = len(seen)
        self._give_up_waiting()
        rows = self._inside(np.concatenate([self._waiting, new]))
        outside = ~np.isin(seen["variable"][rows], self.window.landmarks.variables)
        self._bring(self._newest(rows[outside]))
        waiting = ~np.isin(seen["variable"][rows], self.window.landmarks.variables)
        self._waiting, rows = rows[waiting], rows[~waiting]
        covariance = self.builder.noise.power * seen["covariance"][rows]
        variables, measured = seen["variable"][rows], seen["measurement"][rows]
        self.window.observe(seen["frame"][rows], variables, measured, covariance)

    def _inside(self, rows: IntArray) -> IntArray:
        """Of observations those from the window's frames that were not taken out."""
        seen = self.builder.observed
        inside = seen["frame"][rows] >= self.window.frames[0]
        return np.asarray(rows[inside & ~seen["gone"][rows]])

    def _newest(self, rows: IntArray) -> IntArray:
        """Of observations in their order the last one of each landmark, by ascending variable."""
        variables = self.builder.observed["variable"][rows]
        last = np.unique(variables[::-1], return_index=True)[1]
        return np.asarray(rows[::-1][last])

    def _bring(self, rows: IntArray) -> None:
        """Landmarks, by an observation each, into the window, but those that have yet to wait.

        What was known of them when they left it comes along.
        """
        variables = self.builder.observed["variable"][rows]
        places = self.held.homes[variables] // _PLACE
        for place in np.unique(places[places >= 0]).tolist():
            back, tie = variables[places == place], None
            if place not in self.window.places:
                back, tie = self._back(rows[places == place], place), self.tie_of(place)
            if len(back):
                self.window.bring_back(self.held.of(back), place, tie)
        self.window.add_landmarks(self.held.of(variables[self.held.homes[variables] < 0]))

    def _back(self, rows: IntArray, place: int) -> IntArray:
        """Variables of landmarks of a place that are surely back; where many are, no other is."""
        seen = self._placed(rows)
        known = self.held.of(seen.variables)
        there = seen.returned(known, self.window.poses[0], self._drift_since(place))
        if there.sum() >= LEAST:
            self._begin_elsewhere(seen.select(~there))
        return np.asarray(seen.variables[there])

    def _placed(self, rows: IntArray) -> SeenAgain:
        """Landmarks where observations (k,) of one each have them."""
        seen, power = self.builder.observed, self.builder.noise.power
        poses = np.array([self.poses[frame] for frame in seen["frame"][rows].tolist()])
        measured = seen["measurement"][rows], power * seen["covariance"][rows]
        return SeenAgain.of(self._sensor, self.held.of(seen["variable"][rows]), poses, *measured)

    def _give_up_waiting(self) -> None:
        """Landmarks that the window does not show to be back begin where they are seen now."""
        seen, rows = self.builder.observed, self._waiting
        late = seen["frame"][rows] < self.window.frames[0]
        of_late = np.isin(seen["variable"][rows], seen["variable"][rows[late]])
        self._begin_elsewhere(self._placed(self._newest(self._inside(rows[of_late]))))

    def _begin_elsewhere(self, seen: SeenAgain) -> None:
        """What was known of landmarks was of others; those too far to be placed wait on."""
        self.held.begin(seen.variables[seen.near], seen.points[seen.near])

    def tie_of(self, place: int) -> Tie:
        """How a place is off, given the one next to it, or the window's first pose."""
        own, frame, follows = self.frame_of(place), self.window.frames[0], None
        for other in self.window.places:
            if abs(self.frame_of(other) - own) < abs(frame - own):
                frame, follows = self.frame_of(other), other
        shared, drift, of_other = self._drifts(own, frame)
        gain = np.linalg.solve(of_other, shared).T
        rest = nearest_positive(drift - gain @ shared) + _STIFF**2 * np.eye(6)
        return Tie(follows, np.asarray(gain), np.asarray(np.linalg.inv(rest)))

    def _drift_since(self, place: int) -> FloatArray:
        """(6, 6) covariance of the motion between a place and the window's first pose."""
        shared, drift, here = self._drifts(self.frame_of(place), self.window.frames[0])
        return nearest_positive(drift + here - 2.0 * shared) + _STIFF**2 * np.eye(6)

    def _drifts(self, own: int, other: int) -> list[FloatArray]:
        """(6, 6) of what two frames share, and of each, in the axes of the window's first pose.

        Drift adds up: they share that of the best known frame between them.
        """
        here = inverse(self.window.poses[0])
        begin, end = min(own, other), max(own, other)
        least = begin + int(np.argmin(self._sizes[begin : end + 1]))
        return [
            congruence(adjoint(here), self.drift[frame]) + _STIFF**2 * np.eye(6)
            for frame in (least, own, other)
        ]

    def frame_of(self, place: int) -> int:
        """The frame whose drift is a place's."""
        return min(place * _PLACE + _PLACE // 2, self.window.frames[0])

    def _solve(self) -> Solved:
        self._let_go()
        self._take_in()
        self._solved_at = self.window.frames[-1]
        try:
            solved = self.window.repaired(self.window.take_out, self._failed)
        except EstimatorError:
            self._begin_again()
            solved = self.window.repaired(self.window.take_out, self._failed)
        for frame, pose in zip(self.window.frames, self.window.poses, strict=True):
            self.poses[frame] = pose.copy()  # a view would keep the whole window's array
        self.held.points[self.window.landmarks.variables] = self.window.landmarks.points
        if self.window.places:  # the tracker's map is uncertain: some of it may have moved
            self.builder.noise.smoothed(self.window.frames, self.window.poses)
        return solved

    def _let_go(self) -> None:
        """Lets the window begin so many frames back, in the frame after its solution."""
        solved, self._leaving = self._leaving, None
        leaving = len(self.window.frames) - self._settings.window
        if solved is not None and leaving > 0:
            first, home = self.window.frames[leaving], self.window.frames[leaving - 1]
            for row in (leaving - 1, leaving):
                self._measured(solved, row)
            try:
                self.held.left(self.window.let_go_before(first), home)
            except (UndeterminedError, np.linalg.LinAlgError):
                self._begin_again()

    def _begin_again(self) -> None:
        """What has left, known too unevenly to be solved, gives way to the first pose's place."""
        first = self.window.frames[0]
        self.window.carried_along(np.eye(4), pose_prior(pose_key(first), self._at(first)))
        self.remarks.append(
            f"known too unevenly at frame {self.builder.frames[-1]}: the window begun again"
        )

    def _measured(self, solved: Solved, row: int) -> Prediction:
        """A pose of the window's solution, and its covariance, which is noted as its drift."""
        frame, pose = self.window.frames[row], self.window.poses[row]
        covariance = solved.eliminated.pose(row)
        found = Prediction(pose, allowed_parts(self._floor, pose[None], covariance[None])[0])
        self._note(frame, found)
        return found

    def _note(self, frame: int, found: Prediction) -> None:
        self.drift[frame] = congruence(adjoint(found.wTc), found.covariance)
        self._sizes[frame] = float(np.trace(found.covariance[3:, 3:]))

    # -- loops -------------------------------------------------------------------------------

    def close(self, loop: Constraint, chain: Chain, wTc: FloatArray, what: str) -> Smoothed | bool:
        """Moves the drive and all that it saw to where the loop has it, the window in one piece.

        A loop within the window is a factor more.
        """
        self._measured(solved := self._solve(), len(solved.frames) - 1)
        inside = loop.before >= self.window.frames[0]
        if inside:
            self._measured(solved, solved.frames.index(loop.before))
        before, last = self._at(loop.before), self._at(loop.after)
        found, remark = drift_undone(self._floor, before, last, loop, what)
        self.remarks.append(remark + ("" if found is None else ", the drive with it"))
        if found is None:
            return False
        self.accept(loop)
        if inside:
            self.window.factors.add(constraint_factor(loop))
            self._leaving = solved = self._solve()
            there = self._measured(solved, len(solved.frames) - 1)
            return Smoothed(self.window.values(), there, self.window.frames[0])
        self.move_by_loop(found, loop, chain)
        every = range(len(self.held))
        values = WindowValues(
            dict(zip(map(pose_key, range(len(self.poses))), self.poses, strict=True)),
            dict(zip(map(landmark_key, every), self.held.points, strict=True)),
        )
        return Smoothed(values, found, by_loop=True)

    def _at(self, frame: int) -> Prediction:
        """A pose as it is now, as uncertain as when it left."""
        pose = self.poses[frame]
        return Prediction(pose, congruence(adjoint(inverse(pose)), self.drift[frame]))

    def move_by_loop(self, last: Prediction, loop: Constraint, chain: Chain) -> None:
        """Spreads the last pose's change over the drive, and takes all landmarks along."""
        window, poses = self.window, np.array(self.poses)
        moved = closed_chain(poses, chain, self.accepted, last.wTc)
        by = changes(poses, moved)
        self.poses = list(moved)
        held = self.held
        held.carried_along(by)
        oldest = window.frames[0]
        whole = last.wTc @ inverse(window.poses[-1])
        to_oldest = adjoint(inverse(window.poses[0]) @ window.poses[-1])
        there = Prediction(whole @ window.poses[0], congruence(to_oldest, last.covariance))
        prior = pose_prior(pose_key(oldest), there)
        window.carried_along(whole, prior, np.flatnonzero(held.saved))
        held.points[window.landmarks.variables] = window.landmarks.points
        for frame, pose in zip(window.frames, window.poses, strict=True):
            self.poses[frame] = pose.copy()
        self._note(oldest, there)
        for frame in window.frames[1:]:
            self.drift[frame], self._sizes[frame] = self.drift[oldest], np.inf
        self._note(window.frames[-1], last)

    # -- all of it ---------------------------------------------------------------------------

    def solve_whole(self) -> Any:
        """The minimum from the poses and landmarks of the window and before it."""
        self.values = self._everything()
        return super().solve_whole()

    def _everything(self) -> Any:
        """GTSAM values of all poses and landmarks."""
        values = gtsam.Values()
        for frame, pose in enumerate(self.poses):
            values.insert(pose_key(frame), gtsam.Pose3(reorthonormalise(pose)))
        for variable, point in enumerate(self.held.points):
            if self.builder.in_graph(variable):
                values.insert(landmark_key(variable), point)
        return values
