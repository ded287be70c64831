"""Replays a measurement log through one estimator, as the live loop would have driven it.

The ego-motion of the live loop, against each estimator's own map; without its matching.
"""

from __future__ import annotations

import dataclasses
import math
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fgslam.backend.protocol import Estimator, predicted, recalibrated, updated
from fgslam.backend.settings import EstimatorSettings, family_of
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import ConfigError
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import Increment, MeasurementType, Observations
from fgslam.core.stopwatch import Stopwatch
from fgslam.core.threads import one_blas_thread
from fgslam.core.types import (
    NO_LANDMARKS,
    EgoMotion,
    EgoMotionStatus,
    Estimate,
    LandmarkMap,
    Prediction,
    Trajectory,
    UpdateStats,
)
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem, Resection, unmeasured
from fgslam.frontend.tracking.landmarks import MapParts
from fgslam.slam.bridging import bridged
from fgslam.slam.build import Arrival, made_or_given, take_over
from fgslam.slam.motion import ConstantVelocityMotion, MotionModel
from fgslam.slam.pipeline import FrameNoise, noise_in_use, observe
from fgslam.slam.results import ESTIMATOR_FAULTS, Answered, estimate_of_failed, reason

_PROC_STATUS = Path("/proc/self/status")


class ReplayRow(NamedTuple):
    """Numbers of one replayed frame; NaN where unknown."""

    status: str
    matched: int
    inliers: int
    landmarks: int
    nis: float
    nis_dof: int
    update_ms: float
    solve_ms: float


@dataclass(frozen=True, slots=True, eq=False, repr=False, kw_only=True)
class Replay(Answered):
    """Result of an estimator on a replayed log.

    Attributes:
        title: the estimator's name in tables and folders.
        rows: one for each frame; ``update_ms`` is prediction and update, ``solve_ms`` the
            least-squares pose that all estimators share.
        noise: that each frame was estimated with.
        estimator: as it is after the last frame; None where it could not be made.
    """

    title: str
    rows: tuple[ReplayRow, ...]
    noise: tuple[FrameNoise, ...] = ()
    estimator: Estimator | None = dataclasses.field(default=None, repr=False)

    @property
    def map(self) -> LandmarkMap:
        """The landmarks: identities, positions, covariances."""
        return self.estimate.landmarks

    def __len__(self) -> int:
        return len(self.rows)

    def column(self, name: str) -> npt.NDArray[Any]:
        """One number of all frames."""
        return np.array([getattr(row, name) for row in self.rows])


@dataclass(frozen=True, slots=True, eq=False)
class ReplayedFrame:
    """What one frame of a log gave, and how long `predict`, `track` and `update` took."""

    tracking: EgoMotion
    stats: UpdateStats
    stage_ms: dict[str, float]
    noise: FrameNoise


@one_blas_thread()
def replay(
    log: MeasurementLog,
    settings: EstimatorSettings | Estimator,
    ego_motion: EgoMotionSettings,
    progress: Callable[[int, int], None] = lambda done, total: None,
    arrival: Arrival | None = None,
) -> Replay:
    """Gives every frame of the log to a new estimator; its faults end the replay, not the program.

    Args:
        log: the measurements; not changed.
        settings: of the estimator; or a new one, at its prior pose.
        ego_motion: of the least squares that finds each frame's pose against the estimator's map.
        progress: called with frames done, and of how many.
        arrival: where the run began in a saved map; None began with an empty one.
    """
    before_mb = memory_mb("VmRSS")
    run = _Replaying(log, settings)
    try:
        prior = None if arrival is None else arrival.prior
        estimator = made_or_given(log.rig, settings, ego_motion, prior)
        if arrival is not None:
            take_over(estimator, arrival)
        _require_support(estimator, log)
    except ESTIMATOR_FAULTS as error:
        return run.result(None, before_mb, f"could not start: {reason(error)}")
    solver = EgoMotionSolver(log.rig, ego_motion)
    motion = ConstantVelocityMotion()
    for k, increment in enumerate(log):
        try:
            frame = replay_frame(increment, estimator, solver, motion, k)
            run.record(increment, frame)
        except ESTIMATOR_FAULTS as error:
            where, why = f"frame {increment.index}: ", reason(error)
            return run.result(estimator, before_mb, where + why.removeprefix(where))
        progress(k + 1, len(log))
    return run.result(estimator, before_mb, "")


