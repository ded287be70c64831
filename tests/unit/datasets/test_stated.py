"""Poses and covariances of other programs' files: what is read, and what is refused with a mend."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bags import PERIOD_NS, START_NS, write_bag
from reports import loop

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError
from fgslam.core.types import Trajectory, pose_rows, write_covariances
from fgslam.datasets.stated import read_stated

COUNT = 12
PATH = loop(COUNT)
ROWS = pose_rows(PATH.poses)
UPPER = np.triu_indices(6)
HALF = np.triu_indices(3)


def covariances(seed: int = 0) -> FloatArray:
    roots = np.random.default_rng(seed).normal(size=(COUNT, 6, 6)) * np.repeat([0.01, 0.1], 3)
    return np.asarray(np.swapaxes(roots, 1, 2) @ roots)


def table(path: Path, *columns: FloatArray, header: str = "", delimiter: str = " ") -> Path:
    """A file of these columns; the times of the loop come first."""
    rows = np.column_stack([PATH.timestamps, *columns])
    np.savetxt(path, rows, fmt="%.12g", header=header, delimiter=delimiter, comments="")
    return path


def blocks(matrices: FloatArray) -> tuple[FloatArray, FloatArray]:
    first, second = matrices[:, :3, :3], matrices[:, 3:, 3:]
    return first[:, HALF[0], HALF[1]], second[:, HALF[0], HALF[1]]


@pytest.mark.parametrize(
    ("header", "delimiter", "words"),
    [
        (
            "# timestamp(s) tx ty tz qx qy qz qw Pr11 Pr12 Pr13 Pr22 Pr23 Pr33 Pt11 Pt12 Pt13 Pt22",
            " ",
            {"rotation_first", "split_local", "radians"},
        ),
        (
            "#t,tx,ty,tz,qx,qy,qz,qw,pxx,pxy,pxz,pyy,pyz,pzz,qrr,qrp,qry,qpp,qpy,qyy,type1,theta_R",
            ",",
            {"translation_first", "local", "radians"},
        ),
        ("", " ", set()),
    ],
)
def test_blocks_after_the_pose_are_read_with_what_their_header_states(
    tmp_path: Path, header: str, delimiter: str, words: set[str]
) -> None:
    """OpenVINS' recorder and cnspy's PosOrientWithCov; a row alone states no order."""
    known = covariances()
    file = table(tmp_path / "a.txt", ROWS, *blocks(known), header=header, delimiter=delimiter)
    found = read_stated(file)
    np.testing.assert_allclose(found.trajectory.poses, PATH.poses, atol=1e-9)
    assert found.words == words
    assert found.covariances is not None
    np.testing.assert_allclose(found.covariances[:, :3, :3], known[:, :3, :3], atol=1e-9)
    np.testing.assert_allclose(found.covariances[:, 3:, 3:], known[:, 3:, 3:], atol=1e-9)
    assert not found.covariances[:, :3, 3:].any()


def test_a_whole_matrix_and_its_upper_triangle_are_the_same(tmp_path: Path) -> None:
    known = covariances()
    whole = table(tmp_path / "a.txt", ROWS, known.reshape(-1, 36))
    upper = table(tmp_path / "b.txt", ROWS, known[:, UPPER[0], UPPER[1]])
    apart = table(tmp_path / "c.txt", ROWS)
    alone = tmp_path / "d.txt"
    np.savetxt(alone, known.reshape(-1, 36))
    for found in (read_stated(whole), read_stated(upper), read_stated(apart, alone)):
        assert found.covariances is not None
        np.testing.assert_allclose(found.covariances, known, atol=1e-10)


def test_euroc_s_tables_have_nanoseconds_and_w_first(tmp_path: Path) -> None:
    PATH.save(tmp_path / "a.csv")
    plain = tmp_path / "plain.csv"
    plain.write_text(
        "".join(
            line + "\n" for line in (tmp_path / "a.csv").read_text().splitlines() if line[0] != "#"
        )
    )
    for file in (tmp_path / "a.csv", plain):
        found = read_stated(file)
        np.testing.assert_allclose(found.trajectory.timestamps, PATH.timestamps, atol=1e-6)
        np.testing.assert_allclose(found.trajectory.poses, PATH.poses, atol=1e-9)
        assert found.covariances is None
        assert "nanoseconds" in found.notes[0]


def test_covariances_of_another_file_go_to_the_poses_of_their_times(tmp_path: Path) -> None:
    """Our own covariance.csv, which states all; one row is lacking."""
    known, kept = covariances(), np.arange(COUNT) != 3
    PATH.save(tmp_path / "final.tum")
    some = Trajectory(PATH.timestamps[kept], PATH.poses[kept])
    write_covariances(tmp_path / "covariance.csv", some, known[kept])
    found = read_stated(tmp_path / "final.tum", tmp_path / "covariance.csv")
    assert found.words == {"rotation_first", "local", "radians"}
    assert found.frame_stated
    assert found.covariances is not None
    np.testing.assert_allclose(found.covariances[kept], known[kept], atol=1e-8)
    assert np.isnan(found.covariances[3]).all()


@pytest.mark.parametrize("name", ["a.bag", "a"])
def test_a_topic_of_a_bag_states_translation_first(tmp_path: Path, name: str) -> None:
    known = covariances()
    held = bag(tmp_path / name, known)
    with pytest.raises(DatasetError, match=r"2 topics of poses; give one of .*:/odom, .*:/truth"):
        read_stated(bag(tmp_path / f"two{name}", known, second="/truth"))
    found = read_stated(f"{held}:/odom")
    assert found.words == {"translation_first", "radians"}
    np.testing.assert_allclose(found.trajectory.poses, PATH.poses, atol=1e-9)
    np.testing.assert_array_equal(found.covariances, known)


def bag(path: Path, known: FloatArray, second: str = "") -> Path:
    kinds = {"/odom": "nav_msgs/msg/Odometry"}
    if second:
        kinds[second] = "geometry_msgs/msg/PoseWithCovarianceStamped"
    return write_bag(
        path,
        [
            (topic, START_NS + k * PERIOD_NS, kind, {"pose": row, "covariance": known[k].ravel()})
            for k, row in enumerate(ROWS.tolist())
            for topic, kind in kinds.items()
        ],
    )


def spoilt(values: FloatArray, at: tuple[int, int], value: float) -> FloatArray:
    out = values.copy()
    out[at] = value
    return out


WHOLE = covariances().reshape(-1, 36)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ((ROWS, WHOLE[:, :20]), "28 numbers in a row; give timestamp tx ty tz qx qy qz qw"),
        ((ROWS[:, :6],), "7 numbers in a row"),
        ((ROWS, 0.0 * WHOLE), "all its covariances are zero"),
        ((ROWS, spoilt(WHOLE, (4, 0), -1.0)), "line 5: the covariance is not positive definite"),
        ((ROWS, spoilt(WHOLE, (4, 1), 9.0)), "line 5: the covariance is not symmetric"),
        ((2.0 * ROWS,), "the quaternion has length 2"),
        ((spoilt(ROWS, (3, 0), np.nan),), "line 4: a pose is not finite"),
        ((spoilt(ROWS, (0, 0), np.nan),), "line 1: a pose is not finite"),
    ],
)
def test_what_cannot_be_read_is_named_with_its_line(
    tmp_path: Path, columns: tuple[FloatArray, ...], message: str
) -> None:
    with pytest.raises(DatasetError, match=message):
        read_stated(table(tmp_path / "a.txt", *columns))


def test_an_indefinite_covariance_is_named_and_can_be_left_out_as_told(tmp_path: Path) -> None:
    bad = WHOLE.reshape(-1, 6, 6).copy()
    bad[2, 0, 1] = bad[2, 1, 0] = 2.0 * np.sqrt(bad[2, 0, 0] * bad[2, 1, 1])
    file = table(tmp_path / "a.txt", ROWS, bad.reshape(-1, 36))
    with pytest.raises(DatasetError, match="line 3: the covariance is not positive definite, nor"):
        read_stated(file)
    bad[2] = np.nan
    found = read_stated(table(tmp_path / "a.txt", ROWS, bad.reshape(-1, 36))).covariances
    assert found is not None
    assert np.isfinite(found).all(axis=(1, 2)).sum() == COUNT - 1


def test_files_that_do_not_belong_together_are_refused(tmp_path: Path) -> None:
    poses, short, late = table(tmp_path / "a.txt", ROWS), tmp_path / "b.txt", tmp_path / "c.txt"
    np.savetxt(short, WHOLE[1:])
    np.savetxt(late, np.column_stack([PATH.timestamps + 1000.0, WHOLE]))
    with pytest.raises(DatasetError, match="11 rows without times for the 12 poses of"):
        read_stated(poses, short)
    with pytest.raises(DatasetError, match="no time is the same; write the poses' times"):
        read_stated(poses, late)
