"""What an estimator was given, frame by frame: the state of those that cannot show their inside.

Of the tracking only what smoothers use is kept: pose, covariance, inliers, residuals, and whether
the landmarks determined it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray, StateArrays
from fgslam.core.estimates import EgoMotion, EgoMotionStatus, Prediction
from fgslam.core.log_arrays import frames_of
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.measurements import Increment, Odometry
from fgslam.core.sensors import CameraRig

Input: TypeAlias = tuple[Increment, EgoMotion]


class RecordedInputs:
    """Arguments of all updates so far."""

    def __init__(self, sensor: CameraRig) -> None:
        """None yet."""
        self._sensor = sensor
        self._inputs: list[Input] = []

    def __len__(self) -> int:
        return len(self._inputs)

    def append(self, increment: Increment, tracking: EgoMotion) -> None:
        """Keeps one update's arguments."""
        self._inputs.append((increment, tracking))

    def timestamps(self) -> FloatArray:
        """(n,) seconds."""
        return np.array([increment.timestamp for increment, _ in self._inputs])

    def timestamp(self, frame: int) -> float:
        """A frame's, seconds."""
        return self._inputs[frame][0].timestamp

    def tracked(self, frame: int) -> Prediction:
        """A frame's pose and covariance as tracked."""
        tracking = self._inputs[frame][1]
        return Prediction(tracking.wTc, tracking.covariance)

    def motions(self) -> list[Odometry | None]:
        """The step to each frame, as it was used."""
        return [increment.odometry for increment, _ in self._inputs]

    def state(self) -> StateArrays:
        """All of it as plain arrays."""
        return _arrays(self._sensor, self._inputs)

    @staticmethod
    def recalled(state: StateArrays) -> list[Input]:
        """Everything that :meth:`state` told of, in order, to be put in once more."""
        return _inputs(state)


def _arrays(sensor: CameraRig, inputs: Sequence[Input]) -> StateArrays:
    """Inputs as plain arrays."""
    log, trackings = MeasurementLog(sensor, {}), [tracking for _, tracking in inputs]
    for increment, _ in inputs:
        log.append(increment)
    motions = [increment.odometry for increment, _ in inputs]
    n, known = len(trackings), np.array([motion is not None for motion in motions], np.bool_)
    given = [motion for motion in motions if motion is not None]
    return {f"log/{name}": array for name, array in log.to_arrays().items()} | {
        "wTc": np.array([t.wTc for t in trackings]).reshape(n, 4, 4),
        "covariance": np.array([t.covariance for t in trackings]).reshape(n, 6, 6),
        "matches": np.array([len(t.inliers) for t in trackings], np.int64),
        "inliers": np.concatenate([np.empty(0, np.bool_), *(t.inliers for t in trackings)]),
        "residuals": np.concatenate([np.empty(0), *(t.residuals for t in trackings)]),
        "noise": np.array([t.noise for t in trackings]),
        "measured": np.array([t.status.measured for t in trackings], np.bool_),
        "motion_known": known,
        "motion": np.array([m.motion for m in given]).reshape(-1, 4, 4),
        "motion_covariance": np.array([m.covariance for m in given]).reshape(-1, 6, 6),
    }


def _inputs(state: StateArrays) -> list[Input]:
    """Inputs back from their arrays."""
    logged = {
        name.removeprefix("log/"): array for name, array in state.items() if name.startswith("log/")
    }
    frames = frames_of(logged, "the smoother's saved state")[2]
    ends = np.cumsum(state["matches"])[:-1]
    inliers = np.split(state["inliers"], ends)
    residuals = np.split(state["residuals"], ends)
    row = np.cumsum(state["motion_known"]) - 1
    out = []
    for k, increment in enumerate(frames):
        tracking = EgoMotion(
            state["wTc"][k],
            state["covariance"][k],
            inliers[k],
            residuals[k],
            EgoMotionStatus.OK if state["measured"][k] else EgoMotionStatus.TOO_FEW_MATCHES,
            0,
            noise=float(state["noise"][k]),
        )
        measured = increment.odometry
        turned = measured is not None and measured.turned
        if (measured is None or turned) and state["motion_known"][k]:
            motion, covariance = state["motion"][row[k]], state["motion_covariance"][row[k]]
            bias = None if measured is None else measured.bias
            stand_in = Odometry(motion, covariance, False, turned, bias)
            increment = dataclasses.replace(increment, odometry=stand_in)
        out.append((increment, tracking))
    return out
