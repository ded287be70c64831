"""10,000 frames along a course far longer than what is seen at once: time, memory, answers.

A street of points with an appearance, without images, closed to a ring; the whole front-end and the
paper's filter run on it, and fixed lag, each in a process of its own; and several seeds of a ring
of 200 m. At the end of the drive the robot is carried off, several times, to where it was thousands
of frames ago.
"""

from __future__ import annotations

import itertools
import multiprocessing
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field

import numpy as np

from benchmarks.feature_world import FeatureWorld
from benchmarks.speed.blocks import Memory, of_blocks
from benchmarks.speed.maps import RIG
from fgslam.core import geometry as g
from fgslam.core.arrays import ByteArray, FloatArray, IntArray
from fgslam.core.log import Frame
from fgslam.core.sensors import Odometry
from fgslam.core.threads import one_blas_thread
from fgslam.evaluation.statistics import align, moved, position_errors
from fgslam.frontend.settings import EgoMotionSettings, FrontendSettings
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.session import Session
from fgslam.worlds.driving import planar_poses, straights_and_turns

FRAMES, BLOCK = 10_000, 1_000
SEEDS = range(1, 5)
ESTIMATORS = ("landmark_kalman", "fixed_lag")
SETTINGS = FrontendSettings(
    ego_motion=EgoMotionSettings(dof=3),
    loops=True,
    lost=True,
    self_calibration=False,
    watch_cameras=False,
)
_SIGMA_PX = 0.2
_TURN_M = 40.0  # way of a bend of 90 degrees, on a ring that is long enough
_APART = 500  # frames to the end of the drive from where the robot is carried, at least
_SEEN_M = 12.0
_ASIDE_M = (1.5, 3.5)
_HEIGHTS_M = (-1.2, 1.2)
_A_METRE = 9.0  # points
_WHEELS = np.array([1e-6, 0.002, 1e-6, 0.01, 1e-6, 0.01])  # deviations a step, camera axes
CARRIES, CARRIED_FRAMES = 5, 40
RIGHT_M = 0.5  # off where the map has the place: what is farther is another place
_IMAGES = (np.zeros((RIG.height, RIG.width), np.uint8),) * 3


