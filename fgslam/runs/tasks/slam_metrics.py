"""The numbers of a run, as metrics.json holds them."""

from __future__ import annotations

import csv
import io
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, astuple, fields
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import DatasetError
from fgslam.core.estimates import EgoMotionStatus, Estimate, Trajectory, correlation
from fgslam.evaluation.judging import (
    Answer,
    JudgedClosure,
    Truth,
    judge_answer,
    judge_closures,
    predicted_poses,
)
from fgslam.evaluation.statistics import EstimatorMetrics, JsonValue, UpdateTime
from fgslam.report.content import Cell, Column, TextTable, write_csv
from fgslam.runs.engine import LocatedShare
from fgslam.slam.part_remarks import located_frames
from fgslam.slam.replay import peak_memory_mb
from fgslam.slam.results import STAGES, RunRecorder

_NO_IMAGE = EgoMotionStatus.NO_IMAGE.value
_ESTIMATOR_STAGES = ("predict", "update")
_LOOP_STAGES = ("watch", "predict", "stereo", "track", "places", "update", "calibrate")


def estimator_metrics(estimate: Estimate, truth: Truth, recorder: RunRecorder) -> EstimatorMetrics:
    """Accuracy, consistency, time and memory of the live estimator, as of a replayed one."""
    times = recorder.known_times()
    online = Trajectory(recorder.log.timestamps, np.array(recorder.online_poses).reshape(-1, 4, 4))
    answer = Answer(
        estimate=estimate,
        online=online,
        online_covariances=np.array(recorder.online_covariances).reshape(-1, 6, 6),
        nis=recorder.column("nis").astype(np.float64),
        nis_dof=recorder.column("nis_dof").astype(np.int64),
        update_ms=_stage_sum(times, _ESTIMATOR_STAGES),
        peak_memory_mb=peak_memory_mb(),
        predicted=predicted_poses(recorder.column("status").tolist()),
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
        "located": asdict(located(recorder)),
        "frames_without_image": int(np.count_nonzero(recorder.column("status") == _NO_IMAGE)),
        "frame_problems": frame_problems(recorder),
        "loop_ms": asdict(UpdateTime.of(_stage_sum(times, _LOOP_STAGES))),
        "sift_ms": asdict(UpdateTime.of(_stage_sum(times, ("sift",)))),
    }


def located(recorder: RunRecorder) -> LocatedShare:
    """Frames that landmarks gave a pose; the first one, which the world is, among them.

    Of all, with those before the first one.
    """
    known = located_frames(recorder)
    return LocatedShare(int(known.sum()), recorder.left_out + len(known))


def frame_problems(recorder: RunRecorder) -> list[str]:
    """A line for each frame that the landmarks did not locate: which and why."""
    lines = []
    for number, row in zip(recorder.log.numbers.tolist(), recorder.rows, strict=True):
        status = EgoMotionStatus(row.status)
        if status is EgoMotionStatus.CAMERA_FAULT:  # said of all of them together
            continue
        if row.problem:
            lines.append(f"frame {number}: {row.problem}")
        elif not status.measured and status is not EgoMotionStatus.FIRST:
            lines.append(
                f"frame {number}: pose predicted only ({status.value}; {row.features} "
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


LOOPS_FILE = "loops.csv"
_NAMES = ("frame", "returned_to", *(f.name for f in fields(JudgedClosure)), "false")
_COLUMNS = (
    Column("taken", "whether the estimator closed the loop; one it refused changed nothing"),
    Column("returned to", "number of the frame whose place was recognised"),
    Column("matches", "landmarks of that place seen again"),
    Column("made one", "landmarks of the return found to be earlier ones"),
    Column("correction (cm)", "how far closing the loop moved the pose"),
    Column("error before (cm)", "of the position just before, in the world of the first pose"),
    Column("error after (cm)", "of the position just after"),
    Column("closure's error (cm)", "of the relative position that the closure measured"),
    Column("closure's error (deg)", "of the relative heading that the closure measured"),
)


def closures_of(
    recorder: RunRecorder, taken: Sequence[bool], truth: Trajectory | None
) -> list[JudgedClosure]:
    """The closures of a run, judged by the truth where there is one.

    Args:
        recorder: the run's.
        taken: of each closure of the log, in its order, whether the run's estimator took it.
        truth: true poses.
    """
    closures = [(*which, so) for which, so in zip(recorder.log.closures, taken, strict=True)]
    if not closures:
        return []
    online = Trajectory(recorder.log.timestamps, np.array(recorder.online_poses).reshape(-1, 4, 4))
    tracked = np.array(recorder.tracked_poses).reshape(-1, 4, 4)
    return judge_closures(closures, tracked, online, truth)


def place_numbers(recorder: RunRecorder, closures: list[JudgedClosure]) -> dict[str, JsonValue]:
    """For metrics.json: loops closed and, of these, false ones; closures refused; relocalised."""
    closed = [closure for closure in closures if closure.taken]
    known = [closure.false for closure in closed if closure.false is not None]
    return {
        "closures": len(closed),
        "false_closures": sum(known) if len(known) == len(closed) else None,
        "refused_closures": len(closures) - len(closed),
        "relocalised": recorder.log.relocalised,
    }


def write_closures(folder: Path, recorder: RunRecorder, closures: list[JudgedClosure]) -> None:
    """loops.csv, one line a closure; no file where there was none, nor an earlier run's."""
    if not closures:
        (folder / LOOPS_FILE).unlink(missing_ok=True)
        return
    numbers = recorder.log.numbers.tolist()
    rows: list[tuple[Cell, ...]] = [
        (numbers[one.at], numbers[one.to], *astuple(one), one.false) for one in closures
    ]
    write_csv(folder / LOOPS_FILE, _NAMES, rows)


def read_closures(path: Path) -> tuple[TextTable, list[tuple[int, int]]]:
    """The report's table of a loops.csv, and (closing, returned to) of the loops closed."""
    try:
        text = path.read_text(encoding="utf-8")
        rows = list(csv.DictReader(io.StringIO(text)))
        lines = tuple((_title(row), _values(row)) for row in rows)
        closed = [(int(row["at"]), int(row["to"])) for row in rows if row["taken"] == "true"]
        return TextTable("places", "Places recognised", "closed at", _COLUMNS, lines), closed
    except (OSError, UnicodeDecodeError, KeyError, ValueError, TypeError) as error:
        raise DatasetError(
            f"{path}: not a table of closed loops ({error}); run the experiment again"
        ) from None


def _title(row: dict[str, str]) -> str:
    return f"frame {row['frame']}" + (" (false)" if row["false"] == "true" else "")


def _values(row: dict[str, str]) -> tuple[str, ...]:
    lengths = ("correction_m", "before_m", "after_m", "error_m")
    return (
        "yes" if row["taken"] == "true" else "no",
        row["returned_to"],
        row["matches"],
        row["merged"],
        *(_text(row[name], 100.0, ".1f") for name in lengths),
        _text(row["error_deg"], 1.0, ".2f"),
    )


def _text(value: str, scale: float, spec: str) -> str:
    return format(scale * float(value), spec) if value else "-"
