"""Odometry: arcs worked out by hand, gyroscopes against fine steps, files, noise drawn on truth."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bags import START_NS, gyroscope, stereo, write_bag
from dataset_builders import (
    PERIOD_NS,
    START_NS as EUROC_START_NS,
    curve,
    euroc,
    image_folder,
    write_tum,
)
from hypothesis import given, strategies as st
from scipy import stats

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError, DatasetError, OdometryError
from fgslam.core.geometry import (
    inverse,
    rotation_angle,
    se3_log,
    so3_exp,
    so3_log,
)
from fgslam.core.sensors import Odometry
from fgslam.datasets.odometry import (
    GyroscopeNoise,
    Steps,
    file_odometry,
    gyroscope_motions,
    integrate_rates,
    read_columns,
    read_gyroscope_noise,
    speed_motions,
    steps_covered,
)
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording, with_synthetic_odometry
from fgslam.datasets.settings import (
    BagSettings,
    EurocSettings,
    ImageFolderSettings,
    RecordedOdometrySettings,
    SyntheticOdometrySettings,
)
from fgslam.runs.bare import bare_experiment

DEFAULT = RecordedOdometrySettings()


def known(steps: Steps) -> list[Odometry]:
    assert all(step is not None for step in steps)
    return [step for step in steps if step is not None]


def of_speed(stamps: FloatArray, speed: float, rate: float, frames: FloatArray) -> Steps:
    ones = np.ones(len(stamps))
    return speed_motions(stamps, speed * ones, rate * ones, frames, DEFAULT)


@pytest.mark.parametrize("rate", [0.0, 1e-9, 0.7, -0.3])
def test_constant_speed_and_turn_give_the_exact_arc(rate: float) -> None:
    (step,) = known(of_speed(np.linspace(0.0, 2.0, 9), 3.0, rate, np.array([0.3, 1.7])))
    angle, length = 1.4 * rate, 1.4 * 3.0
    radius = length / angle if abs(angle) > 1e-6 else None
    expected = [radius * np.sin(angle), radius * (1 - np.cos(angle))] if radius else [length, 0.0]
    np.testing.assert_allclose(step.motion[:2, 3], expected, atol=1e-8)
    np.testing.assert_allclose(step.motion[:2, 0], [np.cos(angle), np.sin(angle)], atol=1e-12)
    np.testing.assert_array_equal(step.motion[2], [0.0, 0.0, 1.0, 0.0])


def test_linear_speed_between_samples_is_integrated_exactly() -> None:
    log = np.array([0.0, 0.5, 1.0, 1.5]), np.array([1.0, 2.0, 1.0, 0.0]), np.zeros(4)
    (step,) = known(speed_motions(*log, np.array([0.25, 1.0]), DEFAULT))
    # From 1.5 to 2 m/s in a quarter of a second, then from 2 to 1 m/s in half a second.
    np.testing.assert_allclose(step.motion[:3, 3], [0.4375 + 0.75, 0.0, 0.0], atol=1e-12)


@given(
    seed=st.integers(0, 1000),
    cuts=st.lists(st.floats(0.01, 4.99), min_size=1, max_size=6, unique=True),
)
def test_motions_compose_whatever_frames_are_chosen(seed: int, cuts: list[float]) -> None:
    rng = np.random.default_rng(seed)
    stamps = np.linspace(0.0, 5.0, 60) + rng.uniform(-0.04, 0.04, 60)
    stamps[[0, -1]] = [0.0, 5.0]
    log = stamps, rng.uniform(0, 9, 60), rng.uniform(-0.6, 0.6, 60)
    frames = np.array([0.0, *sorted(cuts), 5.0])
    composed = np.eye(4)
    for step in known(speed_motions(*log, frames, DEFAULT)):
        composed = composed @ step.motion
    (whole,) = known(speed_motions(*log, frames[[0, -1]], DEFAULT))
    np.testing.assert_allclose(composed, whole.motion, atol=1e-9)


def test_covariance_is_the_stated_noise_times_the_duration() -> None:
    (step,) = known(of_speed(np.linspace(0.0, 2.0, 9), 3.0, 0.1, np.array([0.5, 0.75])))
    sigmas = 0.25 * np.array([*np.radians([1.3, 1.9, 0.3]), 0.1, 0.08, 0.12])
    np.testing.assert_allclose(step.covariance, np.diag(sigmas**2), rtol=1e-9)


def test_gaps_leave_steps_without_odometry_and_ends_are_held() -> None:
    stamps = np.array([0.2, 0.4, 0.6, 2.0, 2.2, 2.4])
    frames = np.array([0.0, 0.5, 1.0, 1.5, 2.1, 2.6, 3.2])
    expected = [True, False, False, False, True, False]
    np.testing.assert_array_equal(steps_covered(stamps, frames, 0.5, 0.5), expected)
    steps = of_speed(stamps, 2.0, 0.0, frames)
    assert [step is not None for step in steps] == expected
    assert steps[0] is not None
    assert steps[0].motion[0, 3] == pytest.approx(1.0)


@given(
    stamps=st.lists(st.integers(0, 60), min_size=2, max_size=12, unique=True),
    frames=st.lists(st.integers(-10, 70), min_size=2, max_size=8, unique=True),
    gap=st.integers(1, 20),
    hold=st.integers(0, 10),
)
def test_covered_steps_are_those_without_an_unbridged_moment(
    stamps: list[int], frames: list[int], gap: int, hold: int
) -> None:
    """Against the definition, moment by moment: every half second of a step must be covered."""
    times, at = np.sort(np.array(stamps, float)), np.sort(np.array(frames, float))

    def moment_covered(t: float) -> bool:
        if t < times[0] or t > times[-1]:
            return bool(min(abs(t - times[0]), abs(t - times[-1])) <= hold)
        return any(a <= t <= b and b - a <= gap for a, b in pairwise(times))

    expected = [
        all(moment_covered(t) for t in np.arange(a + 0.25, b, 0.5)) and at_ends(times, a, b, hold)
        for a, b in pairwise(at)
    ]
    np.testing.assert_array_equal(steps_covered(times, at, gap, hold), expected)


def at_ends(stamps: FloatArray, before: float, after: float, hold: float) -> bool:
    return bool(before >= stamps[0] - hold and after <= stamps[-1] + hold)


def with_speeds(root: Path, frames: int = 6, row: str = "{t:.2f},5.0,0.1,9.9\n") -> Path:
    image_folder(root, frames)
    lines = "".join(row.format(t=0.05 * k) for k in range(-1, 2 * frames + 1))
    (root / "odom_car.csv").write_text("# t, v, yaw rate, more\n" + lines, encoding="utf-8")
    return root


def opened(root: Path, odometry: RecordedOdometrySettings = DEFAULT, **s: object) -> Recording:
    return open_recording(ImageFolderSettings(path=str(root), **s), odometry)  # type: ignore[arg-type]


def test_time_offset_moves_the_log(tmp_path: Path) -> None:
    image_folder(tmp_path)
    rows = "".join(f"{0.05 * k:.2f},{k}.0,0.0\n" for k in range(12))
    (tmp_path / "odom.csv").write_text(rows, encoding="utf-8")
    plain = opened(tmp_path).odometry(3)
    late = opened(tmp_path, RecordedOdometrySettings(time_offset_s=0.1)).odometry(3)
    assert plain is not None
    assert late is not None
    # Speed grows by 20 m/s every second: shifted by 0.1 s the step of 0.1 s is 0.2 m shorter.
    assert plain.motion[0, 3] - late.motion[0, 3] == pytest.approx(0.2)


def test_folder_with_poses_of_the_body(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    poses = curve(11)
    write_tum(root / "odometry.txt", 0.05 * np.arange(11), poses)
    recording = opened(root)
    for i in range(1, 6):
        step = recording.odometry(i)
        assert step is not None
        np.testing.assert_allclose(step.motion, inverse(poses[2 * i - 2]) @ poses[2 * i], atol=1e-7)
        length = np.linalg.norm(step.motion[:3, 3])
        np.testing.assert_allclose(np.diag(step.covariance)[3:], (0.02 * length) ** 2)
        assert np.all(np.diag(step.covariance)[:3] >= np.radians(0.1) ** 2)


def test_poses_are_not_held_beyond_their_ends(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    write_tum(root / "odometry.txt", 0.1 * np.arange(2, 5), curve(3))
    recording = opened(root)
    got = [recording.odometry(i) is not None for i in range(1, 6)]
    assert got == [False, False, True, True, False]


BAD_LOGS = [
    ("0.1,1,0\n0.2,nan,0\n", ["line 3", "v is nan", "not finite"]),
    ("0.1,1,0\n0.2,400,0\n", ["line 3", "400 m/s is absurd", "limit 60"]),
    ("0.1,1,0\n0.2,1,-99\n", ["line 3", "yaw rate", "absurd", "limit 720"]),
    ("0.1,1,0\n0.3,1,0\n0.2,1,0\n", ["line 4", "0.200000", "time order"]),
    ("0.1,1\n", ["line 2", "2 columns, expected 3"]),
    ("0.1,1,0\n0.2,fast,0\n", ["line 3", "'fast'", "not a number"]),
    ("", ["0 samples", "at least 2", "constant_velocity"]),
]


def read(path: Path) -> None:
    source = file_odometry(path, DEFAULT)
    assert source is not None
    source(np.array([0.0, 0.1]))


@pytest.mark.parametrize(("rows", "words"), BAD_LOGS)
def test_bad_speed_log_names_the_line(tmp_path: Path, rows: str, words: list[str]) -> None:
    path = tmp_path / "odom.csv"
    path.write_text("# t, v, w\n" + rows, encoding="utf-8")
    with pytest.raises(OdometryError) as error:
        read(path)
    assert "\n" not in str(error.value)
    for part in [str(path), *words]:
        assert part in str(error.value)


def test_bad_odometry_is_an_error_only_where_it_is_used(tmp_path: Path) -> None:
    root = with_speeds(tmp_path)
    (root / "odom_car.csv").write_text("0,nan,0\n", encoding="utf-8")
    recording = opened(root)
    assert recording.frame(1).images[0].shape == (24, 32)
    with pytest.raises(OdometryError):
        recording.odometry(1)


def test_absurd_pose_names_the_line(tmp_path: Path) -> None:
    poses = curve(5)
    poses[3, :3, 3] += 100.0
    write_tum(tmp_path / "odometry.txt", 0.1 * np.arange(5), poses)
    with pytest.raises(OdometryError, match=r"odometry\.txt, line 5: speed of 17.* absurd"):
        read(tmp_path / "odometry.txt")
    turning = curve(5)
    turning[2, :3, :3] = turning[2, :3, :3] @ np.diag([-1.0, -1.0, 1.0])
    write_tum(tmp_path / "odometry.txt", 0.1 * np.arange(5), turning)
    with pytest.raises(OdometryError, match=r"odometry\.txt, line 4: turn of 1\d{3} degrees/s"):
        read(tmp_path / "odometry.txt")


def test_log_of_another_clock(tmp_path: Path) -> None:
    (image_folder(tmp_path) / "odom_car.csv").write_text("100.0,1,0\n101.0,1,0\n")
    with pytest.raises(OdometryError, match=r"covers none of the frames"):
        opened(tmp_path).odometry(1)


def test_several_files_of_odometry_are_refused(tmp_path: Path) -> None:
    root = with_speeds(tmp_path)
    write_tum(root / "odometry.txt", 0.1 * np.arange(6), curve(6))
    with pytest.raises(
        DatasetError, match=r"several odometry files \(odometry.txt, odom_car.csv\); keep one"
    ):
        opened(root)


# --------------------------------------------------------------------------------------------
# Named columns: every table is the same arc


TIMES = 0.1 * np.arange(11)
SPEED, YAW_RATE = 0.8, 0.5


def table(path: Path, columns: dict[str, Any], separator: str = ",") -> Path:
    rows = np.column_stack(list(columns.values()))
    lines = [separator.join(columns), *(separator.join(f"{x:.12g}" for x in row) for row in rows)]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def step_of(path: Path) -> Odometry:
    """From 0.2 to 0.6 s."""
    source = file_odometry(path, DEFAULT)
    assert source is not None
    found = source(np.array([0.2, 0.6]))[0]
    assert found is not None
    return found


def arc() -> tuple[FloatArray, FloatArray, FloatArray]:
    yaw = YAW_RATE * TIMES
    return SPEED / YAW_RATE * np.sin(yaw), SPEED / YAW_RATE * (1.0 - np.cos(yaw)), yaw


X, Y, YAW = arc()
ONES = np.ones(11)
TABLES: dict[str, dict[str, Any]] = {
    "speeds": {"time": TIMES, "speed": SPEED * ONES, "yaw_rate": YAW_RATE * ONES},
    "speeds as ROS names them, among others": {
        "seq": ONES,
        "twist.angular.z": YAW_RATE * ONES,
        "twist.linear.x": SPEED * ONES,
        "t": TIMES,
    },
    "units in the names": {
        "timestamp_ms": 1e3 * TIMES,
        "v [km/h]": 3.6 * SPEED * ONES,
        "omega (deg/s)": np.degrees(YAW_RATE) * ONES,
    },
    "nanoseconds without a word": {"stamp": 1e9 * TIMES, "vx": SPEED * ONES, "wz": YAW_RATE * ONES},
    "planar poses": {"time": TIMES, "x": X, "y": Y, "theta": YAW},
    "poses": {
        "t": TIMES,
        "x_m": X,
        "y_m": Y,
        "z_m": 0 * X,
        "qx": 0 * X,
        "qy": 0 * X,
        "qz": np.sin(YAW / 2),
        "qw": np.cos(YAW / 2),
    },
}


@pytest.mark.parametrize(
    ("name", "separator"), [*((name, ",") for name in TABLES), ("poses", ";"), ("poses", " ")]
)
def test_every_table_gives_the_same_arc(tmp_path: Path, name: str, separator: str) -> None:
    columns = TABLES[name]
    if separator == " ":
        columns = {key.replace(" ", "_"): value for key, value in columns.items()}
    motion = step_of(table(tmp_path / "odom.csv", columns, separator)).motion
    turn = 0.4 * YAW_RATE
    expected = SPEED / YAW_RATE * np.array([np.sin(turn), 1.0 - np.cos(turn)])
    assert np.allclose(motion[:2, 3], expected, rtol=0.0, atol=2e-6)
    assert np.arctan2(motion[1, 0], motion[0, 0]) == pytest.approx(turn, abs=1e-6)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"time": TIMES, "speed": ONES}, "columns speed, time were understood; name time"),
        ({"speed": ONES, "yaw_rate": ONES}, "no column is named time"),
        ({"time": 0 * TIMES, "v": ONES, "w": ONES}, "line 3: time 0.000000 s does not come after"),
        ({"time": TIMES, "v": ONES, "w": 30 * ONES}, "absurd .* are these degrees"),
    ],
)
def test_bad_tables(tmp_path: Path, columns: dict[str, Any], message: str) -> None:
    with pytest.raises(OdometryError, match=message) as caught:
        step_of(table(tmp_path / "odom.csv", columns))
    assert "\n" not in str(caught.value)


def test_without_names_the_columns_are_time_speed_and_yaw_rate(tmp_path: Path) -> None:
    rows = [f"{t:.3e},{SPEED},{YAW_RATE}" for t in TIMES]
    (tmp_path / "odom.csv").write_text("\n".join(rows), encoding="utf-8")
    motion = step_of(tmp_path / "odom.csv").motion
    assert np.arctan2(motion[1, 0], motion[0, 0]) == pytest.approx(0.4 * YAW_RATE, abs=1e-9)


# --------------------------------------------------------------------------------------------
# Gyroscope


RATE = np.array([0.3, -0.2, 0.5])  # rad/s
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def tumbling(stamps: FloatArray) -> FloatArray:
    """Rates (n, 3) whose axis turns, so that the order of turns counts."""
    return np.column_stack([1.5 * np.sin(3 * stamps), np.cos(2 * stamps), 0.5 + stamps])


def finely(stamps: FloatArray, start: float, end: float, bias: FloatArray) -> FloatArray:
    """The rotation by many small steps of the interpolated rate in their middle."""
    edges = np.linspace(start, end, 4001)
    middle = 0.5 * (edges[1:] + edges[:-1])
    rates = np.column_stack([np.interp(middle, stamps, axis) for axis in tumbling(stamps).T]) - bias
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


def test_integration_is_that_of_many_small_steps() -> None:
    stamps = np.arange(0.0, 1.2, 0.02)
    turned, jacobians = integrate_rates(stamps, tumbling(stamps), np.array([0.103, 0.9]))
    fine = finely(stamps, 0.103, 0.9, np.zeros(3))
    assert rotation_angle(turned[0].T @ fine) < 1e-6, "by the mean rate of two samples 3e-5"
    for axis in np.eye(3):
        moved = so3_log(fine.T @ finely(stamps, 0.103, 0.9, 1e-3 * axis)) / 1e-3
        np.testing.assert_allclose(jacobians[0] @ axis, moved, rtol=0.0, atol=1e-3)


def test_steps_beyond_the_samples_and_over_gaps_are_not_measured() -> None:
    stamps = np.array([0.0, 0.05, 0.1, 0.4, 0.45, 0.5])
    frames = np.array([-0.2, 0.0, 0.1, 0.2, 0.42, 0.5, 0.6])
    steps = gyroscope_motions(stamps, np.tile(RATE, (6, 1)), frames, GyroscopeNoise())
    assert [step is not None for step in steps] == [False, True, False, False, True, False]


def test_noise_grows_with_time_and_turn() -> None:
    stamps, rates = sampled(1.0, np.zeros(3))
    noise = GyroscopeNoise(density=0.01, walk=0.1)
    frames = np.array([0.0, 0.25])
    (step,) = known(gyroscope_motions(stamps, rates, frames, noise))
    assert (step.measured, step.turned) == (False, True)
    np.testing.assert_allclose(step.covariance[:3, :3], 0.25e-4 * np.eye(3), atol=1e-12)
    assert step.covariance[3, 3] >= 100.0  # metres squared: nothing is known of it
    assert step.bias is not None
    assert step.bias.walk == pytest.approx(0.0025)
    (turning,) = known(gyroscope_motions(stamps, rates + RATE, frames, noise))
    assert turning.covariance[0, 0] > step.covariance[0, 0]


def only_step(steps: Steps) -> FloatArray:
    assert steps[0] is not None
    return so3_log(steps[0].motion[:3, :3])


@pytest.mark.parametrize("unit", [1.0, 1e-3, 1e-6, 1e-9])
def test_times_of_rates_are_in_any_unit(tmp_path: Path, unit: float) -> None:
    stamps, rates = sampled(1.0)
    path = tmp_path / "rates.csv"
    rows = np.column_stack([stamps / unit, rates])
    path.write_text("\n".join(",".join(f"{x:.12g}" for x in row) for row in rows))
    table = read_columns(path, "rates")
    np.testing.assert_allclose(table.values[:, 0], stamps, rtol=0.0, atol=1e-9)


def test_degrees_are_refused_by_their_size(tmp_path: Path) -> None:
    stamps, rates = sampled(1.0)
    path = write_rates(tmp_path / "imu.csv", 1e9 * stamps, np.degrees(rates))
    with pytest.raises(OdometryError, match=r"line 2: angular velocity .*are these degrees\?"):
        read(path)


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
    assert "; a gyroscope, no odometry" in found.description
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
    stamps, rates = sampled(1.0)
    rows = [f"{round(1e9 * t)},{x:.9g},{y:.9g},{z:.9g},0" for t, (x, y, z) in
            zip(stamps, rates / unit, strict=True)]  # fmt: skip
    (root / "imu.csv").write_text("\n".join([*([head] if head else []), *rows]))
    step = open_recording(ImageFolderSettings(path=str(root))).odometry(1)
    np.testing.assert_allclose(only_step((step,)), 0.1 * RATE, rtol=0.0, atol=1e-6)


def test_a_bag_turns_by_its_imu(tmp_path: Path) -> None:
    stamps = START_NS + 5_000_000 * np.arange(-20, 100)
    bag = write_bag(tmp_path / "walk.bag", stereo(4) + gyroscope(stamps.tolist(), RATE))
    recording = open_recording(BagSettings(path=str(bag)), DEFAULT)
    np.testing.assert_allclose(only_step((recording.odometry(1),)), 0.1 * RATE, atol=1e-6)
    assert "; a gyroscope, no odometry" in bare_experiment(bag).description


# --------------------------------------------------------------------------------------------
# Synthetic odometry


SETTINGS = SyntheticOdometrySettings()
FRAMES = 300


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = image_folder(tmp_path_factory.mktemp("synthetic"), FRAMES)
    write_tum(root / "gt_right_cam.txt", 0.1 * np.arange(FRAMES), curve(FRAMES))
    return root


def mounted(root: Path, **settings: object) -> Recording:
    mounting = {"lever_arm_m": (0.5, -0.2, 1.0), "camera_yaw_deg": 10.0}
    return open_recording(ImageFolderSettings(path=str(root), **mounting, **settings))  # type: ignore[arg-type]


def synthetic_step(sequence: Recording, i: int) -> Odometry:
    odometry = sequence.odometry(i)
    assert odometry is not None
    return odometry


def whitened_errors(sequence: Recording) -> FloatArray:
    """Whitened error (n, 6) of every step against the truth, in the body's tangent space."""
    truth = sequence.ground_truth
    assert truth is not None
    bTc = sequence.rig.bTc
    out = []
    for i in range(1, len(sequence)):
        given = synthetic_step(sequence, i)
        camera = inverse(truth.poses[i - 1]) @ truth.poses[i]
        body = bTc @ camera @ inverse(bTc)
        xi = se3_log(inverse(body) @ given.motion)
        out.append(xi / np.sqrt(np.diag(given.covariance)))
    return np.array(out)


