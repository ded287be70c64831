"""Replays: the same numbers as the loop gives, and faults that end one estimator only."""

from __future__ import annotations

import dataclasses
import mmap
from typing import Any

import numpy as np
import pytest
from loops import CLOSED, Rounds, drive_rounds
from simulated import RIG, Drive, assert_same_bits, play, simulate

from fgslam.backend.filters.kalman import LandmarkKalman
from fgslam.backend.measured import LOOKED_FOR
from fgslam.backend.settings import BatchSettings, DeadReckoningSettings, LandmarkKalmanSettings
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import pose
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import Increment, Odometry
from fgslam.core.types import Estimate, Trajectory, UpdateStats
from fgslam.evaluation.judging import Truth, judge_replay
from fgslam.factors.measurement import LandmarkModel
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.slam import build as factory, replay as module
from fgslam.slam.replay import Replay, memory_mb, peak_memory_mb, replay

SETTINGS = LandmarkKalmanSettings(label="named")
CONSTANT_VELOCITY: dict[str, Any] = factory.ConstantVelocityMotion().description()


def a_log(frames: int = 8) -> MeasurementLog:
    simulation = simulate(Drive(frames=frames), np.random.default_rng(4))
    motion = {"kind": "recorded"}
    return MeasurementLog(RIG, motion, simulation.increments)


def faulty(monkeypatch: pytest.MonkeyPatch, **methods: Any) -> None:
    """Estimators of the kind, with some of their methods replaced."""
    kind = type("Faulty", (LandmarkKalman,), methods)

    def make(rig: Any, settings: Any, ego_motion: Any, prior: Any) -> Any:
        assert prior is None  # no saved map here
        start = factory.Prediction(np.eye(4), np.zeros((6, 6)))
        return kind(rig, settings, start, ego_motion)

    monkeypatch.setattr(module, "made_or_given", make)


def run(log: MeasurementLog) -> Replay:
    return replay(log, SETTINGS, EgoMotionSettings())


def test_a_replay_gives_what_the_loop_gives() -> None:
    log = a_log()
    estimator = factory.make_estimator(RIG, SETTINGS)
    stats = play(estimator, log.increments)
    reported: list[tuple[int, int]] = []
    replayed = replay(
        log, SETTINGS, EgoMotionSettings(), lambda done, of: reported.append((done, of))
    )
    assert_same_bits(replayed.estimate, estimator.estimate())
    np.testing.assert_array_equal(replayed.online.poses, [s.wTc for s in stats])
    np.testing.assert_array_equal(replayed.online_covariances, [s.covariance for s in stats])
    np.testing.assert_array_equal(replayed.online.timestamps, [i.timestamp for i in log])
    np.testing.assert_array_equal(replayed.column("nis"), [s.nis for s in stats])
    assert replayed.column("status").tolist() == ["first"] + 7 * ["ok"]
    assert replayed.column("landmarks").tolist() == [s.landmarks for s in stats]
    assert (replayed.column("inliers") <= replayed.column("matched")).all()
    assert (replayed.column("update_ms") > 0.0).all()
    assert replayed.column("solve_ms")[1:].min() > 0.0
    assert (replayed.title, replayed.kind, replayed.failure) == ("named", "landmark_kalman", "")
    assert reported == [(k + 1, 8) for k in range(8)]
    assert "closures" not in judge_replay(replayed, Truth()).metrics.more, "the log has none"


@pytest.mark.parametrize("lies", [False, True])
def test_each_replay_counts_the_closures_that_it_took(lies: bool) -> None:
    rounds = Rounds(lies=((CLOSED, (0.0, 0.5, 0.0, 1.0, 0.0, 0.5)),) if lies else ())
    drive = drive_rounds(rounds, np.random.default_rng(4))
    log = MeasurementLog(RIG, {"kind": "recorded"}, drive.increments)
    for settings, taken in ((SETTINGS, not lies), (DeadReckoningSettings(), False)):
        replayed = replay(log, settings, EgoMotionSettings())
        assert replayed.closed == (taken,)
        more = judge_replay(replayed, Truth()).metrics.more
        assert (more["closures"], more["refused_closures"]) == (int(taken), int(not taken))


