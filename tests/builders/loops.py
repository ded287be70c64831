"""A simulated drive round and round whose returns are first not, and then recognised.

A point that was out of sight for long gets a new identity, as the landmark database gives one to
what it does not find where the drifted map has it. At a recognised return the frame names the old
landmarks that it sees, with its pose beside an earlier frame, true up to the stated noise; from the
next frame on old landmarks are found again, and the new identities end with it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from simulated import Drive, noisy_odometry, observations, points_in_views

from benchmarks.feature_world import visible
from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.sensors import Increment, LoopClosure

CIRCLE = (0.0, 0.1, 0.0, 0.0, 0.0, 0.25)
"""63 frames a round of 5 m across."""
ROUND = 63
CLOSED = ROUND + 6
"""When the return is recognised."""
LOOP_SIGMA = np.array([0.001, 0.001, 0.001, 0.005, 0.005, 0.005])
_FORGOTTEN_AFTER = 15


@dataclass(frozen=True)
class Rounds:
    """What to simulate.

    Attributes:
        drive: noise and points; its twist goes round.
        closes: frames whose return is recognised.
        lies: of these, frames whose closure is wrong, with the motion (6,) that it is off by.
    """

    drive: Drive = dataclasses.field(
        default_factory=lambda: Drive(
            frames=75, points=80, twist=CIRCLE, sigma_px=(0.8, 0.8, 0.6), miss_rate=0.1
        )
    )
    closes: tuple[int, ...] = (CLOSED,)
    lies: tuple[tuple[int, tuple[float, ...]], ...] = ()


@dataclass(frozen=True)
class Returned:
    """The truth and the measurements: poses (n, 4, 4), point (3,) of each identity (m, 3)."""

    poses: FloatArray
    points_by_id: FloatArray
    increments: list[Increment]


def drive_rounds(rounds: Rounds, rng: np.random.Generator) -> Returned:
    """Drives, measures, forgets, and recognises."""
    drive = rounds.drive
    step = g.se3_exp(np.array(drive.twist))
    poses = [np.eye(4)]
    for _ in range(drive.frames - 1):
        poses.append(g.reorthonormalise(poses[-1] @ step))
    points = points_in_views(drive, poses, rng)
    book = _Book(drive, points, np.array(poses))
    increments = []
    for k in range(drive.frames):
        lie = dict(rounds.lies).get(k)
        increments.append(book.increment(k, step, k in rounds.closes, lie, rng))
    return Returned(np.array(poses), points[np.array(book.point_of_id)], increments)


class _Book:
    """Who is known under which identity."""

    def __init__(self, drive: Drive, points: FloatArray, poses: FloatArray) -> None:
        self._drive, self._points, self._poses = drive, points, poses
        self._id = np.full(len(points), -1, np.int64)
        self._old_id = np.full(len(points), -1, np.int64)
        self._last = np.full(len(points), -1, np.int64)
        self._recognised = False
        self.point_of_id: list[int] = []
        self._seen: list[BoolArray] = []
        self._ending = np.empty(0, np.int64)

    def increment(
        self,
        k: int,
        step: FloatArray,
        closes: bool,
        lie: tuple[float, ...] | None,
        rng: np.random.Generator,
    ) -> Increment:
        """Frame ``k``."""
        drive = self._drive
        local = g.transform_to_camera(self._poses[k], self._points)
        in_view = visible(drive.rig, local)
        seen = in_view & (rng.uniform(size=len(in_view)) >= drive.miss_rate)
        local[~in_view] = 1.0
        noise = drive.noise * np.array(drive.sigma_px) * rng.standard_normal(local.shape)
        measured = drive.rig.predict(local) + noise
        odometry = None if k == 0 else noisy_odometry(drive, step, rng)
        self._forget(k)
        matched, new = np.flatnonzero(seen & (self._id >= 0)), np.flatnonzero(seen & (self._id < 0))
        missed = self._id[in_view & ~seen & (self._id >= 0)]
        self._id[new] = len(self.point_of_id) + np.arange(len(new))
        self.point_of_id += new.tolist()
        both = np.concatenate([matched, new])
        self._last[both] = k
        self._seen.append(seen)
        is_new = np.arange(len(both)) >= len(matched)
        observed = observations(self._id[both], measured[both], np.array(drive.sigma_px), is_new)
        loops: tuple[LoopClosure, ...] = ()
        pruned, self._ending = self._ending, np.empty(0, np.int64)
        if closes:
            loop = self._loop(k, measured, seen, lie, rng)
            loops, self._ending = (loop,), np.sort(loop.merged[:, 0])
        return Increment(
            index=2 * k,
            timestamp=drive.period_s * k,
            odometry=odometry,
            observations=observed,
            rejected=np.zeros(len(both), np.bool_),
            missed_ids=np.sort(missed),
            pruned_ids=pruned,
            loops=loops,
        )

    def _forget(self, k: int) -> None:
        gone = (self._id >= 0) & (k - self._last > _FORGOTTEN_AFTER)
        if self._recognised:
            return
        first = gone & (self._old_id < 0)
        self._old_id[first] = self._id[first]
        self._id[gone] = -1

    def _loop(
        self,
        k: int,
        measured: FloatArray,
        seen: BoolArray,
        lie: tuple[float, ...] | None,
        rng: np.random.Generator,
    ) -> LoopClosure:
        """The closure to the earlier frame that saw most of what is seen now."""
        again = seen & (self._old_id >= 0)
        common = [int((again & earlier).sum()) for earlier in self._seen[: k - 30]]
        frame = int(np.argmax(common))
        true = g.inverse(self._poses[frame]) @ self._poses[k]
        noise = g.se3_exp(self._drive.noise * LOOP_SIGMA * rng.standard_normal(6))
        off = np.eye(4) if lie is None else g.se3_exp(np.array(lie))
        which = np.flatnonzero(again)
        sigma = np.array(self._drive.sigma_px)
        local = g.transform_to_camera(self._poses[frame] @ true @ off, self._points[which])
        which, local = which[local[:, 2] > 0.2], local[local[:, 2] > 0.2]
        fresh = self._drive.rig.predict(local)
        fresh = fresh + self._drive.noise * sigma * rng.standard_normal(fresh.shape)
        old = observations(self._old_id[which], fresh, sigma, np.zeros(len(which), np.bool_))
        merged = np.column_stack([self._id[which], self._old_id[which]])
        merged = merged[merged[:, 0] != merged[:, 1]]
        if lie is None:
            self._recognised = True
            back = self._old_id >= 0
            also = np.flatnonzero(back & (self._id >= 0) & (self._id != self._old_id))
            merged = np.column_stack([self._id[also], self._old_id[also]])
            self._id[back] = self._old_id[back]
        else:
            merged = merged[:0]
        return LoopClosure(frame, true @ off @ noise, np.diag(LOOP_SIGMA**2), old, merged)
