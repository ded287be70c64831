"""UTIAS "Starry Night": a stereo camera over 20 landmarks, with truth (docs/datasets/utias.md).

Variables, after Barfoot's course notes (State Estimation for Robotics, assignment of data set 3):
``theta_vk_i``, ``r_i_vk_i`` true rotation vector and position of the vehicle; ``w_vk_vk_i``,
``v_vk_vk_i`` its measured rates; ``y_k_j`` pixels (left column, left row, right column, right row),
-1 where unseen; ``C_c_v``, ``rho_v_c_v`` the left camera in the vehicle.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.errors import DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.measurements import Odometry
from fgslam.core.recordings import LandmarkTruth, MeasurementRecording
from fgslam.core.sensors import CameraRig
from fgslam.datasets.measurements.files import (
    MeasuredFrame,
    files_identity,
    make_increments,
    make_log,
)
from fgslam.datasets.measurements.matlab_files import MatlabFile, read_matlab
from fgslam.datasets.odometry_settings import OdometrySettings
from fgslam.datasets.selection import select_of
from fgslam.datasets.settings import UtiasStereoSettings

# (column, row, disparity) of the right camera, from left column and row, right column and row.
_MEASURE: FloatArray = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.5, 0.0, 0.5], [1.0, 0.0, -1.0, 0.0]])
_NOT_RIGID = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class _Recorded:
    stamps: FloatArray  # (n,)
    body: FloatArray  # (n, 4, 4) true wTb
    rates: FloatArray  # (n, 6) measured, [rotation, translation]
    rate_variance: FloatArray  # (6,)
    pixels: FloatArray  # (n, landmarks, 4)
    seen: BoolArray  # (n, landmarks)
    landmarks: FloatArray  # (landmarks, 3)
    rig: CameraRig


def open_starry_night(
    settings: UtiasStereoSettings, odometry: OdometrySettings
) -> MeasurementRecording:
    """Opens the file.

    Raises:
        DatasetError: it is missing, damaged, or another data set; or no frame is left.
    """
    path = Path(settings.path)
    file = read_matlab(path)
    recorded = _read(file)
    chosen = select_of(len(recorded.stamps), settings, settings.path)
    covariance = _pixel_covariance(file, settings)
    increments = make_increments(_frames(recorded, chosen, settings, covariance))
    poses = recorded.body[chosen] @ recorded.rig.bTc
    return MeasurementRecording(
        name="UTIAS Starry Night",
        identity=files_identity([path], settings),
        log=make_log(recorded.rig, increments, odometry),
        ground_truth=Trajectory(recorded.stamps[chosen], poses),
        landmark_truth=LandmarkTruth(
            np.arange(len(recorded.landmarks), dtype=np.int64), recorded.landmarks
        ),
        notes=(),
    )


def _read(file: MatlabFile) -> _Recorded:
    stamps = file.stamps(file.array("t", (1, None))[0])
    n = len(stamps)
    landmarks = file.array("rho_i_pj_i", (3, None)).T
    y = file.array("y_k_j", (4, n, len(landmarks))).transpose(1, 2, 0)
    unseen = (y == -1.0).all(axis=2)
    if ((y < 0.0).any(axis=2) & ~unseen).any():
        raise DatasetError(
            f"{file.path}: y_k_j has a negative pixel that is not marked unseen (all four -1); "
            "restore the file"
        )
    positive = ~unseen & (y[:, :, 0] > y[:, :, 2])
    if not positive.any():
        raise DatasetError(f"{file.path}: y_k_j never sees a landmark; restore the file")
    body = np.tile(np.eye(4), (n, 1, 1))
    body[:, :3, :3] = [g.so3_exp(theta) for theta in file.array("theta_vk_i", (3, n)).T]
    body[:, :3, 3] = file.array("r_i_vk_i", (3, n)).T
    rates = np.vstack([file.array("w_vk_vk_i", (3, n)), file.array("v_vk_vk_i", (3, n))]).T
    variance = np.vstack([file.positive("w_var", (3, 1)), file.positive("v_var", (3, 1))])
    rig = _read_rig(file, y[positive])
    return _Recorded(stamps, body, rates, variance[:, 0], y, positive, landmarks, rig)


def _read_rig(file: MatlabFile, pixels: FloatArray) -> CameraRig:
    """The rectified cameras; the image is what holds all measurements."""
    fu, fv, b = (float(file.positive(name, (1, 1))[0, 0]) for name in ("fu", "fv", "b"))
    cu, cv = (float(file.array(name, (1, 1))[0, 0]) for name in ("cu", "cv"))
    rotation = file.array("C_c_v", (3, 3)).T
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _NOT_RIGID:
        raise DatasetError(f"{file.path}: C_c_v is not a rotation; restore the file")
    left = g.pose(rotation, file.array("rho_v_c_v", (3, 1))[:, 0])
    size = np.ceil(pixels.reshape(-1, 2, 2).max(axis=(0, 1))).astype(np.int64) + 1
    return CameraRig(
        width=int(size[0]),
        height=int(size[1]),
        fx=fu,
        fy=fv,
        cx=cu,
        cy=cv,
        baseline=b,
        vertical_baseline=None,
        bTc=g.right_from_left_camera(left, b),
    )


def _pixel_covariance(file: MatlabFile, settings: UtiasStereoSettings) -> FloatArray:
    """Covariance (3, 3) of (column, row, disparity): the file's variances, correlated."""
    sigma = settings.pixel_sigma_scale * np.sqrt(file.positive("y_var", (4, 1))[:, 0])
    columns, rows = settings.left_right_correlation
    correlation = np.eye(4)
    correlation[0, 2] = correlation[2, 0] = columns
    correlation[1, 3] = correlation[3, 1] = rows
    return g.congruence(_MEASURE, correlation * np.outer(sigma, sigma))


def _frames(
    recorded: _Recorded, chosen: IntArray, settings: UtiasStereoSettings, covariance: FloatArray
) -> Iterator[MeasuredFrame]:
    variance = settings.rate_sigma_scale**2 * recorded.rate_variance
    for k, index in enumerate(chosen.tolist()):
        odometry = None
        if k:
            steps = (_step(recorded, i, variance) for i in range(chosen[k - 1], index))
            odometry = g.odometry_of_camera(g.compose_odometry(steps), recorded.rig.bTc)
        ids = np.flatnonzero(recorded.seen[index])
        y = recorded.pixels[index, ids]
        pixels = np.full((len(ids), 3, 2), np.nan)
        pixels[:, 0], pixels[:, 1] = y[:, 2:], y[:, :2]
        yield MeasuredFrame(
            index=index,
            timestamp=float(recorded.stamps[index]),
            odometry=odometry,
            ids=ids,
            measurement=y @ _MEASURE.T,
            covariance=np.tile(covariance, (len(ids), 1, 1)),
            pixels=pixels,
        )


def _step(recorded: _Recorded, i: int, variance: FloatArray) -> Odometry:
    """Motion of the vehicle from frame ``i`` to the next, its rates taken as constant.

    Translation is along the axes at the start; its noise is turned to those at the end.
    """
    duration = float(recorded.stamps[i + 1] - recorded.stamps[i])
    by = duration * recorded.rates[i]
    rotation = g.so3_exp(by[:3])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = duration**2 * np.diag(variance[:3])
    covariance[3:, 3:] = duration**2 * g.congruence(rotation.T, np.diag(variance[3:]))
    return Odometry(g.pose(rotation, by[3:]), covariance)
