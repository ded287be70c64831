"""The numbers of a run, as metrics.json holds them."""

from __future__ import annotations

import resource
from collections import Counter
from dataclasses import asdict

import numpy as np

from fgslam.evaluation.consistency import judge, pose_nees
from fgslam.evaluation.trajectory import (
    Alignment,
    TrajectoryError,
    end_pose,
    evaluate_trajectory,
    to_estimate_world,
)
from fgslam.export.metrics import EstimatorMetrics, JsonValue, UpdateTime
from fgslam.runs.recorder import STAGES, RunRecorder
from fgslam.types import EgoMotionStatus, Estimate, FloatArray, IntArray, Trajectory, correlation

_ESTIMATOR_STAGES = ("predict", "update")
_LOOP_STAGES = ("predict", "stereo", "track", "update")


def estimator_metrics(
    estimate: Estimate, truth: Trajectory | None, recorder: RunRecorder
) -> EstimatorMetrics:
    """Accuracy, consistency, time and memory of the live estimator.

    ``ate_rmse_m`` is after SE3 alignment; drift and end errors have the first pose aligned.
    """
    aligned = evaluate_trajectory(estimate.trajectory, truth, Alignment.SE3)
    first = evaluate_trajectory(estimate.trajectory, truth, Alignment.FIRST_POSE)
    times = np.array(recorder.stage_ms).reshape(-1, len(STAGES))
    nees, verdict = _pose_consistency(estimate, truth)
    return EstimatorMetrics(
        ate_rmse_m=aligned.ate_rmse_m,
        rpe_trans_m=aligned.rpe_trans_m,
        rpe_rot_deg=aligned.rpe_rot_deg,
        drift_percent=first.drift_percent,
        end_error_m=first.end_error_m,
        end_error_deg=first.end_error_deg,
        landmarks=len(estimate.landmarks),
        nees_pose_per_dof=nees,
        nees_landmark_per_dof=None,
        update_ms=UpdateTime.of(_stage_sum(times, _ESTIMATOR_STAGES)),
        peak_memory_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        more=_alignment_notes(aligned, first)
        | {"nees_pose": verdict, "end_against_start": _end_against_start(estimate.trajectory)},
    )


def run_numbers(recorder: RunRecorder) -> dict[str, JsonValue]:
    """Counts over the frames that do not depend on truth."""
    times = np.array(recorder.stage_ms).reshape(-1, len(STAGES))
    return {
        "status_counts": dict(sorted(Counter(recorder.column("status").tolist()).items())),
        "features": _spread(recorder.column("features")),
        "stereo_matches": _spread(recorder.column("stereo")),
        "landmark_matches": _spread(recorder.column("inliers")[1:]),
        "mean_residual_px": _median(recorder.column("mean_residual_px")),
        "stereo_precision": _mean(recorder.column("stereo_precision")),
        "correlation_x_yaw": _sideways_yaw(recorder),
        "frames_without_image": int(np.count_nonzero(recorder.column("problem") != "")),
        "frame_problems": frame_problems(recorder),
        "loop_ms": asdict(UpdateTime.of(_stage_sum(times, _LOOP_STAGES))),
        "sift_ms": asdict(UpdateTime.of(_stage_sum(times, ("sift",)))),
    }


def frame_problems(recorder: RunRecorder) -> list[str]:
    """A line for each frame that the landmarks did not locate: which and why."""
    lines = []
    for increment, row in zip(recorder.log, recorder.rows, strict=True):
        status = EgoMotionStatus(row.status)
        if row.problem:
            lines.append(f"frame {increment.index}: {row.problem}")
        elif not status.measured and status is not EgoMotionStatus.FIRST:
            lines.append(
                f"frame {increment.index}: pose predicted only ({status.value}; {row.features} "
                f"features, {row.stereo} stereo matches, {row.matched} landmarks matched)"
            )
    return lines


def _stage_sum(times: FloatArray, stages: tuple[str, ...]) -> FloatArray:
    return np.asarray(times[:, [STAGES.index(stage) for stage in stages]].sum(axis=1))


def _alignment_notes(aligned: TrajectoryError, first: TrajectoryError) -> dict[str, JsonValue]:
    return {
        "alignment": aligned.alignment.value,
        "matched_poses": aligned.matched_poses,
        "ate_max_m": aligned.ate_max_m,
        "ate_first_pose_m": first.ate_rmse_m,
        "path_length_m": aligned.path_length_m,
    }


def _pose_consistency(
    estimate: Estimate, truth: Trajectory | None
) -> tuple[float | None, JsonValue]:
    """Pose NEES per degree of freedom with its chi-square band and verdict, None without truth."""
    found = None if truth is None else to_estimate_world(estimate.trajectory, truth)
    if found is None:
        return None, None
    rows, poses = found
    # The first pose is the gauge: it has neither error nor covariance.
    rows, poses = rows[1:], poses[1:]
    result = judge([pose_nees(estimate.trajectory.poses[rows], estimate.covariances[rows], poses)])
    return (None, None) if result is None else (result.per_dof, asdict(result))


def _end_against_start(trajectory: Trajectory) -> JsonValue:
    """Last pose in the frame of the first: what the paper judges its loop by."""
    found = end_pose(trajectory)
    return None if found is None else asdict(found)


def _spread(counts: IntArray) -> JsonValue:
    if not len(counts):
        return None
    low, middle, high = np.percentile(counts, [5.0, 50.0, 95.0])
    return {
        "min": int(counts.min()),
        "p05": float(low),
        "median": float(middle),
        "p95": float(high),
        "max": int(counts.max()),
    }


def _sideways_yaw(recorder: RunRecorder) -> float | None:
    """Median correlation of sideways motion and yaw (Se et al. 5; S28); None before frame 1."""
    if len(recorder) < 2:
        return None
    found = correlation(np.array(recorder.online_covariances[1:]))
    return float(np.median(found[:, 1, 3]))


def _median(values: FloatArray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None


def _mean(values: FloatArray) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None
