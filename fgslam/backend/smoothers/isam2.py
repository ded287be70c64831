"""iSAM2 (Kaess et al. 2012) over all poses and landmarks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import gtsam
import numpy as np

from fgslam.backend.loops import Chain, Constraint, constraint_factor
from fgslam.backend.self_calibration import RigChange
from fgslam.backend.settings import Isam2Settings
from fgslam.backend.smoothers.bundle import Sightings, State, WholeGraph, by_kind, keys_of
from fgslam.backend.smoothers.final import Refined, WholeGraphSolver, refine
from fgslam.backend.smoothers.graph import (
    NewFactors,
    Smoothed,
    allowed_parts,
    solved,
    suspect,
)
from fgslam.backend.smoothers.keyframes import Segments
from fgslam.backend.smoothers.smoother import GraphProblem, MapSmoother
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.sensors import CameraRig
from fgslam.core.types import LAGS, Floor, LandmarkMap, Prediction
from fgslam.factors.graphs import (
    RELINEARISED,
    is_pose,
    isam2_parameters,
    landmark_key,
    nuisance_key,
    number,
    pose_key,
    poses_of_frame,
)
from fgslam.factors.measurement import nuisance_prior

_REPAIRS = 20  # landmarks taken out in one update before the graph itself must be wrong
_SINGLE = 3  # of these, before Cholesky's rounding is suspected


class Isam2Solver(WholeGraphSolver):
    """Updates GTSAM's Bayes tree every few frames; in between the tracker answers.

    The last poses are kept at the root of the tree, which is three times faster than GTSAM's own
    choice (all landmarks of the update), with the same estimate.
    """

    kind: ClassVar[str] = "isam2"

    def __init__(self, problem: GraphProblem, settings: Isam2Settings) -> None:
        """An empty tree."""
        super().__init__(problem.builder, problem.floor)
        self._settings = settings
        self._with_qr = False
        self.tree = self.new_tree()
        self._graph = gtsam.NonlinearFactorGraph()
        self.new_values = gtsam.Values()
        self._updated = 0
        self._rebuilt = 0  # last frame of the tree's last rebuilding
        self._linear = LinearFactors()

    def add(self, new: NewFactors, landmarks: LandmarkMap) -> None:
        """Keeps a frame's factors for the next update."""
        self._graph.push_back(new.graph)
        self._graph.push_back(self.builder.observation_factors(new))
        self._linear.measured += [one for one in new.measured if not one.model.has_factor]
        for model in (one.model for one in new.measured):
            if new.values.exists(nuisance_key(model.kind)):
                self._graph.add(nuisance_prior(model))
        self.new_values.insert(new.values)
        self._answer = None

    def solve_if_due(self, frame: int, closes_loop: bool) -> Smoothed | None:
        """Updates the tree where the last update lies `update_every` frames back."""
        if closes_loop or (frame and frame - self._updated < self._settings.update_every):
            return None
        self._updated = frame
        self._flush()
        last = self.builder.frames[-1]
        here = Prediction(poses_of_frame(self.values, last), self._covariance(last))
        return Smoothed(self.values, here, earlier=self._earlier(last))

    def _earlier(self, last: int) -> dict[int, FloatArray]:
        """Of the last poses, which are at the root of the tree."""
        inside = [lag for lag in LAGS if last - lag in self.builder.frames[-max(LAGS) - 1 :]]
        keys = {lag: pose_key(last - lag) for lag in (0, *inside)}
        try:
            joint = self.tree.jointMarginalCovariance(list(keys.values()))
        except RuntimeError:
            return {}
        pairs = {lag: (keys[lag], keys[0]) for lag in inside}
        return {
            lag: np.block([[joint.at(row, column) for column in two] for row in two])
            for lag, two in pairs.items()
        }

    def _flush(self) -> None:
        """Brings the frames since the last update in."""
        if self._graph.size() == 0:
            return
        graph, values = self._graph, self.new_values
        self._graph, self.new_values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._update(graph, values)

    def _update(self, graph: Any, values: Any) -> None:
        moved: list[int] = []
        if self._linear.measured:
            moved, linear = self._linear.renewed(self._with(values))
            graph.push_back(linear)
        try:
            result = self.tree.update(graph, values, moved, self._groups())
            self._linear.took(result.getNewFactorsIndices())
            self.values = self.tree.calculateEstimate()
        except RuntimeError as error:
            self._repair(self._with(values), error)

    def _with(self, values: Any) -> Any:
        """All values: a copy of those of the tree, with new ones."""
        together = gtsam.Values(self.values)
        together.insert(values)
        return together

    def _groups(self) -> Any:
        """Constrained ordering: the last poses in the last group; None for GTSAM's own."""
        window = self._settings.ordering_window
        if window == 0:
            return None
        groups = gtsam.KeyGroupMap()
        for frame in self.builder.frames[-window:]:
            groups.insert2(pose_key(frame), 1)
        return groups

    def _covariance(self, frame: int) -> FloatArray:
        """Marginal of a pose; where the tree does not give it, it is rebuilt first."""
        try:
            covariance = np.asarray(self.tree.marginalCovariance(pose_key(frame)))
        except RuntimeError as error:
            self._repair(self.values, error)
            try:
                covariance = np.asarray(self.tree.marginalCovariance(pose_key(frame)))
            except RuntimeError as again:
                raise self._failed(again) from None
        pose = poses_of_frame(self.values, frame)
        return np.asarray(allowed_parts(self._floor, pose[None], covariance[None])[0])

    def close(self, loop: Constraint, chain: Chain, wTc: FloatArray, what: str) -> Smoothed | bool:
        """Updates the tree with the loop, or rebuilds it where the loop moves the map."""
        self._updated = self.builder.frames[-1]
        self._flush()
        accepted, values = self._judge(loop, chain, wTc, what, _without_loop)
        if not accepted:
            return False
        self._join(values)
        return self._after_loop(self._covariance(self.builder.frames[-1]))

    def _join(self, found: Any | None) -> None:
        """Goes on with the graph that has the loop; from these values where they are given."""
        if found is None:
            graph = gtsam.NonlinearFactorGraph()
            graph.add(constraint_factor(self.accepted[-1]))
            self._update(graph, gtsam.Values())
            return
        try:
            self._rebuild(found)
        except RuntimeError as error:
            self._repair(found, error)

    def solve_whole(self) -> Refined:
        """The minimum from the tree's values, with those of frames that wait."""
        return refine(self.builder, self._with(self.new_values), self._minimise)

    def recalibrate(self, change: RigChange) -> None:
        """Rebuilds the tree, of the new measurements.

        That costs as much as the drive is long: only where the rig is known from twice as many
        frames, so that all rebuildings together cost as two of the last. The answer is solved of
        all measurements as they are known.
        """
        super().recalibrate(change)
        known, then = self.builder.frames[-1:], self._rebuilt - change.since
        if not known or known[0] - change.since < 2 * then:
            return
        together = self._with(self.new_values)
        self._graph, self.new_values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        try:
            self._rebuild(together)
        except RuntimeError as error:
            self._repair(together, error)

    # -- where the tree cannot be solved -------------------------------------------------------

    def _repair(self, values: Any, error: Exception) -> None:
        """Rebuilds the solver from the last good values, without the landmark that failed.

        After an exception iSAM2's own state is unusable; the builder's graph is not.
        """
        last: Exception | None = error
        if self._put_before_cameras(values):
            last = self._tried(values)
        for repair in range(_REPAIRS):
            if last is None:
                return
            if not self._mended(values, last, several=repair >= _SINGLE):
                break
            last = self._tried(values)
        if last is not None:
            raise self._failed(last)

    def _tried(self, values: Any) -> RuntimeError | None:
        """Rebuilds the solver; what it fails on, or None."""
        try:
            self._rebuild(values)
        except RuntimeError as error:
            return error
        return None

    def _rebuild(self, values: Any) -> None:
        self._rebuilt = self.builder.frames[-1]
        self.tree, self._linear = self.new_tree(), LinearFactors()
        graph, every = self.builder.kept_factors(callbacks=False), self.builder.measured.values()
        self._linear.measured += [one for one in every if not one.model.has_factor]
        graph.push_back(self._linear.renewed(values)[1])
        result = self.tree.update(graph, values, [], self._groups())
        self._linear.took(result.getNewFactorsIndices())
        self.values = self.tree.calculateEstimate()

    def _mended(self, values: Any, error: Exception, several: bool) -> bool:
        """Whether something was done about what the error names.

        One landmark is to blame itself. Of ``several`` that failed after each other what hangs
        together is known too unevenly, as a piece of the drive beyond a gap.
        """
        key = suspect(error)
        if key is None:
            return False
        if (is_pose(key) or several) and not self._with_qr:
            self._with_qr = True
            what = f"pose of frame {number(key)}" if is_pose(key) else "the map beyond a gap"
            self.remarks.append(
                f"{what} known too unevenly for Cholesky at frame "
                f"{self.builder.frames[-1]}: iSAM2 rebuilt, with QR from here on"
            )
            return True
        if is_pose(key) or not self.builder.in_graph(number(key)):
            return False
        self._take_out(number(key), values, "left the system indeterminate")
        return True

    def _put_before_cameras(self, values: Any) -> int:
        """How many landmarks a step took behind a camera; they are where they were seen last.

        Behind a camera nothing holds them: each alone would leave the system indeterminate.
        """
        poses = np.full((self.builder.frames[-1] + 1, 4, 4), np.nan)
        for frame in self.builder.frames:
            poses[frame] = poses_of_frame(values, frame)
        places = self.builder.seen_last(poses)
        points = {v: values.atPoint3(landmark_key(v)) for v in places}
        behind = self.builder.behind(poses, points)
        for variable in behind:
            values.update(landmark_key(variable), places[variable])
        if behind:
            self.remarks.append(
                f"{len(behind)} landmarks came out behind a camera at frame "
                f"{self.builder.frames[-1]}: put where they were seen last, iSAM2 rebuilt"
            )
        return len(behind)

    def _take_out(self, variable: int, values: Any, why: str) -> None:
        what = self.builder.take_out(variable)
        values.erase(landmark_key(variable))
        self.remarks.append(
            f"{what} {why} at frame {self.builder.frames[-1]}: taken out of the graph, iSAM2 "
            "rebuilt from the last estimate"
        )

    def new_tree(self) -> Any:
        """An empty Bayes tree."""
        method, factorization = (
            gtsam.ISAM2GaussNewtonParams(),
            "QR" if self._with_qr else "CHOLESKY",
        )
        return gtsam.ISAM2(isam2_parameters(method, factorization))


