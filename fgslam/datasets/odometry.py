"""Odometry of recordings: motions by speed and yaw rate, by poses, by a gyroscope, or by truth.

The body's axes are x forward, y left, z up. All covariances are 6x6 [rotation, translation] in the
tangent space at the new pose.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import TypeAlias

import numpy as np

from fgslam.cameras.formats import read_asl_mounting
from fgslam.cameras.trees import Values, read_tree
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.errors import DatasetError, OdometryError
from fgslam.core.files import read_lines, read_text
from fgslam.core.geometry import inverse, rotation_angle, se3_exp
from fgslam.core.sensors import BiasEffect, Odometry
from fgslam.core.types import Trajectory
from fgslam.datasets.settings import RecordedOdometrySettings, SyntheticOdometrySettings
from fgslam.datasets.times import (
    TUM_COLUMNS,
    Table,
    interpolate_poses,
    poses_of,
    read_table,
    require_increasing,
    rows_at,
    time_unit,
)

Steps: TypeAlias = tuple[Odometry | None, ...]
OdometrySource: TypeAlias = Callable[[FloatArray], Steps]
"""Body motions between consecutive stamps (n,): n - 1 of them, None where nothing was recorded."""

# --------------------------------------------------------------------------------------------
# Files and their columns


SPEED_COLUMNS = ("time", "speed", "yaw_rate")
RATE_COLUMNS = ("time", "rate_x", "rate_y", "yaw_rate")
POSE_COLUMNS = ("time", *TUM_COLUMNS[1:])
"""Roles of the columns of speeds, of a gyroscope and of poses, in seconds, metres and radians."""

_UNNAMED = {
    "speeds": (("time", "forward speed", "yaw rate"), ","),
    "rates": (("time", *(f"angular velocity {axis}" for axis in "xyz")), ","),
    "poses": (TUM_COLUMNS, None),
}
"""Columns of files without names of columns, and what separates them."""

_NAMES = {
    "time": "t time stamp timestamp sec secs seconds header_stamp rosbagtimestamp "
    "stamp_sec stamp_secs",
    "nanoseconds": "nsec nsecs nanosec nanosecs nanoseconds stamp_nsec stamp_nsecs stamp_nanosec",
    "speed": "v vx speed velocity forward_speed linear_x linear_velocity linear_velocity_x "
    "twist_linear_x v_forward",
    "yaw_rate": "w wz omega yaw_rate yawrate turn_rate angular_z angular_velocity "
    "twist_angular_z gyro_z w_z omega_z angular_velocity_z gz gyr_z rotation_rate_z w_rs_s_z",
    "rate_x": "wx w_x omega_x angular_x angular_velocity_x gyro_x gx gyr_x rotation_rate_x "
    "w_rs_s_x",
    "rate_y": "wy w_y omega_y angular_y angular_velocity_y gyro_y gy gyr_y rotation_rate_y "
    "w_rs_s_y",
    **{a: f"{a} p{a} p_{a} p_rs_r_{a} pos_{a} position_{a} pose_{a} t{a}" for a in "xyz"},
    "yaw": "yaw theta heading phi",
    **{f"q{axis}": f"q{axis} q_{axis} q_rs_{axis} orientation_{axis}" for axis in "xyzw"},
}
"""Names of the columns of each role, in small letters, anything else as `_`."""

_ROLES = {name: role for role, names in _NAMES.items() for name in names.split()}
_UNITS = {
    unit: factor
    for factor, units in (
        (1e-9, "ns nsec"),
        (1e-6, "us"),
        (1e-3, "ms mm mm_s"),
        (1e-2, "cm cm_s"),
        (1.0, "s m m_s mps rad rad_s radps rps rad_s_1"),
        (1 / 3.6, "kmh km_h kph"),
        (np.pi / 180.0, "deg degrees dps deg_s degps deg_s_1"),
    )
    for unit in units.split()
}
"""Units at the end of a name, in seconds, metres, radians."""

_SLOWEST_S, _SLOWEST_GYROSCOPE_S = 1.0, 0.1  # between two samples: what makes a unit plausible


def find_odometry(root: Path) -> Path | None:
    """The only file of odometry in a recording's folder; None where it has none.

    Without any, the only file of a gyroscope, imu*.csv or gyro*.csv.

    Raises:
        DatasetError: there are several.
    """
    named = (root / "odometry.txt", root / "odom.txt")  # the second of OpenLORIS
    found = [path for path in (*named, *sorted(root.glob("odom*.csv"))) if path.is_file()]
    # Wheels measure more than a gyroscope.
    found = found or [path for path in sorted(root.glob("*.csv")) if is_of_gyroscope(path)]
    if len(found) > 1:
        raise DatasetError(
            f"{root} has several odometry files ({', '.join(p.name for p in found)}); keep one"
        )
    return found[0] if found else None


def is_of_gyroscope(path: Path) -> bool:
    """Whether a file is that of a gyroscope, by its name."""
    return path.is_file() and path.name.lower().startswith(("imu", "gyro"))


def file_odometry(path: Path, settings: RecordedOdometrySettings) -> OdometrySource:
    """Body motions by a file, which is read when they are first needed."""
    kind = "rates" if is_of_gyroscope(path) else "speeds" if path.suffix == ".csv" else "poses"
    return recorded_motions(lambda: motions_of(read_columns(path, kind), settings))


def gyroscope_odometry(
    path: Path, mounting: Path | None, noise: Path | None, settings: RecordedOdometrySettings
) -> OdometrySource:
    """Turns of the body by a file of rates, and what other files state of the sensor.

    Args:
        path: seconds, or another unit of time, and rad/s about the sensor's axes.
        mounting: sensor.yaml with the sensor's pose in the body; None: its axes are the body's.
        noise: as :func:`read_gyroscope_noise` reads it; None for the default.
        settings: limits and time offset.

    Raises:
        OdometryError: (when motions are asked for) the file of rates is malformed.
        CalibrationError: (then) another one is.
    """

    def read() -> OdometrySource:
        bRs = None if mounting is None else read_asl_mounting(mounting)[:3, :3]
        stated = GyroscopeNoise() if noise is None else read_gyroscope_noise(noise)
        return motions_of(read_columns(path, "rates"), settings, bRs, stated)

    return recorded_motions(read)


def recorded_motions(read: Callable[[], OdometrySource]) -> OdometrySource:
    """Body motions of a file or topic that is read when motions are first asked for.

    Raises:
        OdometryError: (when motions are asked for) it is malformed, or covers none of the frames.
    """
    read = cache(read)  # motions are asked for again with the clock shifted
    return lambda frames: read()(frames)


def read_columns(path: Path, kind: str) -> Table:
    """The columns of known roles, in seconds, metres and radians; the first of a role counts.

    Args:
        path: the file, perhaps with names of columns in its first line.
        kind: what the columns are where they have no names: speeds, rates or poses.

    Raises:
        OdometryError: a line is malformed, a number not finite, or no column is of time.
    """
    lines = read_lines(path, OdometryError)
    names, delimiter = _UNNAMED[kind]
    header = ""
    if lines and re.search(r"[A-Za-z]", re.sub(r"[eE][-+]?\d", "", lines[0][1])):
        _, header = lines.pop(0)
    elif lines and kind != "poses":  # a comment may name the columns, as EuRoC's
        stated = read_text(path, OdometryError).lstrip().partition("\n")[0].split(",")
        if (
            stated[0][:1] == "#"
            and len(stated) == len(lines[0][1].split(","))
            and all(map(_role, stated[:3]))
        ):
            header = ",".join(stated).lstrip("# ")
    if header:
        delimiter = next((mark for mark in ",;\t" if mark in header), None)
        names = tuple(header.split(delimiter))
    known = [_role(name) for name in names]
    roles, factors = zip(*filter(None, known), strict=True) if any(known) else ((), ())
    if "time" not in roles:  # else they are the rest of a second
        roles = tuple("time" if role == "nanoseconds" else role for role in roles)
    if "time" not in roles:
        raise OdometryError(f"{path}: no column is named time; name the columns")
    used = [name.strip() if role else None for name, role in zip(names, known, strict=True)]
    table = read_table(path, used, delimiter, OdometryError, lines)
    values = table.values * np.where(np.isnan(factors), 1.0, factors)
    k = roles.index("time")
    if "nanoseconds" in roles:
        values[:, k] += values[:, roles.index("nanoseconds")]
    elif np.isnan(factors[k]):
        slowest = _SLOWEST_GYROSCOPE_S if "rate_x" in roles else _SLOWEST_S
        timed = kind == "rates" or names != _UNNAMED[kind][0]  # of others without names: seconds
        values[:, k] *= time_unit(values[:, k], slowest)[1] if timed else 1.0
    return Table(path, values, table.lines, roles)


def _role(name: str) -> tuple[str, float] | None:
    """What a column is, and what its numbers are multiplied by: NaN for times of unknown unit.

    Of a full name in ROS, field.pose.pose.position.x or /odom/pose/pose/position/x, its last two
    parts say it.
    """
    if len(parts := re.split(r"[./]", name)) > 2 and (found := _role("_".join(parts[-2:]))):
        return found
    clean = re.sub(r"[^a-z0-9]+", "_", name.strip().lower()).strip("_")
    if role := _ROLES.get(clean):
        return role, {"time": np.nan, "nanoseconds": 1e-9}.get(role, 1.0)
    for unit in sorted(_UNITS, key=len, reverse=True):
        if clean.endswith(f"_{unit}") and (role := _ROLES.get(clean.removesuffix(f"_{unit}"))):
            return role, _UNITS[unit]
    return None


# --------------------------------------------------------------------------------------------
# What the columns measure


# Faster samples are absurd: of cars, drones and hands none of the data sets comes near.
_MAX_SPEED_MPS, _MAX_TURN_DPS = 60.0, 720.0


@dataclass(frozen=True, slots=True)
class GyroscopeNoise:
    """White noise in rad/s/sqrt(Hz), and random walk of the bias in rad/s^2/sqrt(Hz).

    The defaults: MPU-9250, 0.01 degrees/s/sqrt(Hz); and what EuRoC states for an ADIS16448.
    """

    density: float = 1.75e-4
    walk: float = 1.94e-5


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


def motions_of(
    table: Table,
    settings: RecordedOdometrySettings,
    bRs: FloatArray | None = None,
    noise: GyroscopeNoise | None = None,
) -> OdometrySource:
    """Body motions by the best columns that a table has: poses, speeds, or a gyroscope's.

    Args:
        table: columns by their roles, as :func:`read_columns` gives them.
        settings: noise and limits.
        bRs: (3, 3) axes of a gyroscope in the body; None: the same.
        noise: of a gyroscope; None for the default.

    Raises:
        OdometryError: columns are lacking, rows are too few, out of time order, or absurd.
    """
    columns = dict(zip(reversed(table.names), table.values.T[::-1], strict=True))
    path, time = table.path, columns["time"]

    def has(*roles: str) -> bool:
        return columns.keys() >= set(roles)

    def require_sane(values: FloatArray, limit: float, what: str, hint: str = "") -> None:
        bad = np.flatnonzero(np.abs(values) > limit)
        if len(bad):
            quantity, _, unit = what.partition(", ")
            raise OdometryError(
                f"{path}, line {table.lines[-len(values) :][bad[0]]}: {quantity} of "
                f"{values[bad[0]]:.4g} {unit} is absurd (limit {limit:g}){hint}; correct the line"
            )

    if len(table) < 2:
        raise OdometryError(
            f"{path} holds {len(table)} samples, at least 2 are needed; restore the file, or "
            "choose another odometry.kind (constant_velocity, synthetic)"
        )
    require_increasing(table, time, OdometryError)
    stamps, none = time + settings.time_offset_s, np.zeros(len(time))
    covering = partial(_covering, path, stamps, settings.time_offset_s)
    are_degrees = ", radians are expected: are these degrees?"
    if has("x", "y", "qx", "qy", "qz", "qw"):
        quaternion = [columns[name] for name in ("qx", "qy", "qz", "qw")]
    elif has("x", "y", "yaw"):
        yaw = columns["yaw"]
        quaternion = [none, none, np.sin(0.5 * yaw), np.cos(0.5 * yaw)]
    elif has("speed", "yaw_rate"):
        speed, yaw_rate = columns["speed"], columns["yaw_rate"]
        require_sane(speed, _MAX_SPEED_MPS, "forward speed, m/s")
        require_sane(np.degrees(yaw_rate), _MAX_TURN_DPS, "yaw rate, degrees/s", are_degrees)
        return covering(lambda frames: speed_motions(stamps, speed, yaw_rate, frames, settings))
    elif has("rate_x", "rate_y", "yaw_rate"):
        rates = np.column_stack([columns[role] for role in RATE_COLUMNS[1:]])
        size = np.degrees(np.linalg.norm(rates, axis=1))
        require_sane(size, _MAX_TURN_DPS, "angular velocity, degrees/s", are_degrees)
        body = rates if bRs is None else rates @ bRs.T
        noise = noise or GyroscopeNoise()
        return covering(lambda frames: gyroscope_motions(stamps, body, frames, noise))
    else:
        raise OdometryError(
            f"{path}: columns {', '.join(sorted(columns))} were understood; name time with "
            "speed and yaw_rate, x, y and yaw (or qx, qy, qz, qw), or gyro_x, gyro_y and gyro_z"
        )
    from scipy.spatial.transform import Rotation  # slow to load, and not all have odometry

    xyz = np.column_stack([columns["x"], columns["y"], columns.get("z", none)])
    poses = poses_of(table, xyz, np.column_stack(quaternion), OdometryError)
    motions, duration = inverse(poses[:-1]) @ poses[1:], np.diff(time)
    pace = np.linalg.norm(motions[:, :3, 3], axis=1) / duration
    require_sane(pace, _MAX_SPEED_MPS, "speed, m/s")
    turns = np.degrees(Rotation.from_matrix(motions[:, :3, :3]).magnitude()) / duration
    require_sane(turns, _MAX_TURN_DPS, "turn, degrees/s")
    return covering(lambda frames: pose_motions(Trajectory(stamps, poses), frames, settings))


def _covering(
    path: Path, stamps: FloatArray, added: float, source: OdometrySource
) -> OdometrySource:
    """The source, which refuses frames that it covers nowhere; ``added`` is in its stamps (n,)."""

    def checked(frames: FloatArray) -> Steps:
        steps = source(frames)
        if len(frames) > 1 and all(step is None for step in steps):
            offset = added + frames[0] - stamps[0]
            raise OdometryError(
                f"{path}: from {stamps[0]:.3f} to {stamps[-1]:.3f} s, covers none of the frames, "
                f"{frames[0]:.3f} to {frames[-1]:.3f} s; where its clock is another one, "
                f"--set odometry.time_offset_s={offset:.3f} lets both begin at once"
            )
        return steps

    return checked


# --------------------------------------------------------------------------------------------
# Motions between frames


_MAX_GAP_S = 0.5  # between samples of speed, or poses, that is bridged


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


def _steps(poses: FloatArray, covariances: Sequence[FloatArray], known: BoolArray) -> Steps:
    steps = zip(inverse(poses[:-1]) @ poses[1:], covariances, known, strict=True)
    return tuple(Odometry(m, c) if ok else None for m, c, ok in steps)


# What speed and yaw rate leave unmeasured; by KITTI raw 2011_09_26, as the settings' defaults.
_LATERAL_SIGMA_MPS, _VERTICAL_SIGMA_MPS = 0.08, 0.12
_ROLL_RATE_SIGMA_DPS, _PITCH_RATE_SIGMA_DPS = 1.3, 1.9


def speed_motions(
    stamps: FloatArray,
    speed: FloatArray,
    yaw_rate: FloatArray,
    frames: FloatArray,
    settings: RecordedOdometrySettings,
) -> Steps:
    """Planar arcs between frames (m,) by forward speed and yaw rate (n,) in m/s, rad/s at stamps.

    Between neighbouring stamps both are linear in time: the turn follows exactly, the path by
    Gauss-Legendre quadrature, exact to rounding for turns below a radian between two stamps.
    Outside the log the nearest sample is held. The covariance is diagonal: noise of the measured
    speed and yaw rate, and of the unmeasured rates, each times the step's duration.
    """
    from scipy.spatial.transform import Rotation

    times = np.union1d(stamps, frames)
    duration = np.diff(times)
    v, rate = (np.interp(times, stamps, y) for y in (speed, yaw_rate))
    yaw = np.concatenate([[0.0], np.cumsum(duration * 0.5 * (rate[1:] + rate[:-1]))])
    nodes, weights = np.polynomial.legendre.leggauss(6)
    nodes, weights = 0.5 * (nodes + 1.0), 0.5 * weights  # on [0, 1]
    v_inside = v[:-1, None] + np.diff(v)[:, None] * nodes
    turned = rate[:-1, None] * nodes + 0.5 * np.diff(rate)[:, None] * nodes**2
    heading = yaw[:-1, None] + duration[:, None] * turned
    x, y = (
        np.concatenate([[0.0], np.cumsum(duration * ((v_inside * part(heading)) @ weights))])
        for part in (np.cos, np.sin)
    )
    at = np.searchsorted(times, frames)
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", yaw[at][:, None]).as_matrix()
    poses[:, :2, 3] = np.column_stack([x, y])[at]
    rotation = (_ROLL_RATE_SIGMA_DPS, _PITCH_RATE_SIGMA_DPS, settings.yaw_rate_sigma_dps)
    translation = (settings.speed_sigma_mps, _LATERAL_SIGMA_MPS, _VERTICAL_SIGMA_MPS)
    rates = np.concatenate([np.radians(rotation), translation])
    covariances = [np.diag((rates * dt) ** 2) for dt in np.diff(frames)]
    known = steps_covered(stamps, frames, _MAX_GAP_S, _MAX_GAP_S)
    return _steps(poses, covariances, known)


_POSE_HOLD_S = 1e-3
# Least noise of a step between two poses: what the encoders of a standing robot leave open.
_TRANSLATION_FLOOR_M, _ROTATION_FLOOR_DEG = 0.002, 0.1


def pose_motions(log: Trajectory, frames: FloatArray, settings: RecordedOdometrySettings) -> Steps:
    """Body motions between frames (m,) by recorded poses."""
    poses = interpolate_poses(log, frames)
    covariances = [pose_noise(m, settings) for m in inverse(poses[:-1]) @ poses[1:]]
    # Unlike a speed, a pose cannot be held beyond the log's ends: that would say "no motion".
    known = steps_covered(log.timestamps, frames, _MAX_GAP_S, _POSE_HOLD_S)
    return _steps(poses, covariances, known)


def pose_noise(motion: FloatArray, settings: RecordedOdometrySettings) -> FloatArray:
    """Covariance (6, 6) of a body motion (4, 4): a fraction of its length and angle, no less."""
    length = float(np.linalg.norm(motion[:3, 3]))
    angle = rotation_angle(motion[:3, :3])
    rotation = max(settings.rotation_sigma_fraction * angle, float(np.radians(_ROTATION_FLOOR_DEG)))
    translation = max(settings.translation_sigma_fraction * length, _TRANSLATION_FLOOR_M)
    return np.diag(np.repeat([rotation**2, translation**2], 3))


# Of MEMS gyroscopes in cameras, phones and drones, by their data sheets (InvenSense MPU-9250, Bosch
# BMI055 and BMI160, Analog Devices ADIS16448). EuRoC's is 4.5 degrees/s off.
_START_BIAS_DPS = 3.0
_TURN_SIGMA_FRACTION = 0.013  # sensitivity 1 %, alignment of its axes half a degree
_MAX_RATE_GAP_S = 0.1  # over which the angular velocity is taken as linear
_RATE_HOLD_S = 0.02  # beyond the first and last sample


def gyroscope_motions(
    stamps: FloatArray, rates: FloatArray, frames: FloatArray, noise: GyroscopeNoise
) -> Steps:
    """Turns between frames (m,) by angular velocities (n, 3) in rad/s about the body's axes.

    docs/derivations/motion.md.
    """
    known = steps_covered(stamps, frames, _MAX_RATE_GAP_S, _RATE_HOLD_S)
    rotations, jacobians = integrate_rates(stamps, rates, frames)
    start = float(np.radians(_START_BIAS_DPS)) ** 2
    steps: list[Odometry | None] = []
    for ok, dt, rotation, jacobian in zip(
        known, np.diff(frames).tolist(), rotations, jacobians, strict=True
    ):
        angle = rotation_angle(rotation)
        variance = noise.density**2 * dt + (_TURN_SIGMA_FRACTION * angle) ** 2
        bias = BiasEffect(jacobian, start_variance=start, walk=noise.walk**2 * dt)
        steps.append(Odometry.turn(rotation, variance * np.eye(3), bias) if ok else None)
    return tuple(steps)


def integrate_rates(
    stamps: FloatArray, rates: FloatArray, at: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Rotations (m - 1, 3, 3) between times (m,), and their Jacobians by the bias.

    Between samples the angular velocity is linear in time; the rotation of that is exact to the
    fourth order (Magnus expansion: Iserles et al. 2000). The Jacobian is that of the rotation
    vector at the step's end (Forster et al. 2017, (A.20)). Outside the log the nearest sample is
    held.
    """
    from scipy.spatial.transform import Rotation

    times = np.union1d(stamps, at)
    sampled = np.column_stack([np.interp(times, stamps, axis) for axis in rates.T])
    dt = np.diff(times)[:, None]
    first, second = sampled[:-1], sampled[1:]
    vectors = 0.5 * dt * (first + second) + dt**2 / 12.0 * np.cross(first, second)
    steps = Rotation.from_rotvec(vectors).as_matrix()
    turned = np.empty((len(steps) + 1, 3, 3))  # the product of the first k steps, for every k
    turned[0] = np.eye(3)
    for k, step in enumerate(steps):
        turned[k + 1] = turned[k] @ step
    x, y, z = vectors.T
    none = np.zeros_like(x)
    skew = np.array([[none, -z, y], [z, none, -x], [-y, x, none]]).transpose(2, 0, 1)
    right = np.eye(3) - 0.5 * skew + skew @ skew / 6.0  # Jacobians, to the second order
    effect = turned[1:] @ (right * dt[:, :, None])
    summed = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(effect, axis=0)])
    rows = np.searchsorted(times, at)
    start, end = rows[:-1], rows[1:]
    back = np.swapaxes(turned[end], -1, -2)
    return np.swapaxes(turned[start], -1, -2) @ turned[end], -back @ (summed[end] - summed[start])


