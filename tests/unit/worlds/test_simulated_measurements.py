"""Simulated measurements: exact where they should be, noisy as stated, the same for a seed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulated import assert_same_bits, assert_same_value

from fgslam.backend.filters.kalman import LandmarkKalman
from fgslam.backend.settings import LandmarkKalmanSettings
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import ConfigError
from fgslam.core.log import MeasurementRecording
from fgslam.core.sensors import CameraRig, compose_odometry
from fgslam.core.types import Prediction, Trajectory
from fgslam.datasets.opening import open_measurements
from fgslam.datasets.settings import ConstantVelocitySettings, SyntheticOdometrySettings
from fgslam.evaluation.statistics import Alignment, evaluate_trajectory
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver
from fgslam.runs.config import ExperimentConfig, load_experiment, make_config
from fgslam.slam.motion import ConstantVelocityMotion
from fgslam.slam.replay import replay_frame
from fgslam.worlds.settings import SimulatedMeasurementsSettings
from fgslam.worlds.simulated_measurements import IdentityBook


def settings(**values: Any) -> SimulatedMeasurementsSettings:
    """Settings as an experiment's file would give them: the short part of a drive."""
    values = {"kind": "simulated_measurements", "stop": 40} | values
    config = make_config({"name": "x", "dataset": values}, "x")
    assert isinstance(config.dataset, SimulatedMeasurementsSettings)
    return config.dataset


def recorded(seed: int = 0, **values: Any) -> MeasurementRecording:
    return open_measurements(settings(**values), seed)


def exactly_seen(recording: MeasurementRecording) -> list[tuple[FloatArray, FloatArray, IntArray]]:
    """For each frame measured, true (column, row, disparity) and ids, of landmarks with truth."""
    truth, landmarks, rig = recording.ground_truth, recording.landmark_truth, recording.log.rig
    assert truth is not None
    assert landmarks is not None
    out = []
    for increment, wTc in zip(recording.log, truth.poses, strict=True):
        seen = increment.observations
        known = np.isin(seen.ids, landmarks.ids)
        rows = np.searchsorted(landmarks.ids, seen.ids[known])
        points = g.transform_to_camera(wTc, landmarks.positions[rows])
        out.append((seen.measurement[known], rig.predict(points), seen.ids[known]))
    return out


def differences(recording: MeasurementRecording) -> FloatArray:
    """All errors of measurement (k, 3) against the truth, pixels."""
    return np.concatenate([measured - true for measured, true, _ in exactly_seen(recording)])


DRIVES: dict[str, dict[str, Any]] = {
    "lab_loop": {},
    "room_laps": {"drive": {"path": "laps", "frames": None}},
    "sharp_turns": {"drive": {"path": "sharp_turns", "frames": 60}},
    "corridor_laps": {"world": {"place": "corridor"}, "drive": {"path": "laps", "frames": None}},
}


# --------------------------------------------------------------------------------------------
# Truth and noise


@pytest.mark.parametrize("name", DRIVES)
def test_without_noise_measurements_are_those_of_the_truth(name: str) -> None:
    recording = recorded(**DRIVES[name], detection={"noise_scale": 0.0})
    assert np.abs(differences(recording)).max() < 1e-9
    assert min(len(i.observations) for i in recording.log) > 5
    truth = recording.ground_truth
    assert truth is not None
    np.testing.assert_allclose(truth.poses[0], np.eye(4), atol=1e-12)
    for k, increment in enumerate(recording.log.increments[1:], 1):
        assert increment.odometry is not None
        moved = g.inverse(truth.poses[k - 1]) @ truth.poses[k]
        np.testing.assert_allclose(increment.odometry.motion, moved, atol=1e-9)


@pytest.mark.parametrize("vertical", [0.1, None])
def test_noise_of_measurements_is_as_stated(vertical: float | None) -> None:
    """The sample covariance of some thousand errors is the stated one; so is its inverse."""
    recording = recorded(rig={"vertical_baseline_m": vertical})
    error = differences(recording)
    assert len(error) > 3000
    stated = recording.log.increments[0].observations.covariance[0]
    assert stated[0, 2] < -0.1 * stated[0, 0]  # column and disparity share the reference pixel
    whitened = error @ np.linalg.inv(np.linalg.cholesky(stated)).T
    assert np.abs(np.cov(whitened.T) - np.eye(3)).max() < 0.08
    assert np.abs(whitened.mean(axis=0)).max() < 0.06


