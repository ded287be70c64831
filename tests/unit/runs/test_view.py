"""What is sent to the viewer; films: what is read of a followed route, and how fast they run."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError, DatasetError
from fgslam.core.geometry import rotation_from_quaternion
from fgslam.core.sensors import Increment, Observations, moved_pixels
from fgslam.core.types import LandmarkMap
from fgslam.runs.view import (
    ChangedBlocks,
    Row,
    command_text,
    follow_rows,
    half_axes,
    median_step,
    seen_pixels,
)


def landmarks(ids: list[int], positions: FloatArray) -> LandmarkMap:
    return LandmarkMap(np.array(ids, np.int64), positions, np.tile(np.eye(3), (len(ids), 1, 1)))


def increment(ids: list[int], new: list[bool], rejected: list[bool]) -> Increment:
    """Landmark k is seen by the right camera at (10 k, k), and at (10 k + 5, k) by the left one."""
    column, row = 10.0 * np.array(ids), 1.0 * np.array(ids)
    nothing = np.full(len(ids), np.nan)
    pixels = np.stack([[column, row], [column + 5.0, row], [nothing, nothing]]).transpose(2, 0, 1)
    measured = np.column_stack([column, row, np.full(len(ids), 5.0)])
    covariances = np.tile(np.eye(3), (len(ids), 1, 1))
    seen = Observations(np.array(ids), measured, covariances, pixels, np.array(new))
    none = np.empty(0, np.int64)
    return Increment(0, 0.0, None, seen, np.array(rejected), none, none)


def test_only_blocks_that_changed_are_sent_again() -> None:
    """Identities 5 and 9 share a block, 2000 and 2001 another, 5000 is alone."""
    blocks, positions = ChangedBlocks(), np.arange(15.0).reshape(5, 3)
    first = landmarks([5, 9, 2000, 2001, 5000], positions)
    sent = dict(blocks.of(first))
    assert list(sent) == [0, 1, 4]
    assert_array_equal(np.concatenate(list(sent.values())), positions)
    assert not list(blocks.of(first))
    assert not list(blocks.of(landmarks([5, 9, 2000, 2001, 5000], positions + 1e-6)))
    moved = positions.copy()
    moved[3, 1] += 0.01
    ((number, places),) = blocks.of(landmarks([5, 9, 2000, 2001, 5000], moved))
    assert number == 1
    assert_array_equal(places, moved[2:4])
    ((number, places),) = blocks.of(landmarks([5, 9, 2000, 2001], moved[:4]))
    assert (number, len(places)) == (4, 0)


def test_small_motions_add_up_to_one_that_is_sent() -> None:
    blocks, position = ChangedBlocks(), np.zeros((1, 3))
    sent = [len(list(blocks.of(landmarks([1], position + 4e-4 * k)))) for k in range(7)]
    assert sent == [1, 0, 0, 1, 0, 0, 1]


def test_a_map_without_landmarks_sends_nothing() -> None:
    assert not list(ChangedBlocks().of(landmarks([], np.empty((0, 3)))))


def test_colours_tell_matched_new_and_rejected_apart() -> None:
    frame = increment([1, 2, 3], [False, True, False], [False, False, True])
    pixels, colours = seen_pixels(frame, 1)
    assert_array_equal(pixels, [[15.0, 1.0], [25.0, 2.0], [35.0, 3.0]])
    assert len({tuple(colour) for colour in colours.tolist()}) == 3
    top, none = seen_pixels(frame, 2)  # a camera that is not there
    assert (top.shape, none.shape) == ((0, 2), (0, 3))


def test_ways_are_those_of_landmarks_that_both_frames_kept() -> None:
    earlier = increment([1, 2, 3], [True, True, True], [False, False, False])
    now = increment([2, 3, 4], [False, False, True], [False, True, False])
    before, after = moved_pixels(earlier, now)
    assert_array_equal(before, [[20.0, 2.0]])
    assert_array_equal(after, [[20.0, 2.0]])
    assert moved_pixels(None, now)[0].shape == (0, 2)


def test_half_axes_rebuild_the_covariance() -> None:
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(20, 3, 3))
    covariances = roots @ roots.transpose(0, 2, 1)
    half, turns = half_axes(covariances)
    for k in range(20):
        axes = rotation_from_quaternion(turns[k])
        rebuilt = axes @ np.diag((half[k] / 3.0) ** 2) @ axes.T
        np.testing.assert_allclose(rebuilt, covariances[k], rtol=0, atol=1e-9)
    assert [part.shape for part in half_axes(np.empty((0, 3, 3)))] == [(0, 3), (0, 4)]


# --------------------------------------------------------------------------------------------
# Films

ROW = {
    "image": "3",
    "name": "view_3.png",
    "time_s": "1700000000.250000000",
    "path_image": "2",
    "path_image_name": "taught_2.png",
    "probability": "0.9",
    "target": "3",
    "direction_deg": "12.5",
    "sigma_direction_deg": "2",
    "inliers": "41",
    "v_mps": "0.3",
    "omega_deg_s": "-4",
    "state": "driving",
    "refusal": "",
    "to_target_m": "",
}


READ = ROW | {
    "image": 3.0,
    "time_s": 1700000000.25,
    "path_image": 2.0,
    "probability": 0.9,
    "target": 3.0,
    "direction_deg": 12.5,
    "sigma_direction_deg": 2.0,
    "v_mps": 0.3,
    "omega_deg_s": -4.0,
    "to_target_m": 8.0,
}


def table(path: Path, row: Row) -> Path:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(row))
        writer.writeheader()
        writer.writerows([row, row])
    return path


def test_a_whole_follow_csv_is_read(tmp_path: Path) -> None:
    assert follow_rows(table(tmp_path / "follow.csv", ROW | {"to_target_m": "8"})) == [READ, READ]
    (row, _) = follow_rows(table(tmp_path / "follow.csv", ROW))
    assert np.isnan(row["to_target_m"])


@pytest.mark.parametrize(
    ("column", "text"),
    [("time_s", "12:30"), ("time_s", ""), ("time_s", "nan"), ("image", "1.5"), ("target", "x"),
     ("direction_deg", "1\n2"), ("v_mps", "inf"), ("to_target_m", "y" * 500)],
)  # fmt: skip
def test_a_damaged_cell_of_follow_csv_is_named_in_one_line(
    column: str, text: str, tmp_path: Path
) -> None:
    with pytest.raises(DatasetError, match=rf"line 2: {column} is '.*not a number") as caught:
        follow_rows(table(tmp_path / "follow.csv", ROW | {column: text}))
    assert str(caught.value).endswith("; follow the route again")
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("column", ["state", "target", "path_image_name", "inliers", "v_mps"])
def test_a_column_that_follow_csv_lacks_is_named(column: str, tmp_path: Path) -> None:
    rest = {name: text for name, text in ROW.items() if name != column}
    with pytest.raises(DatasetError, match=f"follow.csv: lacks column {column}; follow the route"):
        follow_rows(table(tmp_path / "follow.csv", rest))


@pytest.mark.parametrize(
    ("turn", "said"),
    [(4.0, "4 degrees/s, left"), (-4.0, "4 degrees/s, right"), (0.0, "0 degrees/s"),
     (-0.2, "0 degrees/s")],
)  # fmt: skip
def test_a_turn_has_a_side_unless_it_is_zero(turn: float, said: str) -> None:
    assert f"omega {said}" in command_text(READ | {"omega_deg_s": turn}).splitlines()


def test_a_film_runs_by_the_median_step_of_the_recording() -> None:
    where = Path("run")
    epoch = 1.7e9 + np.array([0.25, 0.35, 0.45])
    assert median_step(epoch, "images", where) == pytest.approx(0.1, abs=1e-5)
    with pytest.raises(ConfigError, match="a film needs two at least"):
        median_step(np.zeros(1), "images", where)


@pytest.mark.parametrize("times", [[5.0, 5.0, 5.0], [3.0, 2.0, 1.0], [0.0, 0.0, 0.0, 1.0]])
def test_times_that_stand_still_give_no_rate(times: list[float]) -> None:
    with pytest.raises(DatasetError, match="run: the times of its images do not increase"):
        median_step(np.array(times), "images", Path("run"))
