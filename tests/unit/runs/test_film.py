"""What a film of a followed route reads from follow.csv, and how fast it runs."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from fgslam.core.errors import ConfigError, DatasetError
from fgslam.runs.view import Row, command_text, follow_rows, frame_rate

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


def test_a_whole_table_is_read(tmp_path: Path) -> None:
    assert follow_rows(table(tmp_path / "follow.csv", ROW | {"to_target_m": "8"})) == [READ, READ]
    (row, _) = follow_rows(table(tmp_path / "follow.csv", ROW))
    assert np.isnan(row["to_target_m"])


@pytest.mark.parametrize("column", ["state", "target", "path_image_name", "inliers", "v_mps"])
def test_a_missing_column_is_named(column: str, tmp_path: Path) -> None:
    rest = {name: text for name, text in ROW.items() if name != column}
    with pytest.raises(DatasetError, match=f"follow.csv: lacks column {column}; follow the route"):
        follow_rows(table(tmp_path / "follow.csv", rest))


@pytest.mark.parametrize(
    ("column", "text"),
    [("time_s", "12:30"), ("time_s", ""), ("time_s", "nan"), ("image", "1.5"), ("target", "x"),
     ("direction_deg", "1\n2"), ("v_mps", "inf"), ("to_target_m", "y" * 500)],
)  # fmt: skip
def test_a_damaged_cell_is_named_in_one_line(column: str, text: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=rf"line 2: {column} is '.*not a number") as caught:
        follow_rows(table(tmp_path / "follow.csv", ROW | {column: text}))
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 300


def test_a_line_that_breaks_off_is_named(tmp_path: Path) -> None:
    path = table(tmp_path / "follow.csv", ROW)
    whole = path.read_text(encoding="utf-8")
    path.write_text(whole[: whole.rindex(",41")], encoding="utf-8")
    with pytest.raises(DatasetError, match="line 3: ends before column v_mps"):
        follow_rows(path)


@pytest.mark.parametrize(
    ("turn", "said"),
    [(4.0, "4 degrees/s, left"), (-4.0, "4 degrees/s, right"), (0.0, "0 degrees/s"),
     (-0.2, "0 degrees/s")],
)  # fmt: skip
def test_a_turn_has_a_side_unless_it_is_zero(turn: float, said: str) -> None:
    assert f"omega {said}" in command_text(READ | {"omega_deg_s": turn}).splitlines()


def test_a_film_runs_as_fast_as_the_recording_and_at_most_30_frames_a_second() -> None:
    where = Path("run")
    epoch = 1.7e9 + np.array([0.25, 0.35, 0.45])
    assert frame_rate(epoch, "images", where) == pytest.approx(10.0, abs=1e-4)
    assert frame_rate(np.arange(3) / 200.0, "images", where) == 30.0


@pytest.mark.parametrize("times", [[5.0, 5.0, 5.0], [3.0, 2.0, 1.0], [0.0, 0.0, 0.0, 1.0]])
def test_times_that_stand_still_give_no_rate(times: list[float]) -> None:
    with pytest.raises(DatasetError, match="run: the times of its images do not increase"):
        frame_rate(np.array(times), "images", Path("run"))


def test_one_image_is_no_film() -> None:
    with pytest.raises(ConfigError, match="a film needs two at least"):
        frame_rate(np.zeros(1), "images", Path("run"))