# --------------------------------------------------------------------------------------------
# Synthetic odometry


STAMP_TOLERANCE_S = 1e-6
"""Within which a frame has a true pose."""

# Least noise per axis and step: a covariance of a standing robot must be invertible.
_SYNTHETIC_FLOOR_M, _SYNTHETIC_FLOOR_DEG = 0.001, 0.01


def synthetic_motions(
    truth: Trajectory,
    bTc: FloatArray,
    settings: SyntheticOdometrySettings,
    seed: int,
    frames: FloatArray,
) -> Steps:
    """Motions of the body between frames (m,): the truth with noise drawn from a seed.

    The motion of a step is ``M = M_true * Exp(xi)``, ``xi`` normal with the covariance that is
    reported with it, independent per body axis and step; None where the truth has a gap. Each step
    has its own generator, seeded from (seed, numbers of its two frames), so that any part of a
    recording repeats the same noise.
    """
    steps: list[Odometry | None] = []
    # Stamps identify frames whatever the selection; microseconds are what files keep.
    marks = np.round(frames * 1e6).astype(np.int64)
    rows = rows_at(truth.timestamps, frames, STAMP_TOLERANCE_S)
    for i, (before, after) in enumerate(pairwise(rows.tolist())):
        if before < 0 or after < 0:
            steps.append(None)
            continue
        camera = inverse(truth.poses[before]) @ truth.poses[after]
        motion = bTc @ camera @ inverse(bTc)
        length = float(np.linalg.norm(motion[:3, 3]))
        rotation = np.radians(max(settings.rotation_sigma_deg, _SYNTHETIC_FLOOR_DEG))
        translation = max(settings.translation_sigma_fraction * length, _SYNTHETIC_FLOOR_M)
        sigmas = np.repeat([rotation, translation], 3)
        generator = np.random.default_rng([seed, *(int(t) % 2**63 for t in marks[i : i + 2])])
        noise = generator.standard_normal(6) * sigmas
        steps.append(Odometry(motion @ se3_exp(noise), np.diag(sigmas**2)))
    return tuple(steps)
