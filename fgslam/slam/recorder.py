"""Record of a session, frame by frame: measurement log, online poses, counts and times."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray, StateArrays
from fgslam.core.measurement_log import MeasurementLog
from fgslam.slam.pipeline import FrameReport

STAGES = ("load", "sift", "wait", "predict", "stereo", "track", "places", "update")
"""Per frame: `load` and `sift` run in threads beside the loop, `wait` is what they held it up."""


class FrameRow(NamedTuple):
    """Numbers of one frame; NaN where unknown."""

    status: str
    features: int
    stereo: int
    matched: int
    inliers: int
    landmarks: int
    mean_residual_px: float
    nis: float
    nis_dof: int
    stereo_precision: float
    problem: str


@dataclass(slots=True, eq=False)
class RunRecorder:
    """Record of all frames, besides the estimator's result."""

    log: MeasurementLog
    rows: list[FrameRow] = field(default_factory=list)
    tracked_poses: list[FloatArray] = field(default_factory=list)
    online_poses: list[FloatArray] = field(default_factory=list)
    online_covariances: list[FloatArray] = field(default_factory=list)
    stage_ms: list[FloatArray] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.rows)

    def add(self, report: FrameReport, wait_ms: float, stereo_precision: float) -> None:
        """Appends one frame."""
        beside = {"load": report.found.load_ms, "sift": report.found.sift_ms, "wait": wait_ms}
        times = beside | report.stage_ms
        row = _row(report, stereo_precision)
        self.stage_ms.append(np.array([times[stage] for stage in STAGES]))
        self.tracked_poses.append(report.tracking.wTc)
        self.online_poses.append(report.stats.wTc)
        self.online_covariances.append(report.stats.covariance)
        self.log.append(report.increment)
        self.rows.append(row)

    def column(self, name: str) -> npt.NDArray[Any]:
        """One number of all frames."""
        return np.array([getattr(row, name) for row in self.rows])

    def known_times(self) -> FloatArray:
        """(n, stages) milliseconds, without the frames of a session before: NaN there."""
        times = np.array(self.stage_ms).reshape(-1, len(STAGES))
        return times[np.isfinite(times).all(axis=1)]

    def state(self) -> StateArrays:
        """All but the log, as arrays."""
        out: StateArrays = {name: self.column(name) for name in FrameRow._fields}
        out["tracked_poses"] = np.array(self.tracked_poses).reshape(-1, 4, 4)
        out["online_poses"] = np.array(self.online_poses).reshape(-1, 4, 4)
        out["online_covariances"] = np.array(self.online_covariances).reshape(-1, 6, 6)
        out["stage_ms"] = np.array(self.stage_ms).reshape(-1, len(STAGES))
        return out

    def restore(self, state: StateArrays, log: MeasurementLog) -> None:
        """Continues from :meth:`state` and the log of as many frames."""
        columns = [state[name].tolist() for name in FrameRow._fields]
        self.rows = [FrameRow(*values) for values in zip(*columns, strict=True)]
        self.tracked_poses = list(state["tracked_poses"])
        self.online_poses = list(state["online_poses"])
        self.online_covariances = list(state["online_covariances"])
        self.stage_ms = list(state["stage_ms"])
        self.log.increments = log.increments[: len(self.rows)]


def _row(report: FrameReport, stereo_precision: float) -> FrameRow:
    tracking = report.tracking
    used = tracking.residuals[tracking.inliers]
    return FrameRow(
        status=tracking.status.value,
        features=len(report.found.features[0]) if report.found.features else 0,
        stereo=len(report.stereo),
        matched=len(tracking.inliers),
        inliers=int(tracking.inliers.sum()),
        landmarks=report.stats.landmarks,
        mean_residual_px=float(used.mean()) if len(used) else float("nan"),
        nis=report.stats.nis,
        nis_dof=report.stats.nis_dof,
        stereo_precision=stereo_precision,
        problem=report.found.problem,
    )
