"""UTIAS "Starry Night", a MATLAB file, as a folder of measurements (docs/datasets/published.md).

`python -m scripts.convert.starry_night FILE.mat FOLDER`. Variables, after Barfoot's course notes
(State Estimation for Robotics, assignment of data set 3): ``theta_vk_i``, ``r_i_vk_i`` true
rotation vector and position of the vehicle; ``w_vk_vk_i``, ``v_vk_vk_i`` its measured rates;
``y_k_j`` pixels (left column, left row, right column, right row), -1 where unseen; ``C_c_v``,
``rho_v_c_v`` the left camera in the vehicle.
"""

from __future__ import annotations

import struct
import sys
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.errors import DatasetError
from fgslam.core.log import LANDMARK_TRUTH_FILE, LandmarkTruth, write_landmark_truth
from fgslam.core.sensors import CameraRig, Odometry, compose_odometry, odometry_of_camera
from fgslam.datasets.measured import (
    GROUND_TRUTH_FILE,
    LOG_FILE,
    MeasuredFrame,
    make_increments,
    make_log,
)
from fgslam.datasets.settings import RecordedOdometrySettings
from scripts.convert import run, write_poses

# (column, row, disparity) of the right camera, from left column and row, right column and row.
_MEASURE: FloatArray = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.5, 0.0, 0.5], [1.0, 0.0, -1.0, 0.0]])
LEFT_RIGHT_CORRELATION = 0.86, 0.99
"""Of the noise of both images, in columns and rows, against the truth."""
_NOT_RIGID = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class StarryNight:
    """The file's contents, in our conventions."""

    stamps: FloatArray  # (n,)
    body: FloatArray  # (n, 4, 4) true wTb
    rates: FloatArray  # (n, 6) measured, [rotation, translation]
    rate_variance: FloatArray  # (6,)
    pixels: FloatArray  # (n, landmarks, 4)
    seen: BoolArray  # (n, landmarks)
    landmarks: FloatArray  # (landmarks, 3)
    rig: CameraRig


def convert(path: Path, folder: Path) -> None:
    """Writes the file's log, true poses and true landmarks into a folder.

    Raises:
        DatasetError: the file is missing, damaged, or another data set.
        OutputError: the folder cannot be written.
    """
    recorded, covariance = read_starry_night(path)
    increments = make_increments(_stereo_frames(recorded, covariance))
    folder.mkdir(parents=True, exist_ok=True)
    make_log(recorded.rig, increments, RecordedOdometrySettings()).save(folder / LOG_FILE)
    write_poses(folder / GROUND_TRUTH_FILE, recorded.stamps, recorded.body @ recorded.rig.bTc)
    ids = np.arange(len(recorded.landmarks), dtype=np.int64)
    truth, exact = LandmarkTruth(ids, recorded.landmarks), np.zeros(len(ids))
    write_landmark_truth(folder / LANDMARK_TRUTH_FILE, truth, exact)


def read_starry_night(path: Path) -> tuple[StarryNight, FloatArray]:
    """The recording, and the covariance (3, 3) of one measurement. Raises DatasetError."""
    file = read_matlab(path)
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
    recorded = StarryNight(stamps, body, rates, variance[:, 0], y, positive, landmarks, rig)
    return recorded, _pixel_covariance(file)


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


def _pixel_covariance(file: MatlabFile) -> FloatArray:
    """Covariance (3, 3) of (column, row, disparity): the file's variances, correlated."""
    sigma = np.sqrt(file.positive("y_var", (4, 1))[:, 0])
    columns, rows = LEFT_RIGHT_CORRELATION
    correlation = np.eye(4)
    correlation[0, 2] = correlation[2, 0] = columns
    correlation[1, 3] = correlation[3, 1] = rows
    return g.congruence(_MEASURE, correlation * np.outer(sigma, sigma))


