"""The correction that a drive shows of its own rig, from its measurement log."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.backend.filters.landmark_kalman import LandmarkKalman
from fgslam.backend.filters.rig_models import WeighedCorrection
from fgslam.backend.filters.self_calibration import SelfCalibration
from fgslam.backend.settings import LandmarkKalmanSettings
from fgslam.core.arrays import Brief, FloatArray
from fgslam.core.errors import MeasurementLogError
from fgslam.core.estimates import Prediction
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.rig_correction import RigCorrection
from fgslam.core.sensors import CameraRig
from fgslam.core.threads import one_blas_thread
from fgslam.frontend.settings import EgoMotionSettings, StereoSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver
from fgslam.slam.replay import replay_frame, replay_motion


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class CalibratedDrive(Brief):
    """A log and the correction of its rig, as known in the end and on the way.

    Attributes:
        found: after the last frame.
        values: (n, p) of the correction after each frame, in the order of
            :func:`fgslam.core.rig_correction.term_names`.
        sigmas: (n, p) of those.
        log: the drive as the correction of the end measures it: for smoothers.
        causal: each frame as the correction of the frames before measures it: for filters.
    """

    found: WeighedCorrection
    values: FloatArray
    sigmas: FloatArray
    log: MeasurementLog
    causal: MeasurementLog


@one_blas_thread()
def calibrate(log: MeasurementLog, ego_motion: EgoMotionSettings | None = None) -> CalibratedDrive:
    """Estimates what the calibration of a log's rig leaves uncorrected, from the drive alone.

    Args:
        log: of a rig of two or three cameras, with raw pixels; not changed.
        ego_motion: of the least squares that finds each frame's pose; None for the defaults.

    Raises:
        MeasurementLogError: the log is of another sensor, has no pixels or no frame.
    """
    rig = _rig_of(log)
    settings = ego_motion or EgoMotionSettings()
    estimator = LandmarkKalman(
        rig, LandmarkKalmanSettings(), Prediction(np.eye(4), np.zeros((6, 6)))
    )
    solver, motion = EgoMotionSolver(rig, settings), replay_motion(log)
    itself = SelfCalibration(rig, StereoSettings().pixel_sigma)
    causal, known = [], []
    for k, increment in enumerate(log):
        causal.append(itself.found.applied.corrected_increment(increment))
        frame = replay_frame(causal[-1], estimator, solver, motion, k)
        known.append(itself.observe(increment, frame.stats.wTc))
    return CalibratedDrive(
        found=known[-1],
        values=np.array([c.estimated.values for c in known]),
        sigmas=np.array([np.sqrt(np.diagonal(c.estimated.covariance)) for c in known]),
        log=corrected_log(log, known[-1].applied),
        causal=MeasurementLog(rig, log.motion_model, causal),
    )


def corrected_log(log: MeasurementLog, correction: RigCorrection) -> MeasurementLog:
    """A log in which every frame is corrected."""
    frames = [correction.corrected_increment(increment) for increment in log]
    return MeasurementLog(log.rig, log.motion_model, frames)


def _rig_of(log: MeasurementLog) -> CameraRig:
    if not isinstance(log.rig, CameraRig):
        raise MeasurementLogError(
            "calibrate: the log is of a range-bearing sensor; give that of a stereo rig"
        )
    if not len(log):
        raise MeasurementLogError("calibrate: the log holds no frame; give that of a drive")
    seen = (s.observations.pixels[:, : log.rig.cameras] for s in log)
    if not any(np.isfinite(pixels).all(axis=(1, 2)).any() for pixels in seen):
        raise MeasurementLogError(
            "calibrate: the log lacks raw pixels of its cameras; give one of a run on images"
        )
    return log.rig
