"""Odometry of recordings: motions by speed and yaw rate, by poses, by a gyroscope, or by truth.

The body's axes are x forward, y left, z up. All covariances are 6x6 [rotation, translation] in the
tangent space at the new pose.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TypeAlias

import numpy as np

from fgslam.cameras.formats import read_asl_mounting
from fgslam.cameras.trees import Values, read_tree
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.errors import DatasetError, OdometryError
from fgslam.core.files import read_lines
from fgslam.core.geometry import inverse, rotation_angle, se3_exp
from fgslam.core.log import Frame, ImageSequence
from fgslam.core.sensors import BiasEffect, CameraRig, Odometry
from fgslam.core.types import Trajectory
from fgslam.datasets.settings import RecordedOdometrySettings, SyntheticOdometrySettings
from fgslam.datasets.times import (
    SLOWEST_MOTION_S,
    TUM_COLUMNS,
    Table,
    finite_number,
    interpolate_poses,
    read_table,
    require_increasing,
    rows_at,
    time_unit,
    trajectory_of,
)

OdometrySource: TypeAlias = Callable[[FloatArray], tuple[Odometry | None, ...]]
"""Body motions between consecutive stamps (n,): n - 1 of them, None where nothing was recorded."""

# --------------------------------------------------------------------------------------------
# Files


_POSES = ("odometry.txt", "odom.txt")  # the second of OpenLORIS
_SPEED_COLUMNS = ("time", "forward speed", "yaw rate")
_RATE_COLUMNS = ("time", "angular velocity x", "y", "z")


def find_odometry(root: Path, name: str | None) -> Path | None:
    """The file of odometry in a recording's folder: the named one, else the only one there is.

    Without any, the only file of a gyroscope, imu*.csv or gyro*.csv.

    Raises:
        DatasetError: it is not there, or there are several.
    """
    if name is not None:
        if not (root / name).is_file():
            raise DatasetError(
                f"dataset.odometry_file {root / name} does not exist; correct the name, or leave "
                "it out"
            )
        return root / name
    found = [*(root / name for name in _POSES), *sorted(root.glob("odom*.csv"))]
    candidates = [path for path in found if path.is_file()]
    if not candidates:  # wheels say more than a gyroscope
        candidates = [path for path in sorted(root.glob("*.csv")) if is_of_gyroscope(path)]
    if len(candidates) > 1:
        raise DatasetError(
            f"{root} has several odometry files ({', '.join(p.name for p in candidates)}); name "
            "one in dataset.odometry_file"
        )
    return candidates[0] if candidates else None


def is_of_gyroscope(path: Path) -> bool:
    """Whether a file is that of a gyroscope, by its name."""
    return path.is_file() and path.name.lower().startswith(("imu", "gyro"))


def file_odometry(path: Path | None, settings: RecordedOdometrySettings) -> OdometrySource | None:
    """Body motions by a file, which is read when they are first needed; None without a file."""
    if path is None:
        return None

    def read() -> AnyLog:
        if _has_named_columns(path):
            return _read_named_columns(path, settings)
        if is_of_gyroscope(path):
            return checked_rates(read_rates(path), settings)
        if path.suffix == ".csv":
            return checked_speeds(read_table(path, _SPEED_COLUMNS, ",", OdometryError), settings)
        return checked_poses(read_table(path, TUM_COLUMNS, error=OdometryError), settings)

    return recorded_motions(str(path), read, settings)


def recorded_motions(
    name: str, read: Callable[[], AnyLog], settings: RecordedOdometrySettings
) -> OdometrySource:
    """Body motions by a log that is read when motions are first asked for.

    Args:
        name: of the file or topic, for messages.
        read: the log; raises OdometryError where it is malformed.
        settings: noise and limits.

    Raises:
        OdometryError: (when motions are asked for) it covers none of the frames.
    """
    read = cache(read)  # motions are asked for again with the clock shifted

    def source(frames: FloatArray) -> tuple[Odometry | None, ...]:
        log = read()
        if isinstance(log, SpeedLog):
            steps = motions_from_speed(log, frames, settings)
        elif isinstance(log, GyroscopeLog):
            steps = motions_from_gyroscope(log, frames)
        else:
            steps = motions_from_poses(log, frames, settings)
        if len(frames) > 1 and all(step is None for step in steps):
            raise OdometryError(
                f"{name} covers none of the frames ({frames[0]:.3f} to {frames[-1]:.3f} s); check "
                "that both use one clock, or set odometry.time_offset_s"
            )
        return steps

    return source


def _check_samples(table: Table) -> None:
    if len(table) < 2:
        raise OdometryError(
            f"{table.path} holds {len(table)} samples, at least 2 are needed; restore the file, or "
            "choose another odometry.kind (constant_velocity, synthetic)"
        )
    require_increasing(table, table.column(0), OdometryError)


def _require_sane(
    table: Table, values: FloatArray, limit: float, what: str, unit: str, hint: str = ""
) -> None:
    """Raises OdometryError, naming the line, if one of the values (n,) exceeds the limit."""
    bad = np.flatnonzero(np.abs(values) > limit)
    if len(bad):
        k = int(bad[0])
        raise OdometryError(
            f"{table.path}, line {table.lines[k]}: {what} of {values[k]:.4g} {unit} is absurd "
            f"(limit {limit:g}){hint}; correct the line"
        )


# Faster samples are absurd: of cars, drones and hands none of the data sets comes near.
_MAX_SPEED_MPS, _MAX_TURN_DPS = 60.0, 720.0
_ARE_DEGREES = ", radians are expected: are these degrees?"


def steps_covered(stamps: FloatArray, frames: FloatArray, max_gap: float, hold: float) -> BoolArray:
    """Which of the n - 1 steps between frames (n,) the increasing stamps (m,) cover.

    A step is covered unless it overlaps a gap between stamps longer than ``max_gap`` seconds, or
    reaches more than ``hold`` seconds beyond the first or last stamp.
    """
    before, after = frames[:-1], frames[1:]
    long = np.diff(stamps) > max_gap
    starts, ends = stamps[:-1][long], stamps[1:][long]
    overlapped = np.searchsorted(starts, after, "left") - np.searchsorted(ends, before, "right")
    within = (before >= stamps[0] - hold) & (after <= stamps[-1] + hold)
    return np.asarray(within & (overlapped == 0))


def _motions(
    poses: FloatArray, covariances: Sequence[FloatArray], known: BoolArray
) -> tuple[Odometry | None, ...]:
    motions = inverse(poses[:-1]) @ poses[1:]
    steps = zip(motions, covariances, known, strict=True)
    return tuple(Odometry(m, c) if ok else None for m, c, ok in steps)


# --------------------------------------------------------------------------------------------
# Speed and yaw rate


# What speed and yaw rate leave unmeasured; by KITTI raw 2011_09_26, as the settings' defaults.
_LATERAL_SIGMA_MPS, _VERTICAL_SIGMA_MPS = 0.08, 0.12
_ROLL_RATE_SIGMA_DPS, _PITCH_RATE_SIGMA_DPS = 1.3, 1.9


@dataclass(frozen=True, slots=True, eq=False)
class SpeedLog:
    """Forward speed (n,) in m/s and yaw rate (n,) in rad/s, counter-clockwise, at stamps (n,)."""

    stamps: FloatArray
    speed: FloatArray
    yaw_rate: FloatArray


def checked_speeds(table: Table, settings: RecordedOdometrySettings) -> SpeedLog:
    """Rows (time, forward speed in m/s, yaw rate in rad/s) as a log.

    Raises:
        OdometryError: rows are too few, out of time order, or absurd.
    """
    _check_samples(table)
    time, speed, yaw_rate = (table.column(k) for k in range(3))
    _require_sane(table, speed, _MAX_SPEED_MPS, "forward speed", "m/s")
    turn, limit = np.degrees(yaw_rate), _MAX_TURN_DPS
    _require_sane(table, turn, limit, "yaw rate", "degrees/s", _ARE_DEGREES)
    return SpeedLog(time + settings.time_offset_s, speed, yaw_rate)


def planar_poses(log: SpeedLog, at: FloatArray) -> FloatArray:
    """(x, y, yaw) (m, 3) at increasing times (m,): the path of interpolated speed and yaw rate.

    Between neighbouring stamps both are linear in time: the turn follows exactly, the path by
    Gauss-Legendre quadrature, exact to rounding for turns below a radian between two stamps.
    Outside the log the nearest sample is held.
    """
    times = np.union1d(log.stamps, at)
    duration = np.diff(times)
    speed, rate = (np.interp(times, log.stamps, y) for y in (log.speed, log.yaw_rate))
    yaw = np.concatenate([[0.0], np.cumsum(duration * 0.5 * (rate[1:] + rate[:-1]))])
    nodes, weights = np.polynomial.legendre.leggauss(6)
    nodes, weights = 0.5 * (nodes + 1.0), 0.5 * weights  # on [0, 1]
    speed_inside = speed[:-1, None] + np.diff(speed)[:, None] * nodes
    turned = rate[:-1, None] * nodes + 0.5 * np.diff(rate)[:, None] * nodes**2
    heading = yaw[:-1, None] + duration[:, None] * turned
    x, y = (
        np.concatenate([[0.0], np.cumsum(duration * ((speed_inside * part(heading)) @ weights))])
        for part in (np.cos, np.sin)
    )
    return np.column_stack([x, y, yaw])[np.searchsorted(times, at)]


def motions_from_speed(
    log: SpeedLog, frames: FloatArray, settings: RecordedOdometrySettings
) -> tuple[Odometry | None, ...]:
    """Body motions (n - 1) between consecutive frame stamps (n,): planar arcs; None if not covered.

    The covariance is diagonal: noise of the measured speed and yaw rate, and of the unmeasured
    rates, each times the step's duration.
    """
    from scipy.spatial.transform import Rotation  # slow to load, and not all have odometry

    planar = planar_poses(log, frames)
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", planar[:, 2:]).as_matrix()
    poses[:, :2, 3] = planar[:, :2]
    rotation = (
        _ROLL_RATE_SIGMA_DPS,
        _PITCH_RATE_SIGMA_DPS,
        settings.yaw_rate_sigma_dps,
    )
    translation = (
        settings.speed_sigma_mps,
        _LATERAL_SIGMA_MPS,
        _VERTICAL_SIGMA_MPS,
    )
    rates = np.concatenate([np.radians(rotation), translation])
    covariances = [np.diag((rates * dt) ** 2) for dt in np.diff(frames)]
    known = steps_covered(log.stamps, frames, settings.max_gap_s, settings.max_gap_s)
    return _motions(poses, covariances, known)


# --------------------------------------------------------------------------------------------
# Poses


_POSE_HOLD_S = 1e-3
# Least noise of a step between two poses: what the encoders of a standing robot leave open.
_TRANSLATION_FLOOR_M, _ROTATION_FLOOR_DEG = 0.002, 0.1


def checked_poses(table: Table, settings: RecordedOdometrySettings) -> Trajectory:
    """Rows (time, position, quaternion) as a trajectory of the body, in any world.

    Raises:
        OdometryError: rows are too few, malformed, out of time order, or move absurdly fast.
    """
    from scipy.spatial.transform import Rotation

    _check_samples(table)
    log = trajectory_of(table, OdometryError)
    motions = inverse(log.poses[:-1]) @ log.poses[1:]
    duration = np.diff(log.timestamps)
    speed = np.linalg.norm(motions[:, :3, 3], axis=1) / duration
    turn = np.degrees(Rotation.from_matrix(motions[:, :3, :3]).magnitude()) / duration
    arrival = Table(table.path, table.values[1:], table.lines[1:])
    _require_sane(arrival, speed, _MAX_SPEED_MPS, "speed", "m/s")
    _require_sane(arrival, turn, _MAX_TURN_DPS, "turn", "degrees/s")
    return Trajectory(log.timestamps + settings.time_offset_s, log.poses)


def motions_from_poses(
    log: Trajectory, frames: FloatArray, settings: RecordedOdometrySettings
) -> tuple[Odometry | None, ...]:
    """Body motions between consecutive frame stamps (n,): n - 1 of them; None where not covered."""
    poses = interpolate_poses(log, frames)
    motions = inverse(poses[:-1]) @ poses[1:]
    covariances = [pose_noise(motion, settings) for motion in motions]
    # Unlike a speed, a pose cannot be held beyond the log's ends: that would say "no motion".
    known = steps_covered(log.timestamps, frames, settings.max_gap_s, _POSE_HOLD_S)
    return _motions(poses, covariances, known)


def pose_noise(motion: FloatArray, settings: RecordedOdometrySettings) -> FloatArray:
    """Covariance (6, 6) of a body motion (4, 4): a fraction of its length and angle, no less."""
    length = float(np.linalg.norm(motion[:3, 3]))
    angle = rotation_angle(motion[:3, :3])
    rotation = max(settings.rotation_sigma_fraction * angle, float(np.radians(_ROTATION_FLOOR_DEG)))
    translation = max(settings.translation_sigma_fraction * length, _TRANSLATION_FLOOR_M)
    return np.diag(np.repeat([rotation**2, translation**2], 3))


# --------------------------------------------------------------------------------------------
# Gyroscope: angular velocity, integrated between frames (docs/derivations/motion.md)


# Of MEMS gyroscopes in cameras, phones and drones, by their data sheets (InvenSense MPU-9250, Bosch
# BMI055 and BMI160, Analog Devices ADIS16448). EuRoC's is 4.5 degrees/s off.
_START_BIAS_DPS = 3.0
_TURN_SIGMA_FRACTION = 0.013  # sensitivity 1 %, alignment of its axes half a degree
_MAX_GAP_S = 0.1  # over which the angular velocity is taken as linear
_HOLD_S = 0.02  # beyond the first and last sample


@dataclass(frozen=True, slots=True)
class GyroscopeNoise:
    """White noise in rad/s/sqrt(Hz), and random walk of the bias in rad/s^2/sqrt(Hz).

    The defaults: MPU-9250, 0.01 degrees/s/sqrt(Hz); and what EuRoC states for an ADIS16448.
    """

    density: float = 1.75e-4
    walk: float = 1.94e-5


@dataclass(frozen=True, slots=True, eq=False)
class GyroscopeLog:
    """Angular velocity (n, 3) in rad/s about the body's axes, at stamps (n,)."""

    stamps: FloatArray
    rates: FloatArray
    noise: GyroscopeNoise = field(default_factory=GyroscopeNoise)


