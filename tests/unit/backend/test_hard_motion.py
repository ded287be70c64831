"""Drives without odometry that start, stop and bend harder than a moment before."""

from __future__ import annotations

import numpy as np

from fgslam.backend.settings import BatchSettings, EstimatorSettings
from fgslam.datasets.opening import open_measurements
from fgslam.datasets.settings import ConstantVelocitySettings
from fgslam.evaluation.judging import Truth, judge_replay
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.slam.replay import replay
from fgslam.worlds.settings import (
    MeasurementDriveSettings,
    SimulatedMeasurementsSettings,
)

HARD = SimulatedMeasurementsSettings(
    stop=60, drive=MeasurementDriveSettings(frames=111, max_speed_m_s=5.0, max_turn_deg_s=90.0)
)
"""Up to 54 deviations squared a number, as the last ten frames have them, in a single step."""


def nees(settings: EstimatorSettings, seed: int) -> float:
    drive = open_measurements(HARD, seed, ConstantVelocitySettings())
    played = replay(drive.log, settings, EgoMotionSettings(dof=3))
    found = judge_replay(played, Truth(drive.ground_truth, None)).metrics.nees_pose_per_dof
    assert found is not None
    return found


def test_a_step_that_was_not_foreseen_does_not_pull_the_path() -> None:
    """Without the kernel 2.4."""
    assert np.mean([nees(BatchSettings(), seed) for seed in (2, 5)]) < 1.2
