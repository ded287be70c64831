"""The report page of a run, built from the files of its folder alone."""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, astuple, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.errors import DatasetError, FgslamError
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import vertical_of
from fgslam.core.types import (
    EgoMotionStatus,
    Estimate,
    LandmarkMap,
    Trajectory,
    correlation,
    read_covariances,
)
from fgslam.core.yaml_text import plain_values
from fgslam.evaluation.judging import (
    Answer,
    JudgedClosure,
    Truth,
    judge_answer,
    judge_closures,
    predicted_poses,
)
from fgslam.evaluation.statistics import EstimatorMetrics, JsonValue, UpdateTime
from fgslam.report.content import Cell, Column, Picture, TextTable, read_metrics, write_csv
from fgslam.report.formats import MapPoints, read_ply
from fgslam.report.results import (
    EstimatorReport,
    ReportData,
    judged_report,
    same_times,
    truth_in_their_world,
)
from fgslam.runs.engine import LocatedShare
from fgslam.runs.folder import CALIBRATION_FILE, LOG_FILE, REPORT_FILE, RUN_MARKER
from fgslam.runs.tables import NOISE_TABLE, SYNTHETIC, marked, page_tables
from fgslam.slam.replay import peak_memory_mb
from fgslam.slam.results import STAGES, RunRecorder, located_frames

# ------------------------------------------------------------------------------------------
# The numbers of a run, as metrics.json holds them

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


_UP = np.array([0.0, -1.0, 0.0])
_TIMED_STAGES = ("predict", "update")


def report_from_folder(folder: Path, run: Path | None = None) -> Path:
    """Writes ``report.html`` into a folder of results.

    Args:
        folder: what `fgslam run` or `fgslam compare` wrote.
        run: where configuration, truth, log and pictures are sought that ``folder`` lacks; None
            for the folder above it, where that is a run.

    Returns:
        The page.

    Raises:
        FgslamError: there are no results, one of the files is damaged, or writing failed.
    """
    from fgslam.report.page import write_report  # loads Plotly

    page = folder / REPORT_FILE
    write_report(page, load_report(folder, run))
    return page


def load_report(folder: Path, run: Path | None = None) -> ReportData:
    """All that the page of a folder shows; arguments and errors as :func:`report_from_folder`."""
    folders = _places(folder, run)
    metrics = read_metrics(folder / "metrics.json")
    config_text = _report_text(_find(folders, RUN_MARKER))
    config = _mapping(config_text)
    if "task" in config:
        raise DatasetError(
            f"{folder}: is a homing run ({config['task']}), and this needs one of SLAM; open its "
            "report.html, or give it to `fgslam compare`"
        )
    truth_file = _find(folders, "ground_truth.tum")
    truth = None if truth_file is None else Trajectory.load(truth_file)
    live = _live_title(config)
    timing = _live_times(_find(folders, "timing.csv")) if folder == folders[-1] else {}
    estimators = tuple(
        _estimator(folder / title, values or {}, truth, timing if title == live else {})
        for title, values in metrics["estimators"].items()
    )
    pictures = next((p for p in folders if (p / "pictures").is_dir()), folder) / "pictures"
    loops = _find(folders, LOOPS_FILE)
    places, closures = (None, []) if loops is None else read_closures(loops)
    synthetic = SYNTHETIC if metrics.get("remark") else ""
    of_estimators = marked(metrics["estimators"], synthetic, say_failed=False)
    estimators = tuple(
        replace(one, title=title) for one, title in zip(estimators, of_estimators, strict=True)
    )
    return ReportData(
        title=str(metrics.get("name") or config.get("name") or folder.name),
        subtitle=_subtitle(metrics, config),
        estimators=estimators,
        truth=truth_in_their_world(estimators, truth),
        notes=_notes(metrics),
        tables=(*page_tables(of_estimators), *([places] if places and places.rows else [])),
        closures=tuple(closures),
        pictures=tuple(_pictures(pictures)),
        config_yaml=config_text,
        versions=_versions(config),
        up=_up(_find(folders, LOG_FILE)),
        alignment="after SE3 alignment",
        calibration=_columns(_find(folders, CALIBRATION_FILE)),
    )


# --------------------------------------------------------------------------------------------
# Files


def _places(folder: Path, run: Path | None) -> list[Path]:
    """Where files are sought, in order; the run's own folder last."""
    if run is None and not (folder / LOG_FILE).is_file():
        above = folder.resolve().parent
        run = above if (above / RUN_MARKER).is_file() else None
    return [folder] if run is None or run == folder else [folder, run]