class LinearFactors:
    """Measurements of models without a C++ factor: linear ones, renewed where variables moved.

    One that calls back costs 30 to 400 us whenever it is linearised; a row of arrays less than one.

    Attributes:
        measured: landmarks by one model each, by keys.
    """

    def __init__(self) -> None:
        """None yet."""
        self.measured: list[Sightings] = []
        self._at: list[tuple[FloatArray, FloatArray]] = []  # poses and points of each
        self._slots: list[IntArray] = []  # of each in the tree
        self._new: list[IntArray] = []

    def renewed(self, values: Any) -> tuple[list[int], Any]:
        """Slots of the tree to empty, and factors to add, at values of all variables."""
        graph, emptied = gtsam.NonlinearFactorGraph(), list[int]()
        self._join()
        keys, state = keys_of(values), State.of(values)
        self._new = []
        for one, (poses, points), slots in zip(self.measured, self._at, self._slots, strict=True):
            there = one.at_rows(*keys)
            here, seen = state.poses[there.poses], state.points[there.points]
            off = np.maximum(np.abs(here - poses).max((1, 2)), np.abs(seen - points).max(1))
            moved = np.flatnonzero(~(off < RELINEARISED))  # NaN: not in the tree yet
            emptied += slots[moved][slots[moved] >= 0].tolist()
            new = there.select(moved)
            rows, more = new.look(state.poses, state.points), new.shifted()
            key = nuisance_key(one.model.kind)
            known = values.atVector(key) if more.size else np.empty(0)
            unit = gtsam.noiseModel.Unit.Create(rows.residual.shape[1])
            columns = (
                one.poses[moved].tolist(),
                one.points[moved].tolist(),
                here[moved],
                seen[moved],
            )
            linear = rows.by_pose, rows.by_point, more, -rows.residual - more @ known
            for pose, point, wTx, place, *by, right in zip(*columns, *linear, strict=True):
                at = gtsam.Values()
                at.insert(pose, gtsam.Pose3(wTx))
                at.insert(point, place)
                terms: list[Any] = [pose, by[0], point, by[1]]
                if more.size:
                    at.insert(key, known)
                    terms += [key, by[2]]
                factor = gtsam.JacobianFactor(*terms, right, unit)  # type: ignore[call-overload]
                graph.add(gtsam.LinearContainerFactor(factor, at))
            poses[moved], points[moved] = here[moved], seen[moved]
            self._new.append(moved)
        return emptied, graph

    def took(self, slots: Sequence[int]) -> None:
        """The tree has the last factors added, in these slots of all that were added."""
        left = np.asarray(slots, np.int64)[len(slots) - sum(map(len, self._new)) :]
        for own, moved in zip(self._slots, self._new, strict=False):
            own[moved], left = left[: len(moved)], left[len(moved) :]
        self._new = []

    def _join(self) -> None:
        """Brings new measurements to those of the same kind."""
        self.measured = list(by_kind(self.measured).values())
        new = len(self.measured) - len(self._at)
        self._at += [(np.empty((0, 4, 4)), np.empty((0, 3)))] * new
        self._slots += [np.empty(0, np.int64)] * new
        for k, one in enumerate(self.measured):
            more = len(one) - len(self._slots[k])
            poses, points = self._at[k]
            nowhere = np.full((more, 4, 4), np.nan), np.full((more, 3), np.nan)
            self._at[k] = np.concatenate([poses, nowhere[0]]), np.concatenate([points, nowhere[1]])
            self._slots[k] = np.concatenate([self._slots[k], np.full(more, -1)])


def _without_loop(graph: WholeGraph, state: State) -> State:
    """The graph's minimum from iSAM2's values: these, but for one with a gyroscope's bias.

    That is no variable of the tree, whose values lie far from the minimum of a graph that has it.
    """
    return state if graph.rest.turns is None else solved(graph, state)


def isam2_smoother(
    sensor: CameraRig, settings: Isam2Settings, floor: Floor, prior: Prediction
) -> MapSmoother:
    """Estimator of kind ``isam2``, at the prior pose with an empty map."""
    problem = GraphProblem.of(sensor, settings, floor, prior)
    segments = Segments(sensor, settings.keyframe_every)
    return MapSmoother(problem, Isam2Solver(problem, settings), segments)
