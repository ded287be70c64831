"""The log of a run, replayed through the same estimator, gives the run's own poses to the bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import experiment
from running import KIND, Finished, run_values

from fgslam.core.log import MeasurementLog
from fgslam.core.types import Estimate
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver
from fgslam.runs.config import ExperimentConfig, make_config
from fgslam.slam import build as factory
from fgslam.slam.replay import replay_frame


def replay(config: ExperimentConfig, log: MeasurementLog) -> Estimate:
    estimator = factory.make_estimator(log.rig, config.estimator, config.frontend.ego_motion)
    motion = factory.make_motion(log.rig, config.odometry)
    solver = EgoMotionSolver(log.rig, config.frontend.ego_motion)
    for k, increment in enumerate(log):
        replay_frame(increment, estimator, solver, motion, k)
    return estimator.estimate()


KINDS = ("recorded", "constant_velocity", "synthetic")
FRONTENDS: dict[str, dict[str, Any]] = {
    "height_fixed": {
        "matching": {"widen_sigmas": 3.0},
        "ego_motion": {"dof": 5, "kernel": "huber"},
    },
    "plain": {"matching": {"widen_sigmas": 3.0}},
    "refined": {"matching": {"widen_sigmas": 3.0, "refine": True, "rescue": True}},
}


@pytest.mark.parametrize(("kind", "frontend"), tuple(zip(KINDS, FRONTENDS, strict=True)))
def test_replay_to_the_bit(kind: str, frontend: str, recording: Path, tmp_path: Path) -> None:
    values = experiment(recording, odometry={"kind": kind}, frontend=FRONTENDS[frontend])
    run = run_values(values, tmp_path / "run")
    live = run.result.outputs.pipeline.estimator.estimate()
    log = MeasurementLog.load(run.folder / "measurements.npz")
    assert log.motion_model["kind"] == kind
    replayed = replay(make_config(values, "test"), log)
    np.testing.assert_array_equal(replayed.trajectory.poses, live.trajectory.poses)
    np.testing.assert_array_equal(replayed.covariances, live.covariances)
    np.testing.assert_array_equal(replayed.landmarks.ids, live.landmarks.ids)
    np.testing.assert_array_equal(replayed.landmarks.positions, live.landmarks.positions)
    np.testing.assert_array_equal(replayed.landmarks.covariances, live.landmarks.covariances)
    replayed.trajectory.save(tmp_path / "replayed.tum", run.result.outputs.remark)
    assert (tmp_path / "replayed.tum").read_bytes() == (
        run.folder / KIND / "final.tum"
    ).read_bytes()


def test_a_changed_measurement_changes_the_replay(finished: Finished) -> None:
    """Another measurement, another pose: the equality above is no accident."""
    log = MeasurementLog.load(finished.folder / "measurements.npz")
    log.increments[5].observations.measurement[0, 0] += 0.25
    replayed = replay(make_config(finished.values, "test"), log)
    live = finished.result.outputs.pipeline.estimator.estimate()
    np.testing.assert_array_equal(replayed.trajectory.poses[:5], live.trajectory.poses[:5])
    assert np.abs(replayed.trajectory.poses[5:] - live.trajectory.poses[5:]).max() > 1e-9
