"""Tables of odometry with named columns, against arcs worked out by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgslam.core.errors import OdometryError
from fgslam.core.sensors import Odometry
from fgslam.datasets.odometry import file_odometry
from fgslam.datasets.settings import RecordedOdometrySettings

TIMES = 0.1 * np.arange(11)
SPEED, RATE, TRACK = 0.8, 0.5, 0.4


def table(path: Path, columns: dict[str, Any], separator: str = ",") -> Path:
    rows = np.column_stack(list(columns.values()))
    lines = [separator.join(columns), *(separator.join(f"{x:.12g}" for x in row) for row in rows)]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def step(path: Path, **settings: Any) -> Odometry:
    """From 0.2 to 0.6 s."""
    source = file_odometry(path, RecordedOdometrySettings(**settings))
    assert source is not None
    found = source(np.array([0.2, 0.6]))[0]
    assert found is not None
    return found


def arc() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    yaw = RATE * TIMES
    return SPEED / RATE * np.sin(yaw), SPEED / RATE * (1.0 - np.cos(yaw)), yaw


X, Y, YAW = arc()
WHEELS = (SPEED - 0.5 * RATE * TRACK, SPEED + 0.5 * RATE * TRACK)
ONES = np.ones(11)
TABLES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "speeds": ({"time": TIMES, "speed": SPEED * ONES, "yaw_rate": RATE * ONES}, {}),
    "speeds as ROS names them, among others": (
        {"seq": ONES, "twist.angular.z": RATE * ONES, "twist.linear.x": SPEED * ONES, "t": TIMES},
        {},
    ),
    "units in the names": (
        {
            "timestamp_ms": 1e3 * TIMES,
            "v [km/h]": 3.6 * SPEED * ONES,
            "omega (deg/s)": np.degrees(RATE) * ONES,
        },
        {},
    ),
    "nanoseconds without a word": (
        {"stamp": 1e9 * TIMES, "vx": SPEED * ONES, "wz": RATE * ONES},
        {},
    ),
    "wheels": (
        {"time": TIMES, "v_left": WHEELS[0] * ONES, "v_right": WHEELS[1] * ONES},
        {"track_m": TRACK},
    ),
    "ticks": (
        {
            "time": TIMES,
            "left_ticks": 7 + 1e6 * WHEELS[0] * TIMES,
            "right_ticks": 1e6 * WHEELS[1] * TIMES,
        },
        {"track_m": TRACK, "metres_per_tick": 1e-6},
    ),
    "planar poses": ({"time": TIMES, "x": X, "y": Y, "theta": YAW}, {}),
    "poses": (
        {
            "t": TIMES,
            "x_m": X,
            "y_m": Y,
            "z_m": 0 * X,
            "qx": 0 * X,
            "qy": 0 * X,
            "qz": np.sin(YAW / 2),
            "qw": np.cos(YAW / 2),
        },
        {},
    ),
}


@pytest.mark.parametrize("separator", [",", ";", " "])
@pytest.mark.parametrize("name", TABLES)
def test_every_table_gives_the_same_arc(tmp_path: Path, name: str, separator: str) -> None:
    columns, settings = TABLES[name]
    if separator == " ":
        columns = {key.replace(" ", "_"): value for key, value in columns.items()}
    motion = step(table(tmp_path / "odom.csv", columns, separator), **settings).motion
    turn = 0.4 * RATE
    expected = SPEED / RATE * np.array([np.sin(turn), 1.0 - np.cos(turn)])
    assert np.allclose(motion[:2, 3], expected, rtol=0.0, atol=2e-6)
    assert np.arctan2(motion[1, 0], motion[0, 0]) == pytest.approx(turn, abs=1e-6)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"time": TIMES, "speed": ONES}, "columns speed, time were understood; needed are time"),
        ({"speed": ONES, "yaw_rate": ONES}, "no column is named time"),
        ({"time": TIMES, "v_left": ONES, "v_right": ONES}, r"--set odometry\.track_m="),
        ({"time": TIMES, "left_ticks": ONES, "right_ticks": ONES}, r"odometry\.metres_per_tick="),
        ({"time": 0 * TIMES, "v": ONES, "w": ONES}, "line 3: time 0.000000 s does not come after"),
        ({"time": TIMES, "v": ONES, "w": 30 * ONES}, "absurd .* are these degrees"),
    ],
)
def test_bad_tables(tmp_path: Path, columns: dict[str, Any], message: str) -> None:
    with pytest.raises(OdometryError, match=message) as caught:
        step(table(tmp_path / "odom.csv", columns))
    assert "\n" not in str(caught.value)


def test_words_and_short_lines_are_named_by_their_line(tmp_path: Path) -> None:
    path = tmp_path / "odom.csv"
    for line, message in (("0.1,fast,0", "line 3: v is 'fast'"), ("0.1,1", "line 3: 2 columns")):
        path.write_text(f"time,v,w\n0.0,1,0\n{line}\n", encoding="utf-8")
        with pytest.raises(OdometryError, match=message):
            step(path)


def test_without_names_the_columns_are_time_speed_and_yaw_rate(tmp_path: Path) -> None:
    rows = [f"{t:.3e},{SPEED},{RATE}" for t in TIMES]
    (tmp_path / "odom.csv").write_text("\n".join(rows), encoding="utf-8")
    motion = step(tmp_path / "odom.csv").motion
    assert np.arctan2(motion[1, 0], motion[0, 0]) == pytest.approx(0.4 * RATE, abs=1e-9)
