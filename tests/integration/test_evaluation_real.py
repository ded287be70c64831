"""Trajectory files and errors on the truth of real recordings, against evo."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fgslam.core.geometry import se3_exp
from fgslam.core.types import Trajectory
from fgslam.evaluation.statistics import Alignment, evaluate_trajectory, path_length

DATA = Path(__file__).parents[2].parent / "shared" / "data"
pytestmark = pytest.mark.data


def truth_of(name: str) -> Trajectory:
    path = DATA / name / "gt_left_cam.txt"
    if not path.exists():
        pytest.skip(f"the recording {name} is not there ({path})")
    return Trajectory.load(path)


@pytest.mark.parametrize(
    ("name", "frames", "metres"),
    [("euroc_v101_kf100", 100, 49.4), ("kitti06", 51, 60.0), ("kitti_raw_0926_5hz", 200, 300.0)],
)
def test_truth_of_real_recordings(name: str, frames: int, metres: float, tmp_path: Path) -> None:
    truth = truth_of(name)
    assert len(truth) == frames
    assert path_length(truth.poses) == pytest.approx(metres, rel=0.03)
    truth.save(tmp_path / "a.tum")
    again = Trajectory.load(tmp_path / "a.tum")
    np.testing.assert_array_equal(again.timestamps, truth.timestamps)
    np.testing.assert_allclose(again.poses, truth.poses, atol=2e-12)


def test_drifting_estimate_of_a_real_drive_agrees_with_evo(tmp_path: Path) -> None:
    metrics = pytest.importorskip("evo.core.metrics", reason="evo is not installed")
    from evo.core import sync
    from evo.tools import file_interface

    truth = truth_of("kitti_raw_0926_5hz")
    rng = np.random.default_rng(1)
    poses = [np.eye(4)]
    for before, after in zip(truth.poses[:-1], truth.poses[1:], strict=True):
        noise = se3_exp(rng.normal(scale=[0.001] * 3 + [0.01, 0.005, 0.02]))
        poses.append(poses[-1] @ np.linalg.inv(before) @ after @ noise)
    # Every third frame was lost: association has something to do.
    kept = np.flatnonzero(np.arange(len(truth)) % 3)
    estimate = Trajectory(truth.timestamps[kept] + 0.002, np.array(poses)[kept])
    truth.save(tmp_path / "truth.tum")
    estimate.save(tmp_path / "estimate.tum")

    true, estimated = sync.associate_trajectories(
        file_interface.read_tum_trajectory_file(str(tmp_path / "truth.tum")),
        file_interface.read_tum_trajectory_file(str(tmp_path / "estimate.tum")),
        max_diff=0.01,
    )
    estimated.align(true)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((true, estimated))

    ours = evaluate_trajectory(estimate, truth, Alignment.SE3)

    assert ours.matched_poses == len(kept) == true.num_poses
    assert ours.ate_rmse_m == pytest.approx(
        ape.get_statistic(metrics.StatisticsType.rmse), rel=1e-8
    )
    assert ours.ate_rmse_m is not None
    assert ours.end_error_m is not None
    assert 0.01 < ours.ate_rmse_m < ours.end_error_m
