"""iSAM2 (Kaess et al. 2012) over all poses and landmarks."""

from __future__ import annotations

from typing import Any, ClassVar

import gtsam
import numpy as np

from fgslam.backend.filters.submaps import Constraint, constraint_factor
from fgslam.backend.smoothers.between import fill_between
from fgslam.backend.smoothers.graph_solution import (
    Solution,
    allowed_parts,
    poses_of_frame,
    solution,
    suspect,
)
from fgslam.backend.smoothers.outliers import solver_parameters, trimmed
from fgslam.backend.smoothers.refinement import Refined, refine
from fgslam.backend.smoothers.segments import Segments, TrackedFrame
from fgslam.backend.smoothers.settings import Isam2Settings
from fgslam.backend.smoothers.whole_graph import WholeGraphSmoother
from fgslam.core.arrays import FloatArray
from fgslam.core.estimates import Prediction
from fgslam.core.floor import Floor
from fgslam.core.geometry import adjoint, congruence, inverse, reorthonormalise
from fgslam.core.measurements import Observations
from fgslam.core.sensors import Sensor
from fgslam.factors.keys import is_pose, landmark_key, number, pose_key

_RELATIVE_TOLERANCE = 1e-9  # of the cost
_REPAIRS = 20  # landmarks taken out in one update before the graph itself must be wrong


