from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from dataset_builders import curve, image_folder, write_tum
from hypothesis import given
from hypothesis import strategies as st

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError, OdometryError
from fgslam.core.geometry import inverse
from fgslam.core.sensors import Odometry
from fgslam.datasets.odometry import (
    SpeedLog,
    file_odometry,
    motions_from_speed,
    steps_covered,
)
from fgslam.datasets.opening import open_recording
from fgslam.datasets.recording import Recording
from fgslam.datasets.settings import ImageFolderSettings, RecordedOdometrySettings

DEFAULT = RecordedOdometrySettings()


def speed_log(stamps: FloatArray, speed: float, rate: float) -> SpeedLog:
    return SpeedLog(stamps, np.full(len(stamps), speed), np.full(len(stamps), rate))


def known(steps: tuple[Odometry | None, ...]) -> list[Odometry]:
    assert all(step is not None for step in steps)
    return [step for step in steps if step is not None]


@pytest.mark.parametrize("rate", [0.0, 1e-9, 0.7, -0.3])
def test_constant_speed_and_turn_give_the_exact_arc(rate: float) -> None:
    log = speed_log(np.linspace(0.0, 2.0, 9), 3.0, rate)
    (step,) = known(motions_from_speed(log, np.array([0.3, 1.7]), DEFAULT))
    angle, length = 1.4 * rate, 1.4 * 3.0
    radius = length / angle if abs(angle) > 1e-6 else None
    expected = [radius * np.sin(angle), radius * (1 - np.cos(angle))] if radius else [length, 0.0]
    np.testing.assert_allclose(step.motion[:2, 3], expected, atol=1e-8)
    np.testing.assert_allclose(step.motion[:2, 0], [np.cos(angle), np.sin(angle)], atol=1e-12)
    np.testing.assert_array_equal(step.motion[2], [0.0, 0.0, 1.0, 0.0])


def test_linear_speed_between_samples_is_integrated_exactly() -> None:
    log = SpeedLog(np.array([0.0, 1.0, 3.0]), np.array([1.0, 2.0, 0.0]), np.zeros(3))
    (step,) = known(
        motions_from_speed(log, np.array([0.5, 2.0]), RecordedOdometrySettings(max_gap_s=5.0))
    )
    # From 1.5 to 2 m/s in half a second, then from 2 to 1 m/s in one second.
    np.testing.assert_allclose(step.motion[:3, 3], [0.875 + 1.5, 0.0, 0.0], atol=1e-12)


@given(
    seed=st.integers(0, 1000),
    cuts=st.lists(st.floats(0.01, 4.99), min_size=1, max_size=6, unique=True),
)
def test_motions_compose_whatever_frames_are_chosen(seed: int, cuts: list[float]) -> None:
    rng = np.random.default_rng(seed)
    stamps = np.sort(rng.uniform(0.0, 5.0, 60))
    stamps[[0, -1]] = [0.0, 5.0]
    log = SpeedLog(stamps, rng.uniform(0, 9, 60), rng.uniform(-0.6, 0.6, 60))
    frames = np.array([0.0, *sorted(cuts), 5.0])
    wide = RecordedOdometrySettings(max_gap_s=5.0)
    composed = np.eye(4)
    for step in known(motions_from_speed(log, frames, wide)):
        composed = composed @ step.motion
    (whole,) = known(motions_from_speed(log, frames[[0, -1]], wide))
    np.testing.assert_allclose(composed, whole.motion, atol=1e-9)


def test_covariance_is_the_stated_noise_times_the_duration() -> None:
    noise = RecordedOdometrySettings(
        speed_sigma_mps=0.1,
        yaw_rate_sigma_dps=3.0,
    )
    log = speed_log(np.linspace(0.0, 2.0, 9), 3.0, 0.1)
    (step,) = known(motions_from_speed(log, np.array([0.5, 0.75]), noise))
    sigmas = 0.25 * np.array([*np.radians([1.3, 1.9, 3.0]), 0.1, 0.08, 0.12])
    np.testing.assert_allclose(step.covariance, np.diag(sigmas**2), rtol=1e-9)


def test_gaps_leave_steps_without_odometry_and_ends_are_held() -> None:
    stamps = np.array([0.2, 0.4, 0.6, 2.0, 2.2, 2.4])
    frames = np.array([0.0, 0.5, 1.0, 1.5, 2.1, 2.6, 3.2])
    expected = [True, False, False, False, True, False]
    np.testing.assert_array_equal(steps_covered(stamps, frames, 0.5, 0.5), expected)
    log = speed_log(stamps, 2.0, 0.0)
    steps = motions_from_speed(log, frames, DEFAULT)
    assert [step is not None for step in steps] == expected
    assert steps[0] is not None
    assert steps[0].motion[0, 3] == pytest.approx(1.0)


def test_gap_wholly_inside_one_step() -> None:
    stamps = np.array([0.0, 0.1, 0.9, 1.0])
    np.testing.assert_array_equal(steps_covered(stamps, np.array([0.05, 0.95]), 0.5, 0.5), [False])
    np.testing.assert_array_equal(steps_covered(stamps, np.array([0.05, 0.95]), 0.8, 0.5), [True])


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


def test_folder_with_speed_and_yaw_rate(tmp_path: Path) -> None:
    recording = opened(with_speeds(tmp_path), stride=2)
    step = recording.odometry(1)
    assert step is not None
    assert np.linalg.norm(step.motion[:3, 3]) == pytest.approx(1.0, rel=1e-4)
    assert np.arctan2(step.motion[1, 0], step.motion[0, 0]) == pytest.approx(0.02)


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
    ("0.1,1,0\n0.2,nan,0\n", ["line 3", "forward speed is nan", "not finite"]),
    ("0.1,1,0\n0.2,1,inf\n", ["line 3", "yaw rate is inf", "not finite"]),
    ("0.1,1,0\n0.2,400,0\n", ["line 3", "400 m/s is absurd", "limit 60"]),
    ("0.1,1,0\n0.2,1,-99\n", ["line 3", "yaw rate", "absurd", "limit 720"]),
    ("0.1,1,0\n0.3,1,0\n0.2,1,0\n", ["line 4", "0.200000", "time order"]),
    ("0.1,1,0\n0.1,1,0\n", ["line 3", "duplicates"]),
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
    root = with_speeds(tmp_path, row="{t:.2f},5.0,0.1\n")
    path = root / "odom_car.csv"
    path.write_text("100.0,1,0\n101.0,1,0\n", encoding="utf-8")
    with pytest.raises(OdometryError, match=r"covers none of the frames .* one clock"):
        opened(root).odometry(1)


def test_ambiguous_and_absent_odometry_files(tmp_path: Path) -> None:
    root = with_speeds(tmp_path)
    with pytest.raises(DatasetError, match=r"odometry_file .*lost.csv does not exist"):
        opened(root, odometry_file="lost.csv")
    write_tum(root / "odometry.txt", 0.1 * np.arange(6), curve(6))
    with pytest.raises(
        DatasetError, match=r"several odometry files \(odometry.txt, odom_car.csv\)"
    ):
        opened(root)
    assert opened(root, odometry_file="odom_car.csv").odometry(1) is not None
