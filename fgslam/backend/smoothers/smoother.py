"""A smoother: a tracker in front, the factor graph behind, and one answer from both.

Between two solutions of the graph the paper's filter tracks on the smoothed map: it predicts, gives
the landmarks to match against, and the initial values of what is new. After each solution it
takes over the smoothed pose and positions. So the graph may be solved every frame, every tenth,
or once, and the front-end never waits for it.

The parts: a tracker (:class:`~fgslam.backend.filters.kalman.LandmarkKalman`), a
:class:`~fgslam.backend.smoothers.graph.GraphBuilder`, a
:class:`~fgslam.backend.smoothers.graph.GraphSolver`, and, if not every frame is a variable,
:class:`~fgslam.backend.smoothers.keyframes.Segments`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np

from fgslam.backend.considered import ConsiderCovariance, symmetric_root
from fgslam.backend.filters.filtered import placed, require_finite
from fgslam.backend.filters.kalman import LandmarkKalman, motions_by_lag
from fgslam.backend.loops import (
    CLOSURE_FACTOR,
    Constraint,
    with_unknown_step,
)
from fgslam.backend.persistence import learn_from
from fgslam.backend.protocol import recalibrated
from fgslam.backend.settings import GraphSettings, LandmarkKalmanSettings
from fgslam.backend.smoothers.admission import LandmarkAdmission, Sighting
from fgslam.backend.smoothers.bundle import Turn
from fgslam.backend.smoothers.graph import (
    FactorGraph,
    GraphBuilder,
    GraphSolver,
    Smoothed,
    Solution,
    TrackedFrame,
    carried_to,
    factor_graph,
)
from fgslam.backend.smoothers.keyframes import Segments, fill_between
from fgslam.backend.smoothers.window import WindowValues
from fgslam.core.arrays import FloatArray, IntArray, StateArrays
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import (
    adjoint,
    congruence,
    inverse,
    motion_covariance,
    reorthonormalise,
    transform_to_world,
)
from fgslam.core.sensors import (
    CameraRig,
    Increment,
    LoopClosure,
    MeasurementType,
    Observations,
    Odometry,
)
from fgslam.core.store import pack, unpack
from fgslam.core.types import (
    LAGS,
    EgoMotion,
    EgoMotionStatus,
    Estimate,
    Floor,
    LandmarkMap,
    Prediction,
    Trajectory,
    UpdateStats,
)
from fgslam.factors.graphs import landmarks_in, pose_key, poses_of_frame
from fgslam.frontend.settings import EgoMotionSettings


class Smoother:
    """A smoothing estimator, on :class:`fgslam.backend.protocol.Estimator`."""

    supports: ClassVar[frozenset[MeasurementType]] = frozenset(MeasurementType)

    def __init__(
        self, problem: GraphProblem, solver: GraphSolver, segments: Segments | None = None
    ) -> None:
        """Starts at the problem's prior pose with an empty map.

        Args:
            problem: the tracker, the builder, and what they share.
            solver: of the builder's graph.
            segments: chooses the keyframes; None: every frame is a variable.
        """
        self._sensor, self._floor = problem.sensor, problem.floor
        self.tracker, self.builder = problem.tracker, problem.builder
        self.solver, self._segments = solver, segments
        self._map = TrackerMap(problem.sensor, problem.tracker, problem.builder.admission)
        self.inputs: list[Input] = []
        self._smoothed = problem.prior
        self._answer: Solution | None = None
        self._takeovers = 0
        self._eras: list[int] = []
        self._considered = ConsiderCovariance(problem.sensor, problem.floor)
        self._added: list[FloatArray] = []  # (6, 6) a frame: added to its pose when it came
        self._earlier: Mapping[int, FloatArray] = {}  # of the last frame, as in Smoothed
        self._online: list[Prediction] = []  # the last poses as first estimated
        self._motions: list[FloatArray] = []  # (l, 6, 6) a frame

    def update(self, increment: Increment, tracking: EgoMotion) -> UpdateStats:
        """Tracks the frame, adds it to the graph, solves the graph if it is time to.

        Raises:
            EstimatorError: a number is not finite, or time does not increase; the state is then as
                before. Or the solver failed beyond repair; the estimator is then at its end.
        """
        if self.inputs:
            before = self.tracker.predict(None).wTc
            times = (one.increment.timestamp for one in self.inputs)
            increment = with_unknown_step(increment, tracking, before, times)
        require_finite(increment, tracking)
        recalibrated(self, increment.rig_correction, increment.rig_since)
        before = self.tracker.predict(None).wTc
        # The tracker's covariances are given the graph's, and so are not uncertain themselves.
        plain = dataclasses.replace(increment, loops=(), rig_correction=None)
        stats = self.tracker.update(plain, tracking)
        if increment.measured:
            now = self.tracker.predict(None)
            tracking = dataclasses.replace(tracking, wTc=now.wTc, covariance=now.covariance)
        self._record(increment, tracking)
        learn_from(self.builder.noise, len(self.inputs) - 1, increment, tracking, before)
        tracked = self._admitted(increment, tracking)
        at_once = bool(increment.loops or increment.measured)
        entering = self._entering(tracked, at_once)
        for frame in entering:
            self._add(frame)
        if entering:
            self._solve(entering[-1], tracked, bool(increment.loops))
        closed = tuple(self._close(loop, increment.index) for loop in increment.loops)
        current = self._current(tracking)
        self._considered.observe(increment, current.wTc)
        self._added.append(self._considered.of_pose())
        self._motions.append(self._motions_to(current))
        covariance = current.covariance + self._added[-1]
        return dataclasses.replace(stats, wTc=current.wTc, covariance=covariance, closed=closed)

    # -- its steps -----------------------------------------------------------------------------

    def _record(self, increment: Increment, tracking: EgoMotion) -> None:
        self.inputs.append(Input(increment, tracking))
        self.builder.note(increment)
        self._eras.append(self._takeovers)
        self._answer = None

    def _admitted(self, increment: Increment, tracking: EgoMotion) -> TrackedFrame:
        """The frame with those observations that fit; landmarks that moved have started again."""
        admission, observed = self.builder.admission, increment.observations
        matched = observed.select(~observed.is_new)
        used, outliers = admission.judge(tracking)
        admission.pruned(increment.pruned_ids)
        admission.confirmed(matched.ids[~outliers])
        moved = admission.contradicted(self._held(matched.select(outliers)), tracking.wTc)
        self._restart(moved)
        used &= ~np.isin(matched.ids, moved.ids)
        if not tracking.status.measured:  # what matched agrees on no pose: chance would
            used &= ~increment.rejected[~observed.is_new]
        accepted = matched.select(used).join(observed.select(observed.is_new)).join(moved)
        frame, step = len(self.inputs) - 1, increment.odometry
        turn, measured = Turn.of((step,)), increment.measured
        held = self._held(accepted)
        known = tracking.covariance
        return TrackedFrame(frame, tracking.wTc, step, held, turn, None, measured, known)

    def _held(self, observed: Observations) -> Observations:
        """Those of landmarks that are in the map, pruned ones no longer."""
        return observed.select(np.isin(observed.ids, self.tracker.landmarks().ids))

    def _restart(self, moved: Observations) -> None:
        """Landmarks that were contradicted too often begin again where they are seen now."""
        ids = moved.ids.tolist()
        why = "was seen elsewhere in frame after frame: moved, started again"
        self.builder.admission.restart(ids, why)
        self.tracker.restart(moved)
        self._considered.forget(moved.ids)
        if self._segments is not None:
            self._segments.forget(ids)

    def _entering(self, tracked: TrackedFrame, at_once: bool) -> list[TrackedFrame]:
        """What now enters the graph: this frame, or a segment that it completes, or nothing."""
        if self._segments is None:
            return [tracked]
        return self._segments.take(tracked, self.tracker.landmarks(), at_once)

    def _add(self, frame: TrackedFrame) -> None:
        landmarks = self.tracker.landmarks()
        self._map.entered(frame.frame, frame.wTc)
        self.solver.add(self.builder.add(frame, landmarks), landmarks)

    def _solve(self, entered: TrackedFrame, tracked: TrackedFrame, closes_loop: bool) -> None:
        smoothed = self.solver.solve_if_due(tracked.frame, closes_loop)
        self._earlier = {}
        if smoothed is not None:
            last = smoothed.last
            if entered.frame == tracked.frame:
                self._earlier = smoothed.earlier
            if self._segments is not None:
                since = inverse(entered.wTc) @ tracked.wTc  # as it was tracked
                covariance = congruence(adjoint(inverse(since)), last.covariance)
                last = Prediction(reorthonormalise(last.wTc @ since), covariance)
            self._take_over(smoothed, last)

    def _take_over(self, smoothed: Smoothed, current: Prediction) -> None:
        self._smoothed = current
        self._takeovers += 1
        self._map.take_over(smoothed, current)

    def _close(self, loop: LoopClosure, index: int) -> bool:
        """Closes a loop of the frame just taken in, or refuses it."""
        known = self._between(loop)
        what = f"frame {index}: loop closure to frame {loop.frame} of the log"
        wTc = self.tracker.predict(None).wTc
        closed = self.solver.close(known, self.tracker.chain, wTc, what)
        if isinstance(closed, Smoothed):
            self._take_over(closed, closed.last)
        return closed is not False

    def _between(self, loop: LoopClosure) -> Constraint:
        """A loop between poses of the graph, the last of which is the present frame's.

        An earlier frame that has none gives way to the nearest one that was tracked on the same
        map, since only the tracked poses of such are relative to each other.
        """
        last = len(self.inputs) - 1
        if not 0 <= loop.frame < last:
            raise EstimatorError(
                f"{self.kind}: a loop closure of frame {last} of the log leads to frame "
                f"{loop.frame}, which does not come before it; correct the log"
            )
        era, frames = self._eras[loop.frame], self.builder.frames
        fellows = [frame for frame in frames if self._eras[frame] == era] or frames
        near = min(fellows, key=lambda frame: abs(frame - loop.frame))
        covariance = CLOSURE_FACTOR**2 * loop.covariance
        loop = dataclasses.replace(loop, covariance=covariance)
        return carried_to(near, loop, lambda frame: self.inputs[frame].tracking, last)

    def _current(self, tracking: EgoMotion) -> Prediction:
        """The last pose: the tracker's, whose map is as uncertain as the pose last smoothed."""
        now = self.tracker.predict(None)
        if now.wTc is self._smoothed.wTc:
            return self._smoothed
        moved = adjoint(inverse(now.wTc) @ self._smoothed.wTc)
        drift = congruence(moved, self._smoothed.covariance)
        since = self.tracker.since_correction
        if since is None:
            weighed = self.builder.noise.power / tracking.noise  # as the graph weighs it
            since = weighed * tracking.covariance
        return Prediction(now.wTc, self._floor.allowed_part(now.wTc, drift + since))

    def _motions_to(self, current: Prediction) -> FloatArray:
        """(l, 6, 6) of the motions over LAGS frames, from poses as first estimated to the last one.

        Errors of the last pose are independent of the corrections of an earlier one since it was
        first estimated: it is as much less certain as it was then. NaN where that is not known.
        """
        out, of_rig = self.tracker.motions.copy(), self._considered.motions(current.wTc)
        for row, lag in enumerate(LAGS):
            if lag in self._earlier and lag <= len(self._online):
                before, joint = self._online[-lag], self._earlier[lag]
                motion = inverse(before.wTc) @ current.wTc
                less = symmetric_root(before.covariance - joint[:6, :6])  # 0 where it was surer
                then = joint[:6, :6] + less @ less
                found = motion_covariance(motion, then, joint[6:, 6:], joint[:6, 6:])
                out[row] = self._floor.allowed_part(current.wTc, found)
            out[row] += of_rig.get(lag, 0.0)
        self._online = [*self._online, current][-max(LAGS) :]
        return out

    # -- what is asked of it -------------------------------------------------------------------

    @property
    def kind(self) -> str:
        """The solver's."""
        return self.solver.kind

    @property
    def noise_factors(self) -> tuple[float, float]:
        """Factors on stated deviations: of a single measurement, and as the graph weighs them."""
        noise = self.builder.noise
        return float(np.sqrt(noise.spread)), float(np.sqrt(noise.power))

    def predict(self, odometry: Odometry | None) -> Prediction:
        """Pose after the camera moved by ``odometry``."""
        return self.tracker.predict(odometry)

    def landmarks(self) -> LandmarkMap:
        """Smoothed landmarks with what is known of them given the poses."""
        return self.tracker.landmarks()

    def estimate(self) -> Estimate:
        """All poses and landmarks as the graph has them now, with their marginals."""
        if not len(self.inputs):
            return self.tracker.estimate()
        answer = self._solved()
        covariances, landmarks = answer.pose_covariances, self._map.reported(answer)
        relative = answer.relative if answer.considers_rig or not self._considered.present else {}
        if self._considered.present and not answer.considers_rig:
            covariances = covariances + np.array(self._added)
            landmarks = self._considered.landmarks(landmarks)
        return Estimate(
            Trajectory(np.array([one.increment.timestamp for one in self.inputs]), answer.poses),
            covariances,
            landmarks,
            (*self.solver.remarks, *self.builder.admission.remarks, *answer.remarks),
            noise_factor=float(np.sqrt(self.builder.noise.power * answer.noise_ratio)),
            gyroscope=answer.gyroscope,
            relative={
                lag: np.concatenate([one, np.full((n - lag - len(one), 6, 6), np.nan)])
                for lag, one in relative.items()
                if (n := len(self.inputs)) > lag
            },
            online_relative=motions_by_lag(self._motions),
        )

    def _solved(self) -> Solution:
        """The graph's answer, with the poses of frames between keyframes."""
        if self._answer is None:
            self._answer = self.solver.solution()
            if self._segments is not None:
                tracks = self.builder.admission.tracks
                variable_of = {i: track.variable for i, track in tracks.items()}
                between = self._segments.between
                motions = [one.increment.odometry for one in self.inputs]
                self._answer = fill_between(
                    self._sensor, self._floor, self._answer, between, motions, variable_of
                )
        return self._answer

    def recalibrate(self, correction: FloatArray, since: int = 0) -> None:
        """Where the tracker's map moves, corrects all that was measured since then again."""
        change = self.tracker.recalibrate(correction, since)
        if change is None:
            return
        self._answer = None
        self.builder.recalibrate(change)
        if self._segments is not None:
            self._segments.recalibrate(change)
        self.solver.recalibrate(change)

    def state(self) -> StateArrays:
        """Everything that was put in: a solver's inside has no arrays, but repeats to the bit."""
        return pack([one.used for one in self.inputs])

    def restore(self, state: StateArrays) -> None:
        """Repeats all updates of :meth:`state`."""
        if len(self.inputs):
            raise EstimatorError("only a new estimator can be restored")
        for increment, tracking in unpack(state, list[Input]):
            self.update(increment, tracking)