def test_synthetic_odometry_is_a_sequence_and_noted_as_synthetic(folder: Path) -> None:
    recording = mounted(folder)
    sequence = with_synthetic_odometry(recording, SETTINGS, 3)
    assert (sequence.name, sequence.identity) == (recording.name, recording.identity)
    assert len(sequence) == FRAMES
    np.testing.assert_array_equal(sequence.timestamps, recording.timestamps)
    np.testing.assert_array_equal(sequence.frame(5).images[1], recording.frame(5).images[1])
    assert any("synthetic" in n and "2 %" in n and "1 degrees" in n for n in sequence.notes)


def test_noise_is_the_stated_one(folder: Path) -> None:
    """Sound statistics: each axis' whitened errors are standard normal, uncorrelated."""
    white = whitened_errors(with_synthetic_odometry(mounted(folder), SETTINGS, 11))
    n = len(white)
    low, high = stats.chi2.ppf([0.001, 0.999], n) / n
    power = (white**2).mean(axis=0)
    assert np.all((power > low) & (power < high))
    assert np.all(np.abs(white.mean(axis=0)) < 3.3 / np.sqrt(n))
    correlation = np.corrcoef(white.T) - np.eye(6)
    assert np.abs(correlation).max() < 3.8 / np.sqrt(n)


