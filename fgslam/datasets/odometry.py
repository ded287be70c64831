"""Odometry of recordings: body motions from speed and yaw rate, from poses, or from the truth.

Turns of a gyroscope are in ``gyroscope.py``.
The body's axes are x forward, y left, z up. All covariances are 6x6 [rotation, translation] in the
tangent space at the new pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.errors import DatasetError, OdometryError
from fgslam.core.estimates import Trajectory
from fgslam.core.geometry import inverse, rotation_angle, se3_exp
from fgslam.core.measurements import Odometry
from fgslam.core.recordings import Frame
from fgslam.core.recordings import Sequence as FrameSequence
from fgslam.core.sensors import CameraRig
from fgslam.datasets.gyroscope import GyroscopeLog, motions_from_gyroscope
from fgslam.datasets.odometry_checks import require_samples, require_sane, steps_covered
from fgslam.datasets.recording import OdometrySource
from fgslam.datasets.settings import RecordedOdometrySettings, SyntheticOdometrySettings
from fgslam.datasets.tables import (
    TUM_COLUMNS,
    Table,
    interpolate_poses,
    read_table,
    require_increasing,
    rows_at,
    trajectory_of,
)

SPEED_COLUMNS = ("time", "forward speed", "yaw rate")
_POSE_HOLD_S = 1e-3
# Least noise of a step between two poses: what the encoders of a standing robot leave open.
_TRANSLATION_FLOOR_M, _ROTATION_FLOOR_DEG = 0.002, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class SpeedLog:
    """Forward speed (n,) in m/s and yaw rate (n,) in rad/s, counter-clockwise, at stamps (n,)."""

    stamps: FloatArray
    speed: FloatArray
    yaw_rate: FloatArray


def read_speed_log(path: Path, settings: RecordedOdometrySettings) -> SpeedLog:
    """Read a comma-separated file: time in s, forward speed in m/s, yaw rate (up) in rad/s.

    Raises:
        OdometryError: a line is malformed, not finite, out of time order, or absurd.
    """
    return checked_speeds(read_table(path, SPEED_COLUMNS, ",", OdometryError), settings)


def checked_speeds(table: Table, settings: RecordedOdometrySettings) -> SpeedLog:
    """Rows (time, forward speed, yaw rate) as a log; raises as :func:`read_speed_log`."""
    require_samples(table.path, len(table))
    require_increasing(table, table.column(0), OdometryError)
    require_sane(table, table.column(1), settings.max_speed_mps, "forward speed", "m/s")
    turn = np.degrees(table.column(2))
    require_sane(table, turn, settings.max_turn_dps, "yaw rate", "degrees/s")
    return SpeedLog(table.column(0) + settings.time_offset_s, table.column(1), table.column(2))


# --------------------------------------------------------------------------------------------
# Speed and yaw rate


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
    nodes, weights = _unit_gauss_legendre()
    speed_inside = speed[:-1, None] + np.diff(speed)[:, None] * nodes
    turned = rate[:-1, None] * nodes + 0.5 * np.diff(rate)[:, None] * nodes**2
    heading = yaw[:-1, None] + duration[:, None] * turned
    x, y = (
        np.concatenate([[0.0], np.cumsum(duration * ((speed_inside * part(heading)) @ weights))])
        for part in (np.cos, np.sin)
    )
    return np.column_stack([x, y, yaw])[np.searchsorted(times, at)]


def _unit_gauss_legendre() -> tuple[FloatArray, FloatArray]:
    """Nodes and weights (6,) of the quadrature on [0, 1]."""
    nodes, weights = np.polynomial.legendre.leggauss(6)
    return np.asarray(0.5 * (nodes + 1.0)), np.asarray(0.5 * weights)


def motions_from_speed(
    log: SpeedLog, frames: FloatArray, settings: RecordedOdometrySettings
) -> tuple[Odometry | None, ...]:
    """Body motions (n - 1) between consecutive frame stamps (n,): planar arcs; None if not covered.

    The covariance is diagonal: noise of the measured speed and yaw rate, and of the unmeasured
    rates, each times the step's duration.
    """
    planar = planar_poses(log, frames)
    poses = np.tile(np.eye(4), (len(frames), 1, 1))
    from scipy.spatial.transform import Rotation  # not needed by all that have no odometry

    poses[:, :3, :3] = Rotation.from_euler("z", planar[:, 2:]).as_matrix()
    poses[:, :2, 3] = planar[:, :2]
    rotation = [settings.roll_rate_sigma_dps, settings.pitch_rate_sigma_dps]
    rotation.append(settings.yaw_rate_sigma_dps)
    translation = [
        settings.speed_sigma_mps,
        settings.lateral_sigma_mps,
        settings.vertical_sigma_mps,
    ]
    rates = np.concatenate([np.radians(rotation), translation])
    covariances = [np.diag((rates * dt) ** 2) for dt in np.diff(frames)]
    known = steps_covered(log.stamps, frames, settings.max_gap_s, settings.max_gap_s)
    return _motions(poses, covariances, known)


def _motions(
    poses: FloatArray, covariances: Sequence[FloatArray], known: BoolArray
) -> tuple[Odometry | None, ...]:
    motions = inverse(poses[:-1]) @ poses[1:]
    steps = zip(motions, covariances, known, strict=True)
    return tuple(Odometry(m, c) if ok else None for m, c, ok in steps)


# --------------------------------------------------------------------------------------------
# Poses


def read_pose_log(path: Path, settings: RecordedOdometrySettings) -> Trajectory:
    """Read body poses in TUM format, in whatever world the odometry started.

    Raises:
        OdometryError: a line is malformed, out of time order, or moves absurdly fast.
    """
    return checked_poses(read_table(path, TUM_COLUMNS, error=OdometryError), settings)


def checked_poses(table: Table, settings: RecordedOdometrySettings) -> Trajectory:
    """Rows (time, position, quaternion) as a trajectory; raises as :func:`read_pose_log`."""
    log = trajectory_of(table, OdometryError)
    require_samples(table.path, len(table))
    motions = inverse(log.poses[:-1]) @ log.poses[1:]
    duration = np.diff(log.timestamps)
    speed = np.linalg.norm(motions[:, :3, 3], axis=1) / duration
    from scipy.spatial.transform import Rotation

    angle = Rotation.from_matrix(motions[:, :3, :3]).magnitude()
    arrival = Table(table.path, table.values[1:], table.lines[1:])
    require_sane(arrival, speed, settings.max_speed_mps, "speed", "m/s")
    require_sane(arrival, np.degrees(angle) / duration, settings.max_turn_dps, "turn", "degrees/s")
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


AnyLog: TypeAlias = SpeedLog | GyroscopeLog | Trajectory
"""What odometry is recorded as: speeds, angular velocities, or poses."""


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


def pose_noise(motion: FloatArray, settings: RecordedOdometrySettings) -> FloatArray:
    """Covariance (6, 6) of a body motion (4, 4): a fraction of its length and angle, no less."""
    length = float(np.linalg.norm(motion[:3, 3]))
    angle = rotation_angle(motion[:3, :3])
    rotation = max(settings.rotation_sigma_fraction * angle, float(np.radians(_ROTATION_FLOOR_DEG)))
    translation = max(settings.translation_sigma_fraction * length, _TRANSLATION_FLOOR_M)
    return np.diag(np.repeat([rotation**2, translation**2], 3))


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
        self, sequence: FrameSequence, settings: SyntheticOdometrySettings, seed: int
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
        sigmas = self._sigmas(float(np.linalg.norm(motion[:3, 3])))
        noise = self._generator(i).standard_normal(6) * sigmas
        return Odometry(motion @ se3_exp(noise), np.diag(sigmas**2))

    def _sigmas(self, length: float) -> FloatArray:
        """Standard deviations (6,) [rotation, translation] for a step of this length in metres."""
        s = self._settings
        rotation = np.radians(max(s.rotation_sigma_deg, _SYNTHETIC_FLOOR_DEG))
        translation = max(s.translation_sigma_fraction * length, _SYNTHETIC_FLOOR_M)
        return np.repeat([rotation, translation], 3)

    def _generator(self, i: int) -> np.random.Generator:
        # Stamps identify frames whatever the selection; microseconds are what files keep.
        pair = np.round(self.timestamps[i - 1 : i + 1] * 1e6).astype(np.int64)
        return np.random.default_rng([self._seed, *(int(t) % 2**63 for t in pair)])