def test_raw_pixels_make_the_measurement() -> None:
    recording = recorded(stop=5)
    rig = recording.log.rig
    assert isinstance(rig, CameraRig)
    for increment in recording.log:
        pixels, seen = increment.observations.pixels, increment.observations.measurement
        horizontal = pixels[:, 1, 0] - pixels[:, 0, 0]
        vertical = pixels[:, 2, 1] - pixels[:, 0, 1]
        assert np.abs(0.5 * (horizontal + vertical) - seen[:, 2]).max() < 1.0
        assert (pixels >= -1.0).all()
        assert (pixels <= np.array([rig.width, rig.height])).all()


def test_odometry_errs_as_stated() -> None:
    """Whitened errors of many steps: unit variance, no correlation from step to step."""
    recording = recorded(stop=None, detection={"features": 1}, world={"landmarks": 10})
    truth = recording.ground_truth
    assert truth is not None
    whitened = []
    for k, increment in enumerate(recording.log.increments[1:], 1):
        assert increment.odometry is not None
        moved = g.inverse(truth.poses[k - 1]) @ truth.poses[k]
        error = g.se3_log(g.inverse(moved) @ increment.odometry.motion)
        root = np.linalg.cholesky(increment.odometry.covariance)
        whitened.append(np.linalg.solve(root, error))
    drawn = np.array(whitened)
    assert np.mean(drawn**2) == pytest.approx(1.0, abs=0.08)
    assert np.abs(np.mean(drawn[1:] * drawn[:-1], axis=0)).max() < 0.25


# --------------------------------------------------------------------------------------------
# Seeds


def test_the_same_seed_gives_the_same_bytes() -> None:
    values: dict[str, Any] = {"outlier_fraction": 0.2}
    first, second = recorded(3, **values), recorded(3, **values)
    assert_same_value(first.log, second.log)
    assert_same_bits(first.landmark_truth, second.landmark_truth)
    assert first.identity == second.identity


def test_the_run_s_seed_changes_noise_and_not_the_world() -> None:
    first, second = recorded(0), recorded(1)
    assert first.identity != second.identity
    assert first.ground_truth is not None
    assert second.ground_truth is not None
    assert_same_bits(first.ground_truth, second.ground_truth)
    assert first.landmark_truth is not None
    assert second.landmark_truth is not None
    one, two = first.landmark_truth.positions, second.landmark_truth.positions
    common = {tuple(row) for row in one.tolist()} & {tuple(row) for row in two.tolist()}
    assert len(common) > 0.7 * len(one)
    moves = [r.log.increments[5].odometry for r in (first, second)]
    assert moves[0] is not None
    assert moves[1] is not None
    assert np.abs(moves[0].motion - moves[1].motion).max() > 1e-5


def test_wrong_matches_leave_the_rest_as_it_was() -> None:
    clean, spoilt = recorded(), recorded(outlier_fraction=0.3)
    for a, b in zip(clean.log, spoilt.log, strict=True):
        assert_same_bits(a.observations.ids, b.observations.ids)
        same = (a.observations.measurement == b.observations.measurement).all(axis=1)
        assert same[a.observations.is_new].all()
        assert (a.odometry is None) == (b.odometry is None)


# --------------------------------------------------------------------------------------------
# Identities


def test_an_identity_is_kept_through_misses_and_new_after_pruning() -> None:
    book = IdentityBook(3, prune_after=2)
    everything = np.ones(3, np.bool_)
    first = book.take(np.array([True, False, True]), everything)
    assert (first.new.tolist(), first.new_ids.tolist()) == ([0, 2], [0, 1])
    assert first.missed_ids.tolist() == []  # point 1 is not known, so it cannot be missed
    second = book.take(np.array([False, True, True]), everything)
    assert (second.matched_ids.tolist(), second.new_ids.tolist()) == ([1], [2])
    assert (second.missed_ids.tolist(), second.pruned_ids.tolist()) == ([0], [])
    third = book.take(np.array([False, True, False]), np.array([True, True, False]))
    assert (third.missed_ids.tolist(), third.pruned_ids.tolist()) == (
        [0],
        [0],
    )  # 2 was not expected
    fourth = book.take(np.array([True, False, True]), everything)
    assert (fourth.matched.tolist(), fourth.matched_ids.tolist()) == ([2], [1])
    assert (fourth.new.tolist(), fourth.new_ids.tolist()) == ([0], [3])
    assert book.point_of_id.tolist() == [0, 2, 1, 0]


