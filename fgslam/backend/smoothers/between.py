"""Poses of the frames between keyframes, once the map is smoothed.

Each frame's own observations give its pose against the smoothed map (all frames at once, in
NumPy); a chain of these, of the odometry, and of the graph's poses held fixed gives all of them
their final place.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from fgslam.backend.smoothers.graph_solution import Solution, allowed_parts
from fgslam.backend.smoothers.segments import TrackedFrame
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.estimates import Prediction
from fgslam.core.floor import Floor
from fgslam.core.geometry import (
    adjoint,
    congruence,
    in_front,
    inverse,
    inverse_spd3,
    measurement_difference,
    point_pose_jacobian,
    project,
    projection_jacobian,
    reorthonormalise,
    se3_exp,
)
from fgslam.core.measurements import Odometry
from fgslam.core.sensors import Sensor
from fgslam.factors.keys import pose_key
from fgslam.factors.motion import floor_factors, odometry_factor, pose_prior

_ITERATIONS = 4  # of Gauss-Newton; the tracker's pose is millimetres away
_GATE = 16.3  # 99.9 % quantile of chi-square with three degrees of freedom
_LEAST_OBSERVATIONS = 4  # of landmarks in the graph; fewer leave a frame to its odometry


def fill_between(
    sensor: Sensor,
    floor: Floor,
    solved: Solution,
    frames: list[TrackedFrame],
    motions: list[Odometry | None],
    variable_of: dict[int, int],
) -> Solution:
    """The solution with the poses and covariances of the frames between, too.

    Args:
        sensor: that observed.
        floor: on which the robot stays.
        solved: poses of the graph's frames, NaN for others.
        frames: those between, as tracked.
        motions: from each frame to the next, by the later one's number.
        variable_of: landmark variable by identity.
    """
    if not frames:
        return solved
    total = len(motions)
    poses, covariances = np.full((total, 4, 4), np.nan), np.full((total, 6, 6), np.nan)
    poses[: len(solved.poses)] = solved.poses
    covariances[: len(solved.poses)] = solved.pose_covariances
    start = _starting_poses(poses, frames, motions)
    located, information = _locate(sensor, solved, frames, start, variable_of)
    values, marginals = _chain(floor, poses, frames, motions, located, information)
    in_graph = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    for frame in np.setdiff1d(np.arange(total), in_graph).tolist():
        key = pose_key(frame)
        poses[frame] = values.atPose3(key).matrix()
        after = int(np.searchsorted(in_graph, frame))
        carried = _carried(poses, covariances, frame, in_graph[max(after - 1, 0) : after + 1])
        own = np.array(marginals.marginalCovariance(key)) + carried
        covariances[frame] = allowed_parts(floor, poses[frame][None], own[None])[0]
    return Solution(poses, covariances, solved.points, solved.point_covariances, solved.remarks)


def _carried(
    poses: FloatArray, covariances: FloatArray, frame: int, neighbours: IntArray
) -> FloatArray:
    """What a frame's pose (6, 6) is uncertain by although its neighbours in the graph are held.

    The frame hangs on both; that of the less certain one is the safe answer.
    """
    carried = [
        congruence(adjoint(inverse(poses[frame]) @ poses[k]), covariances[k]) for k in neighbours
    ]
    return max(carried, key=lambda covariance: float(np.trace(covariance)))


def _starting_poses(
    poses: FloatArray, frames: list[TrackedFrame], motions: list[Odometry | None]
) -> FloatArray:
    """(f, 4, 4) the graph's last pose before each frame, moved on by the odometry."""
    known = poses.copy()
    for k in range(1, len(known)):
        motion = motions[k]
        if not np.isfinite(known[k, 0, 0]) and motion is not None:
            known[k] = known[k - 1] @ motion.motion
    return known[[frame.frame for frame in frames]]


