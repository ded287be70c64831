"""What a run keeps of its frames, through a checkpoint and into the numbers of metrics.json."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fgslam.core.geometry import se3_exp
from fgslam.core.log import Frame, MeasurementLog
from fgslam.core.sensors import CameraRig, Increment, Observations
from fgslam.core.store import load_arrays, restore, state_of, write_arrays
from fgslam.core.types import (
    EgoMotion,
    EgoMotionStatus,
    Estimate,
    Features,
    LandmarkMap,
    StereoFeatures,
    Trajectory,
    UpdateStats,
)
from fgslam.evaluation.judging import Truth
from fgslam.evaluation.statistics import value_at
from fgslam.frontend.tracking.landmarks import MapParts
from fgslam.runs.engine import LocatedShare
from fgslam.runs.report import alarms, estimator_metrics, frame_problems, located, run_numbers
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.pipeline import FrameNoise, FrameReport
from fgslam.slam.results import STAGES, FrameRow, RunRecorder

RIG = CameraRig(32, 24, 30.0, 30.0, 15.5, 11.5, 0.1, None, np.eye(4))
NO_IDS = np.empty(0, np.int64)


class Apart(MapParts):
    """Parts as given."""

    def __init__(self, connected: list[bool]) -> None:
        super().__init__()
        self._frames = [int(not one) for one in connected]


def pose_at(k: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    return se3_exp(k * np.array([0.0, 0.05, 0.01, 0.1, 0.0, 0.4]))


def report(k: int, matches: int, problem: str = "") -> FrameReport:
    """A frame with ``matches`` matches, all but one of them used, residuals 0.5 px and 99 px."""
    image = np.zeros((24, 32), np.uint8)
    features = Features(
        np.zeros((9 + k, 2)), np.ones(9 + k), np.zeros(9 + k), np.zeros((9 + k, 128), np.uint8)
    )
    found = FeatureFrame(
        i=k,
        frame=None if problem else Frame(2 * k, float(k), (image, image)),
        features=() if problem else (features, features),
        problem=problem,
        load_ms=1.0 + k,
        sift_ms=10.0,
    )
    inliers = np.arange(matches) > 0
    tracking = EgoMotion(
        wTc=pose_at(k),
        covariance=np.eye(6) * 1e-4,
        inliers=inliers,
        residuals=np.where(inliers, 0.5, 99.0),
        status=EgoMotionStatus.NO_IMAGE if problem else EgoMotionStatus.OK,
        iterations=3,
    )
    nothing = Observations(
        NO_IDS,
        np.empty((0, 3)),
        np.empty((0, 3, 3)),
        np.empty((0, 3, 2)),
        np.empty(0, np.bool_),
    )
    increment = Increment(2 * k, float(k), None, nothing, np.empty(0, np.bool_), NO_IDS, NO_IDS)
    stats = UpdateStats(pose_at(k), np.eye(6) * 1e-4, 100 + k, float("nan"), 0)
    times = {"predict": 1.0, "stereo": 2.0, "track": 2.5, "places": 0.5, "update": 4.0 + k}
    times["calibrate"] = 0.0
    noise = FrameNoise(match_factor=1.0 + k)
    return FrameReport(found, StereoFeatures.empty(), increment, tracking, stats, times, noise)


def recorder_of(count: int, bad: int = -1) -> RunRecorder:
    out = RunRecorder(MeasurementLog(RIG, {}))
    for k in range(count):
        problem = "image right/000003.png is truncated at 17 bytes" if k == bad else ""
        out.add(report(k, 0 if problem else 10 + k, problem), 5.0, float("nan"))
    return out


def estimate_of(count: int) -> Estimate:
    trajectory = Trajectory(
        np.arange(count, dtype=float), np.array([pose_at(k) for k in range(count)])
    )
    covariances = np.tile(np.eye(6) * 1e-4, (count, 1, 1))
    ids = np.arange(7)
    landmarks = LandmarkMap(ids, np.zeros((7, 3)), np.tile(np.eye(3), (7, 1, 1)))
    return Estimate(trajectory, covariances, landmarks)


# --------------------------------------------------------------------------------------------
# Recorder


def test_a_frames_row_holds_its_status_and_counts() -> None:
    row = recorder_of(1).rows[0]
    assert (row.status, row.features, row.matched, row.inliers) == ("ok", 9, 10, 9)
    assert row.mean_residual_px == 0.5  # of those used
    assert row.landmarks == 100
    bad = recorder_of(1, bad=0).rows[0]
    assert (bad.status, bad.features, bad.matched, bad.inliers) == ("no_image", 0, 0, 0)
    assert np.isnan(bad.mean_residual_px)


def test_stage_times_stand_in_their_columns() -> None:
    times = dict(zip(STAGES, recorder_of(2).stage_ms[1].tolist(), strict=True))
    assert times == {
        "load": 2.0,
        "sift": 10.0,
        "wait": 5.0,
        "watch": 0.0,
        "predict": 1.0,
        "stereo": 2.0,
        "track": 2.5,
        "places": 0.5,
        "update": 5.0,
        "calibrate": 0.0,
    }


@pytest.mark.parametrize("count", [0, 1, 6])
def test_state_survives_a_file(count: int, tmp_path: Path) -> None:
    before = recorder_of(count, bad=3)
    write_arrays(tmp_path / "state.npz", state_of(before))
    after = RunRecorder(MeasurementLog(RIG, {}))
    restore(after, load_arrays(tmp_path / "state.npz"))
    after.log.increments[:] = before.log.increments
    assert len(after) == len(after.log) == count
    for name in FrameRow._fields:
        np.testing.assert_array_equal(after.column(name), before.column(name))
    assert [type(value) for row in after.rows for value in row] == [
        type(value) for row in before.rows for value in row
    ]
    np.testing.assert_array_equal(after.online_poses, before.online_poses)
    np.testing.assert_array_equal(after.online_covariances, before.online_covariances)
    np.testing.assert_array_equal(after.stage_ms, before.stage_ms)
    np.testing.assert_array_equal(after.noise, before.noise)


def test_a_restored_recorder_goes_on_and_drops_what_came_after_the_state() -> None:
    early, late = recorder_of(3), recorder_of(6)
    after = RunRecorder(MeasurementLog(RIG, {}))
    restore(after, state_of(early))
    after.log.increments[:] = late.log.increments[: len(after)]
    assert len(after.log) == 3
    for k in range(3, 6):
        after.add(report(k, 10 + k), 5.0, float("nan"))
    for name in ("status", "features", "matched", "landmarks"):
        np.testing.assert_array_equal(after.column(name), late.column(name))
    assert [row.match_factor for row in after.noise] == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    assert len(late.log) == 6


# --------------------------------------------------------------------------------------------
# Numbers


def test_counts_of_a_run() -> None:
    numbers = run_numbers(recorder_of(5, bad=3))
    assert numbers["status_counts"] == {"no_image": 1, "ok": 4}
    assert numbers["frames_without_image"] == 1
    assert numbers["frame_problems"] == ["frame 6: image right/000003.png is truncated at 17 bytes"]
    # Features 9 10 11 0 13; landmark matches without the first frame 10 11 0 13.
    features = numbers["features"]
    assert isinstance(features, dict)
    assert features["median"] == 10.0
    matches = numbers["landmark_matches"]
    assert isinstance(matches, dict)
    assert (matches["min"], matches["median"], matches["max"]) == (0, 10.5, 13)
    assert numbers["mean_residual_px"] == 0.5
    assert numbers["stereo_precision"] is None
    assert numbers["loop_ms"] == {"median": 12.0, "p95": pytest.approx(13.8), "max": 14.0}
    assert numbers["sift_ms"] == {"median": 10.0, "p95": 10.0, "max": 10.0}


def test_sideways_motion_and_yaw_hang_together_as_the_covariances_say() -> None:
    recorder = recorder_of(4)
    for covariance, wanted in zip(recorder.online_covariances[1:], (-0.9, -0.5, 0.1), strict=True):
        covariance[1, 3] = covariance[3, 1] = wanted * 1e-4
    assert run_numbers(recorder)["correlation_x_yaw"] == pytest.approx(-0.5)
    assert run_numbers(recorder_of(1))["correlation_x_yaw"] is None


def test_frames_that_no_landmark_located_are_named() -> None:
    recorder = recorder_of(3)
    recorder.rows[2] = recorder.rows[2]._replace(status="too_few_matches", inliers=0)
    assert frame_problems(recorder) == [
        "frame 4: pose predicted only (too_few_matches; 11 features, 0 stereo matches, "
        f"{recorder.rows[2].matched} landmarks matched)"
    ]


def test_no_frame_at_all_is_unknown_not_an_error() -> None:
    numbers = run_numbers(recorder_of(0))
    assert numbers["features"] is None
    assert numbers["mean_residual_px"] is None
    assert numbers["loop_ms"] == {"median": None, "p95": None, "max": None}
    assert frame_problems(recorder_of(0)) == []


def test_a_perfect_path_has_no_error_in_any_world() -> None:
    estimate, recorder = estimate_of(8), recorder_of(8)
    world = se3_exp(np.array([0.3, -1.2, 0.7, 5.0, -3.0, 2.0]))
    truth = Trajectory(estimate.trajectory.timestamps, world @ estimate.trajectory.poses)
    metrics = estimator_metrics(estimate, Truth(truth), recorder)
    assert metrics.ate_rmse_m == pytest.approx(0.0, abs=1e-12)
    assert metrics.end_error_m == pytest.approx(0.0, abs=1e-12)
    assert metrics.rpe_rot_deg == pytest.approx(0.0, abs=1e-5)
    assert metrics.nees_pose_per_dof == pytest.approx(0.0, abs=1e-9)
    assert value_at(metrics.more, "coverage.all") == 1.0
    assert metrics.landmarks == 7
    assert metrics.update_ms["median"] == 8.5  # predict 1 and update 4 to 11
    assert metrics.peak_memory_mb is not None
    assert 10.0 < metrics.peak_memory_mb < 1e5


def test_a_known_error_at_the_end() -> None:
    estimate, recorder = estimate_of(8), recorder_of(8)
    poses = estimate.trajectory.poses.copy()
    poses[-1] = poses[-1] @ se3_exp(np.array([0.0, np.radians(2.0), 0.0, 0.0, 0.0, 0.0]))
    poses[-1, :3, 3] += [0.03, 0.0, 0.04]
    truth = Trajectory(estimate.trajectory.timestamps, poses)
    metrics = estimator_metrics(estimate, Truth(truth), recorder)
    assert metrics.end_error_m == pytest.approx(0.05, abs=1e-9)
    assert metrics.end_error_deg == pytest.approx(2.0, abs=1e-6)
    length = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum()
    assert metrics.drift_percent == pytest.approx(100.0 * 0.05 / length)
    assert metrics.more["matched_poses"] == 8


@pytest.mark.parametrize("count", [1, 2])
def test_without_truth_or_with_too_little_of_it(count: int) -> None:
    estimate, recorder = estimate_of(count), recorder_of(count)
    metrics = estimator_metrics(estimate, Truth(), recorder)
    assert metrics.ate_rmse_m is None
    assert metrics.nees_pose_per_dof is None
    assert metrics.landmarks == 7
    assert estimator_metrics(estimate, Truth(estimate.trajectory), recorder).ate_rmse_m is None


@pytest.mark.parametrize(("connected", "enough"), [(33, False), (34, True), (51, True)])
def test_frames_beyond_the_map_that_is_reported_are_no_success(
    connected: int, enough: bool
) -> None:
    """All 51 are located, some relative to each other only."""
    share = located(recorder_of(51), Apart([k < connected for k in range(51)]))
    assert (share.frames, share.of, share.enough) == (connected, 51, enough)
    assert bool(alarms(share, landmarks=900)) is not enough
    assert all("No success: 33 of 51 frames" in one for one in alarms(share, landmarks=900))


@pytest.mark.parametrize(("misplaced", "enough"), [(2, True), (17, True), (18, False)])
def test_frames_of_another_moment_are_not_located(misplaced: int, enough: bool) -> None:
    recorder = recorder_of(51)
    numbers = recorder.log.numbers[10 : 10 + misplaced].tolist()
    share = located(recorder, Apart([True] * 51), None, numbers)
    assert (share.frames, share.enough) == (51 - misplaced, enough)


@pytest.mark.parametrize(("moves", "enough"), [([], True), ([20], True), ([20, 40], False)])
def test_what_a_loose_camera_has_seen_is_no_success(moves: list[int], enough: bool) -> None:
    share = located(recorder_of(51), Apart([True] * 51), SimpleNamespace(moves=moves))
    assert share.enough is enough
    said = alarms(share, landmarks=900)
    assert [("31 frames are undecided" in one, "loose camera" in one) for one in said] == [
        (True, True)
    ] * (not enough)


def test_without_a_map_the_headline_says_so() -> None:
    share = LocatedShare(51, 51)
    assert alarms(share, landmarks=900) == ()
    assert alarms(share, landmarks=0) == (
        "No success: there is no map, not one landmark was kept.",
    )
