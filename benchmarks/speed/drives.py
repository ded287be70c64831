"""Simulated drives for timing estimators, and their replay with the estimator's own time."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from benchmarks.runs import EXPERIMENTS
from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import EstimatorSettings
from fgslam.core.arrays import FloatArray
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import Increment, Odometry
from fgslam.core.types import EgoMotion, LandmarkMap, Prediction, Trajectory, UpdateStats
from fgslam.datasets.opening import open_measurements
from fgslam.datasets.settings import MeasurementDatasetSettings
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver
from fgslam.runs.config import load_config
from fgslam.slam.build import make_estimator
from fgslam.slam.motion import ConstantVelocityMotion
from fgslam.slam.replay import replay_frame


@dataclass(frozen=True)
class MeasuredDrive:
    """A log, the least squares that all estimators share, and the truth."""

    log: MeasurementLog
    ego_motion: EgoMotionSettings
    truth: Trajectory


def open_drive(experiment: str, overrides: tuple[str, ...] = ()) -> MeasuredDrive:
    """Simulates the measurements of ``experiments/NAME.yaml`` with its seed."""
    config = load_config(EXPERIMENTS / f"{experiment}.yaml", overrides)
    assert isinstance(config.dataset, MeasurementDatasetSettings)
    recording = open_measurements(config.dataset, config.seed, config.odometry)
    assert recording.ground_truth is not None
    return MeasuredDrive(recording.log, config.frontend.ego_motion, recording.ground_truth)


@dataclass
class Clocked:
    """An estimator whose prediction and update are timed, without the ego-motion they share."""

    inner: Estimator
    cpu: list[float] = field(default_factory=list)
    wall: list[float] = field(default_factory=list)
    _spent: float = 0.0

    def predict(self, odometry: Odometry | None) -> Prediction:
        """The prediction of the timed estimator."""
        start = time.process_time()
        found = self.inner.predict(odometry)
        self._spent = time.process_time() - start
        return found

    def landmarks(self) -> LandmarkMap:
        """The landmarks of the timed estimator."""
        return self.inner.landmarks()

    def update(self, increment: Increment, tracking: EgoMotion) -> UpdateStats:
        """The update of the timed estimator."""
        cpu, wall = time.process_time(), time.perf_counter()
        stats = self.inner.update(increment, tracking)
        self.wall.append(time.perf_counter() - wall)
        self.cpu.append(self._spent + time.process_time() - cpu)
        return stats


@dataclass(frozen=True)
class Played:
    """A drive, or its beginning, through one estimator.

    Attributes:
        estimator: after the last frame.
        cpu_s, wall_s: (n,) its own seconds a frame, of the processor and on the clock.
        online: (n, 4, 4) poses as first estimated.
    """

    estimator: Estimator
    cpu_s: FloatArray
    wall_s: FloatArray
    online: FloatArray


class Player:
    """Replays a log through a new estimator, as far as it is asked to at a time."""

    def __init__(self, drive: MeasuredDrive, settings: EstimatorSettings) -> None:
        self._log = drive.log
        self._clocked = Clocked(make_estimator(drive.log.rig, settings, drive.ego_motion))
        self._solver = EgoMotionSolver(drive.log.rig, drive.ego_motion)
        self._motion = ConstantVelocityMotion()
        self._online: list[FloatArray] = []

    def on_to(self, stop: int) -> None:
        """Goes on to the frame before ``stop``."""
        for k in range(len(self._online), stop):
            frame = replay_frame(
                self._log.increments[k],
                self._clocked,  # type: ignore[arg-type]
                self._solver,
                self._motion,
                k,
            )
            self._online.append(frame.stats.wTc)

    def played(self) -> Played:
        """What has been so far."""
        clocked = self._clocked
        cpu, wall = np.array(clocked.cpu), np.array(clocked.wall)
        return Played(clocked.inner, cpu, wall, np.array(self._online))


def play(drive: MeasuredDrive, settings: EstimatorSettings) -> Played:
    """Replays the whole log through a new estimator."""
    player = Player(drive, settings)
    player.on_to(len(drive.log))
    return player.played()


def cpu_seconds(work: Callable[[], object]) -> float:
    """Processor time of a call, all threads."""
    start = time.process_time()
    work()
    return time.process_time() - start


def interleaved(works: Mapping[str, Callable[[], float]], repeats: int) -> dict[str, float]:
    """Medians of timings that take turns, so that other load meets all alike."""
    series: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(repeats):
        for name, work in works.items():
            series[name].append(work())
    return {name: statistics.median(values) for name, values in series.items()}


def largest_offset_mm(one: FloatArray, other: FloatArray) -> float:
    """Largest distance of positions of two trajectories (n, 4, 4), millimetres."""
    return 1e3 * float(np.linalg.norm(one[:, :3, 3] - other[:, :3, 3], axis=1).max())