def _find(places: list[Path], name: str) -> Path | None:
    return next((place / name for place in places if (place / name).is_file()), None)


def _report_text(path: Path | None) -> str:
    if path is None:
        return ""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read ({error}); run the experiment again") from error


def _mapping(text: str) -> dict[str, Any]:
    """The configuration as plain values; what cannot be read is shown as text only."""
    try:
        values = plain_values(text)
    except yaml.YAMLError:
        return {}
    return values if isinstance(values, dict) else {}


def _live_title(config: dict[str, Any]) -> str:
    estimator = config.get("estimator")
    values = estimator if isinstance(estimator, dict) else {}
    return str(values.get("label") or values.get("kind") or "")


def _versions(config: dict[str, Any]) -> dict[str, str | None]:
    provenance = config.get("provenance")
    found = provenance.get("versions") if isinstance(provenance, dict) else None
    if not isinstance(found, dict):
        return {}
    return {str(name): None if value is None else str(value) for name, value in found.items()}


def _subtitle(metrics: dict[str, Any], config: dict[str, Any]) -> str:
    provenance = config.get("provenance")
    dataset = provenance.get("dataset") if isinstance(provenance, dict) else None
    parts = [
        str(dataset["name"]) if isinstance(dataset, dict) and "name" in dataset else "",
        f"{metrics['frames']:,} frames" if isinstance(metrics.get("frames"), int) else "",
        f"odometry: {metrics['odometry']}" if metrics.get("odometry") else "",
        "interrupted" if metrics.get("status") == "interrupted" else "",
    ]
    return ", ".join(filter(None, parts))


def _notes(metrics: dict[str, Any]) -> tuple[str, ...]:
    remark = [metrics["remark"]] if metrics.get("remark") else []
    lines = [*remark, *(metrics.get("notes") or []), *(metrics.get("frame_problems") or [])]
    shown = [str(line) for line in lines[:20]]
    if len(lines) > len(shown):
        shown.append(f"and {len(lines) - len(shown)} more, see metrics.json")
    return tuple(shown)


def _up(log: Path | None) -> FloatArray:
    """The vertical in the first camera's frame, from the lever arm; its -y axis where unknown."""
    if log is None:
        return _UP
    try:
        return vertical_of(MeasurementLog.load_sensor(log).bTc)
    except FgslamError:  # the page shows results; a log that cannot be replayed is no reason not to
        return _UP


# --------------------------------------------------------------------------------------------
# One estimator


def _estimator(
    folder: Path, values: dict[str, Any], truth: Trajectory | None, live_ms: dict[float, float]
) -> EstimatorReport:
    title, kind = folder.name, str(values.get("kind") or folder.name)
    failure = str(values.get("failure") or "")
    if not (folder / "final.tum").is_file():
        return EstimatorReport.failed(title, kind, failure or "it left no trajectory")
    final = Trajectory.load(folder / "final.tum")
    estimate = Estimate(
        trajectory=final,
        covariances=_covariances(folder / "covariance.csv", final),
        landmarks=_landmarks(folder / "map.ply"),
        remarks=tuple(str(line) for line in values.get("remarks") or ()),
    )
    return replace(
        judged_report(title, kind, estimate, _online(folder / "online.tum"), truth),
        update_ms=_update_ms(folder / "frames.csv", final, live_ms),
        failure=failure,
        predicted=_predicted(values.get("predicted_rows"), len(final)),
        noise=_noise(folder / NOISE_TABLE, final),
    )


def _predicted(rows: object, count: int) -> BoolArray | None:
    """(n,) which poses no landmark measured, of the rows that metrics.json lists; None: unknown."""
    if not isinstance(rows, list):
        return None
    out = np.zeros(count, np.bool_)
    for row in rows:
        if isinstance(row, int) and 0 <= row < count:
            out[row] = True
    return out


def _noise(path: Path, final: Trajectory) -> dict[str, FloatArray]:
    """(n,) each, the columns of noise.csv at the path's time stamps; none where it is absent."""
    found = _columns(path if path.is_file() else None)
    if found is None or "timestamp" not in found:
        return {}
    # Files keep 9 decimals of a second, which makes time stamps of one frame equal.
    rows, of = same_times(final.timestamps.round(9), found.pop("timestamp").round(9))
    out = {name: np.full(len(final), np.nan) for name in found}
    for name, values in found.items():
        out[name][rows] = values[of]
    return out


