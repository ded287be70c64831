"""10,000 frames along a course far larger than what is kept in memory: time, memory, answers.

A street of points with an appearance, without images, closed to a ring; the whole front-end and the
paper's filter run on it. Once with sub-maps on disk, once with one map; each in a process of its
own. On a course where both fit, the trajectories' errors are compared over several seeds.
"""

from __future__ import annotations

import itertools
import multiprocessing
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.speed.images import log_mb, resident_mb
from benchmarks.speed.maps import RIG
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.measurements import Odometry
from fgslam.core.recordings import Frame
from fgslam.core.threads import one_blas_thread
from fgslam.evaluation.trajectory import align, moved, position_errors
from fgslam.frontend.settings import EgoMotionSettings, FrontendSettings, LoopSettings, LostSettings
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.session import Session
from fgslam.worlds.driving.paths import planar_poses, straights_and_turns
from fgslam.worlds.simulated.features import FeatureWorld

FRAMES, BLOCK = 10_000, 1_000
RADIUS_M = 20.0
SEEDS = range(1, 5)
SETTINGS = FrontendSettings(
    ego_motion=EgoMotionSettings(dof=3),
    loops=LoopSettings(),
    lost=LostSettings(),
    self_calibration=False,
    watch_cameras=False,
)
LIMITS = {"submaps_ate_over_one_map": 1.05}
_SIGMA_PX = 0.2
_TURN_M = 40.0  # way of a bend of 90 degrees
_SEEN_M = 12.0
_ASIDE_M = (1.5, 3.5)
_HEIGHTS_M = (-1.2, 1.2)
_A_METRE = 9.0  # points
_WHEELS = np.array([1e-6, 0.002, 1e-6, 0.01, 1e-6, 0.01])  # deviations a step, camera axes
_IMAGES = (np.zeros((RIG.height, RIG.width), np.uint8),) * 3


@dataclass(frozen=True)
class Course:
    """A ring of streets.

    Attributes:
        frames: of the drive.
        round_m: length of the ring.
        seed: of the world and of all noise.
        step_m: way of a frame.
    """

    frames: int
    round_m: float
    seed: int = 0
    step_m: float = 0.25

    def poses(self) -> FloatArray:
        """(n, 4, 4) ``wTc``; the first is the world."""
        side = 0.25 * self.round_m - _TURN_M
        ring = straights_and_turns((0.0, 0.0, 0.0), [(side, 0.0), (_TURN_M, np.pi / 2)] * 4, True)
        way = np.arange(self.frames) * self.step_m
        rounds, along = np.divmod(way, ring.length)
        planar = [np.interp(along, ring.arc, one) for one in (*ring.xy.T, ring.heading)]
        planar[2] += 2.0 * np.pi * rounds
        wTc = planar_poses(np.column_stack(planar)) @ RIG.bTc
        return np.asarray(g.inverse(wTc[0]) @ wTc)

    def features(self, poses: FloatArray) -> Iterator[FeatureFrame]:
        """Frames with the features that the poses see."""
        rng = np.random.default_rng([self.seed, 1])
        count = int(_A_METRE * self.round_m)
        at = poses[rng.integers(0, min(len(poses), int(self.round_m / self.step_m)), count)]
        aside = rng.choice([-1.0, 1.0], count) * rng.uniform(*_ASIDE_M, count)
        local = np.column_stack([aside, rng.uniform(*_HEIGHTS_M, count), np.zeros(count)])
        points = np.einsum("nij,nj->ni", at[:, :3, :3], local) + at[:, :3, 3]
        world = FeatureWorld(points, rng, RIG)
        for i, wTc in enumerate(poses):
            far = np.flatnonzero(np.linalg.norm(points - wTc[:3, 3], axis=1) > _SEEN_M)
            seen = world.features(wTc, _SIGMA_PX, far)
            yield FeatureFrame(i, Frame(i, float(i), _IMAGES), seen, "", 0.0, 0.0)

    def wheels(self, poses: FloatArray) -> list[Odometry | None]:
        """The motion of the robot's body to each frame."""
        rng = np.random.default_rng([self.seed, 2])
        cTb = g.inverse(RIG.bTc)
        covariance = g.change_tangent_frame(RIG.bTc, np.diag(_WHEELS**2))
        out: list[Odometry | None] = [None]
        for a, b in itertools.pairwise(poses):
            step = g.inverse(a) @ b @ g.se3_exp(_WHEELS * rng.standard_normal(6))
            out.append(Odometry(RIG.bTc @ step @ cTb, covariance))
        return out


