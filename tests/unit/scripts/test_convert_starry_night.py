"""UTIAS Starry Night: a small world written as its file and converted, then the file itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from fgslam.core import geometry as g
from fgslam.core.errors import DatasetError
from fgslam.core.log import MeasurementRecording
from fgslam.core.types import Trajectory
from fgslam.datasets.opening import open_measurements
from fgslam.datasets.settings import (
    MeasurementFilesSettings,
)
from fgslam.evaluation.statistics import evaluate_trajectory
from scripts.convert.starry_night import LEFT_RIGHT_CORRELATION, convert

N = 12
STARRY_NIGHT = "landmarks/utias_starry_night_dataset3.mat"


def starry(rng: np.random.Generator) -> dict[str, Any]:
    """An exact world in the file's own variables, written from Barfoot's equations."""
    t = np.cumsum(rng.uniform(0.05, 0.15, N))
    w, v = rng.normal(0.0, 0.4, (3, N)), rng.normal(0.0, 0.5, (3, N))
    rotation, position = g.so3_exp(np.array([0.3, -2.8, 0.4])), np.array([1.0, 2.0, 0.3])
    theta, r = np.empty((3, N)), np.empty((3, N))
    c_c_v, rho = g.so3_exp(np.array([0.1, 1.4, -0.3])), np.array([0.05, 0.1, -0.02])
    landmarks = rng.uniform(-2.0, 2.0, (3, 6)) + position[:, None]
    y = -np.ones((4, N, 6))
    fu, fv, cu, cv, b = 480.0, 470.0, 320.0, 240.0, 0.24
    for k in range(N):
        theta[:, k], r[:, k] = g.so3_log(rotation), position
        local = c_c_v @ (rotation.T @ (landmarks - position[:, None]) - rho[:, None])
        for j in np.flatnonzero(local[2] > 0.3):
            x, down, z = local[:, j]
            row = fv * down / z + cv
            pixels = [fu * x / z + cu, row, fu * (x - b) / z + cu, row]
            if min(pixels) >= 0.0:
                y[:, k, j] = pixels
        if k < N - 1:
            dt = t[k + 1] - t[k]
            position = position + rotation @ (dt * v[:, k])
            rotation = rotation @ g.so3_exp(dt * w[:, k])
    column = np.ones((3, 1))
    numbers = {"fu": fu, "fv": fv, "cu": cu, "cv": cv, "b": b}
    return {
        "t": t[None],
        "theta_vk_i": theta,
        "r_i_vk_i": r,
        "w_vk_vk_i": w,
        "v_vk_vk_i": v,
        "rho_i_pj_i": landmarks,
        "y_k_j": y,
        "C_c_v": c_c_v,
        "rho_v_c_v": rho[:, None],
        "w_var": 0.01 * column,
        "v_var": np.array([[0.001], [0.002], [0.003]]),
        "y_var": np.array([[4.0], [9.0], [16.0], [25.0]]),
        **{name: np.array([[value]]) for name, value in numbers.items()},
    }


def converted(tmp_path: Path, values: dict[str, Any], **settings: Any) -> MeasurementRecording:
    """The values written as a file, converted, and opened."""
    savemat(tmp_path / "values.mat", values)
    return opened(tmp_path / "values.mat", tmp_path / "converted", **settings)


def opened(file: Path, folder: Path, **settings: Any) -> MeasurementRecording:
    convert(file, folder)
    return open_measurements(MeasurementFilesSettings(path=str(folder), **settings), 0)


def require_exact(recording: MeasurementRecording) -> int:
    """Every measurement is that of the true landmark from the true pose; how many there were."""
    truth, landmarks = recording.ground_truth, recording.landmark_truth
    assert truth is not None
    assert landmarks is not None
    at = dict(zip(truth.timestamps.tolist(), truth.poses, strict=True))
    count = 0
    for increment in recording.log:
        if increment.timestamp in at:
            seen = increment.observations
            points = landmarks.positions[np.searchsorted(landmarks.ids, seen.ids)]
            local = g.transform_to_camera(at[increment.timestamp], points)
            expected = recording.log.rig.predict(local)
            # Landmarks are written to 1 nm.
            np.testing.assert_allclose(seen.measurement, expected, atol=1e-5)
            count += len(seen)
    return count


def require_exact_motion(recording: MeasurementRecording) -> None:
    truth = recording.ground_truth
    assert truth is not None
    poses = dict(zip(truth.timestamps.tolist(), truth.poses, strict=True))
    compared = 0
    for before, after in zip(recording.log.increments, recording.log.increments[1:], strict=False):
        if before.timestamp in poses and after.timestamp in poses:
            assert after.odometry is not None
            moved = g.inverse(poses[before.timestamp]) @ poses[after.timestamp]
            np.testing.assert_allclose(after.odometry.motion, moved, atol=1e-9)
            compared += 1
    assert compared > 2


# --------------------------------------------------------------------------------------------
# Exact worlds


def test_starry_night_is_read_as_its_equations_say(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    recording = converted(tmp_path, starry(rng))
    assert require_exact(recording) >= 4
    require_exact_motion(recording)
    assert [i.index for i in recording.log] == list(range(N))


def test_pixel_covariance_follows_from_the_file_s_variances(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    log = converted(tmp_path, starry(rng)).log
    stated = next(i.observations.covariance[0] for i in log if len(i.observations))
    columns, rows = LEFT_RIGHT_CORRELATION
    both = 2.0 * 4.0 * columns
    np.testing.assert_allclose(
        stated, [[16, 0, both - 16], [0, 8.5 + 0.5 * rows * 15, 0], [both - 16, 0, 20 - 2 * both]]
    )


def test_odometry_covariance_is_that_of_noisy_rates(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """Monte Carlo over the rates of one step of Starry Night, in the reference camera."""
    values = starry(rng)
    stated = converted(tmp_path, values).log.increments[1].odometry
    assert stated is not None
    rig = converted(tmp_path, values).log.rig
    dt = values["t"][0, 1] - values["t"][0, 0]
    w, v = values["w_vk_vk_i"][:, 0], values["v_vk_vk_i"][:, 0]
    drawn = []
    for _ in range(4000):
        turn = dt * (w + np.sqrt(values["w_var"][:, 0]) * rng.standard_normal(3))
        way = dt * (v + np.sqrt(values["v_var"][:, 0]) * rng.standard_normal(3))
        body = g.pose(g.so3_exp(turn), way)
        camera = g.body_to_camera_motion(body, rig.bTc)
        drawn.append(g.se3_log(g.inverse(stated.motion) @ camera))
    sample = np.cov(np.array(drawn).T)
    size = np.sqrt(np.diagonal(stated.covariance))
    np.testing.assert_allclose(
        sample / np.outer(size, size), stated.covariance / np.outer(size, size), atol=0.08
    )


# --------------------------------------------------------------------------------------------
# Bad files


def wrong(values: dict[str, Any], name: str, value: object) -> dict[str, Any]:
    changed = {k: v for k, v in values.items() if k != name}
    return changed if value is None else changed | {name: value}


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("t", None, "no variable t of numbers"),
        ("C_c_v", np.eye(2), "variable C_c_v is 2 x 2, expected 3 x 3"),
        ("C_c_v", 2.0 * np.eye(3), "C_c_v is not a rotation"),
        ("w_var", np.zeros((3, 1)), "variable w_var must be positive"),
        ("y_k_j", -np.ones((4, N, 6)), "y_k_j never sees a landmark"),
        ("y_k_j", np.ones((4, N, 5)), f"is 4 x {N} x 5, expected 4 x {N} x 6"),
    ],
)
def test_a_wrong_variable_is_named(
    tmp_path: Path, rng: np.random.Generator, name: str, value: object, message: str
) -> None:
    with pytest.raises(DatasetError, match=message) as caught:
        converted(tmp_path, wrong(starry(rng), name, value))
    assert str(tmp_path / "values.mat") in str(caught.value)
    assert not (tmp_path / "converted").exists()
    assert "\n" not in str(caught.value)


def test_a_negative_pixel_is_no_measurement(tmp_path: Path, rng: np.random.Generator) -> None:
    values = starry(rng)
    values["y_k_j"][1, 0, 0] = -3.0
    with pytest.raises(DatasetError, match="a negative pixel that is not marked unseen"):
        converted(tmp_path, values)


def test_missing_and_damaged_files_give_one_line_errors(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    path = tmp_path / "a.mat"
    with pytest.raises(DatasetError, match=r"does not exist; give the \.mat file"):
        convert(path, tmp_path / "converted")
    savemat(path, starry(rng), do_compression=True)
    whole = path.read_bytes()
    for damaged in (b"", b"not MATLAB", whole[:60], whole[: len(whole) // 2], whole[:-3]):
        path.write_bytes(damaged)
        with pytest.raises(DatasetError, match="it may be truncated, restore it") as caught:
            convert(path, tmp_path / "converted")
        assert "\n" not in str(caught.value)


# --------------------------------------------------------------------------------------------
# The files themselves


def ate(trajectory: Trajectory, recording: MeasurementRecording) -> float:
    error = evaluate_trajectory(trajectory, recording.ground_truth).ate_rmse_m
    assert error is not None
    return error


@pytest.mark.data
def test_the_residuals_of_starry_night_are_those_stated(shared_data: Path, tmp_path: Path) -> None:
    """True landmarks from true poses: the file's variances, and the correlation of the images."""
    recording = opened(shared_data / STARRY_NIGHT, tmp_path)
    truth, landmarks = recording.ground_truth, recording.landmark_truth
    assert truth is not None
    assert landmarks is not None
    errors = []
    for increment, wTc in zip(recording.log, truth.poses, strict=True):
        seen = increment.observations
        local = g.transform_to_camera(wTc, landmarks.positions[seen.ids])
        errors.append(seen.measurement - recording.log.rig.predict(local))
    sample = np.cov(np.concatenate(errors).T)
    first = next(i.observations for i in recording.log if len(i.observations))
    stated = first.covariance[0]
    assert np.diagonal(sample) == pytest.approx(np.diagonal(stated), rel=0.06)
    assert sample[0, 2] == pytest.approx(stated[0, 2], abs=1.5)
