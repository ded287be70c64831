"""Covariances beside errors, where noise and calibration are not what is stated.

Simulated drives of the lab. Noise of pixels is drawn at multiples of the stated one, and without
wheels the motion at multiples of its usual accelerations; then the calibration of a rig is drawn
as far off as any is taken to be, in what all its cameras share.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from benchmarks.runs import EXPERIMENTS, say
from benchmarks.tables import Cell, Table
from fgslam.backend.considered import fused, pixels_of, shared_covariance
from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import (
    BatchSettings,
    EkfSettings,
    EstimatorSettings,
    FixedLagSettings,
    Isam2Settings,
    LandmarkKalmanSettings,
)
from fgslam.core.arrays import FloatArray
from fgslam.core.correction import RigCorrection, shared_displacements
from fgslam.core.log import MeasurementLog, MeasurementRecording
from fgslam.core.sensors import CameraRig, Increment
from fgslam.datasets.opening import open_measurements
from fgslam.datasets.settings import MeasurementDatasetSettings
from fgslam.evaluation.judging import Truth, judge_replay
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.runs.config import load_config
from fgslam.slam.replay import replay

NOISE = (0.5, 1.0, 2.0, 4.0)
"""Drawn noise of a pixel over the stated one."""
MOTION = {
    0.2: ("dataset.drive.frames=557",),
    1.0: ("dataset.drive.frames=249",),
    5.0: (
        "dataset.drive.frames=111",
        "dataset.drive.max_speed_m_s=5",
        "dataset.drive.max_turn_deg_s=90",
    ),
}
"""Accelerations over those of the paper's drive: frames that its way takes, within which limits."""
FRAMES = 80
SMOOTHERS: dict[str, EstimatorSettings] = {"isam2": Isam2Settings(), "batch": BatchSettings()}
EVERY: dict[str, EstimatorSettings] = {
    "landmark_kalman": LandmarkKalmanSettings(),
    "ekf": EkfSettings(),
    "fixed_lag": FixedLagSettings(lag_frames=10),
    "isam2": Isam2Settings(),
}
_RIG = 9  # stream of random numbers, beside those of the drive
_COLUMNS = (
    "NEES online", "2 sigma hold %", "NEES final", "2 sigma hold, final %", "NEES landmarks",
    "ATE cm",
)  # fmt: skip


class Judged(NamedTuple):
    """Of one drive: mean numbers."""

    online: float
    online_held: float
    final: float
    final_held: float
    landmarks: float
    ate_cm: float
    factor: float


@dataclasses.dataclass(frozen=True, eq=False)
class Drive:
    """A simulated drive of the lab, whose log is replayed."""

    recording: MeasurementRecording
    ego_motion: EgoMotionSettings

    @staticmethod
    def of(seed: int, *overrides: str) -> Drive:
        """The drive of a seed, with overrides of its experiment."""
        config = load_config(
            EXPERIMENTS / "lab_trials.yaml",
            (f"seed={seed}", f"dataset.stop={FRAMES}", *overrides),
        )
        assert isinstance(config.dataset, MeasurementDatasetSettings)
        recording = open_measurements(config.dataset, config.seed, config.odometry)
        return Drive(recording, config.frontend.ego_motion)

    def judged(
        self, estimator: EstimatorSettings | Estimator, log: MeasurementLog | None = None
    ) -> Judged:
        """A replay's numbers; another log than the drive's own may be given."""
        of = self.recording
        played = replay(of.log if log is None else log, estimator, self.ego_motion)
        found = judge_replay(played, Truth(of.ground_truth, of.landmark_truth)).metrics
        online: Any = found.more["online"]
        final: Any = found.more["coverage"]
        return Judged(
            online["nees_pose_per_dof"],
            100.0 * online["coverage"]["all"],
            found.nees_pose_per_dof or np.nan,
            100.0 * final["all"],
            found.nees_landmark_per_dof or np.nan,
            100.0 * (found.ate_rmse_m or np.nan),
            played.estimate.noise_factor or np.nan,
        )


def tables(seeds: Sequence[int] = range(8)) -> list[Table]:
    """Noise other than stated, and rigs that are not exact."""
    return [noise_table(seeds), rig_table(seeds)]


def noise_table(seeds: Sequence[int]) -> Table:
    """One row a cell and smoother: noise of pixels and motion, without odometry."""
    rows: list[tuple[Cell, ...]] = []
    for motion, drive in MOTION.items():
        for noise in NOISE:
            say(f"driving with noise {noise:g} and motion {motion:g} times the nominal")
            drives = [noisy_drive(seed, noise, drive) for seed in seeds]
            for kind, settings in SMOOTHERS.items():
                cells = _means([each.judged(settings) for each in drives])
                rows.append((motion, noise, f"`{kind}`", *cells))
    columns = ("motion", "noise", "", *_COLUMNS, "noise found")
    return Table(f"Noise and motion other than nominal, {len(seeds)} drives each", columns, rows)


def rig_table(seeds: Sequence[int]) -> Table:
    """One row an estimator: an exact rig, and rigs a pixel off in all images alike."""
    rows: list[tuple[Cell, ...]] = []
    for name, log_of in (("exact", _exact), ("a pixel off", _off)):
        for kind, settings in EVERY.items():
            say(f"driving {kind} with a rig: {name}")
            drives = [(seed, Drive.of(seed)) for seed in seeds]
            cells = _means(
                [
                    drive.judged(settings, log_of(drive.recording.log, seed))
                    for seed, drive in drives
                ]
            )
            rows.append((name, f"`{kind}`", *cells[:-1]))
    return Table(f"A rig that is not exact, {len(seeds)} drives each", ("rig", "", *_COLUMNS), rows)


def noisy_drive(seed: int, noise: float, drive: tuple[str, ...]) -> Drive:
    """Without odometry, noise of pixels times ``noise``; ``drive`` is one of MOTION."""
    return Drive.of(
        seed,
        "odometry.kind=constant_velocity",
        f"dataset.detection.noise_scale={noise}",
        *drive,
    )


def _means(judged: list[Judged]) -> tuple[Cell, ...]:
    return tuple(float(value) for value in np.mean(judged, axis=0))


def _exact(log: MeasurementLog, seed: int) -> MeasurementLog:
    return log


def _off(log: MeasurementLog, seed: int) -> MeasurementLog:
    """The log of a rig whose calibration is drawn as far off as it is taken to be."""
    assert isinstance(log.rig, CameraRig)
    rig = dataclasses.replace(log.rig, exact=False)
    stated = RigCorrection.none(rig)
    covariance = shared_covariance(stated)
    terms = np.random.default_rng([seed, _RIG]).multivariate_normal(
        np.zeros(len(covariance)), covariance
    )
    moved = [_displaced(each, rig, terms, stated.values) for each in log]
    return dataclasses.replace(log, rig=rig, increments=moved)


def _displaced(
    increment: Increment, rig: CameraRig, terms: FloatArray, applied: FloatArray
) -> Increment:
    seen = increment.observations
    of_pixels = shared_displacements(rig, pixels_of(rig, seen.measurement))
    moved = seen.measurement + fused(rig, of_pixels) @ terms
    return dataclasses.replace(
        increment,
        observations=dataclasses.replace(seen, measurement=moved),
        rig_correction=applied,
    )
