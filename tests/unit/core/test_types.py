"""TUM, KITTI and covariance files: exact there and back, readable by evo, clear when broken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fgslam.core.errors import ConfigError, DatasetError, OutputError
from fgslam.core.geometry import inverse, se3_exp
from fgslam.core.sensors import CameraRig, PoseFrame
from fgslam.core.types import (
    Estimate,
    LandmarkMap,
    Trajectory,
    read_covariances,
    write_covariances,
)
from fgslam.evaluation.statistics import pose_nees


def trajectory(seed: int = 1, n: int = 50) -> Trajectory:
    rng = np.random.default_rng(seed)
    xi = rng.normal(size=(n, 6)) * [2.0, 2.0, 2.0, 30.0, 3.0, 30.0]
    return Trajectory(1.5e9 + np.cumsum(rng.uniform(0.01, 1, n)), np.array([*map(se3_exp, xi)]))


def test_tum_file_round_trip_keeps_the_poses(tmp_path: Path) -> None:
    written = trajectory()
    written.save(tmp_path / "a.tum")
    read = Trajectory.load(tmp_path / "a.tum")
    np.testing.assert_array_equal(read.timestamps, written.timestamps)
    np.testing.assert_allclose(read.poses, written.poses, atol=2e-12)


def test_tum_lines_are_in_the_formats_order(tmp_path: Path) -> None:
    turn = se3_exp(np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0]))
    turn[:3, 3] = [1.0, -2.0, 3.5]
    Trajectory(np.array([1403715273.262142976]), turn[None]).save(tmp_path / "a.tum")
    named, line = (tmp_path / "a.tum").read_text().splitlines()
    assert named == "# wTc: pose of the right camera"
    fields = line.split()
    assert fields[0] == "1403715273.262142897"  # the nearest double, nine decimals
    half = np.sqrt(0.5)
    np.testing.assert_allclose(np.array(fields[1:], float), [1, -2, 3.5, 0, half, 0, half])


def test_tum_has_no_negative_zeros_and_no_negative_w(tmp_path: Path) -> None:
    poses = np.array([se3_exp(np.array([0, 0, angle, -1e-15, 0, 0])) for angle in (-3.0, 0, 3.0)])
    Trajectory(np.arange(3.0), poses).save(tmp_path / "a.tum")
    text = (tmp_path / "a.tum").read_text()
    assert "-0.000000000000" not in text
    assert (np.loadtxt(tmp_path / "a.tum")[:, 7] >= 0).all()


def test_evo_reads_both(tmp_path: Path) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface", reason="evo is not installed")
    written = trajectory()
    written.save(tmp_path / "a.tum")
    written.save(tmp_path / "a.kitti")
    tum = file_interface.read_tum_trajectory_file(str(tmp_path / "a.tum"))
    kitti = file_interface.read_kitti_poses_file(str(tmp_path / "a.kitti"))
    assert tum.check()[0]
    assert kitti.check()[0]
    np.testing.assert_array_equal(tum.timestamps, written.timestamps)
    np.testing.assert_allclose(np.array(tum.poses_se3), written.poses, atol=2e-12)
    np.testing.assert_allclose(np.array(kitti.poses_se3), written.poses, atol=1e-10)


def test_the_suffix_chooses_the_format_in_any_case(tmp_path: Path) -> None:
    for suffix in ("tum", "kitti", "csv"):
        trajectory().save(tmp_path / f"a.{suffix}")
        trajectory().save(tmp_path / f"b.{suffix.upper()}")
        written = (tmp_path / f"a.{suffix}").read_bytes()
        assert (tmp_path / f"b.{suffix.upper()}").read_bytes() == written
    with pytest.raises(OutputError, match=r"use \.tum, \.kitti or \.csv"):
        trajectory().save(tmp_path / "a.txt")


def test_empty_trajectory(tmp_path: Path) -> None:
    Trajectory(np.empty(0), np.empty((0, 4, 4))).save(tmp_path / "a.tum")
    assert len(Trajectory.load(tmp_path / "a.tum")) == 0


def test_comments_blank_lines_and_windows_line_ends_are_accepted(tmp_path: Path) -> None:
    (tmp_path / "a.tum").write_bytes(
        b"# timestamp tx ty tz qx qy qz qw\r\n\r\n1 0 0 0 0 0 0 2  # not of unit length\r\n"
    )
    read = Trajectory.load(tmp_path / "a.tum")
    np.testing.assert_allclose(read.poses[0], np.eye(4))


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("2 0 0 0 0 0 0", "7 numbers instead of 8"),
        ("2 0 0 zero 0 0 0 1", "zero"),
        ("2 0 0 nan 0 0 0 1", "not finite"),
        ("1e999 0 0 0 0 0 0 1\n1e999 0 0 0 0 0 0 1", "not finite"),
        ("2 0 0 0 0 0 0 0", "quaternion"),
        ("1 0 0 0 0 0 0 1", "does not increase"),
    ],
)
def test_broken_tum_lines_are_named(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "a.tum"
    path.write_text(f"# header\n1 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(DatasetError, match=words) as caught:
        Trajectory.load(path)
    assert f"{path}, line 3" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_and_binary_files(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="No such file"):
        Trajectory.load(tmp_path / "absent.tum")
    (tmp_path / "image.tum").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(DatasetError, match="it is not text"):
        Trajectory.load(tmp_path / "image.tum")


@pytest.mark.parametrize("name", ["a.tum", "a.kitti"])
def test_poses_that_are_not_finite_are_refused(tmp_path: Path, name: str) -> None:
    poses = trajectory().poses.copy()
    poses[7, 0, 3] = np.inf
    with pytest.raises(OutputError, match="pose 7"):
        Trajectory(trajectory().timestamps, poses).save(tmp_path / name)
    assert not (tmp_path / name).exists()


def test_covariances_there_and_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(20, 6, 6))
    covariances = root @ np.swapaxes(root, 1, 2) * 1e-4
    covariances[4] = np.nan
    times = 0.5 * np.arange(20)
    path = tmp_path / "covariance.csv"
    write_covariances(path, Trajectory(times, np.tile(np.eye(4), (20, 1, 1))), covariances)
    read_times, read = read_covariances(path)
    np.testing.assert_array_equal(read_times, times)
    np.testing.assert_allclose(read, covariances, rtol=1e-9)

    comment, names, first = path.read_text().splitlines()[:3]
    assert "rotation, translation" in comment
    assert "frame of the right camera" in comment
    columns = names.split(",")
    assert columns[:3] == ["timestamp", "c_rx_rx", "c_rx_ry"]
    assert columns[-1] == "c_tz_tz"
    values = dict(zip(columns, map(float, first.split(",")), strict=True))
    assert values["c_rz_ty"] == pytest.approx(covariances[0, 2, 4])


def test_broken_covariance_file(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("timestamp,c\n")
    with pytest.raises(DatasetError, match="line 1"):
        read_covariances(tmp_path / "a.txt")


# ------------------------------------------------------------------------------------------
# What the poses are of

RIG = CameraRig(
    *(320, 240, 277.0, 277.0, 159.5, 119.5, 0.1, None),
    se3_exp(np.array([0.4, -0.3, 1.2, 0.1, 0.2, 0.3])),
)


def test_the_left_camera_is_a_baseline_to_the_left_of_the_right_one() -> None:
    right = trajectory()
    left = right.of("left", RIG)
    np.testing.assert_allclose(left.poses[:, :3, :3], right.poses[:, :3, :3], atol=1e-12)
    seen = np.array([(inverse(r) @ p)[:3, 3] for r, p in zip(right.poses, left.poses, strict=True)])
    np.testing.assert_allclose(seen, np.tile([-0.1, 0.0, 0.0], (50, 1)), atol=1e-12)


def test_the_body_carries_the_camera() -> None:
    body = trajectory().of("body", RIG)
    np.testing.assert_allclose(body.poses @ RIG.bTc, trajectory().poses, atol=1e-12)


@pytest.mark.parametrize("frame", ["left", "right", "body"])
def test_frames_are_named_in_files_and_lead_back(tmp_path: Path, frame: PoseFrame) -> None:
    moved = trajectory().of(frame, RIG)
    moved.save(tmp_path / "a.tum", "a remark")
    read = Trajectory.load(tmp_path / "a.tum")
    assert read.frame == frame
    symbol = {"left": "wTl", "right": "wTc", "body": "wTb"}[frame]
    assert f"# {symbol}: pose of the {frame}" in (tmp_path / "a.tum").read_text()
    np.testing.assert_allclose(read.of("right", RIG).poses, trajectory().poses, atol=1e-10)
    moved.save(tmp_path / "a.csv")
    assert f"# {symbol}: pose of the" in (tmp_path / "a.csv").read_text()
    write_covariances(tmp_path / "c.csv", moved, np.tile(np.eye(6), (50, 1, 1)))
    assert f"covariance of xi in {symbol} = " in (tmp_path / "c.csv").read_text()
    np.testing.assert_array_equal(read_covariances(tmp_path / "c.csv")[1][3], np.eye(6))


def test_covariances_of_another_frame_state_the_same_errors(rng: np.random.Generator) -> None:
    """The error squared, weighed by its covariance, is that of the right camera."""
    right, root = trajectory(), rng.normal(size=(50, 6, 6))
    covariances = root @ np.swapaxes(root, 1, 2)
    nothing = LandmarkMap(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))
    estimate = Estimate(right, covariances, nothing)
    noise = rng.normal(scale=0.1, size=(50, 6))
    truth = Trajectory(right.timestamps, right.poses @ np.array([*map(se3_exp, noise)]))
    expected = pose_nees(right.poses, covariances, truth.poses).values
    for frame in ("left", "body"):
        moved = estimate.of(frame, RIG)
        true = truth.of(frame, RIG).poses
        found = pose_nees(moved.trajectory.poses, moved.covariances, true).values
        np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_no_other_frame_is_known() -> None:
    with pytest.raises(ConfigError, match="no frame 'top'; use one of left, right, body"):
        trajectory().of("top", RIG)  # type: ignore[arg-type]
