"""The homing graph in GTSAM's factors, and its solvers by GTSAM: incremental and batch.

All keep the values of every variable that they still have, and answer joint covariances.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from fgslam.backend.homing.parts import (
    FIRST_SPEEDS,
    KERNEL,
    KERNEL_WIDTH,
    MOTION_DENSITIES,
    TARGET,
    NewPart,
)
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.factors.bearing import (
    BearingFactors,
    leg_factor,
    motion_factor,
    start_prior,
    tangent_to_pose,
    vector_factor,
    velocity_prior,
    weak_landmark_prior,
)
from fgslam.factors.graphs import (
    is_pose,
    isam2_parameters,
    landmark_key,
    pose_key,
    target_key,
    velocity_key,
)

_TRUST_RADIUS = 1.0  # legs, radians: the first of Powell's dog leg
MAX_ITERATIONS = 50  # of Levenberg-Marquardt; from the last solution it takes three to ten
RELATIVE_TOLERANCE = 1e-5  # of the cost: the estimate then moves by far less than its deviation


def _parts(new: NewPart) -> tuple[Any, Any, set[int]]:
    """Factors, first guesses, and keys of what an image touches."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    pose, velocity = pose_key(new.image), velocity_key(new.image)
    values.insert(pose, gtsam.Pose2(*new.pose))
    values.insert(velocity, new.velocity)
    if new.beginning is not None:
        target, vector, covariance = new.beginning
        values.insert(target_key(), gtsam.Pose2(*target))
        graph.add(start_prior(pose_key(0)))
        graph.add(velocity_prior(velocity_key(0), np.zeros(3), FIRST_SPEEDS))
        graph.add(leg_factor(pose_key(0), target_key()))
        graph.add(vector_factor(target_key(), vector.direction, vector.rotation, covariance))
    else:
        earlier = (pose_key(new.image - 1), velocity_key(new.image - 1), new.times[0])
        graph.add(motion_factor(earlier, (pose, velocity, new.times[1]), MOTION_DENSITIES))
    for row, (point, spread) in new.points.items():
        values.insert(landmark_key(row), point)
        graph.add(weak_landmark_prior(landmark_key(row), point, spread))
    robust = BearingFactors(KERNEL, KERNEL_WIDTH)
    keys = {pose, velocity}
    for seen in new.bearings:
        view = target_key() if seen.view == TARGET else pose_key(seen.view)
        graph.add(robust.bearing(view, landmark_key(seen.row), seen.measured, seen.sigma))
        keys.add(landmark_key(seen.row))
    for pair in new.pairs:
        graph.add(robust.elevation_pair(target_key(), landmark_key(pair.row), *pair[1:]))
    return graph, values, keys


class GtsamSolver:
    """What GTSAM's solvers share: images become factors, values are looked up by key.

    Where an update fails, the solver's own graph is solved as a batch, and the solver is rebuilt
    from there: after an exception an ISAM2 object is corrupt.
    """

    def __init__(self) -> None:
        """Empty."""
        self._image = 0
        self._graph = gtsam.NonlinearFactorGraph()
        self.values = gtsam.Values()

    def add(self, new: NewPart) -> None:
        """See :class:`Solver`."""
        self._image = new.image
        graph, values, keys = _parts(new)
        try:
            self._update(graph, values, keys)
        except RuntimeError:
            self.values.insert(values)
            self._graph.push_back(graph)
            self.values = minimised(self._graph, self.values)
            self._restart()

    def move(self, points: dict[int, FloatArray]) -> None:
        """See :class:`Solver`."""
        for row, point in points.items():
            self.values.update(landmark_key(row), point)
        self._restart()

    def pose(self, image: int) -> FloatArray:
        """See :class:`Solver`."""
        return _pose(self.values, pose_key(image))

    def velocity(self, image: int) -> FloatArray:
        """See :class:`Solver`."""
        return np.asarray(self.values.atVector(velocity_key(image)))

    def target(self) -> FloatArray:
        """See :class:`Solver`."""
        return _pose(self.values, target_key())

    def points(self, rows: list[int]) -> FloatArray:
        """See :class:`Solver`."""
        points = [self.values.atPoint2(landmark_key(row)) for row in rows]
        return np.array(points, np.float64).reshape(len(rows), 2)

    def covariance(self, rows: list[int]) -> FloatArray:
        """See :class:`Solver`."""
        keys = [pose_key(self._image), target_key(), *(landmark_key(row) for row in rows)]
        covariance = self._joint(keys)
        turn = np.eye(len(covariance))
        turn[:3, :3] = tangent_to_pose(self.pose(self._image))
        turn[3:6, 3:6] = tangent_to_pose(self.target())
        return turn @ covariance @ turn.T

    def _update(self, graph: Any, values: Any, touched: set[int]) -> None:
        """Brings an image in, by its factors, first guesses and the keys that it touches.

        Raises RuntimeError, as GTSAM.
        """
        raise NotImplementedError

    def _restart(self) -> None:
        """Rebuilds the solver with the graph, at the values as they are."""

    def _joint(self, keys: list[int]) -> FloatArray:
        """Joint covariance of variables in the order given, in GTSAM's tangent spaces."""
        raise NotImplementedError


