"""What all smoothers share: a tracker in front, the graph behind, and one answer from both.

Between two solutions of the graph the paper's filter tracks on the smoothed map: it predicts, gives
the landmarks to match against, and the initial values of what is new. After each solution it
takes over the smoothed pose and positions. So the graph may be solved every frame, every tenth,
or once, and the front-end never waits for it.
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np

from fgslam.backend.filters.landmark_kalman import LandmarkKalman
from fgslam.backend.filters.settings import LandmarkKalmanSettings
from fgslam.backend.filters.submaps import FREE, Constraint
from fgslam.backend.inputs import RecordedInputs, require_finite
from fgslam.backend.smoothers.graph_builder import GraphBuilder, NewFactors, Sighting
from fgslam.backend.smoothers.graph_solution import Solution, joint_of, poses_of_frame
from fgslam.backend.smoothers.loop_closing import carried_to
from fgslam.backend.smoothers.refinement import Refined
from fgslam.backend.smoothers.segments import TrackedFrame
from fgslam.backend.smoothers.settings import GraphSettings
from fgslam.core.arrays import BoolArray, FloatArray, IntArray, StateArrays
from fgslam.core.errors import EstimatorError
from fgslam.core.estimates import (
    EgoMotion,
    Estimate,
    LandmarkMap,
    Prediction,
    Trajectory,
    UpdateStats,
)
from fgslam.core.floor import Floor
from fgslam.core.geometry import (
    adjoint,
    congruence,
    inverse,
    point_pose_jacobian,
    transform_to_world,
    triangulate,
    triangulation_covariance,
)
from fgslam.core.measurements import Increment, LoopClosure, MeasurementType, Observations, Odometry
from fgslam.core.sensors import CameraRig, Sensor
from fgslam.factors.keys import landmark_key, pose_key

_ASTRAY_PX = 12.0  # where nothing is left out: farther off, a match speaks against its landmark


class Smoother(ABC):
    """Base of the smoothers; they say when the graph is solved, and how."""

    kind: ClassVar[str]
    supports: ClassVar[frozenset[MeasurementType]] = frozenset(MeasurementType)

    def __init__(
        self,
        sensor: Sensor,
        settings: GraphSettings,
        floor: Floor,
        prior: Prediction,
        remember: bool = True,
    ) -> None:
        """Starts at the prior pose with an empty map; ``remember`` as GraphBuilder's."""
        self._sensor = sensor
        self._floor = floor
        self._gate_px = settings.gate_px
        self._tracker = LandmarkKalman(sensor, LandmarkKalmanSettings(loops=settings.loops), prior)
        self._builder = GraphBuilder(sensor, settings, floor, prior, remember)
        self._inputs = RecordedInputs()
        self._smoothed = prior
        self._remarks: list[str] = []
        self._answer: Solution | None = None
        self._refined: Refined | None = None
        self._anchors: dict[int, FloatArray] = {}
        self._frozen: dict[int, tuple[FloatArray, FloatArray]] = {}
        self._loop_settings = settings.loops
        self._loops: list[Constraint] = []
        self._takeovers = 0
        self._eras: list[int] = []

    # -- the protocol ------------------------------------------------------------------------

    def predict(self, odometry: Odometry | None) -> Prediction:
        """Pose after the camera moved by ``odometry``."""
        return self._tracker.predict(odometry)

    def landmarks(self) -> LandmarkMap:
        """Smoothed landmarks with what is known of them given the poses."""
        return self._tracker.landmarks()

    def update(self, increment: Increment, tracking: EgoMotion) -> UpdateStats:
        """Tracks the frame, adds it to the graph, solves the graph if it is time to.

        Raises:
            EstimatorError: a number is not finite, or time does not increase; the state is then as
                before. Or the solver failed beyond mending; the estimator is then at its end.
        """
        if increment.relocalised and self._inputs.increments:
            increment = dataclasses.replace(increment, odometry=self._unknown_step(tracking))
        require_finite(increment, tracking)
        stats = self._tracker.update(dataclasses.replace(increment, loops=()), tracking)
        self._inputs.append(increment, tracking)
        self._eras.append(self._takeovers)
        self._answer = self._refined = None
        self._absorb(self._sorted_out(increment, tracking))
        where = f"frame {increment.index}"
        closed = tuple(self._close(loop, where) for loop in increment.loops)
        current = self._current(tracking)
        return UpdateStats(
            current.wTc, current.covariance, stats.landmarks, stats.nis, stats.nis_dof, closed
        )

    def estimate(self) -> Estimate:
        """All poses and landmarks as the graph has them now, with their marginals."""
        if not self._inputs.increments:
            return self._tracker.estimate()
        answer = self._solved()
        return Estimate(
            Trajectory(self._inputs.timestamps(), answer.poses),
            answer.pose_covariances,
            self._map(answer),
            (*self._remarks, *self._builder.remarks, *answer.remarks),
        )

    def landmark_covariances(self, ids: IntArray) -> FloatArray:
        """Marginal covariances (k, 3, 3) of the named landmarks."""
        self._tracker.landmarks().rows(ids)
        found = self.estimate().landmarks
        return found.covariances[found.rows(ids)]

    def joint_covariance(self, ids: IntArray) -> FloatArray:
        """Joint covariance of the last pose and the named landmarks."""
        self._tracker.landmarks().rows(ids)
        tracks = [self._builder.tracks.get(i) for i in ids.tolist()]
        variables = [-1 if track is None else track.variable for track in tracks]
        outside = [i for i, v in zip(ids.tolist(), variables, strict=True) if v < 0]
        if outside:
            raise EstimatorError(
                f"landmark {outside[0]} waits outside the graph until it is constrained; ask for "
                "its marginal instead"
            )
        return self._joint(variables)

    def state(self) -> StateArrays:
        """Everything that was put in: a solver's inside has no arrays, but repeats to the bit."""
        return self._inputs.to_arrays(self._sensor)

    def restore(self, state: StateArrays) -> None:
        """Repeats all updates of :meth:`state`."""
        if self._inputs.increments:
            raise EstimatorError("only a new estimator can be restored")
        for increment, tracking in RecordedInputs.from_arrays(state):
            self.update(increment, tracking)

    # -- what a smoother adds ----------------------------------------------------------------

    @abstractmethod
    def _absorb(self, tracked: TrackedFrame) -> None:
        """Takes a frame in; solves when it is time to."""

    @abstractmethod
    def _close(self, loop: LoopClosure, where: str) -> bool:
        """Closes a loop of the frame just taken in, which ``where`` names; or refuses it."""

    @abstractmethod
    def _solve(self) -> Solution:
        """All poses and landmarks, with covariances."""

    def _refine(self) -> Refined:
        """The whole graph, solved; for smoothers that keep it."""
        raise NotImplementedError

    def _refined_graph(self) -> Refined:
        if self._refined is None:
            self._refined = self._refine()
        return self._refined

    def _joint(self, variables: list[int]) -> FloatArray:
        """Joint covariance of the graph's last pose and landmark variables."""
        refined = self._refined_graph()
        lost = set(variables) - set(refined.variables)
        if lost:
            raise EstimatorError(f"{self._builder.describe(min(lost))} was left out of the graph")
        last = self._builder.frames[-1]
        return joint_of(refined.graph, refined.values, self._floor, last, variables)

    def _failed(self, error: Exception, when: str = "at") -> EstimatorError:
        """What to raise where a solver's failure is beyond mending."""
        return EstimatorError(
            f"{self.kind}: the solver failed {when} frame {self._builder.frames[-1]} "
            f"({' '.join(str(error).split())}); look at that frame with fgslam inspect"
        )

    # -- common steps ------------------------------------------------------------------------

    def _sorted_out(self, increment: Increment, tracking: EgoMotion) -> TrackedFrame:
        """The frame with those observations that fit; landmarks that moved have started anew."""
        observed = increment.observations
        matched = observed.select(~observed.is_new)
        used, astray = self._judged(tracking)
        self._builder.note(increment.pruned_ids)
        self._builder.confirmed(matched.ids[~astray])
        moved = self._builder.contradicted(self._held(matched.select(astray)), tracking.wTc)
        self._restart(moved)
        used &= ~np.isin(matched.ids, moved.ids)
        accepted = matched.select(used).join(observed.select(observed.is_new)).join(moved)
        frame = len(self._inputs.increments) - 1
        return TrackedFrame(frame, tracking.wTc, increment.odometry, self._held(accepted))

    def _judged(self, tracking: EgoMotion) -> tuple[BoolArray, BoolArray]:
        """Which matched observations are used, and which speak against their landmark's place."""
        astray = ~tracking.inliers
        if isinstance(self._sensor, CameraRig):
            astray = astray & ~(tracking.residuals <= (self._gate_px or _ASTRAY_PX))
        return (~astray if self._gate_px else np.ones(len(astray), np.bool_)), astray

    def _held(self, observed: Observations) -> Observations:
        """Those of landmarks that are in the map, pruned ones no longer."""
        return observed.select(np.isin(observed.ids, self._tracker.landmarks().ids))

    def _restart(self, moved: Observations) -> None:
        """Landmarks that were contradicted too often begin anew where they are seen now."""
        why = "was seen elsewhere in frame after frame: moved, started anew"
        self._builder.start_anew(moved.ids.tolist(), why)
        self._tracker.restart(moved)
        for identity in moved.ids.tolist():
            self._frozen.pop(identity, None)

    def _unknown_step(self, tracking: EgoMotion) -> Odometry:
        """The step to a frame found without a prior: as found, and free to be any other."""
        before = self._tracker.predict(None).wTc
        return Odometry(inverse(before) @ tracking.wTc, FREE, measured=False)

    def _enter(self, tracked: TrackedFrame) -> NewFactors:
        """Enters a frame into the graph."""
        self._anchors[tracked.frame] = tracked.wTc
        return self._builder.add(tracked, self._tracker.landmarks())

    def _take_over(self, values: Any, current: Prediction, whole: bool = False) -> None:
        """Lets the tracker go on from smoothed values.

        Landmarks that the graph knows nothing of stay; after a loop (``whole``) they move along
        with the last pose, near which they are, unless they are a saved map's.
        """
        ids, positions = self._positions(values)
        waiting_ids, waiting_positions = self._waiting(values)
        ids = np.concatenate([ids, waiting_ids])
        positions = np.concatenate([positions, waiting_positions])
        if whole:
            known, moved = self._tracker.landmarks(), self._tracker.predict(None).wTc
            rest = np.flatnonzero(~np.isin(known.ids, ids) & (self._tracker.homes >= 0))
            moved = current.wTc @ inverse(moved)
            ids = np.concatenate([ids, known.ids[rest]])
            positions = np.concatenate(
                [positions, transform_to_world(moved, known.positions[rest])]
            )
        self._smoothed = current
        self._takeovers += 1
        self._tracker.correct(current, ids, positions)

    def _between(self, loop: LoopClosure) -> Constraint:
        """A loop between poses of the graph, the last of which is the present frame's.

        An earlier frame that has none gives way to the nearest one that was tracked on the same
        map, since only among such do tracked poses tell the way.
        """
        last = len(self._inputs.increments) - 1
        if not 0 <= loop.frame < last:
            raise EstimatorError(
                f"{self.kind}: a loop closure of frame {last} of the log leads to frame "
                f"{loop.frame}, which does not come before it; mend the log"
            )
        era, frames = self._eras[loop.frame], self._builder.frames
        fellows = [frame for frame in frames if self._eras[frame] == era] or frames
        near = min(fellows, key=lambda frame: abs(frame - loop.frame))
        covariance = self._loop_settings.closure_factor**2 * loop.covariance
        loop = dataclasses.replace(loop, covariance=covariance)
        return carried_to(near, loop, self._inputs.trackings, last)

    def _waiting(self, values: Any) -> tuple[IntArray, FloatArray]:
        """Landmarks outside the graph, moved along with the pose that saw them last."""
        last_seen: dict[int, list[int]] = {}
        for identity, track in self._builder.waiting():
            last_seen.setdefault(track.last.frame, []).append(identity)
        known = self._tracker.landmarks()
        ids, positions = [np.empty(0, np.int64)], [np.empty((0, 3))]
        anchors = {}
        for frame, identities in last_seen.items():
            if values.exists(pose_key(frame)):
                anchors[frame] = poses_of_frame(values, frame)
                # One just taken out of the graph is where the graph had it, and follows from here.
                moved = anchors[frame] @ inverse(self._anchors.get(frame, anchors[frame]))
                ids.append(np.array(identities, np.int64))
                before = known.positions[known.rows(ids[-1])]
                positions.append(transform_to_world(moved, before))
        self._anchors = anchors
        return np.concatenate(ids), np.concatenate(positions)

    def _positions(self, values: Any) -> tuple[IntArray, FloatArray]:
        """Identities and positions of the tracker's landmarks that ``values`` hold."""
        tracks, ids, positions = self._builder.tracks, [], []
        for identity in self._tracker.landmarks().ids.tolist():
            track = tracks.get(identity)
            if track is not None and track.variable >= 0:
                key = landmark_key(track.variable)
                if values.exists(key):
                    ids.append(identity)
                    positions.append(values.atPoint3(key))
        return np.array(ids, np.int64), np.array(positions, np.float64).reshape(-1, 3)

    def _current(self, tracking: EgoMotion) -> Prediction:
        """The last pose: the tracker's, whose map is as uncertain as the pose last smoothed."""
        now = self._tracker.predict(None)
        if now.wTc is self._smoothed.wTc:
            return self._smoothed
        moved = adjoint(inverse(now.wTc) @ self._smoothed.wTc)
        drift = congruence(moved, self._smoothed.covariance)
        return Prediction(now.wTc, self._floor.allowed_part(now.wTc, drift + tracking.covariance))

    def _solved(self) -> Solution:
        if self._answer is None:
            self._answer = self._solve()
        return self._answer

    def _map(self, answer: Solution) -> LandmarkMap:
        """The tracker's landmarks where the graph has them; those that wait, from their pose."""
        ids = self._tracker.landmarks().ids
        positions, covariances = np.empty((len(ids), 3)), np.empty((len(ids), 3, 3))
        known = self._tracker.landmarks()
        for row, identity in enumerate(ids.tolist()):
            track = self._builder.tracks.get(identity)
            if track is None:  # seen since the last keyframe only
                positions[row], covariances[row] = known.positions[row], known.covariances[row]
            elif track.variable in answer.points:
                positions[row] = answer.points[track.variable]
                covariances[row] = answer.point_covariances[track.variable]
            elif identity in self._frozen:
                positions[row], covariances[row] = self._frozen[identity]
            else:
                positions[row], covariances[row] = self._seen_from(answer, track.last)
        return LandmarkMap(ids, positions, covariances)

    def _seen_from(self, answer: Solution, sighting: Sighting) -> tuple[FloatArray, FloatArray]:
        """Position and covariance of a landmark from a single sighting."""
        wTc = answer.poses[sighting.frame]
        measurement = sighting.measurement[None]
        point = triangulate(self._sensor, measurement)
        local = triangulation_covariance(self._sensor, measurement, sighting.covariance[None])
        by_pose = congruence(point_pose_jacobian(point), answer.pose_covariances[sighting.frame])
        world = congruence(wTc[:3, :3], local + by_pose)
        return transform_to_world(wTc, point)[0], world[0]