@dataclass
class Driven:
    """What a drive gave: numbers of each frame, and the answer."""

    cpu_s: list[float] = field(default_factory=list)
    landmarks: list[int] = field(default_factory=list)
    resident_mb: list[float] = field(default_factory=list)
    log_mb: list[float] = field(default_factory=list)
    closed: list[int] = field(default_factory=list)
    brought: list[tuple[int, int]] = field(default_factory=list)
    ate_m: float = np.nan
    whole: int = 0


@one_blas_thread()
def drive(course: Course, radius_m: float | None, block: int = BLOCK) -> Driven:
    """Drives a course, with sub-maps of a radius or with one map."""
    out, poses = Driven(), course.poses()
    with (
        tempfile.TemporaryDirectory() as folder,
        Session(RIG, "landmark_kalman", frontend=SETTINGS) as session,
    ):
        if radius_m is not None:
            session.keep_near(radius_m, Path(folder) / "submaps")
        wheels = course.wheels(poses)
        for found in course.features(poses):
            start = time.process_time()
            report = session.advance(found, float(found.i), wheels[found.i])
            out.cpu_s.append(time.process_time() - start)
            out.landmarks.append(len(session.pipeline.tracker.database))
            if any(report.stats.closed):
                out.closed.append(found.i)
            submaps = session.pipeline.submaps
            if submaps is not None:
                out.brought.append((submaps.came_near, submaps.recognised))
                if (found.i + 1) % block == 0:
                    submaps.tidy()
            if (found.i + 1) % block == 0:
                out.resident_mb.append(resident_mb())
                out.log_mb.append(log_mb(session.log))
        result = session.result()
    out.whole = len(result.estimate.landmarks)
    tTe = align(result.trajectory.poses, poses)
    assert tTe is not None
    off = position_errors(moved(tTe, result.trajectory.poses), poses)
    out.ate_m = float(np.sqrt(np.mean(off**2)))
    return out


def numbers(frames: int = FRAMES) -> dict[str, float]:
    """All numbers by name: of the long course, with sub-maps and with one map, and of the seeds."""
    long = Course(frames, 0.8 * frames * 0.25)
    short = [Course(450, 200.0, seed, 0.5) for seed in SEEDS]
    block = max(frames * BLOCK // FRAMES, 1)
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as processes:
        work = {
            (k, title): processes.submit(drive, course, radius, block)
            for k, course in enumerate((long, *short))
            for title, radius in (("submaps", RADIUS_M), ("one_map", None))
        }
        found = {name: future.result() for name, future in work.items()}
    out: dict[str, float] = {}
    for title in ("submaps", "one_map"):
        out |= _trace(title, found[0, title], block)
    for k, course in enumerate(short, 1):
        for title in ("submaps", "one_map"):
            out[f"{title}_seed_{course.seed}_ate_m"] = found[k, title].ate_m
    ratio = sum(found[k, "submaps"].ate_m for k in range(1, len(short) + 1))
    ratio /= sum(found[k, "one_map"].ate_m for k in range(1, len(short) + 1))
    return out | {"submaps_ate_over_one_map": ratio}


def _trace(title: str, driven: Driven, block: int) -> dict[str, float]:
    """Blocks of a long drive: median time, most landmarks in memory, memory of process and log."""
    out = {f"{title}_ate_m": driven.ate_m, f"{title}_landmarks": float(driven.whole)}
    for k, (memory, log) in enumerate(zip(driven.resident_mb, driven.log_mb, strict=True)):
        of, at = slice(k * block, (k + 1) * block), f"{title}_{(k + 1) * block}"
        out |= {
            f"{at}_ms": 1e3 * float(np.median(driven.cpu_s[of])),
            f"{at}_landmarks_in_memory": float(max(driven.landmarks[of])),
            f"{at}_mb": memory,
            f"{at}_log_mb": log,
        }
    for k, frame in enumerate(driven.closed):
        out[f"{title}_closed_{k}"] = float(frame)
    if driven.brought:
        near, recognised = driven.brought[-1]
        out |= {f"{title}_came_near": float(near), f"{title}_recognised": float(recognised)}
    return out