class Isam2Smoother(WholeGraphSmoother):
    """Estimator of kind ``isam2``, on :class:`fgslam.backend.protocol.Estimator`.

    Updates come every few frames; in between the tracker answers. The last poses are kept at the
    root of the Bayes tree, which is three times faster than GTSAM's own choice (all landmarks of
    the update), with the same estimate.
    """

    kind: ClassVar[str] = "isam2"

    def __init__(
        self, sensor: Sensor, settings: Isam2Settings, floor: Floor, prior: Prediction
    ) -> None:
        """Starts at the prior pose with an empty map."""
        super().__init__(sensor, settings, floor, prior)
        self._settings = settings
        self._careful = False
        self._isam = self._new_solver()
        self._graph = gtsam.NonlinearFactorGraph()
        self._new_values = gtsam.Values()
        self._values = gtsam.Values()
        self._segments = Segments(sensor, settings.keyframe_every)
        self._updated = 0

    def _absorb(self, tracked: TrackedFrame) -> None:
        if self._inputs.increments[-1].loops:  # they need the frame's own pose
            for entering in self._segments.take_at_once(tracked, self._tracker.landmarks()):
                self._bring_in(entering)
            return
        entering_now = self._segments.take(tracked, self._tracker.landmarks())
        if entering_now is None:
            return
        self._bring_in(entering_now)
        if tracked.frame == 0 or tracked.frame - self._updated >= self._settings.update_every:
            self._updated = tracked.frame
            self._flush()
            self._take_over(self._values, self._moved_on(entering_now, tracked))

    def _bring_in(self, entering: TrackedFrame) -> None:
        new = self._enter(entering)
        self._graph.push_back(new.graph)
        self._new_values.insert(new.values)

    def _values_now(self) -> Any:
        self._updated = self._builder.frames[-1]
        self._flush()
        return self._values

    def _solved_before(self, graph: Any) -> Any:
        return self._values

    def _join(self, known: Constraint, found: Any | None) -> None:
        if found is None:
            graph = gtsam.NonlinearFactorGraph()
            graph.add(constraint_factor(known))
            self._update(graph, gtsam.Values())
        else:
            try:
                self._rebuild(found)
            except RuntimeError as error:
                self._repair(found, error)
        last = self._builder.frames[-1]
        here = reorthonormalise(poses_of_frame(self._values, last))
        self._take_over(self._values, Prediction(here, self._covariance(last)), whole=True)

    def _moved_on(self, entered: TrackedFrame, tracked: TrackedFrame) -> Prediction:
        """The last frame's pose, as far from the one that entered last as it was tracked."""
        motion = inverse(entered.wTc) @ tracked.wTc
        covariance = congruence(adjoint(inverse(motion)), self._covariance(entered.frame))
        pose = poses_of_frame(self._values, entered.frame) @ motion
        return Prediction(reorthonormalise(pose), covariance)

    def _solve(self) -> Solution:
        refined = self._refined_graph()
        frames = self._builder.frames
        solved = solution(refined, frames, self._floor)
        variable_of = {i: track.variable for i, track in self._builder.tracks.items()}
        between, motions = self._segments.between, self._inputs.motions()
        return fill_between(self._sensor, self._floor, solved, between, motions, variable_of)

    def _joint(self, variables: list[int]) -> FloatArray:
        """As the base's; carried on to the last frame where that one has no pose in the graph."""
        joint = super()._joint(variables)
        entered, last = self._builder.frames[-1], len(self._inputs.increments) - 1
        if entered == last:
            return joint
        answer = self._solved()
        carry = np.eye(len(joint))
        carry[:6, :6] = adjoint(inverse(answer.poses[last]) @ answer.poses[entered])
        joint = congruence(carry, joint)
        joint[:6, :6] = answer.pose_covariances[last]
        return joint

    def _refine(self) -> Refined:
        values = gtsam.Values(self._values)
        values.insert(self._new_values)
        iterations = self._settings.final_iterations
        if iterations == 0:
            return Refined(self._builder.kept_factors(), values)
        params = solver_parameters(iterations, _RELATIVE_TOLERANCE)
        try:
            factor = self._settings.noise_factor
            return refine(
                self._builder, values, lambda graph, at: trimmed(graph, at, params, factor)
            )
        except RuntimeError as error:
            raise self._failed(error) from None

    # ----------------------------------------------------------------------------------------

    def _new_solver(self) -> Any:
        params = gtsam.ISAM2Params()
        params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams())
        params.setFactorization("QR" if self._careful else "CHOLESKY")
        params.setRelinearizeThreshold(self._settings.relinearize_threshold)
        params.relinearizeSkip = self._settings.relinearize_skip
        return gtsam.ISAM2(params)

    def _flush(self) -> None:
        """Brings the frames since the last update in."""
        if self._graph.size() == 0:
            return
        graph, values = self._graph, self._new_values
        self._graph, self._new_values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self._update(graph, values)

    def _update(self, graph: Any, values: Any) -> None:
        try:
            self._isam.update(graph, values, [], self._groups())
            self._values = self._isam.calculateEstimate()
        except RuntimeError as error:
            together = gtsam.Values(self._values)
            together.insert(values)
            self._repair(together, error)

    def _groups(self) -> Any:
        """Constrained ordering: the last poses in the last group; None for GTSAM's own."""
        window = self._settings.ordering_window
        if window == 0:
            return None
        groups = gtsam.KeyGroupMap()
        for frame in self._builder.frames[-window:]:
            groups.insert2(pose_key(frame), 1)
        return groups

    def _repair(self, values: Any, error: Exception) -> None:
        """Builds the solver anew from the last good values, without the landmark that failed.

        After an exception iSAM2's inside is unusable; our own graph is not.
        """
        for _ in range(_REPAIRS):
            key = suspect(error)
            if key is not None and is_pose(key) and not self._careful:
                self._careful = True
                self._remarks.append(
                    f"pose of frame {number(key)} known too unevenly for Cholesky at frame "
                    f"{self._builder.frames[-1]}: iSAM2 built anew, with QR from here on"
                )
                try:
                    self._rebuild(values)
                    return
                except RuntimeError as another:
                    error = another
                    continue
            if key is None or is_pose(key) or not self._builder.in_graph(number(key)):
                break
            self._take_out(number(key), values, "left the system indeterminate")
            try:
                self._rebuild(values)
                return
            except RuntimeError as another:
                error = another
        raise self._failed(error)

    def _take_out(self, variable: int, values: Any, why: str) -> None:
        what = self._builder.take_out(variable)
        values.erase(landmark_key(variable))
        self._remarks.append(
            f"{what} {why} at frame {self._builder.frames[-1]}: taken out of the graph, iSAM2 "
            "built anew from the last estimate"
        )

    def _rebuild(self, values: Any) -> None:
        self._isam = self._new_solver()
        self._isam.update(self._builder.kept_factors(), values, [], self._groups())
        self._values = self._isam.calculateEstimate()

    def _restart(self, moved: Observations) -> None:
        super()._restart(moved)
        self._segments.forget(moved.ids.tolist())

    def _covariance(self, frame: int) -> FloatArray:
        """Marginal of a pose."""
        covariance = np.asarray(self._isam.marginalCovariance(pose_key(frame)))
        pose = poses_of_frame(self._values, frame)
        return np.asarray(allowed_parts(self._floor, pose[None], covariance[None])[0])