AnyLog: TypeAlias = SpeedLog | GyroscopeLog | Trajectory
"""What odometry is recorded as: speeds, angular velocities, or poses."""


def read_rates(path: Path) -> Table:
    """Rows (seconds, rad/s about x, y, z) of a comma-separated file, whatever its unit of time.

    Raises:
        OdometryError: a line is malformed or not finite.
    """
    table = read_table(path, _RATE_COLUMNS, ",", OdometryError)
    unit = time_unit(table.column(0), _MAX_GAP_S)[1]
    return Table(path, table.values * [unit, 1.0, 1.0, 1.0], table.lines)


def recorded_gyroscope(
    path: Path,
    mounting: Path | None,
    noise: Path | None,
    settings: RecordedOdometrySettings,
) -> GyroscopeLog:
    """The log of a file of rates, with what other files say of the sensor.

    Args:
        path: as :func:`read_rates` reads it.
        mounting: sensor.yaml with the sensor's pose in the body; None: its axes are the body's.
        noise: as :func:`read_gyroscope_noise` reads it; None for the default.
        settings: limits and time offset.

    Raises:
        OdometryError: the file of rates is malformed.
        CalibrationError: another one is.
    """
    bRs = None if mounting is None else read_asl_mounting(mounting)[:3, :3]
    stated = None if noise is None else read_gyroscope_noise(noise)
    return checked_rates(read_rates(path), settings, bRs, stated)


