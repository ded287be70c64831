"""Runs of the hybrid front-end on the small rendered recording: cost, accuracy, the same bytes."""

from __future__ import annotations

import dataclasses
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import experiment, write_recording
from running import Finished, bytes_of, metrics_of, run_values, stop_after, write_config
from simulated import assert_same_bits, assert_same_value

import fgslam as fg
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray, Image, StateArrays
from fgslam.core.errors import ConfigError
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import BiasEffect, Odometry
from fgslam.core.store import state_of
from fgslam.core.types import Features
from fgslam.frontend.features.sift import SiftExtractor
from fgslam.frontend.settings import FrontendSettings
from fgslam.slam.build import make_extractor
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


def test_features_of_a_likely_key_frame_are_found_in_a_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every sixth frame: each is a key frame, so after two in a row the next is expected to be."""
    begun: list[bool] = []
    extract = SiftExtractor.extract

    def noted(self: SiftExtractor, image: Image) -> Features:
        begun.append(threading.current_thread() is not threading.main_thread())
        return extract(self, image)

    monkeypatch.setattr(SiftExtractor, "extract", noted)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    values = values_of(write_recording(tmp_path / "recording", 24, top=False))
    values["dataset"] |= {"stride": 6}
    run_values(values, tmp_path / "run")
    assert begun == [False, False, True, True]


def test_an_interrupted_run_goes_on_to_the_same_bytes(
    recording: Path, hybrid: Finished, tmp_path: Path
) -> None:
    values = values_of(recording)
    run_values(values, tmp_path / "run", stopped=stop_after(5))
    run_values(values, tmp_path / "run", "resume")
    assert bytes_of(tmp_path / "run") == bytes_of(hybrid.folder)


def test_a_replay_finds_the_poses_of_the_live_run(hybrid: Finished) -> None:
    log = MeasurementLog.load(hybrid.folder / "measurements.npz")
    replayed = fg.replay(log, "landmark_kalman")
    live = fg.Trajectory.load(next(hybrid.folder.glob("landmark_kalman/final.tum")))
    np.testing.assert_allclose(replayed.online.poses, live.poses, rtol=0, atol=1e-6)


class Moody:
    """SIFT, and what becomes of its features."""

    def __init__(self) -> None:
        self.fault: Callable[[Features], Any] = lambda found: found
        self._find = make_extractor(FrontendSettings())

    def __call__(self, image: Image) -> Any:
        return self.fault(self._find(image))


def raises(_: Features) -> Any:
    raise ZeroDivisionError("no image of mine")


FAULTS: list[Callable[[Features], Any]] = [
    raises,
    lambda _: None,
    lambda found: dataclasses.replace(found, xy=found.xy[1:]),
    lambda found: found,
]
WORDS = ["no image of mine", "the extractor returned NoneType", "xy has shape"]


def turn_of(bTc: FloatArray, steps: int) -> Odometry:
    """What a gyroscope says of steps of the recording; its bias is unknown and wanders."""
    turn = np.array([0.0, steps * np.radians(0.6), 0.0])
    rotation = bTc[:3, :3] @ g.so3_exp(turn) @ bTc[:3, :3].T
    return Odometry.turn(rotation, 1e-6 * np.eye(3), BiasEffect(-0.25 * np.eye(3), 1e-3, 1e-5))


def watched_and_carried(slam: fg.Slam) -> dict[str, StateArrays]:
    parts = {"watch": slam.pipeline.watch, "key_frames": slam.pipeline.key_frames}
    return {name: dict(state_of(part)) for name, part in parts.items() if part is not None}


def test_a_frame_whose_features_could_not_be_found_leaves_no_trace(
    recording: Path, tmp_path: Path
) -> None:
    """Key frames fail in three ways and are handed in again: measurements as if none had failed."""
    config = tmp_path / "hybrid.yaml"
    write_config(config, values_of(recording))
    opened = fg.open_recording(config)
    frames, bTc = list(opened), opened.rig.bTc
    finders = Moody(), Moody()
    sound, moody = (
        fg.Slam(opened.rig, frontend={"tracking": "hybrid"}, features=find) for find in finders
    )
    said: list[str] = []
    shown = (0, 1, 2, 8, 9)  # the leap is too far for patches
    for k, steps in zip(shown, np.diff(shown, prepend=0).tolist(), strict=True):
        (t, images, _), turn = frames[k], turn_of(bTc, steps)
        sound.track(t, images, turn)
        before = watched_and_carried(moody)
        for finders[1].fault in FAULTS:
            try:
                moody.track(t, images, turn)
            except (ZeroDivisionError, ConfigError) as failure:
                said.append(str(failure))
                assert_same_bits(watched_and_carried(moody), before)
            else:
                break
    assert len(said) == 2 * len(WORDS)  # two key frames of five
    assert all(words in line for words, line in zip(2 * WORDS, said, strict=True))
    assert_same_value(sound.log, moody.log)
    assert_same_bits(sound.result().estimate, moody.result().estimate)