def test_every_observation_is_new_matched_or_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every observation is of a landmark known and not pruned, or new under the next number."""
    monkeypatch.setattr("fgslam.worlds.simulated_measurements.PRUNE_AFTER", 3)
    recording = recorded(stop=None, detection={"probability": 0.5})
    alive: set[int] = set()
    count = pruned = 0
    for increment in recording.log:
        seen = increment.observations
        matched = set(seen.ids[~seen.is_new].tolist())
        assert matched <= alive
        new = seen.ids[seen.is_new].tolist()
        assert new == list(range(count, count + len(new)))
        missed = set(increment.missed_ids.tolist())
        assert missed <= alive - matched
        alive |= set(new)
        count += len(new)
        gone = set(increment.pruned_ids.tolist())
        assert gone <= missed
        alive -= gone
        pruned += len(gone)
    assert pruned > 10
    assert recording.landmark_truth is not None
    assert recording.landmark_truth.ids.tolist() == list(range(count))


def test_number_of_measurements_is_limited_to_the_strongest() -> None:
    few, many = recorded(detection={"features": 20}), recorded()
    counts = [len(increment.observations) for increment in few.log]
    assert max(counts) == 20
    assert max(len(increment.observations) for increment in many.log) > 60
    followed = [(~increment.observations.is_new).mean() for increment in few.log.increments[1:]]
    assert np.mean(followed) > 0.7


def test_detection_probability_is_respected() -> None:
    full = recorded(detection={"probability": 1.0, "features": 10_000})
    half = recorded(detection={"probability": 0.5, "features": 10_000})
    counts = [sum(len(i.observations) for i in r.log) for r in (half, full)]
    assert counts[0] / counts[1] == pytest.approx(0.5, abs=0.03)
    assert all(len(increment.missed_ids) == 0 for increment in full.log)


def test_range_limits_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fgslam.worlds.simulated_measurements.LEAST_RANGE_M", 1.0)
    monkeypatch.setattr("fgslam.worlds.simulated_measurements.MOST_RANGE_M", 3.0)
    near = recorded(stop=None, detection={"noise_scale": 0.0})
    distance = np.concatenate(
        [
            np.linalg.norm(near.log.rig.triangulate(i.observations.measurement), axis=1)
            for i in near.log
        ]
    )
    assert 1.0 <= distance.min() < 1.1
    assert 2.95 < distance.max() <= 3.0


# --------------------------------------------------------------------------------------------
# What goes wrong on purpose


def test_outlier_fraction_is_the_share_of_wrong_matches() -> None:
    recording = recorded(stop=None, outlier_fraction=0.2)
    error = np.linalg.norm(differences(recording), axis=1)
    matched = sum(int((~i.observations.is_new).sum()) for i in recording.log)
    grossly = int((error > 3.0).sum())
    assert grossly / matched == pytest.approx(0.2, abs=0.015)
    (note,) = [note for note in recording.notes if "wrong" in note]
    assert grossly <= int(note.split()[0]) < 1.05 * grossly
    assert all((i.observations.measurement[:, 2] > 0.0).all() for i in recording.log)
    assert not any(increment.rejected.any() for increment in recording.log)


def test_the_odometry_s_fault_scales_ten_steps() -> None:
    fault = {"start": 7, "frames": 4, "scale": 0.5}
    recording = recorded(stop=20, detection={"noise_scale": 0.0}, odometry_fault=fault)
    truth = recording.ground_truth
    assert truth is not None
    ratios = []
    for k, increment in enumerate(recording.log.increments[1:], 1):
        assert increment.odometry is not None
        moved = g.inverse(truth.poses[k - 1]) @ truth.poses[k]
        way = np.linalg.norm(increment.odometry.motion[:3, 3]) / np.linalg.norm(moved[:3, 3])
        ratios.append(round(float(way), 6))
    assert ratios == [1.0] * 6 + [0.5] * 4 + [1.0] * 9


def test_blackout_gives_no_observation_and_keeps_identities() -> None:
    recording = recorded(blackout={"start": 10, "frames": 5})
    for increment in recording.log:
        dark = 10 <= increment.index < 15
        assert (len(increment.observations) == 0) == dark
        if dark:
            assert len(increment.missed_ids) == len(increment.pruned_ids) == 0
            assert increment.odometry is not None
    seen_before = {int(i) for k in recording.log.increments[:10] for i in k.observations.ids}
    after = recording.log.increments[15].observations
    assert len(seen_before & set(after.ids.tolist())) > 10


# --------------------------------------------------------------------------------------------
# Selection, motion, refusals


def test_a_stride_composes_the_odometry() -> None:
    every, third = (
        recorded(stop=None, detection={"features": 5}),
        recorded(start=3, stop=None, stride=3, detection={"features": 5}),
    )
    assert [i.index for i in third.log] == list(range(3, 249, 3))
    for k, increment in enumerate(third.log.increments[1:], 1):
        steps = [every.log.increments[j].odometry for j in range(3 * k + 1, 3 * k + 4)]
        assert all(step is not None for step in steps)
        whole = compose_odometry(step for step in steps if step is not None)
        assert increment.odometry is not None
        np.testing.assert_allclose(increment.odometry.motion, whole.motion, atol=1e-12)
        np.testing.assert_allclose(
            increment.odometry.covariance, whole.covariance, rtol=1e-9, atol=1e-15
        )
    assert third.ground_truth is not None
    np.testing.assert_allclose(third.ground_truth.poses[0], np.eye(4), atol=1e-12)


def test_the_motion_model_is_what_the_settings_ask_for() -> None:
    plain = recorded(stop=3).log
    assert plain.motion_model == {"kind": "recorded"}
    without = open_measurements(settings(stop=3), 0, ConstantVelocitySettings()).log
    assert without.motion_model == {"kind": "constant_velocity"}
    assert all(increment.odometry is None for increment in without)
    assert_same_bits(
        [i.observations for i in plain.increments], [i.observations for i in without.increments]
    )
    with pytest.raises(ConfigError, match="choose recorded or constant_velocity"):
        open_measurements(settings(stop=3), 0, SyntheticOdometrySettings())


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"world": {"place": "corridor"}}, "lab_loop does not exist in a corridor"),
        ({"drive": {"frames": 50}}, "raise frames or leave it null"),
        ({"start": 249}, "leave none of the drive's 249 frames"),
        ({"blackout": {"start": 249}}, "blackout.start is 249, but the drive has the frames"),
        ({"odometry_fault": {"start": 999}}, "odometry_fault.start is 999"),
        ({"start": 5, "stop": 5}, "leave none of the drive's 249 frames"),
    ],
)
def test_impossible_drives_are_refused(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        recorded(**values)
    assert "\n" not in str(caught.value)


def test_exact_length_of_sharp_turns_and_their_pace() -> None:
    truth = recorded(
        stop=None, drive={"path": "sharp_turns", "frames": 300, "turn_deg_per_frame": 15.0}
    ).ground_truth
    assert truth is not None
    assert len(truth) == 300
    moves = g.inverse(truth.poses[:-1]) @ truth.poses[1:]
    turns = np.rad2deg([g.rotation_angle(move[:3, :3]) for move in moves])
    assert turns.max() < 15.0 + 1e-9
    assert (turns > 10.0).mean() > 0.4


# --------------------------------------------------------------------------------------------
# With an estimator


def filtered(recording: MeasurementRecording) -> tuple[Trajectory, float]:
    """The paper's filter over a recording: its trajectory, and its ATE in metres."""
    rig = recording.log.rig
    prior = Prediction(np.eye(4), np.zeros((6, 6)))
    estimator = LandmarkKalman(rig, LandmarkKalmanSettings(), prior)
    solver = EgoMotionSolver(rig, EgoMotionSettings(dof=3))
    motion = ConstantVelocityMotion()
    for k, increment in enumerate(recording.log):
        replay_frame(increment, estimator, solver, motion, k)
    found = estimator.estimate().trajectory
    error = evaluate_trajectory(found, recording.ground_truth, Alignment.FIRST_POSE)
    assert error.ate_rmse_m is not None
    return found, error.ate_rmse_m