def checked_rates(
    table: Table,
    settings: RecordedOdometrySettings,
    bRs: FloatArray | None = None,
    noise: GyroscopeNoise | None = None,
) -> GyroscopeLog:
    """Rows (time, angular velocity) of a sensor as a log of the body.

    Args:
        table: seconds and rad/s about the sensor's axes.
        settings: limits and time offset.
        bRs: (3, 3) axes of the sensor in the body; None: the same.
        noise: None for the default.

    Raises:
        OdometryError: the times do not increase, or a rate is absurd.
    """
    _check_samples(table)
    rates = table.values[:, 1:4]
    size, limit = np.degrees(np.linalg.norm(rates, axis=1)), _MAX_TURN_DPS
    _require_sane(table, size, limit, "angular velocity", "degrees/s", _ARE_DEGREES)
    body = rates if bRs is None else rates @ bRs.T
    return GyroscopeLog(table.column(0) + settings.time_offset_s, body, noise or GyroscopeNoise())


def read_gyroscope_noise(path: Path) -> GyroscopeNoise:
    """Noise stated in the sensor.yaml of an IMU, or in Kalibr's imu.yaml, which has its keys.

    Raises:
        CalibrationError: a value is not a finite number.
    """
    tree = read_tree(path) or {}
    values = Values(path, tree.get("imu0", tree))
    usual = GyroscopeNoise()
    return GyroscopeNoise(
        values.number("gyroscope_noise_density", usual.density),
        values.number("gyroscope_random_walk", usual.walk),
    )