class MapSmoother(Smoother):
    """A smoother that keeps its whole graph, and so can begin in a saved map (``MapUser``)."""

    def graph(self) -> FactorGraph:
        """The graph so far, at its solution."""
        return factor_graph(self.builder, self.solver.solution())

    @property
    def keeps_maps(self) -> bool:
        """False: a smoother's landmarks are what it estimates."""
        return False

    def begin_in(self, landmarks: LandmarkMap, hits: IntArray, fixed: bool) -> None:
        """Takes a saved map over: a prior factor for each landmark that is seen again."""
        self.tracker.begin_in(landmarks, hits, fixed=False)
        self.builder.admission.know(landmarks)


@dataclasses.dataclass(frozen=True, slots=True, eq=False)
class GraphProblem:
    """Where a run takes place, what its graph is made by, and from where it starts.

    Attributes:
        sensor: the cameras.
        settings: of the graph.
        floor: on which the robot stays.
        prior: pose of the first frame and its covariance.
        tracker: the filter in front.
        builder: of the graph.
    """

    sensor: CameraRig
    settings: GraphSettings
    floor: Floor
    prior: Prediction
    tracker: LandmarkKalman
    builder: GraphBuilder

    @staticmethod
    def of(
        sensor: CameraRig,
        settings: GraphSettings,
        floor: Floor,
        prior: Prediction,
        remember: bool = True,
        ego_motion: EgoMotionSettings | None = None,
    ) -> GraphProblem:
        """A tracker and a builder at the prior, both empty; ``remember`` as GraphBuilder's.

        ``ego_motion`` as LandmarkKalman's: of a solver that leaves the poses on the way to it.
        """
        tracker = LandmarkKalman(sensor, LandmarkKalmanSettings(), prior, ego_motion)
        builder = GraphBuilder(sensor, settings, floor, prior, remember)
        return GraphProblem(sensor, settings, floor, prior, tracker, builder)