def test_memory_is_that_of_this_process() -> None:
    before = memory_mb("VmRSS")
    if before is None:
        pytest.skip("no /proc here: memory comes from getrusage")
    # Pages of its own: an array may take memory that the process holds already.
    pages = mmap.mmap(-1, 61 * 2**20)
    block = np.frombuffer(pages, np.uint8)
    block[:] = 1
    assert memory_mb("VmRSS") > before + 50.0  # type: ignore[operator]
    assert peak_memory_mb() >= before + 50.0
    assert block.all()


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (RuntimeError("Indeterminant\n linear system"), "RuntimeError: Indeterminant linear"),
        (EstimatorError("no such thing"), "no such thing"),
        (np.linalg.LinAlgError("Singular matrix"), "LinAlgError: Singular matrix"),
        (KeyError(17), "KeyError: 17"),
    ],
)
def test_a_fault_ends_the_replay_with_frame_and_reason(
    monkeypatch: pytest.MonkeyPatch, error: Exception, words: str
) -> None:
    def update(self: Any, increment: Any, tracking: Any) -> UpdateStats:
        if increment.index == 10:  # the sixth: the simulation counts by two
            raise error
        return LandmarkKalman.update(self, increment, tracking)

    faulty(monkeypatch, update=update)
    log = a_log()
    replayed = run(log)
    assert replayed.failure.startswith("frame 10: ")
    assert words in replayed.failure
    assert "\n" not in replayed.failure
    sound = replay_of(log, 5)
    assert_same_bits(replayed.estimate, sound.estimate)
    assert_same_bits(replayed.online, sound.online)
    metrics = judge_replay(replayed, Truth()).metrics
    assert metrics.more["failure"] == replayed.failure
    assert metrics.more["frames"] == 5


def replay_of(log: MeasurementLog, frames: int) -> Replay:
    """The first frames of the log through the sound estimator."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "made_or_given", factory.made_or_given)
        return run(MeasurementLog(log.rig, log.motion_model, log.increments[:frames]))


def test_a_pose_that_is_not_finite_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    def update(self: Any, increment: Any, tracking: Any) -> UpdateStats:
        stats = LandmarkKalman.update(self, increment, tracking)
        bad = np.full((4, 4), np.nan) if increment.index == 6 else stats.wTc
        return UpdateStats(bad, stats.covariance, stats.landmarks, stats.nis, stats.nis_dof)

    faulty(monkeypatch, update=update)
    replayed = run(a_log())
    assert replayed.failure == "frame 6: FloatingPointError: the pose is not finite"
    assert len(replayed) == len(replayed.online) == len(replayed.estimate.trajectory) == 3
    assert np.isfinite(replayed.estimate.trajectory.poses).all()


def test_without_a_final_estimate_the_online_poses_remain(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def estimate(self: Any) -> Estimate:
        raise RuntimeError("no solution")

    faulty(monkeypatch, estimate=estimate)
    replayed = run(a_log())
    assert replayed.failure == "no final estimate: RuntimeError: no solution"
    assert_same_bits(replayed.estimate.trajectory, replayed.online)
    assert len(replayed.estimate.landmarks) == 0
    assert "online" in replayed.estimate.remarks[0]
    assert np.isnan(replayed.final_ms)


def test_a_final_estimate_that_is_not_finite_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    def estimate(self: Any) -> Estimate:
        found = LandmarkKalman.estimate(self)
        poses = found.trajectory.poses.copy()
        poses[2, 0, 3] = np.inf
        trajectory = Trajectory(found.trajectory.timestamps, poses)
        return Estimate(trajectory, found.covariances, found.landmarks)

    faulty(monkeypatch, estimate=estimate)
    replayed = run(a_log())
    assert "not finite" in replayed.failure
    assert np.isfinite(replayed.estimate.trajectory.poses).all()


def test_an_estimator_that_cannot_use_the_log_does_not_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    faulty(monkeypatch, supports=frozenset())
    replayed = run(a_log())
    assert replayed.failure == "could not start: it cannot use odometry and stereo measurements"
    assert len(replayed) == 0


def test_a_frame_that_the_estimator_names_itself_is_named_once() -> None:
    log = a_log()
    measurement = log.increments[4].observations.measurement.copy()
    measurement[0] = np.nan
    increments = list(log.increments)
    seen = dataclasses.replace(increments[4].observations, measurement=measurement)
    increments[4] = dataclasses.replace(increments[4], observations=seen)
    spoilt = MeasurementLog(RIG, log.motion_model, increments)
    replayed = replay(spoilt, BatchSettings(), EgoMotionSettings())
    assert replayed.failure.startswith(f"frame {increments[4].index}: the measurement or its")


class Azimuth(LandmarkModel):
    """Of a beacon, whose height no azimuth shows."""

    kind, size, angles = "azimuth", 1, (0,)

    def predict(self, x: FloatArray) -> FloatArray:
        return np.asarray(np.arctan2(x[:, 1], x[:, 0])[:, None])


def test_measurements_that_place_no_landmark_are_not_passed_over_in_silence() -> None:
    log, model = MeasurementLog(), Azimuth()
    for k in range(LOOKED_FOR[-1]):
        seen = model.measured(np.array([[np.arctan2(3.0, 5.0 - 0.1 * k)]]), [[1e-4]], ids=[7])
        odometry = Odometry(pose(np.eye(3), np.array([0.1, 0.0, 0.0])), 1e-4 * np.eye(6))
        log.append(Increment.of(k, 0.1 * k, odometry if k else None, [seen]))
    for settings in (SETTINGS, BatchSettings()):
        assert (
            "none of 60 measurements of kind 'azimuth' is used"
            in replay(log, settings, EgoMotionSettings()).failure
        )
    assert not replay(log, DeadReckoningSettings(), EgoMotionSettings()).failure
