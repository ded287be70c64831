"""Odometry in a table with named columns: speeds, wheels, ticks, poses, or a gyroscope."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import OdometryError
from fgslam.core.files import read_lines
from fgslam.datasets.gyroscope import checked_rates
from fgslam.datasets.odometry import AnyLog, checked_poses, checked_speeds
from fgslam.datasets.settings import RecordedOdometrySettings
from fgslam.datasets.stamps import SLOWEST_MOTION_S, time_unit
from fgslam.datasets.tables import Table, require_increasing

_NAMES = {
    "time": "t time stamp timestamp sec secs seconds header_stamp",
    "speed": "v vx speed velocity forward_speed linear_x linear_velocity twist_linear_x v_forward",
    "yaw_rate": "w wz omega yaw_rate yawrate turn_rate angular_z angular_velocity "
    "twist_angular_z gyro_z w_z omega_z angular_velocity_z gz gyr_z rotation_rate_z w_rs_s_z",
    "rate_x": "wx w_x omega_x angular_x angular_velocity_x gyro_x gx gyr_x rotation_rate_x "
    "w_rs_s_x",
    "rate_y": "wy w_y omega_y angular_y angular_velocity_y gyro_y gy gyr_y rotation_rate_y "
    "w_rs_s_y",
    "left_speed": "v_left left_speed speed_left left_velocity velocity_left vl v_l",
    "right_speed": "v_right right_speed speed_right right_velocity velocity_right vr v_r",
    "left_ticks": "left_ticks ticks_left left_encoder encoder_left left_count count_left left",
    "right_ticks": "right_ticks ticks_right right_encoder encoder_right right_count count_right "
    "right",
    "x": "x px pos_x position_x pose_x tx",
    "y": "y py pos_y position_y pose_y ty",
    "z": "z pz pos_z position_z pose_z tz",
    "yaw": "yaw theta heading phi",
    "qx": "qx q_x orientation_x",
    "qy": "qy q_y orientation_y",
    "qz": "qz q_z orientation_z",
    "qw": "qw q_w orientation_w",
}
"""Names of each column, in small letters, anything else as `_`."""

_ROLES = {name: role for role, names in _NAMES.items() for name in names.split()}
_UNITS = {
    "ns": 1e-9,
    "nsec": 1e-9,
    "us": 1e-6,
    "ms": 1e-3,
    "s": 1.0,
    "mps": 1.0,
    "m_s": 1.0,
    "kmh": 1 / 3.6,
    "km_h": 1 / 3.6,
    "kph": 1 / 3.6,
    "mm_s": 1e-3,
    "cm_s": 1e-2,
    "m": 1.0,
    "mm": 1e-3,
    "cm": 1e-2,
    "rad": 1.0,
    "rad_s": 1.0,
    "radps": 1.0,
    "rps": 1.0,
    "rad_s_1": 1.0,
    **dict.fromkeys(("deg", "degrees", "dps", "deg_s", "degps", "deg_s_1"), np.pi / 180.0),
}
"""Units at the end of a name, in seconds, metres, radians."""


def has_named_columns(path: Path) -> bool:
    """Whether the first line that is no comment has names. Raises OdometryError if unreadable."""
    lines = read_lines(path, OdometryError)
    return (
        bool(lines) and re.search(r"[A-Za-z]", re.sub(r"[eE][-+]?\d", "", lines[0][1])) is not None
    )


def read_named_columns(path: Path, settings: RecordedOdometrySettings) -> AnyLog:
    """Speed and yaw rate, angular velocity, or poses of the body, by what columns there are.

    Raises:
        OdometryError: no known set of columns, a line is malformed, or a value is absurd.
    """
    table = _read(path)
    have = table.columns
    time = _seconds(table)
    for names, make in _SETS:
        if set(names) <= set(have):
            found = make(table, time, settings)
            require_increasing(found, found.column(0), OdometryError)
            return _CHECKED[found.values.shape[1]](found, settings)
    raise OdometryError(
        f"{path}: columns {', '.join(have) or 'none'} were understood; needed are time with speed "
        "and yaw_rate, left_speed and right_speed, left_ticks and right_ticks, x, y and yaw (or "
        "qx, qy, qz, qw), or gyro_x, gyro_y and gyro_z; name the columns so"
    )


@dataclass(frozen=True, eq=False)
class _Columns:
    """Columns (n,) by role, in seconds, metres and radians, and the line of each row."""

    path: Path
    columns: dict[str, FloatArray]
    lines: FloatArray
    plain_time: bool

    def __getitem__(self, name: str) -> FloatArray:
        return self.columns[name]

    def table(self, *columns: FloatArray) -> Table:
        """These columns as a table of this file."""
        return Table(self.path, np.column_stack(columns), self.lines.astype(np.int64))


def _read(path: Path) -> _Columns:
    lines = read_lines(path, OdometryError)
    first = lines[0][1]
    delimiter = next((mark for mark in ",;\t" if mark in first), None)
    names = first.split(delimiter)
    roles = [_role(name) for name in names]
    rows, numbers = [], []
    for number, text in lines[1:]:
        words = [word.strip() for word in text.split(delimiter)]
        if len(words) < len(names):
            raise OdometryError(
                f"{path}, line {number}: {len(words)} columns, the first line names {len(names)}; "
                "complete or remove the line"
            )
        rows.append([_number(path, number, w, n) if r else 0.0
                     for w, n, r in zip(words, names, roles, strict=False)])  # fmt: skip
        numbers.append(number)
    values = np.array(rows, np.float64).reshape(len(rows), len(names))
    columns = {
        role[0]: values[:, k] * role[1] for k, role in reversed(list(enumerate(roles))) if role
    }
    plain = any(role and role[0] == "time" and _clean(n) in _ROLES
                for n, role in zip(names, roles, strict=True))  # fmt: skip
    return _Columns(path, dict(sorted(columns.items())), np.array(numbers, float), plain)


def _clean(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.strip().lower()).strip("_")


def _role(name: str) -> tuple[str, float] | None:
    """What a column is, and what its numbers are multiplied by; None where nobody knows."""
    clean = _clean(name)
    if clean in _ROLES:
        return _ROLES[clean], 1.0
    for unit, factor in sorted(_UNITS.items(), key=lambda each: -len(each[0])):
        if clean.endswith(f"_{unit}") and clean.removesuffix(f"_{unit}") in _ROLES:
            return _ROLES[clean.removesuffix(f"_{unit}")], factor
    return None


def _number(path: Path, line: int, word: str, name: str) -> float:
    try:
        value = float(word)
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise OdometryError(
            f"{path}, line {line}: {name.strip()} is {word!r}, not a finite number; correct or "
            "remove the line"
        )
    return value


def _seconds(table: _Columns) -> FloatArray:
    if "time" not in table.columns:
        raise OdometryError(f"{table.path}: no column is named time; name the columns")
    time = table["time"]
    return time * time_unit(time, SLOWEST_MOTION_S)[1] if table.plain_time else time


# --------------------------------------------------------------------------------------------
# What sets of columns become: time with speed and yaw rate, with angular velocity, or with a pose
# as in a TUM file


def _of_speed(table: _Columns, time: FloatArray, _: RecordedOdometrySettings) -> Table:
    return table.table(time, table["speed"], table["yaw_rate"])


def _of_rates(table: _Columns, time: FloatArray, _: RecordedOdometrySettings) -> Table:
    return table.table(time, table["rate_x"], table["rate_y"], table["yaw_rate"])


def _of_wheels(table: _Columns, time: FloatArray, settings: RecordedOdometrySettings) -> Table:
    left, right = table["left_speed"], table["right_speed"]
    return table.table(time, 0.5 * (left + right), (right - left) / _track(table, settings))


def _of_ticks(table: _Columns, time: FloatArray, settings: RecordedOdometrySettings) -> Table:
    """Exact arcs between the samples of counters that go on."""
    if settings.metres_per_tick is None:
        raise OdometryError(
            f"{table.path} counts ticks; say how far one goes: --set odometry.metres_per_tick=..."
        )
    left, right = (
        settings.metres_per_tick * np.diff(table[name], prepend=table[name][:1])
        for name in ("left_ticks", "right_ticks")
    )
    length, turn = 0.5 * (left + right), (right - left) / _track(table, settings)
    yaw = np.cumsum(turn)
    # The chord of an arc, at the mean of both headings.
    chord = length * np.sinc(turn / (2.0 * np.pi))
    middle = yaw - 0.5 * turn
    x, y = np.cumsum(chord * np.cos(middle)), np.cumsum(chord * np.sin(middle))
    return _level(table, time, (x, y, np.zeros_like(x)), yaw)


def _track(table: _Columns, settings: RecordedOdometrySettings) -> float:
    if settings.track_m is None:
        raise OdometryError(
            f"{table.path} gives both wheels; say their distance: --set odometry.track_m=..."
        )
    return settings.track_m


def _of_yaw(table: _Columns, time: FloatArray, _: RecordedOdometrySettings) -> Table:
    z = table.columns.get("z", np.zeros_like(time))
    return _level(table, time, (table["x"], table["y"], z), table["yaw"])


def _of_quaternion(table: _Columns, time: FloatArray, _: RecordedOdometrySettings) -> Table:
    z = table.columns.get("z", np.zeros_like(time))
    rotation = (table[name] for name in ("qx", "qy", "qz", "qw"))
    return table.table(time, table["x"], table["y"], z, *rotation)


def _level(
    table: _Columns,
    time: FloatArray,
    position: tuple[FloatArray, FloatArray, FloatArray],
    yaw: FloatArray,
) -> Table:
    none = np.zeros_like(yaw)
    return table.table(time, *position, none, none, np.sin(0.5 * yaw), np.cos(0.5 * yaw))


_SETS = (
    (("x", "y", "qx", "qy", "qz", "qw"), _of_quaternion),
    (("x", "y", "yaw"), _of_yaw),
    (("left_ticks", "right_ticks"), _of_ticks),
    (("speed", "yaw_rate"), _of_speed),
    (("left_speed", "right_speed"), _of_wheels),
    (("rate_x", "rate_y", "yaw_rate"), _of_rates),
)
"""Columns that are enough, the best first."""

_CHECKED: Mapping[int, Callable[[Table, RecordedOdometrySettings], AnyLog]] = {
    3: checked_speeds,
    4: checked_rates,
    8: checked_poses,
}
"""What a set becomes, by its number of columns."""