def replay_frame(
    increment: Increment,
    estimator: Estimator,
    ego_motion: EgoMotionSolver,
    motion: MotionModel,
    k: int,
) -> ReplayedFrame:
    """Gives frame ``k`` of a log to an estimator: the live loop without its matching."""
    watch = Stopwatch()
    with watch.stage("predict"):
        if increment.odometry is None or increment.odometry.turned:
            stand_in = motion.between(increment.timestamp, increment.odometry)
            increment = dataclasses.replace(increment, odometry=stand_in)
        recalibrated(estimator, increment.rig_correction, increment.rig_since)
        prediction = predicted(estimator, increment.odometry)
    with watch.stage("track"):
        matched = increment.observations.select(~increment.observations.is_new)
        if k == 0 and not len(estimator.landmarks()):
            tracking = unmeasured(prediction, EgoMotionStatus.FIRST)
        elif increment.relocalised:
            tracking = _relocated(estimator, ego_motion, prediction, matched)
        else:
            tracking = _solve(estimator, partial(ego_motion.solve, prediction), matched)
    with watch.stage("update"):
        stats = updated(estimator, increment, tracking)
        noise = noise_in_use(motion, increment.odometry, ego_motion.noise, estimator)
        observe(motion, increment, tracking, stats)
        ego_motion.noise.learn(tracking)
    return ReplayedFrame(tracking, stats, watch.ms, noise)


def _solve(
    estimator: Estimator, solve: Callable[[PoseProblem], EgoMotion], matched: Observations
) -> EgoMotion:
    """Against the landmarks that the estimator holds; the others are no inliers."""
    landmarks = estimator.landmarks()
    held = np.isin(matched.ids, landmarks.ids)
    if held.all():
        return solve(PoseProblem.of(landmarks, matched))
    solved = solve(PoseProblem.of(landmarks, matched.select(held)))
    inliers = np.zeros(len(matched), np.bool_)
    residuals = np.full(len(matched), np.inf)
    inliers[held], residuals[held] = solved.inliers, solved.residuals
    return dataclasses.replace(solved, inliers=inliers, residuals=residuals)


def _relocated(
    estimator: Estimator,
    ego_motion: EgoMotionSolver,
    prediction: Prediction,
    matched: Observations,
) -> EgoMotion:
    """Without the prediction, which it contradicts; with it where the landmarks are too few."""
    resection = Resection(ego_motion)
    found = _solve(estimator, resection.solve, matched)
    if found.status.measured:
        return found
    return _solve(estimator, partial(ego_motion.solve, prediction), matched)


def memory_mb(name: str) -> float | None:
    """`VmHWM` (peak) or `VmRSS` (now) of this process, mebibytes; None where /proc is missing.

    Not ``ru_maxrss``: Linux hands that down to a child, which would report its parent's memory.
    """
    try:
        lines = _PROC_STATUS.read_text(encoding="ascii").splitlines()
    except OSError:
        return None
    found = [line.split() for line in lines if line.startswith(f"{name}:")]
    return float(found[0][1]) / 1024.0 if found else None


def peak_memory_mb() -> float:
    """Largest resident memory of this process so far, mebibytes."""
    found = memory_mb("VmHWM")
    if found is None:  # no /proc: kibibytes everywhere but on macOS, where they are bytes
        unit = 1024.0**2 if sys.platform == "darwin" else 1024.0
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
    return found