def test_the_filter_finds_the_truth_without_noise() -> None:
    recording = recorded(detection={"noise_scale": 0.0})
    assert recording.ground_truth is not None
    found, _ = filtered(recording)
    np.testing.assert_allclose(found.poses, recording.ground_truth.poses, atol=1e-7)


SIMULATED = {
    path.stem: config
    for path in sorted((Path(__file__).parents[3] / "experiments").glob("*.yaml"))
    for config in (load_experiment(path),)
    if isinstance(config, ExperimentConfig)
    and isinstance(config.dataset, SimulatedMeasurementsSettings)
}


@pytest.mark.parametrize("name", SIMULATED)
def test_every_simulated_experiment_opens(name: str) -> None:
    """Of the length asked for, with matches to live on (sparse ones often not) and odometry."""
    config = SIMULATED[name]
    dataset = config.dataset
    assert isinstance(dataset, SimulatedMeasurementsSettings)
    recording = open_measurements(dataset, config.seed, config.odometry)
    assert len(recording.log) == dataset.drive.frames
    matched = [int((~i.observations.is_new).sum()) for i in recording.log.increments[1:]]
    assert np.mean(np.array(matched) >= 3) > (0.85 if name == "sparse_features" else 0.99)
    assert all(i.odometry is not None for i in recording.log.increments[1:])
