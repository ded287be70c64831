"""Runs of the hybrid front-end on the small rendered recording: cost, accuracy, the same bytes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import experiment, write_recording
from running import Finished, bytes_of, metrics_of, run_values, stop_after, write_config

import fgslam as fg
from fgslam.core.measurement_log import MeasurementLog
from fgslam.slam.pipeline import FrameReport, SlamPipeline

FRAMES = 12


def values_of(recording: Path, **changes: object) -> dict[str, Any]:
    frontend = {"tracking": "hybrid", "matching": {"widen_sigmas": 3.0}}
    return experiment(recording, frontend=frontend) | changes


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("boards") / "recording", FRAMES)


@pytest.fixture(scope="module")
def hybrid(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Finished:
    return run_values(values_of(recording), tmp_path_factory.mktemp("hybrid") / "run")


def test_few_frames_are_key_frames_and_all_are_located(hybrid: Finished) -> None:
    """New landmarks come on key frames only; every frame measures old ones."""
    log = MeasurementLog.load(hybrid.folder / "measurements.npz")
    keys = [bool(s.observations.is_new.any()) for s in log]
    assert keys[0]
    assert sum(keys) <= FRAMES // 2
    assert metrics_of(hybrid.folder)["status_counts"] == {"first": 1, "ok": FRAMES - 1}
    for increment in log.increments[1:]:
        assert (~increment.observations.is_new).sum() >= 40


def test_it_is_as_accurate_as_features_on_every_frame(
    hybrid: Finished, recording: Path, tmp_path: Path
) -> None:
    """Twelve frames are one draw of the noise: the errors are of one size, a few millimetres."""
    sift = run_values(experiment(recording), tmp_path / "sift")
    errors = [
        next(iter(metrics_of(run.folder)["estimators"].values()))["ate_rmse_m"]
        for run in (hybrid, sift)
    ]
    assert errors[0] < 1.3 * errors[1] + 0.001


def test_frames_too_far_apart_to_carry_anything_are_left_to_features_in_all_images(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every sixth: a step moves the image by more than its sixteenth. The first has patches."""
    images: list[int] = []
    process = SlamPipeline.process

    def watched(self: SlamPipeline, *frame: Any) -> FrameReport:
        report = process(self, *frame)
        images.append(len(report.found.features))
        return report

    monkeypatch.setattr(SlamPipeline, "process", watched)
    values = values_of(recording)
    values["dataset"] |= {"stride": 6}
    run = run_values(values, tmp_path / "run")
    assert images == [1, 3]
    assert metrics_of(run.folder)["status_counts"] == {"first": 1, "ok": 1}


@pytest.mark.parametrize("frames", [1, 5, 9])
def test_an_interrupted_run_goes_on_to_the_same_bytes(
    frames: int, recording: Path, hybrid: Finished, tmp_path: Path
) -> None:
    values = values_of(recording)
    run_values(values, tmp_path / "run", stopped=stop_after(frames))
    run_values(values, tmp_path / "run", "resume")
    assert bytes_of(tmp_path / "run") == bytes_of(hybrid.folder)


def test_frames_pushed_one_by_one_give_the_same_measurements(
    recording: Path, hybrid: Finished, tmp_path: Path
) -> None:
    values = values_of(recording)
    config = tmp_path / "hybrid.yaml"
    write_config(config, values)
    slam = fg.Slam.from_config(config)
    for t, images, odometry in fg.open_recording(config):
        slam.track(t, images, odometry)
    slam.close()
    slam.log.save(tmp_path / "log.npz")
    assert (tmp_path / "log.npz").read_bytes() == (hybrid.folder / "measurements.npz").read_bytes()


def test_a_replay_finds_the_poses_of_the_live_run(hybrid: Finished) -> None:
    log = MeasurementLog.load(hybrid.folder / "measurements.npz")
    replayed = fg.replay(log, "landmark_kalman")
    live = fg.Trajectory.load(next(hybrid.folder.glob("landmark_kalman/final.tum")))
    np.testing.assert_allclose(replayed.online.poses, live.poses, rtol=0, atol=1e-6)