def test_standard_deviations_follow_the_settings(folder: Path) -> None:
    sequence = with_synthetic_odometry(mounted(folder), SETTINGS, 1)
    truth = sequence.ground_truth
    assert truth is not None
    bTc = sequence.rig.bTc
    body = bTc @ inverse(truth.poses[0]) @ truth.poses[1] @ inverse(bTc)
    sigmas = np.sqrt(np.diag(synthetic_step(sequence, 1).covariance))
    np.testing.assert_allclose(sigmas[:3], np.radians(1.0))
    np.testing.assert_allclose(sigmas[3:], 0.02 * np.linalg.norm(body[:3, 3]))


def test_a_part_of_the_recording_repeats_the_same_noise(folder: Path) -> None:
    whole = with_synthetic_odometry(mounted(folder), SETTINGS, 5)
    part = with_synthetic_odometry(mounted(folder, start=100, stop=200), SETTINGS, 5)
    for i in (1, 50, 99):
        np.testing.assert_array_equal(
            synthetic_step(part, i).motion, synthetic_step(whole, 100 + i).motion
        )


def test_needs_ground_truth(tmp_path: Path) -> None:
    recording = mounted(image_folder(tmp_path))
    with pytest.raises(DatasetError, match=r"no ground truth.*choose recorded") as error:
        with_synthetic_odometry(recording, SETTINGS, 1)
    assert "\n" not in str(error.value)