class Input(NamedTuple):
    """What an update was given."""

    increment: Increment
    tracking: EgoMotion

    @property
    def used(self) -> Input:
        """With that alone of the tracking which a smoother uses: the same from a log."""
        found = self.tracking
        measured = found.status.measured
        status = EgoMotionStatus.OK if measured else EgoMotionStatus.TOO_FEW_MATCHES
        kept = found.wTc, found.covariance, found.inliers, found.residuals, status, 0
        return Input(self.increment, EgoMotion(*kept, noise=found.noise))


# ------------------------------------------------------------------------------------------
# The tracker's map next to the graph's: what it takes over from a solution, and what is reported


class TrackerMap:
    """Keeps the tracker's map in step with the graph's."""

    def __init__(
        self, sensor: CameraRig, tracker: LandmarkKalman, admission: LandmarkAdmission
    ) -> None:
        """The two maps, both still empty."""
        self._sensor = sensor
        self._tracker = tracker
        self._admission = admission
        self._anchors: dict[int, FloatArray] = {}

    def entered(self, frame: int, wTc: FloatArray) -> None:
        """Notes the pose (4, 4) with which a frame entered the graph."""
        self._anchors[frame] = wTc

    def take_over(self, smoothed: Smoothed, current: Prediction) -> None:
        """Lets the tracker go on from a solution, at its ``current`` pose.

        Landmarks that the graph knows nothing of stay; where a loop moved the map they
        move along with the last pose, near which they are, unless they are a saved map's.
        """
        ids, variables, frames = self._admission.recent(smoothed.since)
        inside = variables >= 0
        waiting_ids, waiting_positions = self._waiting(
            smoothed.values, ids[~inside], frames[~inside]
        )
        ids, positions = self._in_graph(smoothed.values, ids[inside], variables[inside])
        ids = np.concatenate([ids, waiting_ids])
        positions = np.concatenate([positions, waiting_positions])
        if smoothed.by_loop:
            known = self._tracker.landmarks()
            rest = np.flatnonzero(~np.isin(known.ids, ids) & (self._tracker.homes >= 0))
            moved = current.wTc @ inverse(self._tracker.predict(None).wTc)
            ids = np.concatenate([ids, known.ids[rest]])
            positions = np.concatenate(
                [positions, transform_to_world(moved, known.positions[rest])]
            )
        self._tracker.correct(current, ids, positions)

    def reported(self, answer: Solution) -> LandmarkMap:
        """The tracker's landmarks where the graph has them; those that wait, from their pose."""
        known = self._tracker.landmarks()
        positions, covariances = known.positions.copy(), known.covariances.copy()
        waiting: dict[int, list[tuple[int, Sighting]]] = {}
        for row, identity in enumerate(known.ids.tolist()):
            track = self._admission.tracks.get(identity)
            if track is None:
                continue
            if track.variable in answer.points:
                positions[row] = answer.points[track.variable]
                covariances[row] = answer.point_covariances[track.variable]
            elif track.left_at is not None:
                positions[row], covariances[row] = track.left_at
            else:
                waiting.setdefault(track.last.frame, []).append((row, track.last))
        for frame, seen in waiting.items():
            rows = [row for row, _ in seen]
            found = self._seen_from(answer, frame, [sighting for _, sighting in seen])
            positions[rows], covariances[rows] = found
        return LandmarkMap(known.ids.copy(), positions, covariances)  # theirs change later

    def _in_graph(
        self, values: Any, ids: IntArray, wanted: IntArray
    ) -> tuple[IntArray, FloatArray]:
        """Those landmarks (k,) of the tracker that ``values`` hold by variables (k,); positions."""
        inside = isinstance(values, WindowValues)
        variables, positions = values.landmarks() if inside else landmarks_in(values)
        known = np.isin(wanted, variables) & np.isin(ids, self._tracker.landmarks().ids)
        return ids[known], positions[np.searchsorted(variables, wanted[known])]

    def _waiting(self, values: Any, ids: IntArray, frames: IntArray) -> tuple[IntArray, FloatArray]:
        """Landmarks (k,) outside the graph, moved along with the frames (k,) that saw them last."""
        present = [f for f in np.unique(frames).tolist() if values.exists(pose_key(f))]
        anchors = {frame: poses_of_frame(values, frame) for frame in present}
        order = np.argsort(frames, kind="stable")
        order = order[np.isin(frames[order], present)]
        ids, frames = ids[order], frames[order]
        known = self._tracker.landmarks()
        positions = known.positions[known.rows(ids)]
        first = np.searchsorted(frames, [*present, np.inf])
        for k, (frame, wTc) in enumerate(anchors.items()):
            # One just taken out of the graph is where the graph had it, and follows from here.
            moved = wTc @ inverse(self._anchors.get(frame, wTc))
            own = slice(first[k], first[k + 1])
            positions[own] = transform_to_world(moved, positions[own])
        self._anchors = anchors
        return ids, positions

    def _seen_from(
        self, answer: Solution, frame: int, sightings: list[Sighting]
    ) -> tuple[FloatArray, FloatArray]:
        """Positions (k, 3) and covariances (k, 3, 3) of landmarks, each by one sighting of it."""
        measured = np.array([sighting.measurement for sighting in sightings])
        covariances = np.array([sighting.covariance for sighting in sightings])
        pose_covariance = answer.pose_covariances[frame]
        return placed(self._sensor, answer.poses[frame], measured, covariances, pose_covariance)