class Isam2Solver(GtsamSolver):
    """iSAM2 with Powell's dog leg over the whole homing."""

    def __init__(self) -> None:
        """Empty."""
        super().__init__()
        self._isam = gtsam.ISAM2(_parameters())

    def _update(self, graph: Any, values: Any, touched: set[int]) -> None:
        self._isam.update(graph, values, [], _last(touched))
        self.values = self._isam.calculateEstimate()
        self._graph.push_back(graph)

    def _restart(self) -> None:
        self._isam = gtsam.ISAM2(_parameters())
        try:
            self._isam.update(self._graph, self.values)
            self.values = self._isam.calculateEstimate()
        except RuntimeError as error:
            raise _failed(error) from None

    def _joint(self, keys: list[int]) -> FloatArray:
        return joint_of(self._isam, keys)


class BatchSolver(GtsamSolver):
    """Levenberg-Marquardt over the whole graph with every image, from the last solution."""

    def _update(self, graph: Any, values: Any, touched: set[int]) -> None:
        self._graph.push_back(graph)
        self.values.insert(values)
        self.values = minimised(self._graph, self.values)

    def _joint(self, keys: list[int]) -> FloatArray:
        try:
            marginals = gtsam.Marginals(self._graph, self.values)
        except RuntimeError:
            return undetermined(keys)
        return joint_of(marginals, keys)


def _parameters() -> Any:
    """Dog leg, because an undamped step may carry a landmark across a camera's centre."""
    dog_leg = gtsam.ISAM2DoglegParams()
    dog_leg.setInitialDelta(_TRUST_RADIUS)
    return isam2_parameters(dog_leg)


def minimised(graph: Any, values: Any) -> Any:
    """Values at the minimum, by Levenberg-Marquardt."""
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(MAX_ITERATIONS)
    params.setRelativeErrorTol(RELATIVE_TOLERANCE)
    try:
        return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    except RuntimeError as error:
        raise _failed(error) from None


def _last(keys: set[int]) -> Any:
    """Elimination order: what the image sees and the target go last, to the root of the tree.

    There their joint covariance is had at once; from elsewhere it costs more than the update.
    """
    groups = gtsam.KeyGroupMap()
    for key in keys | {target_key()}:
        groups.insert2(key, 1)
    return groups


def joint_of(source: Any, keys: list[int]) -> FloatArray:
    """Joint covariance of keys from whatever has marginals; NaN where it fails."""
    try:
        covariance = source.jointMarginalCovariance(keys).fullMatrix()
    except RuntimeError:
        return undetermined(keys)
    return np.asarray(0.5 * (covariance + covariance.T))


def undetermined(keys: list[int]) -> FloatArray:
    """A covariance of NaN: three numbers a pose, two a landmark."""
    poses = sum(is_pose(key) or key == target_key() for key in keys)
    size = 2 * len(keys) + poses
    return np.full((size, size), np.nan)


def _pose(values: Any, key: int) -> FloatArray:
    at = values.atPose2(key)
    return np.array([at.x(), at.y(), at.theta()])


def _failed(error: Exception) -> EstimatorError:
    cause = " ".join(str(error).split())[:200]
    return EstimatorError(f"the homing graph cannot be solved ({cause}); start the homing again")
