"""Keyframes, and the summary of what the frames between them measured.

Of every segment two poses enter the graph: the keyframe with its own observations, and the middle
frame of the rest, the *block*, with the observations of all frames of the block fused into one
for each landmark. The fusion takes the poses within the block as the tracker found them. Their
common error moves all fused observations alike, and so goes into the middle frame's pose, which
is a variable of its own: what the landmarks learn is their shape, as from single frames. Dropping
the frames between would cost accuracy; fusing them onto the keyframe itself would count its
pose's knowledge once for each frame. Derivation and measurements: docs/derivations/keyframes.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import LandmarkMap
from fgslam.core.geometry import (
    compose_odometry,
    in_front,
    inverse,
    inverse_spd3,
    measurement_difference,
    project,
    projection_jacobian,
    transform_to_camera,
    triangulate,
)
from fgslam.core.measurements import Observations, Odometry
from fgslam.core.sensors import CameraRig, Sensor

_ITERATIONS = 2  # of Gauss-Newton; the map is a fraction of a pixel away
_LEAST_OBSERVATIONS = 6  # of a frame whose place in its block is known: fewer, and it is odometry's


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """A frame as the tracker has it.

    Attributes:
        frame: counted from 0.
        wTc: (4, 4) its pose.
        motion: from the frame before; None for the first.
        accepted: observations that fit.
    """

    frame: int
    wTc: FloatArray
    motion: Odometry | None
    accepted: Observations


def summarise(
    sensor: Sensor, block: list[TrackedFrame], middle: TrackedFrame, landmarks: LandmarkMap
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
    ahead = in_front(sensor, at_middle)
    at_middle[~ahead] = [0.0, 0.0, 1.0]
    fused = project(sensor, at_middle)
    for _ in range(_ITERATIONS):
        information, gradient = _stacked(sensor, block, middle, which, fused)
        covariance = inverse_spd3(information)
        fused = fused + np.einsum("kij,kj->ki", covariance, gradient)
    usable = ahead & np.isfinite(fused).all(axis=1)
    if isinstance(sensor, CameraRig):
        usable &= fused[:, 2] > 0.0
    return Observations(
        ids=ids[usable],
        measurement=fused[usable],
        covariance=covariance[usable],
        pixels=np.full((int(usable.sum()), 3, 2), np.nan),
        is_new=np.zeros(int(usable.sum()), np.bool_),
    )


def _stacked(
    sensor: Sensor,
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
    points = triangulate(sensor, fused)
    by_measurement = np.linalg.inv(projection_jacobian(sensor, points))
    start = 0
    for frame in block:
        rows = which[start : start + len(frame.accepted)]
        start += len(frame.accepted)
        fTm = inverse(frame.wTc) @ middle.wTc
        local = points[rows] @ fTm[:3, :3].T + fTm[:3, 3]
        jacobian = projection_jacobian(sensor, local) @ fTm[:3, :3] @ by_measurement[rows]
        residual = measurement_difference(
            sensor, frame.accepted.measurement, project(sensor, local)
        )
        weighted = np.swapaxes(jacobian, 1, 2) @ inverse_spd3(frame.accepted.covariance)
        # Identities are unique within a frame: no row is added to twice.
        information[rows] += weighted @ jacobian
        gradient[rows] += np.einsum("kij,kj->ki", weighted, residual)
    return 0.5 * (information + np.swapaxes(information, 1, 2)), gradient


class Segments:
    """Turns tracked frames into those that enter the graph."""

    def __init__(self, sensor: Sensor, keyframe_every: int) -> None:
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

    def forget(self, identities: list[int]) -> None:
        """Landmarks that start anew: what the open block saw of them is not the same landmark."""
        gone = np.array(identities, np.int64)
        if len(gone):
            self._block = [_without(frame, gone) for frame in self._block]

    def _entering(self, frame: TrackedFrame, accepted: Observations, later: int) -> TrackedFrame:
        """With the motion since the graph's last frame; the ``later`` last motions come after."""
        here = len(self._motions) - later
        since, self._motions = self._motions[:here], self._motions[here:]
        motion = compose_odometry(since) if since else None
        return TrackedFrame(frame.frame, frame.wTc, motion, accepted)


def _is_placed(frame: TrackedFrame) -> bool:
    """Whether a frame saw enough of the map for the tracker to place it beside the others."""
    return len(frame.accepted) >= _LEAST_OBSERVATIONS


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
