"""Poses of a SLAM run for the path images of the same drive, by the same clock."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError
from fgslam.core.trajectories import Trajectory, read_covariances
from fgslam.datasets.omni import OmniRecording
from fgslam.datasets.times import covered, interpolate_poses, nearest_rows
from fgslam.homing.route import MetricPoses

COVARIANCES = "covariance.csv"
_LONGEST_GAP_S = 1.0  # between two frames: beyond, the way between them is not a straight line
_SAME_TIME_S = 0.05  # beyond the first or last frame: half the time between two images


@dataclass(frozen=True, slots=True, eq=False)
class MetricDrive:
    """Where a drive's SLAM was when.

    Attributes:
        trajectory: of the reference camera.
        covariances: (n, 6, 6) of its poses; NaN where not known.
        where: the file.
    """

    trajectory: Trajectory
    covariances: FloatArray
    where: str

    @staticmethod
    def load(path: Path) -> MetricDrive:
        """A TUM file, and the covariance.csv of its run beside it if there is one.

        Raises:
            DatasetError: a file is missing or malformed, or they are not of one run.
        """
        trajectory = Trajectory.load(path)
        beside = path.parent / COVARIANCES
        if not beside.is_file():
            return MetricDrive(trajectory, np.full((len(trajectory), 6, 6), np.nan), str(path))
        stamps, covariances = read_covariances(beside)
        if len(stamps) != len(trajectory) or not np.allclose(
            stamps, trajectory.timestamps, rtol=0, atol=1e-6
        ):
            raise DatasetError(
                f"{beside}: not the poses' of {path.name}; give the run's final.tum, or a copy of "
                "the trajectory in a folder of its own"
            )
        return MetricDrive(trajectory, covariances, str(path))

    def require(self, recording: OmniRecording) -> None:
        """Raises DatasetError where the recording was not taken during the drive."""
        times = recording.timestamps
        if not np.isfinite(times).all():
            raise DatasetError(
                f"{recording.name}: its images have no times, which poses are found by; put a list "
                "times.txt beside them: name, seconds"
            )
        if not self._covered(times).any():
            first, last = self.trajectory.timestamps[[0, -1]]
            raise DatasetError(
                f"{self.where}: from {first:.3f} to {last:.3f} s, but {recording.name} from "
                f"{times[0]:.3f} to {times[-1]:.3f} s; both need times of one clock"
            )

    def at(self, times: FloatArray) -> MetricPoses:
        """Poses at times (n,), with the covariance of the nearest frame; NaN beyond the drive."""
        known = self._covered(times)
        poses, covariances = (
            np.full((len(times), 4, 4), np.nan),
            np.full((len(times), 6, 6), np.nan),
        )
        poses[known] = interpolate_poses(self.trajectory, times[known])
        rows = nearest_rows(self.trajectory.timestamps, times[known])
        covariances[known] = self.covariances[rows]
        return MetricPoses(poses, covariances)

    def _covered(self, times: FloatArray) -> np.typing.NDArray[np.bool_]:
        return covered(self.trajectory.timestamps, times, _LONGEST_GAP_S, _SAME_TIME_S)