def _locate(
    sensor: Sensor,
    solved: Solution,
    frames: list[TrackedFrame],
    start: FloatArray,
    variable_of: dict[int, int],
) -> tuple[FloatArray, FloatArray]:
    """Poses (f, 4, 4) by least squares on the frames' own observations, and information (f, 6, 6).

    Zero information where a frame saw too little of the map.
    """
    which, points, measured, weights = _observations(solved, frames, variable_of)
    poses = start.copy()
    fits = np.ones(len(which), np.bool_)
    for iteration in range(_ITERATIONS):
        hessian, gradient, squared = _normal_equations(
            sensor, poses, which[fits], points[fits], measured[fits], weights[fits]
        )
        ahead = which[fits][np.isfinite(squared)]  # the others have no weight
        enough = np.bincount(ahead, minlength=len(frames)) >= _LEAST_OBSERVATIONS
        hessian[~enough] = 0.0
        steps = np.zeros((len(frames), 6))
        steps[enough] = np.linalg.solve(hessian[enough], gradient[enough][:, :, None])[:, :, 0]
        poses = np.array(
            [reorthonormalise(T @ se3_exp(step)) for T, step in zip(poses, steps, strict=True)]
        )
        if iteration == _ITERATIONS // 2 - 1:
            fits[np.flatnonzero(fits)[squared > _GATE]] = False
    return poses, hessian


def _observations(
    solved: Solution, frames: list[TrackedFrame], variable_of: dict[int, int]
) -> tuple[IntArray, FloatArray, FloatArray, FloatArray]:
    """All observations of landmarks of the graph: frame's row, point, measurement, information."""
    which, points, measured, covariances = [], [], [], []
    for row, frame in enumerate(frames):
        accepted = frame.accepted
        variables = [variable_of.get(identity, -1) for identity in accepted.ids.tolist()]
        keep: BoolArray = np.array([v in solved.points for v in variables], np.bool_)
        which.append(np.full(int(keep.sum()), row))
        points += [solved.points[v] for v in variables if v in solved.points]
        measured.append(accepted.measurement[keep])
        covariances.append(accepted.covariance[keep])
    return (
        np.concatenate(which),
        np.array(points).reshape(-1, 3),
        np.concatenate(measured),
        inverse_spd3(np.concatenate(covariances)),
    )


def _normal_equations(
    sensor: Sensor,
    poses: FloatArray,
    which: IntArray,
    points: FloatArray,
    measured: FloatArray,
    weights: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Per frame Hessian (f, 6, 6) and gradient (f, 6), and squared residuals (n,)."""
    rotation, origin = poses[which, :3, :3], poses[which, :3, 3]
    local = np.einsum("nji,nj->ni", rotation, points - origin)
    ahead = in_front(sensor, local)
    local[~ahead] = [0.0, 0.0, 1.0]
    residual = measurement_difference(sensor, measured, project(sensor, local))
    jacobian = projection_jacobian(sensor, local) @ point_pose_jacobian(local)
    weighted = np.swapaxes(jacobian, 1, 2) @ weights
    weighted[~ahead] = 0.0
    hessian, gradient = np.zeros((len(poses), 6, 6)), np.zeros((len(poses), 6))
    first = np.flatnonzero(np.diff(which, prepend=-1))
    if len(which):
        rows = which[first]
        hessian[rows] = np.add.reduceat(weighted @ jacobian, first, axis=0)
        gradient[rows] = np.add.reduceat(np.einsum("nij,nj->ni", weighted, residual), first, axis=0)
    squared = np.einsum("ni,nij,nj->n", residual, weights, residual)
    return hessian, gradient, np.where(ahead, squared, np.inf)


def _chain(
    floor: Floor,
    poses: FloatArray,
    frames: list[TrackedFrame],
    motions: list[Odometry | None],
    located: FloatArray,
    information: FloatArray,
) -> tuple[Any, Any]:
    """All poses in a row, those of the graph held; values and marginals."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    between = {frame.frame: row for row, frame in enumerate(frames)}
    held = np.zeros((6, 6))
    for k in range(len(poses)):
        key, row = pose_key(k), between.get(k)
        pose = poses[k] if row is None else located[row]
        values.insert(key, gtsam.Pose3(pose))
        if row is None:
            graph.add(pose_prior(key, Prediction(pose, held)))
        else:
            for factor in floor_factors(key, floor, pose):
                graph.add(factor)
            if information[row].any():
                covariance = np.linalg.inv(information[row])
                graph.add(pose_prior(key, Prediction(pose, covariance)))
        motion = motions[k]
        if k and motion is not None:
            graph.add(odometry_factor(pose_key(k - 1), key, motion))
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return found, gtsam.Marginals(graph, found)