@dataclass(frozen=True)
class Course:
    """A ring of streets.

    Attributes:
        frames: of the drive.
        round_m: length of the ring.
        seed: of the world and of all noise.
        step_m: way of a frame.
        carries: how often the robot is carried off after the drive, and then drives on.
    """

    frames: int
    round_m: float
    seed: int = 0
    step_m: float = 0.25
    carries: int = 0

    @property
    def carried(self) -> IntArray:
        """(carries,) frames of the first round where the robot is put down, far from the end."""
        one = min(self.frames, int(self.round_m / self.step_m))
        end = self.frames % one
        apart = min(_APART, (one - end) // 4)
        return np.linspace(end + apart, one - apart, self.carries).astype(int)

    def poses(self) -> FloatArray:
        """(n, 4, 4) ``wTc``; the first is the world."""
        on = [np.arange(start, start + CARRIED_FRAMES) for start in self.carried]
        return self.at(np.concatenate([np.arange(self.frames), *on]))

    def at(self, frames: IntArray) -> FloatArray:
        """``wTc`` (n, 4, 4) of frames of a drive without end."""
        bend = min(_TURN_M, 0.125 * self.round_m)
        sides = [(0.25 * self.round_m - bend, 0.0), (bend, np.pi / 2)] * 4
        ring = straights_and_turns((0.0, 0.0, 0.0), sides, True)
        rounds, along = np.divmod(self.step_m * np.array([0, *frames]), ring.length)
        planar = [np.interp(along, ring.arc, one) for one in (*ring.xy.T, ring.heading)]
        planar[2] += 2.0 * np.pi * rounds
        wTc = planar_poses(np.column_stack(planar)) @ RIG.bTc
        return np.asarray(g.inverse(wTc[0]) @ wTc[1:])

    def features(self, poses: FloatArray) -> Iterator[FeatureFrame]:
        """Frames with the features that the poses see."""
        rng = np.random.default_rng([self.seed, 1])
        count = int(_A_METRE * self.round_m)
        first = self.at(np.arange(min(self.frames, int(self.round_m / self.step_m))))
        at = first[rng.integers(0, len(first), count)]
        aside = rng.choice([-1.0, 1.0], count) * rng.uniform(*_ASIDE_M, count)
        local = np.column_stack([aside, rng.uniform(*_HEIGHTS_M, count), np.zeros(count)])
        points = np.einsum("nij,nj->ni", at[:, :3, :3], local) + at[:, :3, 3]
        world = FeatureWorld(points, rng, RIG, _looks(count, rng))
        for i, wTc in enumerate(poses):
            far = np.flatnonzero(np.linalg.norm(points - wTc[:3, 3], axis=1) > _SEEN_M)
            seen = world.features(wTc, _SIGMA_PX, far)
            yield FeatureFrame(i, Frame(i, float(i), _IMAGES), seen, "", 0.0, 0.0)

    def wheels(self, poses: FloatArray) -> list[Odometry | None]:
        """The motion of the robot's body to each frame; who is carried off does not notice it."""
        rng = np.random.default_rng([self.seed, 2])
        cTb = g.inverse(RIG.bTc)
        covariance = g.change_tangent_frame(RIG.bTc, np.diag(_WHEELS**2))
        out: list[Odometry | None] = [None]
        rolled = np.eye(4)
        for k, (a, b) in enumerate(itertools.pairwise(poses), 1):
            if k < self.frames or (k - self.frames) % CARRIED_FRAMES:
                rolled = g.inverse(a) @ b
            step = rolled @ g.se3_exp(_WHEELS * rng.standard_normal(6))
            out.append(Odometry(RIG.bTc @ step @ cTb, covariance))
        return out


def _looks(count: int, rng: np.random.Generator) -> ByteArray:
    """Descriptors (count, 128), sparse as SIFT's are.

    Of 2,000 the effective number of words (1 over the sum of their squared shares) is 260; of
    2,000 of a photograph 420, of uniform noise 6.
    """
    drawn = rng.gamma(0.3, size=(count, 128))
    drawn *= 512.0 / np.linalg.norm(drawn, axis=1, keepdims=True)
    return np.minimum(drawn, 255.0).astype(np.uint8)


@dataclass
class Driven:
    """What a drive gave: numbers of each frame, and the answer."""

    cpu_s: list[float] = field(default_factory=list)
    landmarks: list[int] = field(default_factory=list)
    memory: Memory = field(default_factory=Memory)
    closed: list[int] = field(default_factory=list)
    ate_m: float = np.nan
    whole: int = 0
    about: dict[str, float] = field(default_factory=dict)


@one_blas_thread()
def drive(course: Course, block: int = BLOCK, estimator: str = ESTIMATORS[0]) -> Driven:
    """Drives a course, and is carried off as often as it says."""
    out, poses = Driven(), course.poses()
    with Session(RIG, estimator, frontend=SETTINGS) as session:
        ahead = zip(course.features(poses), course.wheels(poses), strict=True)
        for found, wheels in itertools.islice(ahead, course.frames):
            start = time.process_time()
            report = session.advance(found, float(found.i), wheels)
            out.cpu_s.append(time.process_time() - start)
            out.landmarks.append(len(session.pipeline.tracker.database))
            if any(report.stats.closed):
                out.closed.append(found.i)
            if (found.i + 1) % block == 0:
                out.memory.book()
        result = session.result()
        out.whole = len(result.estimate.landmarks)
        tTe = align(result.trajectory.poses, poses[: course.frames])
        assert tTe is not None
        off = position_errors(moved(tTe, result.trajectory.poses), poses[: course.frames])
        out.ate_m = float(np.sqrt(np.mean(off**2)))
        if course.carries:
            out.about = carried(course, session, result.trajectory.poses, ahead)
    return out


def carried(
    course: Course,
    session: Session,
    mapped: FloatArray,
    ahead: Iterator[tuple[FeatureFrame, Odometry | None]],
) -> dict[str, float]:
    """The robot carried off: after how many frames it is found, and how far off it is then."""
    found_after, off, wrong = [], [], 0
    for start in course.carried:
        frames = np.arange(start, start + CARRIED_FRAMES)
        meant, errors = mapped[frames], []
        for k, (found, wheels) in enumerate(itertools.islice(ahead, CARRIED_FRAMES)):
            report = session.advance(found, float(found.i), wheels)
            if report.tracking.status.measured:
                errors.append((k, np.linalg.norm(report.stats.wTc[:3, 3] - meant[k, :3, 3])))
        good = [(k, error) for k, error in errors if error <= RIGHT_M]
        wrong += len(errors) - len(good)
        if good:
            found_after.append(good[0][0] + 1)
            off.append(good[-1][1])
    return {
        "carried": float(course.carries),
        "carried_found": float(len(off)),
        "carried_found_after": float(np.max(found_after, initial=0)),
        "carried_off_m": float(np.max(off, initial=0.0)),
        "carried_wrong_frames": float(wrong),
    }


def numbers(frames: int = FRAMES) -> dict[str, float]:
    """All numbers by name, those of the fixed lag after those of the filter."""
    filtered, lagged = (of_estimator(name, frames) for name in ESTIMATORS)
    return filtered | {f"fixed_lag_{name}": value for name, value in lagged.items()}


def of_estimator(estimator: str, frames: int = FRAMES) -> dict[str, float]:
    """Of the long course, and of the seeds of the short one."""
    long = Course(frames, 0.8 * frames * 0.25, carries=CARRIES)
    short = [Course(450, 200.0, seed, 0.5) for seed in SEEDS]
    block = max(frames * BLOCK // FRAMES, 1)
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as processes:
        work = [processes.submit(drive, course, block, estimator) for course in (long, *short)]
        first, *others = [future.result() for future in work]
    of_seeds = zip(SEEDS, others, strict=True)
    return _trace(first, block) | {
        f"ring_seed_{seed}_ate_m": driven.ate_m for seed, driven in of_seeds
    }


def _trace(driven: Driven, block: int) -> dict[str, float]:
    """Blocks of a long drive: median time, most landmarks in memory, memory of the process."""
    out = {"ring_ate_m": driven.ate_m, "ring_landmarks": float(driven.whole)}
    out |= {f"ring_{name}": value for name, value in driven.about.items()}
    out |= of_blocks("ring", np.array(driven.cpu_s), driven.memory.process_mb, block)
    for stop in range(block, len(driven.landmarks) + 1, block):
        most = max(driven.landmarks[stop - block : stop])
        out[f"ring_{stop}_landmarks_in_memory"] = float(most)
    for k, frame in enumerate(driven.closed):
        out[f"ring_closed_{k}"] = float(frame)
    return out