def motions_from_gyroscope(log: GyroscopeLog, frames: FloatArray) -> tuple[Odometry | None, ...]:
    """Turns of the body between consecutive frame stamps (n,): n - 1; None where not covered."""
    known = steps_covered(log.stamps, frames, _MAX_GAP_S, _HOLD_S)
    rotations, jacobians = integrated(log, frames)
    start = float(np.radians(_START_BIAS_DPS)) ** 2
    steps: list[Odometry | None] = []
    for ok, dt, rotation, jacobian in zip(
        known, np.diff(frames).tolist(), rotations, jacobians, strict=True
    ):
        angle = rotation_angle(rotation)
        variance = log.noise.density**2 * dt + (_TURN_SIGMA_FRACTION * angle) ** 2
        bias = BiasEffect(jacobian, start_variance=start, walk=log.noise.walk**2 * dt)
        steps.append(Odometry.turn(rotation, variance * np.eye(3), bias) if ok else None)
    return tuple(steps)


def integrated(log: GyroscopeLog, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotations (n - 1, 3, 3) between times (n,), and their Jacobians by the bias.

    Between samples the angular velocity is linear in time; the rotation of that is exact to the
    fourth order (Magnus expansion: Iserles et al. 2000). The Jacobian is that of the rotation
    vector at the step's end (Forster et al. 2017, (A.20)). Outside the log the nearest sample is
    held.
    """
    from scipy.spatial.transform import Rotation

    times = np.union1d(log.stamps, at)
    rates = np.column_stack([np.interp(times, log.stamps, axis) for axis in log.rates.T])
    dt = np.diff(times)[:, None]
    first, second = rates[:-1], rates[1:]
    vectors = 0.5 * dt * (first + second) + dt**2 / 12.0 * np.cross(first, second)
    steps = Rotation.from_rotvec(vectors).as_matrix()
    turned = np.empty((len(steps) + 1, 3, 3))  # the product of the first k steps, for every k
    turned[0] = np.eye(3)
    for k, step in enumerate(steps):
        turned[k + 1] = turned[k] @ step
    effect = turned[1:] @ (_right_jacobians(vectors) * dt[:, :, None])
    summed = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(effect, axis=0)])
    rows = np.searchsorted(times, at)
    start, end = rows[:-1], rows[1:]
    back = np.swapaxes(turned[end], -1, -2)
    return np.swapaxes(turned[start], -1, -2) @ turned[end], -back @ (summed[end] - summed[start])


def _right_jacobians(vectors: FloatArray) -> FloatArray:
    """(n, 3, 3) of rotation vectors (n, 3) between samples, to the second order of their angle."""
    x, y, z = vectors.T
    none = np.zeros_like(x)
    skew = np.array([[none, -z, y], [z, none, -x], [-y, x, none]]).transpose(2, 0, 1)
    return np.asarray(np.eye(3) - 0.5 * skew + skew @ skew / 6.0)


# --------------------------------------------------------------------------------------------
# Tables with named columns: speeds, wheels, ticks, poses, or a gyroscope


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
    "mm_s": 1e-3,
    "cm_s": 1e-2,
    "m": 1.0,
    "mm": 1e-3,
    "cm": 1e-2,
    **dict.fromkeys(("kmh", "km_h", "kph"), 1 / 3.6),
    **dict.fromkeys(("rad", "rad_s", "radps", "rps", "rad_s_1"), 1.0),
    **dict.fromkeys(("deg", "degrees", "dps", "deg_s", "degps", "deg_s_1"), np.pi / 180.0),
}
"""Units at the end of a name, in seconds, metres, radians."""

_Columns: TypeAlias = dict[str, FloatArray]
"""Columns (n,) by role, in seconds, metres and radians."""


def _has_named_columns(path: Path) -> bool:
    """Whether the first line that is no comment has names. Raises OdometryError if unreadable."""
    lines = read_lines(path, OdometryError)
    without_exponents = re.sub(r"[eE][-+]?\d", "", lines[0][1]) if lines else ""
    return re.search(r"[A-Za-z]", without_exponents) is not None


def _read_named_columns(path: Path, settings: RecordedOdometrySettings) -> AnyLog:
    """Speed and yaw rate, angular velocity, or poses of the body, by what columns there are.

    Raises:
        OdometryError: no known set of columns, a line is malformed, or a value is absurd.
    """
    (_, header), *rows = read_lines(path, OdometryError)
    delimiter = next((mark for mark in ",;\t" if mark in header), None)
    names = header.split(delimiter)
    roles = [_role(name) for name in names]
    columns: dict[str, list[float]] = {role: [] for role, _ in filter(None, roles)}
    for line, text in rows:
        words = [word.strip() for word in text.split(delimiter)]
        if len(words) < len(names):
            raise OdometryError(
                f"{path}, line {line}: {len(words)} columns, the first line names {len(names)}; "
                "complete or remove the line"
            )
        found = {
            role[0]: role[1]
            * finite_number(word, f"{path}, line {line}: {name.strip()}", OdometryError)
            for role, word, name in reversed(list(zip(roles, words, names, strict=False)))
            if role is not None
        }
        for key, value in found.items():
            columns[key].append(value)
    table = {role: np.array(values) for role, values in sorted(columns.items())}
    if "time" not in table:
        raise OdometryError(f"{path}: no column is named time; name the columns")
    if any(role == "time" for role in map(_ROLES.get, map(_clean, names))):  # without a unit
        table["time"] = table["time"] * time_unit(table["time"], SLOWEST_MOTION_S)[1]
    for needed, make, checked in _SETS:
        if set(needed) <= set(table):
            values = np.column_stack([table["time"], *make(path, table, settings)])
            return checked(Table(path, values, np.array([line for line, _ in rows])), settings)
    raise OdometryError(
        f"{path}: columns {', '.join(table)} were understood; needed are time with speed "
        "and yaw_rate, left_speed and right_speed, left_ticks and right_ticks, x, y and yaw (or "
        "qx, qy, qz, qw), or gyro_x, gyro_y and gyro_z; name the columns so"
    )


def _clean(name: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", name.strip().lower()).strip("_")


def _role(name: str) -> tuple[str, float] | None:
    """What a column is, and what its numbers are multiplied by; None where it is unknown."""
    clean = _clean(name)
    if clean in _ROLES:
        return _ROLES[clean], 1.0
    for unit, factor in sorted(_UNITS.items(), key=lambda each: -len(each[0])):
        if clean.endswith(f"_{unit}") and clean.removesuffix(f"_{unit}") in _ROLES:
            return _ROLES[clean.removesuffix(f"_{unit}")], factor
    return None


def _of_wheels(
    path: Path, table: _Columns, settings: RecordedOdometrySettings
) -> tuple[FloatArray, ...]:
    left, right = table["left_speed"], table["right_speed"]
    return 0.5 * (left + right), (right - left) / _track(path, settings)


def _of_ticks(
    path: Path, table: _Columns, settings: RecordedOdometrySettings
) -> tuple[FloatArray, ...]:
    """Exact arcs between the samples of counters that go on."""
    if settings.metres_per_tick is None:
        raise OdometryError(
            f"{path} counts ticks; say how far one goes: --set odometry.metres_per_tick=..."
        )
    left, right = (
        settings.metres_per_tick * np.diff(table[name], prepend=table[name][:1])
        for name in ("left_ticks", "right_ticks")
    )
    length, turn = 0.5 * (left + right), (right - left) / _track(path, settings)
    yaw = np.cumsum(turn)
    # The chord of an arc, at the mean of both headings.
    chord = length * np.sinc(turn / (2.0 * np.pi))
    middle = yaw - 0.5 * turn
    x, y = np.cumsum(chord * np.cos(middle)), np.cumsum(chord * np.sin(middle))
    return _level(x, y, np.zeros_like(x), yaw)


def _track(path: Path, settings: RecordedOdometrySettings) -> float:
    if settings.track_m is None:
        raise OdometryError(
            f"{path} gives both wheels; say their distance: --set odometry.track_m=..."
        )
    return settings.track_m


def _level(x: FloatArray, y: FloatArray, z: FloatArray, yaw: FloatArray) -> tuple[FloatArray, ...]:
    none = np.zeros_like(yaw)
    return x, y, z, none, none, np.sin(0.5 * yaw), np.cos(0.5 * yaw)


def _of_yaw(_: Path, table: _Columns, __: RecordedOdometrySettings) -> tuple[FloatArray, ...]:
    z = table.get("z", np.zeros_like(table["x"]))
    return _level(table["x"], table["y"], z, table["yaw"])


def _of_quaternion(
    _: Path, table: _Columns, __: RecordedOdometrySettings
) -> tuple[FloatArray, ...]:
    z = table.get("z", np.zeros_like(table["x"]))
    return (table["x"], table["y"], z, *(table[name] for name in ("qx", "qy", "qz", "qw")))


def _of_speed(_: Path, table: _Columns, __: RecordedOdometrySettings) -> tuple[FloatArray, ...]:
    return table["speed"], table["yaw_rate"]


def _of_rates(_: Path, table: _Columns, __: RecordedOdometrySettings) -> tuple[FloatArray, ...]:
    return table["rate_x"], table["rate_y"], table["yaw_rate"]


_Made: TypeAlias = Callable[[Path, _Columns, RecordedOdometrySettings], tuple[FloatArray, ...]]
_Checked: TypeAlias = Callable[[Table, RecordedOdometrySettings], AnyLog]

_SETS: tuple[tuple[tuple[str, ...], _Made, _Checked], ...] = (
    (("x", "y", "qx", "qy", "qz", "qw"), _of_quaternion, checked_poses),
    (("x", "y", "yaw"), _of_yaw, checked_poses),
    (("left_ticks", "right_ticks"), _of_ticks, checked_poses),
    (("speed", "yaw_rate"), _of_speed, checked_speeds),
    (("left_speed", "right_speed"), _of_wheels, checked_speeds),
    (("rate_x", "rate_y", "yaw_rate"), _of_rates, checked_rates),
)
"""Columns that are enough, the best first; the columns that are made of them; what these become."""


# --------------------------------------------------------------------------------------------
# Synthetic odometry


_STAMP_TOLERANCE_S = 1e-6
# Least noise per axis and step: a covariance of a standing robot must be invertible.
_SYNTHETIC_FLOOR_M, _SYNTHETIC_FLOOR_DEG = 0.001, 0.01


class SyntheticOdometry:
    """A recording whose odometry is its ground truth with noise drawn from a seed.

    The motion of step ``i`` is ``M = M_true * Exp(xi)``, ``xi`` normal with the covariance that is
    reported with it, independent per body axis and step. Each step has its own generator, seeded
    from (seed, numbers of its two frames), so that any part of a recording repeats the same noise.
    """

    def __init__(
        self, sequence: ImageSequence, settings: SyntheticOdometrySettings, seed: int
    ) -> None:
        """Wrap ``sequence``.

        Raises:
            DatasetError: the recording has no ground truth.
        """
        if sequence.ground_truth is None or len(sequence.ground_truth) == 0:
            raise DatasetError(
                f"odometry.kind is synthetic but {sequence.name} has no ground truth to make it "
                "from; choose recorded or constant_velocity"
            )
        self._sequence = sequence
        self._settings = settings
        self._seed = seed
        self._truth = sequence.ground_truth
        # Row of the truth at each frame, -1 where there is none.
        self._rows = rows_at(
            sequence.ground_truth.timestamps, sequence.timestamps, _STAMP_TOLERANCE_S
        )

    @property
    def name(self) -> str:
        """Name of the wrapped recording."""
        return self._sequence.name

    @property
    def rig(self) -> CameraRig:
        """Cameras of the wrapped recording."""
        return self._sequence.rig

    @property
    def timestamps(self) -> FloatArray:
        """(n,) seconds."""
        return self._sequence.timestamps

    @property
    def identity(self) -> str:
        """Digest of the wrapped recording; the noise is set by the configuration and its seed."""
        return self._sequence.identity

    def __len__(self) -> int:
        return len(self._sequence)

    def frame(self, i: int) -> Frame:
        """Images of frame ``i``, as recorded."""
        return self._sequence.frame(i)

    @property
    def ground_truth(self) -> Trajectory | None:
        """True poses, as recorded."""
        return self._truth

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes of the recording, and that the odometry is synthetic, with its noise."""
        note = (
            "the odometry is synthetic: ground truth plus noise of "
            f"{100.0 * self._settings.translation_sigma_fraction:g} % of the step and "
            f"{self._settings.rotation_sigma_deg:g} degrees per axis (seed {self._seed})"
        )
        without = int((self._rows < 0).sum())
        partial = (f"{without} frames have no ground truth, so no odometry",) if without else ()
        return (*self._sequence.notes, note, *partial)

    def odometry(self, i: int) -> Odometry | None:
        """Noisy body motion from frame ``i - 1`` to ``i``; None where truth has a gap."""
        if not 1 <= i < len(self):
            raise IndexError(f"step {i} of {self.name}: expected 1 to {len(self) - 1}")
        before, after = self._rows[i - 1], self._rows[i]
        if before < 0 or after < 0:
            return None
        bTc = self.rig.bTc
        camera = inverse(self._truth.poses[before]) @ self._truth.poses[after]
        motion = bTc @ camera @ inverse(bTc)
        settings, length = self._settings, float(np.linalg.norm(motion[:3, 3]))
        rotation = np.radians(max(settings.rotation_sigma_deg, _SYNTHETIC_FLOOR_DEG))
        translation = max(settings.translation_sigma_fraction * length, _SYNTHETIC_FLOOR_M)
        sigmas = np.repeat([rotation, translation], 3)
        # Stamps identify frames whatever the selection; microseconds are what files keep.
        pair = np.round(self.timestamps[i - 1 : i + 1] * 1e6).astype(np.int64)
        generator = np.random.default_rng([self._seed, *(int(t) % 2**63 for t in pair)])
        noise = generator.standard_normal(6) * sigmas
        return Odometry(motion @ se3_exp(noise), np.diag(sigmas**2))