def _stereo_frames(recorded: StarryNight, covariance: FloatArray) -> Iterator[MeasuredFrame]:
    for index in range(len(recorded.stamps)):
        odometry = _camera_step(recorded, index) if index else None
        ids = np.flatnonzero(recorded.seen[index])
        y = recorded.pixels[index, ids]
        pixels = np.full((len(ids), 3, 2), np.nan)
        pixels[:, 0], pixels[:, 1] = y[:, 2:], y[:, :2]
        seen = y @ _MEASURE.T, np.tile(covariance, (len(ids), 1, 1)), pixels
        yield index, float(recorded.stamps[index]), odometry, ids, seen


def _camera_step(recorded: StarryNight, k: int) -> Odometry:
    """Motion of the reference camera into frame ``k``, the vehicle's rates taken as constant.

    Translation is along the axes at the start; its noise is turned to those at the end.
    """
    i = k - 1
    duration = float(recorded.stamps[i + 1] - recorded.stamps[i])
    by, variance = duration * recorded.rates[i], recorded.rate_variance
    rotation = g.so3_exp(by[:3])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = duration**2 * np.diag(variance[:3])
    covariance[3:, 3:] = duration**2 * g.congruence(rotation.T, np.diag(variance[3:]))
    step = compose_odometry([Odometry(g.pose(rotation, by[3:]), covariance)])
    return odometry_of_camera(step, recorded.rig.bTc)


# --------------------------------------------------------------------------------------------
# MATLAB files of numbers, read strictly: errors name file, variable and remedy


_UNREADABLE = (
    OSError,
    ValueError,
    TypeError,
    LookupError,
    EOFError,
    ArithmeticError,
    MemoryError,
    NotImplementedError,
    MatReadError,
    struct.error,
    zlib.error,
)
"""What SciPy raises on truncated, damaged and foreign files."""


@dataclass(frozen=True, slots=True, eq=False)
class MatlabFile:
    """The variables of a .mat file (version 5)."""

    path: Path
    values: dict[str, object]

    def array(self, name: str, shape: tuple[int | None, ...]) -> FloatArray:
        """A variable as float64; None in ``shape`` leaves that length free.

        Raises:
            DatasetError: it is absent, of another shape, not of numbers, or not finite.
        """
        value = self.values.get(name)
        wanted = " x ".join("n" if size is None else str(size) for size in shape)
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
            raise DatasetError(
                f"{self.path}: no variable {name} of numbers ({wanted}); give the file of data "
                "set 3"
            )
        fits = len(value.shape) == len(shape) and all(
            size is None or size == length for size, length in zip(shape, value.shape, strict=True)
        )
        if not fits:
            got = " x ".join(str(length) for length in value.shape)
            raise DatasetError(
                f"{self.path}: variable {name} is {got}, expected {wanted}; restore the file"
            )
        if not np.isfinite(value).all():
            raise DatasetError(f"{self.path}: variable {name} is not finite; restore the file")
        return value.astype(np.float64)

    def positive(self, name: str, shape: tuple[int | None, ...]) -> FloatArray:
        """Like :meth:`array`, for variances and lengths. DatasetError unless all are above 0."""
        value = self.array(name, shape)
        if not (value > 0.0).all():
            raise DatasetError(f"{self.path}: variable {name} must be positive; restore the file")
        return value

    def stamps(self, values: FloatArray) -> FloatArray:
        """Time stamps (n,), checked to increase."""
        if not (np.diff(values) > 0.0).all():
            raise DatasetError(f"{self.path}: the times t do not increase; restore the file")
        return values


def read_matlab(path: Path) -> MatlabFile:
    """All variables of a file.

    Raises:
        DatasetError: it is missing, truncated, or no MATLAB file of version 5.
    """
    if not path.is_file():
        raise DatasetError(f"{path} does not exist; give the .mat file of data set 3")
    try:
        return MatlabFile(path, loadmat(str(path)))
    except _UNREADABLE as error:
        cause = " ".join(str(error).split()) or type(error).__name__
        raise DatasetError(
            f"{path}: not a readable MATLAB file ({cause}); it may be truncated, restore it"
        ) from None


if __name__ == "__main__":
    sys.exit(run(convert, __doc__))