def _require_support(estimator: Estimator, log: MeasurementLog) -> None:
    """Refuses an estimator that cannot use what the log holds."""
    needed = {MeasurementType.STEREO}
    if any(increment.odometry is not None for increment in log):
        needed.add(MeasurementType.ODOMETRY)
    lacking = sorted(kind.value for kind in needed - estimator.supports)
    if lacking:
        raise ConfigError(f"it cannot use {' and '.join(lacking)} measurements")


def never_placed(log: MeasurementLog, held: IntArray) -> str:
    """Why nothing of a sensor was used: its landmarks, seen often, got no place among ``held``."""
    seen: dict[str, list[IntArray]] = {}
    for one in (one for increment in log for one in increment.measured if len(one.ids)):
        seen.setdefault(one.kind, []).append(one.ids)
    for kind, ids in seen.items():
        from fgslam.backend.measured import LOOKED_FOR  # loads GTSAM

        own, times = np.unique(np.concatenate(ids), return_counts=True)
        if times.max() >= LOOKED_FOR[-1] and not np.isin(own, held).any():
            return (
                f"none of {times.sum():,} measurements of kind {kind!r} is used: they leave open "
                "where in space their landmarks are; let predict() give what else is known, "
                "e.g. their height, or start() where they begin"
            )
    return ""


class _Replaying:
    """Collects the frames of a replay."""

    def __init__(self, log: MeasurementLog, settings: EstimatorSettings | Estimator) -> None:
        self._log = log
        self._settings = settings
        self._poses: list[FloatArray] = []
        self._covariances: list[FloatArray] = []
        self._rows: list[ReplayRow] = []
        self._closed: list[bool] = []
        self._noise: list[FrameNoise] = []
        self._parts = MapParts()

    def record(self, increment: Increment, frame: ReplayedFrame) -> None:
        """Keeps a frame's numbers. Raises FloatingPointError for a pose that is not finite."""
        stats, times = frame.stats, frame.stage_ms
        if not np.isfinite(stats.wTc).all():
            raise FloatingPointError("the pose is not finite")
        self._poses.append(np.array(stats.wTc))
        self._covariances.append(np.array(stats.covariance))
        self._closed += stats.closed
        self._noise.append(frame.noise)
        self._parts.record(increment, stats.closed)
        self._rows.append(
            ReplayRow(
                status=frame.tracking.status.value,
                matched=int(np.count_nonzero(~increment.observations.is_new)),
                inliers=int(np.count_nonzero(frame.tracking.inliers)),
                landmarks=stats.landmarks,
                nis=float(stats.nis),
                nis_dof=int(stats.nis_dof),
                update_ms=times["predict"] + times["update"],
                solve_ms=times["track"],
            )
        )

    def result(self, estimator: Estimator | None, before_mb: float | None, failure: str) -> Replay:
        """The answer; of an estimator that cannot give one any more, its online poses."""
        start = time.perf_counter()
        stamps = self._log.timestamps[: len(self._rows)]
        online = Trajectory(stamps, np.array(self._poses).reshape(-1, 4, 4))
        covariances = np.array(self._covariances).reshape(-1, 6, 6)
        final_ms = math.nan
        if estimator is not None and self._rows:
            estimate, why = estimate_of_failed(estimator, online, covariances)
            estimate = bridged(estimate, self._parts)
            final_ms = math.nan if why else 1e3 * (time.perf_counter() - start)
            if family_of(self._settings.kind) != "other":  # odometry alone takes none
                why = why or never_placed(self._log, estimate.landmarks.ids)
            failure = "; ".join(filter(None, (failure, why)))
        else:
            estimate = Estimate(online, covariances, NO_LANDMARKS)
        return Replay(
            title=getattr(self._settings, "title", self._settings.kind),
            kind=self._settings.kind,
            online=online,
            online_covariances=covariances,
            estimate=estimate,
            rows=tuple(self._rows),
            final_ms=final_ms,
            memory_before_mb=before_mb,
            peak_memory_mb=peak_memory_mb(),
            failure=failure,
            closed=tuple(self._closed),
            noise=tuple(self._noise),
            estimator=estimator,
        )
