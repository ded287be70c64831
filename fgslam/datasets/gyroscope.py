"""Turns of the body by a gyroscope: angular velocity, integrated between frames.

docs/derivations/gyroscope.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.cameras.formats import read_asl_mounting
from fgslam.cameras.trees import Values, read_tree
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import OdometryError
from fgslam.core.geometry import rotation_angle
from fgslam.core.measurements import BiasEffect, Odometry
from fgslam.datasets.odometry_checks import require_samples, require_sane, steps_covered
from fgslam.datasets.settings import RecordedOdometrySettings
from fgslam.datasets.stamps import time_unit
from fgslam.datasets.tables import Table, read_table, require_increasing

# Of MEMS gyroscopes in cameras, phones and drones, by their data sheets (InvenSense MPU-9250, Bosch
# BMI055 and BMI160, Analog Devices ADIS16448). EuRoC's is 4.5 degrees/s off.
_START_BIAS_DPS = 3.0
_TURN_SIGMA_FRACTION = 0.013  # sensitivity 1 %, alignment of its axes half a degree
_MAX_GAP_S = 0.1  # over which the angular velocity is taken as linear
_HOLD_S = 0.02  # beyond the first and last sample

RATE_COLUMNS = ("time", "angular velocity x", "y", "z")


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
    noise: GyroscopeNoise = GyroscopeNoise()


def read_rates(path: Path) -> Table:
    """Rows (seconds, rad/s about x, y, z) of a comma-separated file, whatever its unit of time.

    Raises:
        OdometryError: a line is malformed or not finite.
    """
    table = read_table(path, RATE_COLUMNS, ",", OdometryError)
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
    require_samples(table.path, len(table))
    require_increasing(table, table.column(0), OdometryError)
    rates = table.values[:, 1:4]
    size = np.degrees(np.linalg.norm(rates, axis=1))
    require_sane(table, size, settings.max_turn_dps, "angular velocity", "degrees/s")
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


# --------------------------------------------------------------------------------------------
# Integration


def motions_from_gyroscope(log: GyroscopeLog, frames: FloatArray) -> tuple[Odometry | None, ...]:
    """Turns of the body between consecutive frame stamps (n,): n - 1; None where not covered."""
    known = steps_covered(log.stamps, frames, _MAX_GAP_S, _HOLD_S)
    rotations, jacobians = integrated(log, frames)
    durations = np.diff(frames)
    return tuple(
        _turn(log.noise, float(dt), rotation, jacobian) if ok else None
        for ok, dt, rotation, jacobian in zip(known, durations, rotations, jacobians, strict=True)
    )


def _turn(noise: GyroscopeNoise, dt: float, rotation: FloatArray, jacobian: FloatArray) -> Odometry:
    variance = noise.density**2 * dt + (_TURN_SIGMA_FRACTION * rotation_angle(rotation)) ** 2
    start = float(np.radians(_START_BIAS_DPS)) ** 2
    bias = BiasEffect(jacobian, start_variance=start, walk=noise.walk**2 * dt)
    return Odometry.turn(rotation, variance * np.eye(3), bias)


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
    turned = _products(Rotation.from_rotvec(vectors).as_matrix())
    effect = turned[1:] @ (_right_jacobians(vectors) * dt[:, :, None])
    summed = np.concatenate([np.zeros((1, 3, 3)), np.cumsum(effect, axis=0)])
    rows = np.searchsorted(times, at)
    start, end = rows[:-1], rows[1:]
    back = np.swapaxes(turned[end], -1, -2)
    return np.swapaxes(turned[start], -1, -2) @ turned[end], -back @ (summed[end] - summed[start])


def _products(rotations: FloatArray) -> FloatArray:
    """(n + 1, 3, 3) the product of the first k rotations (n, 3, 3), for every k."""
    out = np.empty((len(rotations) + 1, 3, 3))
    out[0] = np.eye(3)
    for k, rotation in enumerate(rotations):
        out[k + 1] = out[k] @ rotation
    return out


def _right_jacobians(vectors: FloatArray) -> FloatArray:
    """(n, 3, 3) of rotation vectors (n, 3) between samples, to the second order of their angle."""
    x, y, z = vectors.T
    none = np.zeros_like(x)
    skew = np.array([[none, -z, y], [z, none, -x], [-y, x, none]]).transpose(2, 0, 1)
    return np.asarray(np.eye(3) - 0.5 * skew + skew @ skew / 6.0)
