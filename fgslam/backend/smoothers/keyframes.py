"""Keyframes: what the frames between them measured, summarised, and the poses given back to them.

Of every segment two poses enter the graph: the keyframe with its own observations, and the middle
frame of the rest, the *block*, with the observations of all frames of the block fused into one
for each landmark. The fusion takes the poses within the block as the tracker found them. Their
common error moves all fused observations alike, and so goes into the middle frame's pose, which
is a variable of its own: what the landmarks learn is their shape, as from single frames. Dropping
the frames between would cost accuracy; fusing them onto the keyframe itself would count its
pose's knowledge once for each frame. Derivation and measurements: docs/derivations/smoothers.md.

Once the map is smoothed, each frame's own observations give its pose against it (all frames at
once, in NumPy); a chain of these, of the odometry, and of the graph's poses held fixed gives all
of them their final place.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import gtsam
import numpy as np

from fgslam.backend.self_calibration import RigChange
from fgslam.backend.smoothers.bundle import Turn
from fgslam.backend.smoothers.graph import Solution, TrackedFrame, allowed_parts
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.geometry import (
    adjoint,
    congruence,
    in_front,
    inverse,
    inverse_spd3,
    point_pose_jacobian,
    reorthonormalise,
    se3_exp,
    transform_to_camera,
)
from fgslam.core.sensors import CameraRig, Observations, Odometry, compose_odometry
from fgslam.core.types import Floor, LandmarkMap, Prediction
from fgslam.factors.graphs import pose_key
from fgslam.factors.motion import floor_factors, odometry_factor, pose_prior

_FUSING_ITERATIONS = 2  # of Gauss-Newton; the map is a fraction of a pixel away
_LEAST_PLACED = 6  # of a frame whose place in its block is known: fewer, and it is odometry's
_LOCATING_ITERATIONS = 4  # of Gauss-Newton; the tracker's pose is millimetres away
_GATE = 16.3  # 99.9 % quantile of chi-square with three degrees of freedom
_LEAST_OBSERVATIONS = 4  # of landmarks in the graph; fewer leave a frame to its odometry


def summarise(
    sensor: CameraRig, block: list[TrackedFrame], middle: TrackedFrame, landmarks: LandmarkMap
) -> Observations:
    """The observations of all frames of a block as observations from its middle frame.

    Each landmark's position in the middle frame is the least-squares one, linearised at the map's;
    its projection is the fused measurement, with the covariance of that position.

    Args:
        sensor: that took them.
        block: frames with their poses.
        middle: one of them.
        landmarks: the map in which all of their landmarks are.
    """
    ids, which = np.unique(
        np.concatenate([frame.accepted.ids for frame in block]), return_inverse=True
    )
    at_middle = transform_to_camera(middle.wTc, landmarks.positions[landmarks.rows(ids)])
    ahead = in_front(at_middle)
    at_middle[~ahead] = [0.0, 0.0, 1.0]
    fused = sensor.predict(at_middle)
    for _ in range(_FUSING_ITERATIONS):
        information, gradient = _stacked(sensor, block, middle, which, fused)
        covariance = inverse_spd3(information)
        fused = fused + np.einsum("kij,kj->ki", covariance, gradient)
    usable = ahead & np.isfinite(fused).all(axis=1) & (fused[:, 2] > 0.0)
    return Observations(
        ids=ids[usable],
        measurement=fused[usable],
        covariance=covariance[usable],
        pixels=np.full((int(usable.sum()), 3, 2), np.nan),
        is_new=np.zeros(int(usable.sum()), np.bool_),
    )


def _stacked(
    sensor: CameraRig,
    block: list[TrackedFrame],
    middle: TrackedFrame,
    which: IntArray,
    fused: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Normal equations (k, 3, 3) and (k, 3) of the fused measurements, from all frames.

    In measurement space a single frame's observation is its own fusion, exactly, and other
    frames' are nearly linear; in metric space the depth of far points would be biased.
    """
    information, gradient = np.zeros((len(fused), 3, 3)), np.zeros((len(fused), 3))
    points = sensor.triangulate(fused)
    by_measurement = np.linalg.inv(sensor.jacobian(points))
    start = 0
    for frame in block:
        rows = which[start : start + len(frame.accepted)]
        start += len(frame.accepted)
        fTm = inverse(frame.wTc) @ middle.wTc
        local = points[rows] @ fTm[:3, :3].T + fTm[:3, 3]
        jacobian = sensor.jacobian(local) @ fTm[:3, :3] @ by_measurement[rows]
        residual = frame.accepted.measurement - sensor.predict(local)
        weighted = np.swapaxes(jacobian, 1, 2) @ inverse_spd3(frame.accepted.covariance)
        # Identities are unique within a frame: no row is added to twice.
        information[rows] += weighted @ jacobian
        gradient[rows] += np.einsum("kij,kj->ki", weighted, residual)
    return 0.5 * (information + np.swapaxes(information, 1, 2)), gradient