def test_gap_in_the_truth_leaves_the_step_without_odometry(tmp_path: Path) -> None:
    root = image_folder(tmp_path)
    keep = [0, 1, 4, 5]
    write_tum(root / "gt_right_cam.txt", 0.1 * np.array(keep), curve(6)[keep])
    sequence = with_synthetic_odometry(mounted(root), SETTINGS, 1)
    got = [sequence.odometry(i) is not None for i in range(1, 6)]
    assert got == [True, False, False, False, True]
    assert "2 frames have no ground truth, so no odometry" in sequence.notes
    with pytest.raises(IndexError):
        sequence.odometry(0)


@pytest.mark.parametrize("mark", [".", "/"])
def test_full_names_of_ros_are_known_by_their_last_parts(tmp_path: Path, mark: str) -> None:
    """As `rostopic echo -p` and PlotJuggler write them; linear_acceleration.x is no position."""
    names = ["%time", "field.header.stamp"]
    names += [f"field.pose.pose.position.{axis}" for axis in "xyz"]
    names += [f"field.pose.pose.orientation.{axis}" for axis in "xyzw"]
    names += [
        "field.twist.twist.linear.x",
        "field.twist.twist.angular.z",
        "a.linear_acceleration.x",
    ]
    header = ",".join(name.replace(".", mark) for name in names)
    rows = [f"{10**8 * k},0,{k},0,0,0,0,0,1,0.5,0.1,9" for k in range(3)]
    path = tmp_path / "odom.csv"
    path.write_text("\n".join([header, *rows]), encoding="utf-8")
    table = read_columns(path, "speeds")
    pose_names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    assert table.names == ("time", "time", *pose_names, "speed", "yaw_rate")
    np.testing.assert_allclose(table.values[:, 0], [0.0, 0.1, 0.2], rtol=0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("header", "row"),
    [
        ("header.stamp.sec,header.stamp.nanosec,linear.x,angular.z", "{s},{rest},1,0"),
        ("secs,nsecs,v,w", "{s},{rest},1,0"),
        ("nanoseconds,v,w", "{ns},1,0"),
        ("rosbagTimestamp,Linear Velocity X,Angular Velocity Z", "{ns},1,0"),
        (
            "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],q_RS_w,q_RS_x,q_RS_y,q_RS_z",
            "{ns},0,0,1,0,0,0",
        ),
        ("t_s,p_x_m,p_y_m,yaw_deg", "{t},0,0,0"),
    ],
)
def test_times_in_parts_and_names_of_other_tools(tmp_path: Path, header: str, row: str) -> None:
    given = [1_700_000_000_900_000_000 + k * 100_000_000 for k in range(3)]
    rows = [
        row.format(s=ns // 10**9, rest=ns % 10**9, ns=ns, t=f"{ns // 10**9}.{ns % 10**9:09d}")
        for ns in given
    ]
    path = tmp_path / "odom.csv"
    path.write_text("\n".join([header, *rows]), encoding="utf-8")
    table = read_columns(path, "speeds")
    times = table.values[:, table.names.index("time")]
    np.testing.assert_allclose(times, 1e-9 * np.array(given, np.float64), rtol=0.0, atol=1e-6)
    assert {"x", "speed"} & {*table.names}
