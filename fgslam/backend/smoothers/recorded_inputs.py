"""What an estimator was given, frame by frame: the state of those that cannot show their inside.

Of the tracking only what smoothers use is kept: pose, covariance, inliers, residuals, and whether
the landmarks determined it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from fgslam.core.arrays import FloatArray, StateArrays
from fgslam.core.estimates import EgoMotion, EgoMotionStatus
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.measurements import Increment, Odometry
from fgslam.core.sensors import Sensor


@dataclass(slots=True, eq=False)
class RecordedInputs:
    """Arguments of all updates so far."""

    increments: list[Increment] = field(default_factory=list)
    trackings: list[EgoMotion] = field(default_factory=list)

    def append(self, increment: Increment, tracking: EgoMotion) -> None:
        """Keeps one update's arguments."""
        self.increments.append(increment)
        self.trackings.append(tracking)

    def __iter__(self) -> Iterator[tuple[Increment, EgoMotion]]:
        return zip(self.increments, self.trackings, strict=True)

    def timestamps(self) -> FloatArray:
        """(n,) seconds."""
        return np.array([increment.timestamp for increment in self.increments])

    def motions(self) -> list[Odometry | None]:
        """The step to each frame, as it was used."""
        return [increment.odometry for increment in self.increments]

    def to_arrays(self, sensor: Sensor) -> StateArrays:
        """All of it as plain arrays."""
        log = MeasurementLog(sensor, {})
        for increment in self.increments:
            log.append(increment)
        n, motions = len(self.trackings), self.motions()
        known = np.array([motion is not None for motion in motions], np.bool_)
        given = [motion for motion in motions if motion is not None]
        return {f"log/{name}": array for name, array in log.to_arrays().items()} | {
            "wTc": np.array([t.wTc for t in self.trackings]).reshape(n, 4, 4),
            "covariance": np.array([t.covariance for t in self.trackings]).reshape(n, 6, 6),
            "matches": np.array([len(t.inliers) for t in self.trackings], np.int64),
            "inliers": np.concatenate(
                [np.empty(0, np.bool_), *(t.inliers for t in self.trackings)]
            ),
            "residuals": np.concatenate([np.empty(0), *(t.residuals for t in self.trackings)]),
            "measured": np.array([t.status.measured for t in self.trackings], np.bool_),
            "motion_known": known,
            "motion": np.array([m.motion for m in given]).reshape(-1, 4, 4),
            "motion_covariance": np.array([m.covariance for m in given]).reshape(-1, 6, 6),
        }

    @staticmethod
    def from_arrays(state: StateArrays) -> RecordedInputs:
        """Back from :meth:`to_arrays`."""
        logged = {
            name.removeprefix("log/"): array
            for name, array in state.items()
            if name.startswith("log/")
        }
        log = MeasurementLog.from_arrays(logged, "the smoother's saved state")
        ends = np.cumsum(state["matches"])[:-1]
        inliers = np.split(state["inliers"], ends)
        residuals = np.split(state["residuals"], ends)
        row = np.cumsum(state["motion_known"]) - 1
        out = RecordedInputs()
        for k, increment in enumerate(log):
            tracking = EgoMotion(
                state["wTc"][k],
                state["covariance"][k],
                inliers[k],
                residuals[k],
                EgoMotionStatus.OK if state["measured"][k] else EgoMotionStatus.TOO_FEW_MATCHES,
                0,
            )
            measured = increment.odometry
            turned = measured is not None and measured.turned
            if (measured is None or turned) and state["motion_known"][k]:
                motion, covariance = state["motion"][row[k]], state["motion_covariance"][row[k]]
                bias = None if measured is None else measured.bias
                stand_in = Odometry(motion, covariance, False, turned, bias)
                increment = dataclasses.replace(increment, odometry=stand_in)
            out.append(increment, tracking)
        return out