class Segments:
    """Turns tracked frames into those that enter the graph."""

    def __init__(self, sensor: CameraRig, keyframe_every: int) -> None:
        """``keyframe_every`` frames make a segment; 1: every frame enters as it is."""
        self._sensor = sensor
        self._every = keyframe_every
        self._motions: list[Odometry] = []
        self._block: list[TrackedFrame] = []
        self.between: list[TrackedFrame] = []
        """Frames that have no pose in the graph."""

    def take(
        self, tracked: TrackedFrame, landmarks: LandmarkMap, at_once: bool = False
    ) -> list[TrackedFrame]:
        """Takes the next frame; gives what now enters the graph, if anything.

        Args:
            tracked: the frame.
            landmarks: the map after it.
            at_once: it is a keyframe out of turn, as for a loop; what is open enters before it.
        """
        if tracked.motion is not None:
            self._motions.append(tracked.motion)
        if at_once:
            before = [self._block_entering(tracked.frame, landmarks)] if self._block else []
            return [*before, self._entering(tracked, tracked.accepted, 0)]
        if tracked.frame % self._every == 0:
            return [self._entering(tracked, tracked.accepted, 0)]
        self._block.append(tracked)
        self.between.append(tracked)
        if (tracked.frame + 1) % self._every:
            return []
        return [self._block_entering(tracked.frame, landmarks)]

    def _block_entering(self, last: int, landmarks: LandmarkMap) -> TrackedFrame:
        """The open block as one frame; ``last`` is the frame to which motions are known."""
        block, self._block = self._block, []
        held = [_held(frame, landmarks) for frame in block]
        middle = _middle(held)
        self.between = [frame for frame in self.between if frame.frame != middle.frame]
        placed = [frame for frame in held if frame is middle or _is_placed(frame)]
        fused = summarise(self._sensor, placed, middle, landmarks)
        return self._entering(middle, fused, last - middle.frame)

    def recalibrate(self, change: RigChange) -> None:
        """Corrects again what frames between keyframes measured."""
        self._block = [_corrected(frame, change) for frame in self._block]
        self.between = [_corrected(frame, change) for frame in self.between]

    def forget(self, identities: list[int]) -> None:
        """Landmarks that start again: what the open block saw of them is not the same landmark."""
        gone = np.array(identities, np.int64)
        if len(gone):
            self._block = [_without(frame, gone) for frame in self._block]

    def _entering(self, frame: TrackedFrame, accepted: Observations, later: int) -> TrackedFrame:
        """With the motion since the graph's last frame; the ``later`` last motions come after."""
        here = len(self._motions) - later
        since, self._motions = self._motions[:here], self._motions[here:]
        motion = compose_odometry(since) if since else None
        turn, measured = Turn.of(since), frame.measured
        return TrackedFrame(frame.frame, frame.wTc, motion, accepted, turn, measured=measured)


def _corrected(frame: TrackedFrame, change: RigChange) -> TrackedFrame:
    if frame.frame < change.since:
        return frame
    measured = change.measured(frame.accepted.measurement)
    accepted = dataclasses.replace(frame.accepted, measurement=measured)
    return dataclasses.replace(frame, accepted=accepted)


def _is_placed(frame: TrackedFrame) -> bool:
    """Whether a frame saw enough of the map for the tracker to place it next to the others."""
    return len(frame.accepted) >= _LEAST_PLACED


def _middle(block: list[TrackedFrame]) -> TrackedFrame:
    """The frame nearest to the middle of those that are placed; of all where none is.

    The fused observations claim to be its own: a blind frame, whose pose is the odometry's, would
    pass for one that saw what its neighbours saw.
    """
    centre = len(block) // 2
    order = sorted(range(len(block)), key=lambda i: (not _is_placed(block[i]), abs(i - centre)))
    return block[order[0]]


def _held(frame: TrackedFrame, landmarks: LandmarkMap) -> TrackedFrame:
    """The frame without observations of landmarks that have left the map."""
    keep = np.isin(frame.accepted.ids, landmarks.ids)
    return TrackedFrame(frame.frame, frame.wTc, frame.motion, frame.accepted.select(keep))


def _without(frame: TrackedFrame, gone: IntArray) -> TrackedFrame:
    keep = ~np.isin(frame.accepted.ids, gone)
    return TrackedFrame(frame.frame, frame.wTc, frame.motion, frame.accepted.select(keep))


def fill_between(
    sensor: CameraRig,
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
    return dataclasses.replace(solved, poses=poses, pose_covariances=covariances)


def _carried(
    poses: FloatArray, covariances: FloatArray, frame: int, neighbours: IntArray
) -> FloatArray:
    """What a frame's pose (6, 6) is uncertain by although its neighbours in the graph are held.

    The frame depends on both; that of the less certain one is the safe answer.
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
    sensor: CameraRig,
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
    for iteration in range(_LOCATING_ITERATIONS):
        hessian, gradient, squared = _normal_equations(
            sensor, poses, which[fits], points[fits], measured[fits], weights[fits]
        )
        ahead = which[fits][np.isfinite(squared)]  # the others have no weight
        enough = np.bincount(ahead, minlength=len(frames)) >= _LEAST_OBSERVATIONS
        hessian[~enough] = 0.0
        steps = np.zeros((len(frames), 6))
        steps[enough] = np.linalg.solve(hessian[enough], gradient[enough][:, :, None])[:, :, 0]
        poses = reorthonormalise(poses @ np.array([se3_exp(step) for step in steps]))
        if iteration == _LOCATING_ITERATIONS // 2 - 1:
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
    sensor: CameraRig,
    poses: FloatArray,
    which: IntArray,
    points: FloatArray,
    measured: FloatArray,
    weights: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Per frame Hessian (f, 6, 6) and gradient (f, 6), and squared residuals (n,)."""
    rotation, origin = poses[which, :3, :3], poses[which, :3, 3]
    local = np.einsum("nji,nj->ni", rotation, points - origin)
    ahead = in_front(local)
    local[~ahead] = [0.0, 0.0, 1.0]
    residual = measured - sensor.predict(local)
    jacobian = sensor.jacobian(local) @ point_pose_jacobian(local)
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
