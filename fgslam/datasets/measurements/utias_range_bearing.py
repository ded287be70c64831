"""UTIAS "Lost in the Woods": a wheeled robot among 17 tubes, with truth (docs/datasets/utias.md).

Variables, after Barfoot's course notes (data set 2): ``t``; ``v``, ``om`` measured speed and turn
rate; ``r``, ``b`` laser range and bearing (positive to the left) to each landmark, 0 where unseen;
``l`` true landmarks; ``x_true``, ``y_true``, ``th_true`` with ``true_valid``; ``d`` how far the
laser sits ahead of the robot's centre; variances ``r_var``, ``b_var``, ``v_var``, ``om_var``.

The plane becomes space with everything at the sensor's height: elevation 0 under the bearing's
noise. It is meant for ``frontend.ego_motion.dof: 3``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.estimates import Trajectory
from fgslam.core.measurements import Odometry
from fgslam.core.recordings import LandmarkTruth, MeasurementRecording
from fgslam.core.sensors import RangeBearingSensor
from fgslam.datasets.measurements.files import (
    MeasuredFrame,
    files_identity,
    make_increments,
    make_log,
)
from fgslam.datasets.measurements.matlab_files import MatlabFile, read_matlab
from fgslam.datasets.odometry_settings import OdometrySettings
from fgslam.datasets.selection import select_of
from fgslam.datasets.settings import UtiasRangeBearingSettings


@dataclass(frozen=True, slots=True, eq=False)
class _Recorded:
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
    recorded = _read(read_matlab(path))
    chosen = select_of(len(recorded.stamps), settings, settings.path)
    bTc = g.BODY_FORWARD_LEFT_UP_FROM_CAMERA.copy()
    bTc[0, 3] = recorded.ahead
    sensor = RangeBearingSensor(settings.max_range_m, bTc)
    increments = make_increments(_frames(recorded, chosen, settings, bTc))
    level = np.zeros(len(recorded.landmarks))
    return MeasurementRecording(
        name="UTIAS Lost in the Woods",
        identity=files_identity([path], settings),
        log=make_log(sensor, increments, odometry),
        ground_truth=_truth(recorded, chosen, bTc),
        landmark_truth=LandmarkTruth(
            np.arange(len(level), dtype=np.int64), np.column_stack([recorded.landmarks, level])
        ),
        notes=tuple(_notes(recorded, chosen, settings)),
    )


def _read(file: MatlabFile) -> _Recorded:
    stamps = file.stamps(file.array("t", (None, 1))[:, 0])
    n = len(stamps)
    landmarks = file.array("l", (None, 2))
    variances = ("r_var", "b_var", "v_var", "om_var")
    return _Recorded(
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


def _truth(recorded: _Recorded, chosen: IntArray, bTc: FloatArray) -> Trajectory | None:
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
    recorded: _Recorded, chosen: IntArray, settings: UtiasRangeBearingSettings
) -> Iterator[str]:
    yield "planar: all landmarks are taken to be at the sensor's height"
    without = int((~recorded.valid[chosen]).sum())
    if without:
        yield f"{without} of {len(chosen)} frames have no ground truth"
    far = int((recorded.ranges[chosen] > settings.max_range_m).sum())
    if far:
        yield f"{far} readings beyond {settings.max_range_m:g} m left out"


def _frames(
    recorded: _Recorded, chosen: IntArray, settings: UtiasRangeBearingSettings, bTc: FloatArray
) -> Iterator[MeasuredFrame]:
    bearing, distance = recorded.variances["b_var"], recorded.variances["r_var"]
    covariance = np.diag([bearing, bearing, distance])
    steps = _steps(recorded, settings)
    for k, index in enumerate(chosen.tolist()):
        odometry = None
        if k:
            between = g.compose_odometry(steps[chosen[k - 1] : index])
            odometry = g.odometry_of_camera(between, bTc)
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


def _steps(recorded: _Recorded, settings: UtiasRangeBearingSettings) -> list[Odometry]:
    """Motions (n - 1) of the robot from each frame to the next, rates taken as constant.

    The speeds are those of the interval's start, which fits the truth better than those of its
    end. What the wheels do not measure gets the noise of what they do: height that of the way,
    pitch and roll that of the heading; a floor leaves them out.
    """
    scale = settings.rate_sigma_scale
    speed, turn = (scale**2 * recorded.variances[name] for name in ("v_var", "om_var"))
    lateral = settings.lateral_sigma_mps**2
    variance = np.array([turn, turn, turn, speed, lateral, speed])
    out = []
    for rates, duration in zip(recorded.rates, np.diff(recorded.stamps), strict=False):
        v, om = duration * rates
        motion = g.se3_exp(np.array([0.0, 0.0, om, v, 0.0, 0.0]))
        out.append(Odometry(motion, duration**2 * np.diag(variance)))
    return out
