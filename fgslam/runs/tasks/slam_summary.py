"""The numbers of a run, as metrics.json holds them."""

from __future__ import annotations

from collections import Counter
from dataclasses import asdict

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import EgoMotionStatus, Estimate, Trajectory, correlation
from fgslam.evaluation.judging import Answer, Truth, judge_answer
from fgslam.evaluation.metrics import EstimatorMetrics, JsonValue, UpdateTime
from fgslam.slam.replay import peak_memory_mb
from fgslam.slam.results import STAGES, RunRecorder

_ESTIMATOR_STAGES = ("predict", "update")
_LOOP_STAGES = ("predict", "stereo", "track", "places", "update")


def estimator_metrics(estimate: Estimate, truth: Truth, recorder: RunRecorder) -> EstimatorMetrics:
    """Accuracy, consistency, time and memory of the live estimator, as of a replayed one."""
    times = recorder.known_times()
    stamps = np.array([increment.timestamp for increment in recorder.log], np.float64)
    online = Trajectory(stamps, np.array(recorder.online_poses).reshape(-1, 4, 4))
    answer = Answer(
        estimate=estimate,
        online=online,
        online_covariances=np.array(recorder.online_covariances).reshape(-1, 6, 6),
        nis=recorder.column("nis").astype(np.float64),
        nis_dof=recorder.column("nis_dof").astype(np.int64),
        update_ms=_stage_sum(times, _ESTIMATOR_STAGES),
        peak_memory_mb=peak_memory_mb(),
    )
    return judge_answer(answer, truth).metrics


def run_numbers(recorder: RunRecorder) -> dict[str, JsonValue]:
    """Counts over the frames that do not depend on truth."""
    times = recorder.known_times()
    return {
        "status_counts": dict(sorted(Counter(recorder.column("status").tolist()).items())),
        "features": spread(recorder.column("features")),
        "stereo_matches": spread(recorder.column("stereo")),
        "landmark_matches": spread(recorder.column("inliers")[1:]),
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


def spread(counts: IntArray) -> JsonValue:
    """Extremes, median and 5 % quantiles; None of nothing."""
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
    """Median correlation of sideways motion and yaw (Se et al. 5); None before frame 1."""
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
