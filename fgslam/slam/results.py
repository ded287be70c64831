"""What a session gives back: a step for each frame, and the whole result at any time."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fgslam.backend.protocol import Estimator
from fgslam.core.arrays import BoolArray, Brief, FloatArray
from fgslam.core.errors import FgslamError
from fgslam.core.estimates import EgoMotionStatus, Estimate, LandmarkMap, Trajectory
from fgslam.core.measurements import Observations
from fgslam.slam.pipeline import FrameReport, SlamPipeline
from fgslam.slam.recorder import STAGES, RunRecorder

ESTIMATOR_FAULTS = (
    FgslamError,
    RuntimeError,
    ValueError,
    ArithmeticError,
    LookupError,
    MemoryError,
)
"""What an estimator may end with: its own errors, GTSAM's (RuntimeError), NumPy's (ValueError)."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Step(Brief):
    """Pose of one tracked frame, and what was matched in it.

    Attributes:
        index: number of the frame in the session, from 0.
        timestamp: seconds.
        wTc: (4, 4) pose of the right camera in the world, metres.
        covariance: (6, 6) of it, [rotation, translation], radians and metres, in the tangent space
            at ``wTc``: ``T = wTc * Exp(xi)``.
        status: how the pose was found: `first`, `ok`, `capped`, `relocalised`; or, by odometry
            alone, `too_few_matches`, `diverged`, `no_image`.
        matches: the k landmarks of the map that the frame sees again: ids (k,), (column, row,
            disparity) (k, 3) in pixels with covariance, raw pixels (k, 3, 2) in right, left, top.
        inliers: (k,) which of the matches agree with the pose.
        new: landmarks that the frame adds to the map, in the same form.
        landmarks: number of landmarks in the map now.
        closed: for each loop closure offered by this frame, whether the estimator took it.
    """

    index: int
    timestamp: float
    wTc: FloatArray
    covariance: FloatArray
    status: EgoMotionStatus
    matches: Observations
    inliers: BoolArray
    new: Observations
    landmarks: int
    closed: tuple[bool, ...]

    @staticmethod
    def of(report: FrameReport) -> Step:
        """Step of a frame's report."""
        increment, stats = report.increment, report.stats
        seen = increment.observations
        return Step(
            index=report.found.i,
            timestamp=increment.timestamp,
            wTc=np.array(stats.wTc),
            covariance=np.array(stats.covariance),
            status=report.tracking.status,
            matches=seen.select(~seen.is_new),
            inliers=~increment.rejected[~seen.is_new],
            new=seen.select(seen.is_new),
            landmarks=stats.landmarks,
            closed=stats.closed,
        )


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SessionResult(Brief):
    """Everything that a session knows at one moment.

    Attributes:
        kind: the estimator.
        estimate: trajectory, pose covariances and landmarks as known now.
        online: each pose as it was first estimated, at its own time.
        online_covariances: (n, 6, 6) of those.
        closed: of all loop closures offered so far, whether the estimator took them.
        frames: the record of every frame, by name of the column.
    """

    kind: str
    estimate: Estimate
    online: Trajectory
    online_covariances: FloatArray
    closed: tuple[bool, ...]
    frames: dict[str, npt.NDArray[Any]]

    # What a comparison of estimators asks of a replay, and a live session does not know.
    failure = ""
    final_ms = math.nan
    memory_before_mb = None
    peak_memory_mb = None

    @property
    def trajectory(self) -> Trajectory:
        """All poses ``wTc`` of the right camera as known now, n of them."""
        return self.estimate.trajectory

    @property
    def covariances(self) -> FloatArray:
        """(n, 6, 6) of the poses, as in :class:`Step`; NaN where one cannot be had."""
        return self.estimate.covariances

    @property
    def remarks(self) -> tuple[str, ...]:
        """What the estimator left out or had to repair, in words."""
        return self.estimate.remarks

    def column(self, name: str) -> npt.NDArray[Any]:
        """(n,) one number of every frame: `status`, `matched`, `inliers`, `nis`, `update_ms`..."""
        return self.frames[name]


def result_of(pipeline: SlamPipeline, recorder: RunRecorder, failed: bool = False) -> SessionResult:
    """The result of the frames so far; nothing is changed.

    Where the estimator ``failed`` in the frame after them, it may have taken in a part of that
    frame, and may have no answer any more.
    """
    stamps = np.array([increment.timestamp for increment in recorder.log], np.float64)
    online = Trajectory(stamps, np.array(recorder.online_poses).reshape(-1, 4, 4))
    covariances = np.array(recorder.online_covariances).reshape(-1, 6, 6)
    if failed:
        estimate, _ = estimate_of_failed(pipeline.estimator, online, covariances)
        unknown = np.setdiff1d(estimate.landmarks.ids, pipeline.tracker.database.ids)
        estimate = replace(estimate, landmarks=estimate.landmarks.without(unknown))
    else:
        estimate = pipeline.estimator.estimate()
    return SessionResult(
        kind=pipeline.estimator.kind,
        estimate=estimate,
        online=online,
        online_covariances=covariances,
        closed=() if pipeline.places is None else tuple(pipeline.places.taken),
        frames=_columns(recorder),
    )


def estimate_of_failed(
    estimator: Estimator, online: Trajectory, covariances: FloatArray
) -> tuple[Estimate, str]:
    """The estimate of the frames that went well; without one the online poses, and the reason.

    Args:
        estimator: it may hold a part of one more frame.
        online: the n poses as they were first estimated.
        covariances: (n, 6, 6) of them.
    """
    n = len(online)
    try:
        found = estimator.estimate()
        if not np.isfinite(found.trajectory.poses[:n]).all():
            raise ValueError("a pose of the final trajectory is not finite")
        if not np.isfinite(found.landmarks.positions).all():
            raise ValueError("a landmark of the final map is not finite")
    except ESTIMATOR_FAULTS as error:
        remark = ("the final trajectory is the online one: no final estimate could be had",)
        none = LandmarkMap(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))
        return Estimate(online, covariances, none, remark), f"no final estimate: {reason(error)}"
    poses = Trajectory(found.trajectory.timestamps[:n], found.trajectory.poses[:n])
    return replace(found, trajectory=poses, covariances=found.covariances[:n]), ""


def reason(error: BaseException) -> str:
    """An error in one line; GTSAM's messages have several."""
    text = " ".join(str(error).split())
    if isinstance(error, FgslamError):
        return text
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def _columns(recorder: RunRecorder) -> dict[str, npt.NDArray[Any]]:
    times = np.array(recorder.stage_ms).reshape(-1, len(STAGES))
    stage = {name: times[:, k] for k, name in enumerate(STAGES)}
    columns = {name: recorder.column(name) for name in recorder.rows[0]._fields}
    return columns | {
        "update_ms": stage["predict"] + stage["update"],
        "solve_ms": stage["track"],
    }