def _covariances(path: Path, final: Trajectory) -> FloatArray:
    """(n, 6, 6) by time stamp; NaN where the file has none."""
    out = np.full((len(final), 6, 6), np.nan)
    if path.is_file():
        stamps, found = read_covariances(path)
        rows, of = same_times(final.timestamps, stamps)
        out[rows] = found[of]
    return out


def _online(path: Path) -> Trajectory | None:
    return Trajectory.load(path) if path.is_file() else None


def _landmarks(path: Path) -> LandmarkMap:
    """Valid landmarks only (Se et al. 6.1), as in the pictures; all while none is."""
    if not path.is_file():
        return LandmarkMap(np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3, 3)))
    points: MapPoints = read_ply(path)
    shown = points.select(points.valid) if points.valid.any() else points
    return LandmarkMap(shown.ids, shown.positions, shown.covariances)


def _update_ms(path: Path, final: Trajectory, live_ms: dict[float, float]) -> FloatArray:
    """Milliseconds a frame (n,) of a frames.csv, else of the live run's own clock; NaN unknown."""
    times = live_ms
    if path.is_file():
        rows = csv.DictReader(io.StringIO(_report_text(path)))
        times = dict(_number_pairs(path, rows, "update_ms"))
    # Files keep 9 decimals of a second, which makes time stamps of one frame equal.
    return np.array([times.get(round(t, 9), np.nan) for t in final.timestamps.tolist()])


def _live_times(path: Path | None) -> dict[float, float]:
    """What the live estimator took for each frame, by time stamp, from timing.csv."""
    if path is None:
        return {}
    out: dict[float, float] = {}
    rows = [
        r
        for r in csv.DictReader(io.StringIO(_report_text(path)))
        if r.get("stage") in _TIMED_STAGES
    ]
    for stamp, milliseconds in _number_pairs(path, rows, "milliseconds"):
        out[stamp] = out.get(stamp, 0.0) + milliseconds
    return out


def _columns(path: Path | None) -> dict[str, FloatArray] | None:
    """The columns of a table of numbers, NaN where empty; None where there is none, or no row."""
    if path is None:
        return None
    rows = list(csv.reader(io.StringIO(_report_text(path))))
    try:
        values = np.array([[float(cell or "nan") for cell in row] for row in rows[1:]])
        return dict(zip(rows[0], values.T, strict=True)) if len(values) else None
    except (IndexError, ValueError) as error:
        raise DatasetError(
            f"{path}: not a table of numbers ({error}); run the experiment again"
        ) from error


def _number_pairs(path: Path, rows: Any, name: str) -> list[tuple[float, float]]:
    try:
        return [(round(float(row["timestamp"]), 9), float(row[name] or "nan")) for row in rows]
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(
            f"{path}: not a table of timestamp and {name} ({error}); run the experiment again"
        ) from error


# --------------------------------------------------------------------------------------------
# Pictures

_FIGURES_OF_A_FRAME = {
    "flow": "Matches of two frames: dot where a landmark was, cross where it is, line its motion",
    "disparities": "Stereo matches: a line as long as the disparity from each feature",
    "features": "SIFT features: a square for each, its side the scale, the stroke its orientation",
}
_FIGURES_OF_A_RUN = {
    "matches": "Landmarks matched and used in each frame, and landmarks in the map",
}
_FIGURES_OF_THE_PAGE = frozenset({"map_from_above", "map_views", "position_error"})
"""The page shows these as figures, drawn from the same values."""


def _pictures(folder: Path) -> Iterator[Picture]:
    """The pictures of a run's folder with captions, matches first; nothing where it is absent."""
    drawn = (path for path in folder.glob("*.png") if path.stem not in _FIGURES_OF_THE_PAGE)
    for path in sorted(drawn, key=_order):
        try:
            yield Picture(_caption(path.stem), path.read_bytes())
        except OSError as error:
            raise DatasetError(f"cannot read {path}: {error.strerror}; check the path") from error


def _order(path: Path) -> tuple[int, str]:
    """Matches of frames, then of the run, then the rest; each by name."""
    kinds = ["flow", *_FIGURES_OF_A_RUN, "disparities", "features"]
    kind = re.sub(r"_\d+$", "", path.stem)
    return (kinds.index(kind) if kind in kinds else len(kinds), path.stem)


def _caption(stem: str) -> str:
    found = re.fullmatch(r"([a-z_]+)_(\d+)", stem)
    if found and found[1] in _FIGURES_OF_A_FRAME:
        return f"{_FIGURES_OF_A_FRAME[found[1]]} (frame number {int(found[2])} of the run)"
    return _FIGURES_OF_A_RUN.get(stem, stem.replace("_", " "))
