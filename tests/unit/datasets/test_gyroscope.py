"""Turns of a gyroscope: integration against fine steps, files, units, bags."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bags import START_NS, gyroscope, stereo, write_bag
from dataset_builders import PERIOD_NS, euroc, image_folder, write_calibration
from dataset_builders import START_NS as EUROC_START_NS

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError, OdometryError
from fgslam.core.geometry import rotation_angle, so3_exp, so3_log
from fgslam.core.sensors import Odometry
from fgslam.datasets.odometry import (
    GyroscopeLog,
    GyroscopeNoise,
    checked_rates,
    integrated,
    motions_from_gyroscope,
    read_gyroscope_noise,
    read_rates,
)
from fgslam.datasets.opening import open_recording
from fgslam.datasets.settings import (
    BagSettings,
    EurocSettings,
    ImageFolderSettings,
    RecordedOdometrySettings,
)
from fgslam.runs.bare import bare_experiment

LIMITS = RecordedOdometrySettings()
RATE = np.array([0.3, -0.2, 0.5])  # rad/s
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def tumbling(stamps: FloatArray) -> FloatArray:
    """Rates (n, 3) whose axis turns, so that the order of turns counts."""
    return np.column_stack([1.5 * np.sin(3 * stamps), np.cos(2 * stamps), 0.5 + stamps])


def finely(log: GyroscopeLog, start: float, end: float, bias: FloatArray) -> FloatArray:
    """The rotation by many small steps of the interpolated rate in their middle."""
    edges = np.linspace(start, end, 4001)
    middle = 0.5 * (edges[1:] + edges[:-1])
    rates = np.column_stack([np.interp(middle, log.stamps, axis) for axis in log.rates.T]) - bias
    rotation = np.eye(3)
    for rate in rates:
        rotation = rotation @ so3_exp(rate * (end - start) / len(rates))
    return rotation


def write_rates(path: Path, stamps: FloatArray, rates: FloatArray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = (f"{int(t)},{x:.12g},{y:.12g},{z:.12g},0,0,9.8" for t, (x, y, z) in
            zip(stamps, rates, strict=True))  # fmt: skip
    head = "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],a,b,c"
    path.write_text("\n".join([head, *rows]), encoding="utf-8")
    return path


def sampled(seconds: float, rate: FloatArray = RATE) -> tuple[FloatArray, FloatArray]:
    """Stamps from a tenth before 0 to a tenth after, at 200 Hz, and one rate at all."""
    stamps = np.arange(-0.1, seconds + 0.1, 0.005)
    return stamps, np.tile(rate, (len(stamps), 1))


# --------------------------------------------------------------------------------------------
# Integration


def test_integration_is_that_of_many_small_steps() -> None:
    stamps = np.arange(0.0, 1.2, 0.02)
    log = GyroscopeLog(stamps, tumbling(stamps))
    turned, jacobians = integrated(log, np.array([0.103, 0.9]))
    fine = finely(log, 0.103, 0.9, np.zeros(3))
    assert rotation_angle(turned[0].T @ fine) < 1e-6, "by the mean rate of two samples 3e-5"
    for axis in np.eye(3):
        moved = so3_log(fine.T @ finely(log, 0.103, 0.9, 1e-3 * axis)) / 1e-3
        np.testing.assert_allclose(jacobians[0] @ axis, moved, rtol=0.0, atol=1e-3)


def test_a_steady_turn_is_exact_at_any_rate_of_samples() -> None:
    for period in (0.005, 0.05):
        stamps = np.arange(0.0, 1.0, period)
        log = GyroscopeLog(stamps, np.tile(RATE, (len(stamps), 1)))
        turned, _ = integrated(log, np.array([0.1, 0.333, 0.8]))
        np.testing.assert_allclose(turned[0], so3_exp(0.233 * RATE), rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(turned[1], so3_exp(0.467 * RATE), rtol=0.0, atol=1e-12)


def test_steps_beyond_the_samples_and_over_gaps_are_not_measured() -> None:
    stamps = np.array([0.0, 0.05, 0.1, 0.4, 0.45, 0.5])
    log = GyroscopeLog(stamps, np.tile(RATE, (6, 1)))
    steps = motions_from_gyroscope(log, np.array([-0.2, 0.0, 0.1, 0.2, 0.42, 0.5, 0.6]))
    assert [step is not None for step in steps] == [False, True, False, False, True, False]


def test_noise_grows_with_time_and_turn() -> None:
    stamps, rates = sampled(1.0, np.zeros(3))
    noise = GyroscopeNoise(density=0.01, walk=0.1)
    (step,) = motions_from_gyroscope(GyroscopeLog(stamps, rates, noise), np.array([0.0, 0.25]))
    assert step is not None
    assert (step.measured, step.turned) == (False, True)
    np.testing.assert_allclose(step.covariance[:3, :3], 0.25e-4 * np.eye(3), atol=1e-12)
    assert step.covariance[3, 3] >= 100.0  # metres squared: nothing is known of it
    assert step.bias is not None
    assert step.bias.walk == pytest.approx(0.0025)
    fast = GyroscopeLog(stamps, rates + RATE, noise)
    (turning,) = motions_from_gyroscope(fast, np.array([0.0, 0.25]))
    assert turning is not None
    assert turning.covariance[0, 0] > step.covariance[0, 0]


# --------------------------------------------------------------------------------------------
# Files


def only_step(steps: tuple[Odometry | None, ...]) -> FloatArray:
    assert steps[0] is not None
    return so3_log(steps[0].motion[:3, :3])


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e-6, 1e-9])
def test_times_of_rates_are_in_any_unit(tmp_path: Path, unit: float) -> None:
    stamps, rates = sampled(1.0)
    path = tmp_path / "rates.csv"
    rows = np.column_stack([stamps / unit, rates])
    path.write_text("\n".join(",".join(f"{x:.12g}" for x in row) for row in rows))
    log = checked_rates(read_rates(path), LIMITS)
    np.testing.assert_allclose(log.stamps, stamps, rtol=0.0, atol=1e-9)


def test_degrees_are_refused_by_their_size(tmp_path: Path) -> None:
    stamps, rates = sampled(1.0)
    path = write_rates(tmp_path / "imu.csv", 1e9 * stamps, np.degrees(rates))
    with pytest.raises(OdometryError, match=r"line 2: angular velocity .*are these degrees\?"):
        checked_rates(read_rates(path), LIMITS)


def test_noise_is_what_the_file_states(tmp_path: Path) -> None:
    own = tmp_path / "imu.yaml"
    own.write_text("imu0:\n  gyroscope_noise_density: 0.002\n  gyroscope_random_walk: 3.0e-05\n")
    assert read_gyroscope_noise(own) == GyroscopeNoise(0.002, 3e-5)
    own.write_text("update_rate: 200.0\n")
    assert read_gyroscope_noise(own) == GyroscopeNoise()
    own.write_text("gyroscope_noise_density: much\n")
    with pytest.raises(CalibrationError, match="gyroscope_noise_density"):
        read_gyroscope_noise(own)


def pose_ahead() -> FloatArray:
    out = np.eye(4)
    out[:3, :3] = AHEAD
    return out


def euroc_with_gyroscope(root: Path) -> Path:
    left = pose_ahead()
    right = pose_ahead()
    right[1, 3] = -0.1
    root = euroc(root, (left, right))
    stamps, rates = sampled(1.0)
    stamps_ns = np.round(1e9 * stamps) + EUROC_START_NS
    write_rates(root / "mav0" / "imu0" / "data.csv", stamps_ns, rates)
    return root


def test_euroc_turns_as_its_gyroscope_says(tmp_path: Path) -> None:
    root = euroc_with_gyroscope(tmp_path)
    steps = open_recording(EurocSettings(path=str(root))).odometry(1)
    np.testing.assert_allclose(only_step((steps,)), 1e-9 * PERIOD_NS * RATE, rtol=0.0, atol=1e-6)
    quarter = "[0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]"  # the sensor's x is the body's y
    text = f"T_BS:\n  data: {quarter}\ngyroscope_noise_density: 0.5\n"
    (root / "mav0" / "imu0" / "sensor.yaml").write_text(text)
    turned = open_recording(EurocSettings(path=str(root))).odometry(1)
    assert turned is not None
    body = np.array([-RATE[1], RATE[0], RATE[2]])
    np.testing.assert_allclose(only_step((turned,)), 1e-9 * PERIOD_NS * body, rtol=0.0, atol=1e-6)
    assert turned.covariance[0, 0] > 0.25e-9 * PERIOD_NS, "the file's noise"


def test_a_bare_recording_says_that_it_has_a_gyroscope(tmp_path: Path) -> None:
    found = bare_experiment(euroc_with_gyroscope(tmp_path))
    assert "; a gyroscope, no odometry" in found.said
    assert found.config.odometry.kind == "recorded"


NAMED = "timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],note"


@pytest.mark.parametrize(
    ("head", "unit"),
    [(NAMED, 1.0), ("t_ns,gyro_x_dps,gyro_y_dps,gyro_z_dps", np.pi / 180.0), (None, 1.0)],
)
def test_a_folder_has_its_gyroscope_beside_its_images(
    tmp_path: Path, head: str | None, unit: float
) -> None:
    root = image_folder(tmp_path)
    write_calibration(root)
    stamps, rates = sampled(1.0)
    rows = [f"{round(1e9 * t)},{x:.9g},{y:.9g},{z:.9g},0" for t, (x, y, z) in
            zip(stamps, rates / unit, strict=True)]  # fmt: skip
    (root / "imu.csv").write_text("\n".join([*([head] if head else []), *rows]))
    step = open_recording(ImageFolderSettings(path=str(root))).odometry(1)
    np.testing.assert_allclose(only_step((step,)), 0.1 * RATE, rtol=0.0, atol=1e-6)


def test_a_bag_turns_by_its_imu(tmp_path: Path) -> None:
    stamps = START_NS + 5_000_000 * np.arange(-20, 100)
    bag = write_bag(tmp_path / "walk.bag", stereo(4) + gyroscope(stamps.tolist(), RATE))
    recording = open_recording(BagSettings(path=str(bag)), LIMITS)
    np.testing.assert_allclose(only_step((recording.odometry(1),)), 0.1 * RATE, atol=1e-6)
    assert "; a gyroscope, no odometry" in bare_experiment(bag).said
