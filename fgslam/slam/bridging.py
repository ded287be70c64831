"""Final poses of frames that nothing measured, between frames that landmarks located.

The prediction of such a frame is worth nothing once the frames after it are located: its steps
are free, and the estimators leave it where it was guessed. It is interpolated in time between the
located frames around its gap, and so are frames located relative to each other only: along the
screw motion from one to the other, bent towards the cubic (Hermite's) that begins and ends with the
velocities there. By how much, and how uncertain that is, the drive shows: wherever it is located
for as long, the same is done with its frames and compared. So the weight of the cubic is found
by least squares (stacking: Breiman, Machine Learning 24, 1996), and the deviations are the errors
left.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray, nearest_rows
from fgslam.core.geometry import (
    adjoint,
    congruence,
    inverse,
    rotate_covariances,
    se3_exp,
    se3_log,
    se3_log_jacobian,
    so3_log,
    transform_to_world,
)
from fgslam.core.types import Estimate, LandmarkMap, Trajectory
from fgslam.frontend.tracking.landmarks import MapParts

_STRETCHES = 50  # of located frames that are compared, those nearest to the gap
_STILL = 1e-12  # radians and metres: no way at all

PoseSigma: TypeAlias = tuple[FloatArray, FloatArray]
"""Pose (4, 4) and covariance (6, 6)."""
Gap: TypeAlias = tuple[int, int]
"""The located frames before and after some that are not."""


def bridged(estimate: Estimate, parts: MapParts) -> Estimate:
    """The estimate, with frames interpolated that no measurement ties to the located ones around.

    Rotation and position are replaced each where it is less certain: a gyroscope's turn stays. A
    part of the map moves as one, with its landmarks, as the middle one of its frames is placed.
    Frames after the last located one stay.

    Args:
        estimate: of as many frames as ``parts`` has recorded; of others it stays as it is.
        parts: which frames and landmarks are connected with the first frame.
    """
    known, trajectory = parts.connected, estimate.trajectory
    if len(known) != len(trajectory) or known.all():
        return estimate
    poses, covariances = trajectory.poses.copy(), estimate.covariances.copy()
    positions, spreads = estimate.landmarks.positions.copy(), estimate.landmarks.covariances.copy()
    of_landmarks = parts.of(estimate.landmarks.ids)
    relative = {lag: one.copy() for lag, one in estimate.relative.items()}
    drive = _Drive(trajectory.timestamps, trajectory.poses, known)
    for part, frames, gap in _bridged_parts(parts):
        middle = frames[len(frames) // 2]
        guess = _between(gap, middle, drive, covariances)
        here = poses[middle], covariances[middle]
        better = _better(here, guess)
        if better is here:
            continue
        pose, covariance = better
        moved = pose @ inverse(poses[middle])
        poses[frames] = moved @ poses[frames]
        for lag, motions in relative.items():  # of which it is not known what they have in common
            ends = np.unique(np.concatenate([frames, frames - lag]))
            motions[ends[(ends >= 0) & (ends < len(motions))]] = np.nan
        covariances[frames] = congruence(adjoint(inverse(poses[frames]) @ pose), covariance)
        own = np.flatnonzero(of_landmarks == part)
        positions[own] = transform_to_world(moved, positions[own])
        spreads[own] = rotate_covariances(moved[:3, :3], spreads[own])
    return dataclasses.replace(
        estimate,
        trajectory=Trajectory(trajectory.timestamps, poses),
        covariances=covariances,
        relative=relative,
        landmarks=LandmarkMap(estimate.landmarks.ids, positions, spreads),
    )


def bridged_frames(parts: MapParts) -> IntArray:
    """Frames (k,), counted from 0, that :func:`bridged` places where nothing else does better."""
    inside = [frames for _, frames, _ in _bridged_parts(parts)]
    return np.sort(np.concatenate([np.empty(0, np.int64), *inside]))


def _bridged_parts(parts: MapParts) -> list[tuple[int, IntArray, Gap]]:
    """Each part that is not the first one: its frames, and the gap that the middle one is in."""
    known = parts.connected
    of_frames = np.array([parts.of_frame(k) for k in range(len(known))])
    at, out = np.flatnonzero(known), []
    for part in np.unique(of_frames[~known]).tolist():
        frames = np.flatnonzero(of_frames == part)
        after = int(np.searchsorted(at, frames[len(frames) // 2]))
        if after < len(at):
            out.append((part, frames, (int(at[after - 1]), int(at[after]))))
    return out


def _between(gap: Gap, frame: int, drive: _Drive, covariances: FloatArray) -> PoseSigma:
    """Pose of a frame between the ends of its gap, and its covariance."""
    first, last = gap
    compared = drive.compared_with(gap, frame)
    ways = [drive.way(*each) for each in compared.tolist()]
    true = drive.poses[compared[:, 1]]
    weight = _weight(ways, true)
    errors = [_apart(way.pose(weight), pose) for way, pose in zip(ways, true, strict=True)]
    lengths = [_apart(drive.poses[start], drive.poses[end]) for start, _, end in compared]
    own = _apart(drive.poses[first], drive.poses[last])
    variance = _variance(own, np.reshape(errors, (-1, 2)), np.reshape(lengths, (-1, 2)))
    ends = [np.diagonal(covariances[k]).reshape(2, 3).max(axis=1) for k in gap]
    spread = np.repeat(variance + np.maximum(*ends), 3)
    return drive.way(first, frame, last).pose(weight), np.diag(spread)


@dataclass(frozen=True, slots=True, eq=False)
class _Way:
    """Where a frame lies between two others: on the straight motion, and on the cubic next to it.

    Attributes:
        start: (4, 4) pose of the first.
        straight: (6,) tangent vector at it.
        correction: (6,) to be added to that.
    """

    start: FloatArray
    straight: FloatArray
    correction: FloatArray

    def pose(self, weight: FloatArray) -> FloatArray:
        """Pose (4, 4); ``weight`` (2,) is that of the cubic, in rotation and position."""
        return self.start @ se3_exp(self.straight + np.repeat(weight, 3) * self.correction)


@dataclass(frozen=True, slots=True, eq=False)
class _Drive:
    """Times (n,), poses (n, 4, 4), and which frames are located (n,)."""

    times: FloatArray
    poses: FloatArray
    known: BoolArray

    def compared_with(self, gap: Gap, frame: int) -> IntArray:
        """(w, 3) begin, middle, end of located frames in a row as long as a gap; the nearest.

        As long in time: a blind frame of a film that was thinned out may last for seconds.
        """
        since, times = self.times - self.times[gap[0]], self.times
        ends = nearest_rows(times, times + since[gap[1]])
        late = times + since[gap[1]] > times[-1] + 0.5 * (times[-1] - times[-2])
        starts = np.arange(len(times))
        middle = np.clip(nearest_rows(times, times + since[frame]), starts + 1, ends - 1)
        before = np.concatenate([[0], np.cumsum(self.known)])  # located frames before each
        located = before[ends + 1] - before[starts] == ends - starts + 1
        rows = np.flatnonzero(located & ~late & (middle > starts) & (middle < ends))
        rows = rows[np.argsort(np.abs(rows - gap[0]), kind="stable")[:_STRETCHES]]
        return np.column_stack([starts, middle, ends])[rows]

    def way(self, first: int, frame: int, last: int) -> _Way:
        """Where a frame lies between two located ones.

        Velocities are those of the steps before and after; the mean one where these are unknown.
        """
        times, start = self.times, self.poses[first]
        span = float(times[last] - times[first])
        s = float(times[frame] - times[first]) / span
        end = se3_log(inverse(start) @ self.poses[last])
        before, after = self._velocity(first - 1), self._velocity(last)
        leaving = end if before is None else span * before
        arriving = end if after is None else span * se3_log_jacobian(end) @ after
        cubic = (s**3 - 2 * s**2 + s) * leaving + (3 * s**2 - 2 * s**3) * end
        cubic += (s**3 - s**2) * arriving
        return _Way(start, s * end, cubic - s * end)

    def _velocity(self, frame: int) -> FloatArray | None:
        """(6,) from a frame to the next one; None unless both are located."""
        if not (0 <= frame < len(self.known) - 1 and self.known[frame] and self.known[frame + 1]):
            return None
        step = se3_log(inverse(self.poses[frame]) @ self.poses[frame + 1])
        return np.asarray(step / (self.times[frame + 1] - self.times[frame]))


def _weight(ways: list[_Way], true: FloatArray) -> FloatArray:
    """(2,) of the cubic in rotation and position, from 0 to 1: least squares over known poses."""
    across, along = np.zeros(2), np.zeros(2)
    for way, pose in zip(ways, true, strict=True):
        off = se3_log(inverse(way.start) @ pose) - way.straight
        correction = way.correction
        across += (off * correction).reshape(2, 3).sum(axis=1)
        along += (correction * correction).reshape(2, 3).sum(axis=1)
    return np.clip(across / np.maximum(along, _STILL**2), 0.0, 1.0)


def _variance(own: FloatArray, errors: FloatArray, lengths: FloatArray) -> FloatArray:
    """(2,) of rotation and position, per axis, of an interpolated frame.

    One sample is the gap's own length: all of it may have been made at once. Where that is longer
    than the segments compared, their errors count for more in the same proportion.

    Args:
        own: (2,) angle and distance between the gap's ends.
        errors: (w, 2) of segments that were interpolated.
        lengths: (w, 2) angles and distances between their ends.
    """
    usual = np.sqrt((lengths**2).mean(axis=0)) if len(lengths) else own
    larger = np.maximum(1.0, own / np.maximum(usual, _STILL))
    total = own**2 + (errors**2).sum(axis=0) * larger**2
    return np.asarray(total / (3.0 * (1.0 + len(errors))))


def _apart(a: FloatArray, b: FloatArray) -> FloatArray:
    """(2,) angle in radians and distance in metres between two poses."""
    turn = so3_log(a[:3, :3].T @ b[:3, :3])
    return np.array([np.linalg.norm(turn), np.linalg.norm(b[:3, 3] - a[:3, 3])])


def _better(one: PoseSigma, other: PoseSigma) -> PoseSigma:
    """The more certain rotation and the more certain position of two; the first where it is both.

    Where they come from different ones, the correlation of their errors is not known.
    """
    turn, place = (
        one if np.trace(one[1][k, k]) <= np.trace(other[1][k, k]) else other
        for k in (slice(0, 3), slice(3, 6))
    )
    if turn is place:
        return turn
    pose, covariance = turn[0].copy(), np.zeros((6, 6))
    pose[:3, 3] = place[0][:3, 3]
    covariance[:3, :3] = turn[1][:3, :3]
    turned = pose[:3, :3].T @ place[0][:3, :3]
    covariance[3:, 3:] = rotate_covariances(turned, place[1][None, 3:, 3:])[0]
    return pose, covariance
