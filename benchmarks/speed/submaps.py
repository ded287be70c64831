"""10,000 frames along a course far larger than what is kept in memory: time, memory, answers.

A street of points with an appearance, without images, closed to a ring; the whole front-end and the
paper's filter run on it. Once with sub-maps on disk, once with one map; each in a process of its
own. On a course where both fit, the trajectories' errors are compared over several seeds.

At the end of the drive with sub-maps single frames from beside the way ask which sub-map they see,
as a lost robot does, and as many of a street that was never driven; then the robot is carried off,
several times, to where it was thousands of frames ago.
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

from benchmarks.speed.blocks import Memory, of_blocks
from benchmarks.speed.maps import RIG
from fgslam.core import geometry as g
from fgslam.core.arrays import ByteArray, FloatArray, IntArray
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
ESTIMATORS = ("landmark_kalman", "fixed_lag")
SETTINGS = FrontendSettings(
    ego_motion=EgoMotionSettings(dof=3),
    loops=LoopSettings(),
    lost=LostSettings(),
    self_calibration=False,
    watch_cameras=False,
)
LIMITS = {"submaps_ate_over_one_map": 1.05, "fixed_lag_submaps_ate_over_one_map": 1.05}
_SIGMA_PX = 0.2
_TURN_M = 40.0  # way of a bend of 90 degrees, on a ring that is long enough
_APART = 500  # frames to the end of the drive from where the robot is carried, at least
_SEEN_M = 12.0
_ASIDE_M = (1.5, 3.5)
_HEIGHTS_M = (-1.2, 1.2)
_A_METRE = 9.0  # points
_WHEELS = np.array([1e-6, 0.002, 1e-6, 0.01, 1e-6, 0.01])  # deviations a step, camera axes
CARRIES, CARRIED_FRAMES = 5, 40
ASKED = 100  # single frames of either street
_BESIDE = np.array([0.0, 5.0, 0.0, 0.3, 0.0, 0.3])  # degrees, metres: deviations, camera axes
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
def drive(
    course: Course, radius_m: float | None, block: int = BLOCK, estimator: str = ESTIMATORS[0]
) -> Driven:
    """Drives a course, with sub-maps of a radius or with one map; the log goes to disk."""
    out, poses = Driven(), course.poses()
    with (
        tempfile.TemporaryDirectory() as folder,
        Session(RIG, estimator, frontend=SETTINGS) as session,
    ):
        session.keep_log(Path(folder) / "log")
        if radius_m is not None:
            session.keep_near(radius_m, Path(folder) / "submaps")
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
                if session.pipeline.submaps is not None:
                    session.pipeline.submaps.tidy()
        result = session.result()
        out.whole = len(result.estimate.landmarks)
        tTe = align(result.trajectory.poses, poses[: course.frames])
        assert tTe is not None
        off = position_errors(moved(tTe, result.trajectory.poses), poses[: course.frames])
        out.ate_m = float(np.sqrt(np.mean(off**2)))
        submaps = session.pipeline.submaps
        if submaps is not None:
            out.about = {
                "came_near": float(submaps.came_near),
                "recognised": float(submaps.recognised),
            }
            mapped = result.trajectory.poses
            if course.carries:
                out.about |= asked(course, session, mapped) | carried(
                    course, session, mapped, ahead
                )
    return out


def asked(course: Course, session: Session, mapped: FloatArray) -> dict[str, float]:
    """Recall and precision of single frames beside the way, and of a street never driven.

    Args:
        course: that was driven.
        session: after it.
        mapped: (n, 4, 4) its poses as estimated.
    """
    submaps, rng = session.pipeline.submaps, np.random.default_rng([course.seed, 3])
    assert submaps is not None
    first, last = course.carried[[0, -1]]
    frames = rng.integers(first, last, ASKED)
    beside = _BESIDE * np.r_[np.full(3, np.pi / 180.0), np.ones(3)]
    true = course.at(frames)
    seen = np.array([wTc @ g.se3_exp(beside * rng.standard_normal(6)) for wTc in true])
    meant = mapped[frames] @ g.inverse(true) @ seen
    off, cpu = [], []
    other = Course(course.frames, course.round_m, course.seed + 100)
    for of, there in ((course, meant), (other, None)):
        for k, found in enumerate(of.features(seen)):
            features = session.pipeline.stereo.match(None, found.features)
            start = time.process_time()
            number, position = submaps.recognise(features, lost=True)
            cpu.append(time.process_time() - start)
            if number >= 0:
                apart = np.inf if there is None else np.linalg.norm(position - there[k, :3, 3])
                off.append(float(apart))
    right = sum(one <= RIGHT_M for one in off)
    return {
        "asked": float(ASKED),
        "recall": right / ASKED,
        "precision": right / len(off) if off else np.nan,
        "asked_off_m": float(np.median(off)) if off else np.nan,
        "asked_ms": 1e3 * float(np.median(cpu)),
        "on_disk": float(len(submaps)),
    }


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
    """Of the long course, with sub-maps and with one map, and of the seeds."""
    long = Course(frames, 0.8 * frames * 0.25, carries=CARRIES)
    short = [Course(450, 200.0, seed, 0.5) for seed in SEEDS]
    block = max(frames * BLOCK // FRAMES, 1)
    with ProcessPoolExecutor(2, multiprocessing.get_context("spawn")) as processes:
        work = {
            (k, title): processes.submit(drive, course, radius, block, estimator)
            for k, course in enumerate((long, *short))
            for title, radius in (("submaps", RADIUS_M), ("one_map", None))
        }
        found = {name: future.result() for name, future in work.items()}
    out: dict[str, float] = {}
    for title in ("submaps", "one_map"):
        out |= _trace(title, found[0, title], block)
    ratios = []
    for k, course in enumerate(short, 1):
        for title in ("submaps", "one_map"):
            out[f"{title}_seed_{course.seed}_ate_m"] = found[k, title].ate_m
        ratios.append(found[k, "submaps"].ate_m / found[k, "one_map"].ate_m)
    every = [
        sum(found[k, t].ate_m for k in range(1, 1 + len(short))) for t in ("submaps", "one_map")
    ]
    return out | {
        "submaps_ate_over_one_map": every[0] / every[1],
        "submaps_ate_over_one_map_worst": max(ratios),
    }


def _trace(title: str, driven: Driven, block: int) -> dict[str, float]:
    """Blocks of a long drive: median time, most landmarks in memory, memory of the process."""
    out = {f"{title}_ate_m": driven.ate_m, f"{title}_landmarks": float(driven.whole)}
    out |= {f"{title}_{name}": value for name, value in driven.about.items()}
    out |= of_blocks(title, np.array(driven.cpu_s), driven.memory.process_mb, block)
    for stop in range(block, len(driven.landmarks) + 1, block):
        most = max(driven.landmarks[stop - block : stop])
        out[f"{title}_{stop}_landmarks_in_memory"] = float(most)
    for k, frame in enumerate(driven.closed):
        out[f"{title}_closed_{k}"] = float(frame)
    return out
