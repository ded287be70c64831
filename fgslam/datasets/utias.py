"""UTIAS "Starry Night" and "Lost in the Woods", with truth (docs/datasets/utias.md).

Variables, after Barfoot's course notes (State Estimation for Robotics, assignments of data sets 3
and 2). *Starry Night*, a stereo camera over 20 landmarks: ``theta_vk_i``, ``r_i_vk_i`` true
rotation vector and position of the vehicle; ``w_vk_vk_i``, ``v_vk_vk_i`` its measured rates;
``y_k_j`` pixels (left column, left row, right column, right row), -1 where unseen; ``C_c_v``,
``rho_v_c_v`` the left camera in the vehicle.

*Lost in the Woods*, a wheeled robot among 17 tubes: ``t``; ``v``, ``om`` measured speed and turn
rate; ``r``, ``b`` laser range and bearing (positive to the left) to each landmark, 0 where unseen;
``l`` true landmarks; ``x_true``, ``y_true``, ``th_true`` with ``true_valid``; ``d`` how far the
laser sits ahead of the robot's centre; variances ``r_var``, ``b_var``, ``v_var``, ``om_var``. The
plane becomes space with everything at the sensor's height: elevation 0 under the bearing's noise.
It is meant for ``frontend.ego_motion.dof: 3``.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.errors import DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.measurements import Odometry
from fgslam.core.recordings import LandmarkTruth, MeasurementRecording
from fgslam.core.sensors import CameraRig, RangeBearingSensor
from fgslam.datasets.measurement_files import (
    MeasuredFrame,
    camera_odometry,
    files_identity,
    make_increments,
    make_log,
)
from fgslam.datasets.recording import select_of
from fgslam.datasets.settings import (
    OdometrySettings,
    UtiasRangeBearingSettings,
    UtiasStereoSettings,
)

# (column, row, disparity) of the right camera, from left column and row, right column and row.
_MEASURE: FloatArray = np.array([[0.0, 0.0, 1.0, 0.0], [0.0, 0.5, 0.0, 0.5], [1.0, 0.0, -1.0, 0.0]])
_LATERAL_SIGMA_MPS = 0.03
"""Of sideways speed, which wheels do not measure; 0.016 in truth (docs/datasets/utias.md)."""
_NOT_RIGID = 1e-6
_SCALES = {"pixel_sigma_scale": 1.0, "rate_sigma_scale": 1.0}
"""Of the file's standard deviations, once settings: part of a recording's identity."""


@dataclass(frozen=True, slots=True, eq=False)
class _StarryNight:
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
    recorded = _read_starry_night(file)
    chosen = select_of(len(recorded.stamps), settings, settings.path)
    covariance = _pixel_covariance(file, settings)
    increments = make_increments(_stereo_frames(recorded, chosen, covariance))
    poses = recorded.body[chosen] @ recorded.rig.bTc
    return MeasurementRecording(
        name="UTIAS Starry Night",
        identity=files_identity([path], asdict(settings) | _SCALES),
        log=make_log(recorded.rig, increments, odometry),
        ground_truth=Trajectory(recorded.stamps[chosen], poses),
        landmark_truth=LandmarkTruth(
            np.arange(len(recorded.landmarks), dtype=np.int64), recorded.landmarks
        ),
        notes=(),
    )


def _read_starry_night(file: MatlabFile) -> _StarryNight:
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
    return _StarryNight(stamps, body, rates, variance[:, 0], y, positive, landmarks, rig)


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
    sigma = np.sqrt(file.positive("y_var", (4, 1))[:, 0])
    columns, rows = settings.left_right_correlation
    correlation = np.eye(4)
    correlation[0, 2] = correlation[2, 0] = columns
    correlation[1, 3] = correlation[3, 1] = rows
    return g.congruence(_MEASURE, correlation * np.outer(sigma, sigma))


def _stereo_frames(
    recorded: _StarryNight, chosen: IntArray, covariance: FloatArray
) -> Iterator[MeasuredFrame]:
    motions = camera_odometry(lambda i: _step(recorded, i), chosen, recorded.rig.bTc)
    for index, odometry in zip(chosen.tolist(), motions, strict=True):
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


def _step(recorded: _StarryNight, i: int) -> Odometry:
    """Motion of the vehicle from frame ``i`` to the next, its rates taken as constant.

    Translation is along the axes at the start; its noise is turned to those at the end.
    """
    duration = float(recorded.stamps[i + 1] - recorded.stamps[i])
    by, variance = duration * recorded.rates[i], recorded.rate_variance
    rotation = g.so3_exp(by[:3])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = duration**2 * np.diag(variance[:3])
    covariance[3:, 3:] = duration**2 * g.congruence(rotation.T, np.diag(variance[3:]))
    return Odometry(g.pose(rotation, by[3:]), covariance)


# --------------------------------------------------------------------------------------------
# Lost in the Woods


@dataclass(frozen=True, slots=True, eq=False)
class _LostInTheWoods:
    stamps: FloatArray  # (n,)
    rates: FloatArray  # (n, 2) speed and turn
    ranges: FloatArray  # (n, landmarks), 0 unseen
    bearings: FloatArray  # (n, landmarks)
    planar: FloatArray  # (n, 3) true x, y, heading
    valid: BoolArray  # (n,) where there is truth
    landmarks: FloatArray  # (landmarks, 2)
    ahead: float
    variances: dict[str, float]


def open_lost_in_the_woods(
    settings: UtiasRangeBearingSettings, odometry: OdometrySettings
) -> MeasurementRecording:
    """Opens the file.

    Raises:
        DatasetError: it is missing, damaged, or another data set; or no frame is left.
    """
    path = Path(settings.path)
    recorded = _read_lost_in_the_woods(read_matlab(path))
    chosen = select_of(len(recorded.stamps), settings, settings.path)
    bTc = g.BODY_FORWARD_LEFT_UP_FROM_CAMERA.copy()
    bTc[0, 3] = recorded.ahead
    sensor = RangeBearingSensor(settings.max_range_m, bTc)
    increments = make_increments(_range_bearing_frames(recorded, chosen, settings, bTc))
    level = np.zeros(len(recorded.landmarks))
    return MeasurementRecording(
        name="UTIAS Lost in the Woods",
        identity=files_identity(
            [path], asdict(settings) | {"rate_sigma_scale": _SCALES["rate_sigma_scale"]}
        ),
        log=make_log(sensor, increments, odometry),
        ground_truth=_truth(recorded, chosen, bTc),
        landmark_truth=LandmarkTruth(
            np.arange(len(level), dtype=np.int64), np.column_stack([recorded.landmarks, level])
        ),
        notes=tuple(_notes(recorded, chosen, settings)),
    )


def _read_lost_in_the_woods(file: MatlabFile) -> _LostInTheWoods:
    stamps = file.stamps(file.array("t", (None, 1))[:, 0])
    n = len(stamps)
    landmarks = file.array("l", (None, 2))
    variances = ("r_var", "b_var", "v_var", "om_var")
    return _LostInTheWoods(
        stamps=stamps,
        rates=np.hstack([file.array(name, (n, 1)) for name in ("v", "om")]),
        ranges=file.array("r", (n, len(landmarks))),
        bearings=file.array("b", (n, len(landmarks))),
        planar=np.hstack([file.array(name, (n, 1)) for name in ("x_true", "y_true", "th_true")]),
        valid=file.array("true_valid", (n, 1))[:, 0] != 0.0,
        landmarks=landmarks,
        ahead=float(file.array("d", (1, 1))[0, 0]),
        variances={name: float(file.positive(name, (1, 1))[0, 0]) for name in variances},
    )


def _truth(recorded: _LostInTheWoods, chosen: IntArray, bTc: FloatArray) -> Trajectory | None:
    rows = chosen[recorded.valid[chosen]]
    if not len(rows):
        return None
    body = np.tile(np.eye(4), (len(rows), 1, 1))
    cosine, sine = np.cos(recorded.planar[rows, 2]), np.sin(recorded.planar[rows, 2])
    body[:, 0, 0] = body[:, 1, 1] = cosine
    body[:, 0, 1], body[:, 1, 0] = -sine, sine
    body[:, :2, 3] = recorded.planar[rows, :2]
    return Trajectory(recorded.stamps[rows], body @ bTc)


def _notes(
    recorded: _LostInTheWoods, chosen: IntArray, settings: UtiasRangeBearingSettings
) -> Iterator[str]:
    yield "planar: all landmarks are taken to be at the sensor's height"
    without = int((~recorded.valid[chosen]).sum())
    if without:
        yield f"{without} of {len(chosen)} frames have no ground truth"
    far = int((recorded.ranges[chosen] > settings.max_range_m).sum())
    if far:
        yield f"{far} readings beyond {settings.max_range_m:g} m left out"


def _range_bearing_frames(
    recorded: _LostInTheWoods,
    chosen: IntArray,
    settings: UtiasRangeBearingSettings,
    bTc: FloatArray,
) -> Iterator[MeasuredFrame]:
    bearing, distance = recorded.variances["b_var"], recorded.variances["r_var"]
    covariance = np.diag([bearing, bearing, distance])
    steps = _steps(recorded, settings)
    motions = camera_odometry(steps.__getitem__, chosen, bTc)
    for index, odometry in zip(chosen.tolist(), motions, strict=True):
        ranges = recorded.ranges[index]
        ids = np.flatnonzero((ranges > 0.0) & (ranges <= settings.max_range_m))
        azimuth = -recorded.bearings[index, ids]
        yield MeasuredFrame(
            index=index,
            timestamp=float(recorded.stamps[index]),
            odometry=odometry,
            ids=ids,
            measurement=np.column_stack([azimuth, np.zeros(len(ids)), ranges[ids]]),
            covariance=np.tile(covariance, (len(ids), 1, 1)),
            pixels=np.full((len(ids), 3, 2), np.nan),
        )


def _steps(recorded: _LostInTheWoods, settings: UtiasRangeBearingSettings) -> list[Odometry]:
    """Motions (n - 1) of the robot from each frame to the next, rates taken as constant.

    The speeds are those of the interval's start, which fits the truth better than those of its
    end. What the wheels do not measure gets the noise of what they do: height that of the way,
    pitch and roll that of the heading; a floor leaves them out.
    """
    speed, turn = recorded.variances["v_var"], recorded.variances["om_var"]
    lateral = _LATERAL_SIGMA_MPS**2
    variance = np.array([turn, turn, turn, speed, lateral, speed])
    out = []
    for rates, duration in zip(recorded.rates, np.diff(recorded.stamps), strict=False):
        v, om = duration * rates
        motion = g.se3_exp(np.array([0.0, 0.0, om, v, 0.0, 0.0]))
        out.append(Odometry(motion, duration**2 * np.diag(variance)))
    return out


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
                f"{self.path}: no variable {name} of numbers ({wanted}); give the file of the "
                "data set that dataset.kind names"
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
        raise DatasetError(
            f"{path} does not exist; check dataset.path, or say where the .mat file is: "
            "--set dataset.path=FILE"
        )
    try:
        return MatlabFile(path, loadmat(str(path)))
    except _UNREADABLE as error:
        cause = " ".join(str(error).split()) or type(error).__name__
        raise DatasetError(
            f"{path}: not a readable MATLAB file ({cause}); it may be truncated, restore it"
        ) from None
