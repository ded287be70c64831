"""The report page of a run, built from the files of its folder alone."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import astuple, fields, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import yaml

from fgslam.backend.self_calibration import SelfCalibration
from fgslam.backend.settings import ESTIMATORS
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import DatasetError, FgslamError
from fgslam.core.files import make_subfolder
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import vertical_of
from fgslam.core.types import (
    NO_LANDMARKS,
    EgoMotionStatus,
    Estimate,
    LandmarkMap,
    Trajectory,
    correlation,
    read_covariances,
)
from fgslam.core.yaml_text import plain_values
from fgslam.datasets.ledger import Entry, of_values, rests_on_guess
from fgslam.datasets.settings import MeasurementDatasetSettings
from fgslam.evaluation.judging import (
    Answer,
    JudgedClosure,
    Truth,
    judge_answer,
    judge_closures,
    predicted_poses,
)
from fgslam.evaluation.statistics import EstimatorMetrics, JsonValue, spread
from fgslam.frontend.tracking.landmarks import MapParts
from fgslam.report.content import (
    Cell,
    Column,
    Picture,
    TextTable,
    read_metrics,
    read_table,
    records,
    write_csv,
)
from fgslam.report.formats import read_ply
from fgslam.report.overlays import draw_plan
from fgslam.report.results import (
    EstimatorReport,
    ReportData,
    judged_report,
    same_times,
    truth_in_their_world,
)
from fgslam.runs.engine import LocatedShare
from fgslam.runs.folder import (
    CALIBRATION_FILE,
    LOG_FILE,
    REPORT_FILE,
    RUN_MARKER,
    next_commands,
)
from fgslam.runs.results import PICTURES, VIEW
from fgslam.runs.tables import (
    FRAMES_FILE,
    NOISE_TABLE,
    SYNTHETIC,
    marked,
    page_tables,
    picture_title,
)
from fgslam.slam.replay import ReplayRow, peak_memory_mb
from fgslam.slam.results import STAGES, RunRecorder, in_first_map

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


def frame_rows(recorder: RunRecorder) -> list[ReplayRow]:
    """The live estimator's frames.csv, frame by frame, as of a replayed one."""
    times = _stage_sum(np.array(recorder.stage_ms).reshape(-1, len(STAGES)), _ESTIMATOR_STAGES)
    return [
        ReplayRow(
            status=row.status,
            matched=row.matched,
            inliers=row.inliers,
            landmarks=row.landmarks,
            nis=row.nis,
            nis_dof=row.nis_dof,
            update_ms=milliseconds,
            solve_ms=math.nan,  # the front-end's own
        )
        for row, milliseconds in zip(recorder.rows, times.tolist(), strict=True)
    ]


def run_numbers(recorder: RunRecorder) -> dict[str, JsonValue]:
    """Counts over the frames that do not depend on truth."""
    times = recorder.known_times()
    # Of sideways motion and yaw (Se et al. 5); none before frame 1.
    correlations = correlation(np.array(recorder.online_covariances[1:]).reshape(-1, 6, 6))
    return {
        "status_counts": dict(sorted(Counter(recorder.column("status").tolist()).items())),
        "features": count_spread(recorder.column("features")),
        "stereo_matches": count_spread(recorder.column("stereo")),
        "landmark_matches": count_spread(recorder.column("inliers")[1:]),
        "mean_residual_px": _of_known(np.median, recorder.column("mean_residual_px")),
        "stereo_precision": _of_known(np.mean, recorder.column("stereo_precision")),
        "correlation_x_yaw": float(np.median(correlations[:, 1, 3])) if len(correlations) else None,
        "frames_without_image": int(np.count_nonzero(recorder.column("status") == _NO_IMAGE)),
        "frame_problems": frame_problems(recorder),
        "loop_ms": spread(_stage_sum(times, _LOOP_STAGES)),
        "sift_ms": spread(_stage_sum(times, ("sift",))),
    }


_LEAST_IN_MAP = 2.0 / 3.0  # of the frames: a map of fewer is no map of the drive


def located(
    recorder: RunRecorder,
    parts: MapParts,
    calibration: SelfCalibration | None = None,
    misplaced: Sequence[int] = (),
) -> LocatedShare:
    """Frames that landmarks gave a pose in the map that is reported, that of the first frame.

    Of all, with those before the first one. None is decided that a loose camera has seen. None is
    located whose images are ``misplaced``, of another moment than its number states, nor in such a
    drive one that is undecided.
    """
    all_of = recorder.left_out + len(recorder)
    status = recorder.column("status")
    undecided = int((status == EgoMotionStatus.CONTRADICTED.value).sum())
    if calibration is not None and len(calibration.moves) > 1:
        undecided = max(undecided, len(recorder) - calibration.moves[0])
    there = in_first_map(recorder, parts)
    if len(misplaced):
        there &= ~np.isin(recorder.log.numbers, misplaced)
        there &= status != EgoMotionStatus.CONTRADICTED.value
    return LocatedShare(int(there.sum()), all_of, _LEAST_IN_MAP, undecided)


def alarms(share: LocatedShare | None, landmarks: object) -> tuple[str, ...]:
    """What makes a run no success, in sentences: too few frames in its map, or no map."""
    found = ["No success: there is no map, not one landmark was kept."] if landmarks == 0 else []
    if share is not None and not share.decided:
        found.append(
            f"No success: {share.undecided} frames are undecided, as images contradict odometry "
            "or, by a loose camera, each other, and nothing in view shows which errs."
        )
    elif share is not None and not share.enough:
        found.append(
            f"No success: {share} were located in the map; where the others are is predicted, or "
            "known relative to each other only."
        )
    return tuple(found)


def frame_problems(recorder: RunRecorder) -> list[str]:
    """A line for each frame that the landmarks did not locate: which and why."""
    lines = []
    for number, row in zip(recorder.log.numbers.tolist(), recorder.rows, strict=True):
        status = EgoMotionStatus(row.status)
        if row.refused:  # reported of all of them together
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


def count_spread(counts: IntArray) -> JsonValue:
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


def _of_known(summary: Callable[[FloatArray], Any], values: FloatArray) -> float | None:
    known = values[np.isfinite(values)]
    return float(summary(known)) if len(known) else None


# ------------------------------------------------------------------------------------------
# Loops closed

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


def read_closures(path: Path) -> tuple[TextTable, tuple[tuple[int, int], ...]]:
    """The report's table of a loops.csv, and (closing, returned to) of the loops closed."""
    whole = ("frame", "returned_to", "at", "to", "matches", "merged")
    lengths = ("correction_m", "before_m", "after_m", "error_m")
    table = read_table(
        path, (*whole, *lengths, "error_deg"), ("taken", "false"), known=whole, whole=whole
    )
    rows, closed = [], []
    for row in records(table):
        if taken := row["taken"] == "true":
            closed.append((int(row["at"]), int(row["to"])))
        values = (
            "yes" if taken else "no",
            *(f"{row[name]:.0f}" for name in ("returned_to", "matches", "merged")),
            *(f"{100.0 * row[name]:.1f}" for name in lengths),
            f"{row['error_deg']:.2f}",
        )
        title = f"frame {row['frame']:.0f}" + (" (false)" if row["false"] == "true" else "")
        rows.append((title, tuple("-" if value == "nan" else value for value in values)))
    heading = ("places", "Places recognised", "closed at")
    return TextTable(*heading, _COLUMNS, tuple(rows)), tuple(closed)


# ------------------------------------------------------------------------------------------
# A folder read back for its page

_UP = np.array([0.0, -1.0, 0.0])
_LEDGER_COLUMNS = (
    Column("taken as", "what figures rest on"),
    Column("source", "where that is stated, or how it was guessed"),
    Column("changed by", "the option that states otherwise"),
)
COUNTS = ("matched", "inliers", "landmarks")
"""Columns of frames.csv that the page draws."""
_MOST_NOTES = 20


def report_from_folder(
    folder: Path, run: Path | None = None, page: bool = True, plan: bool = False
) -> Path:
    """Writes ``report.html`` into a folder of results.

    Args:
        folder: what `fgslam run` or `fgslam compare` wrote.
        run: where configuration, truth, log and pictures are sought that ``folder`` lacks; None
            for the folder above it, where that is a run.
        page: whether to.
        plan: whether to draw the first estimator's path and landmarks from above, too.

    Returns:
        The page.

    Raises:
        FgslamError: there are no results, one of the files is damaged, or writing failed.
    """
    data = load_report(folder, run, page)
    if plan:
        draw_plan(make_subfolder(folder, PICTURES) / "map_from_above.png", data)
    if page:
        from fgslam.report.page import write_report  # loads Plotly

        write_report(folder / REPORT_FILE, data)
    return folder / REPORT_FILE


def draw_run(run: Path) -> list[Path]:
    """Pictures of a run by the estimator that steered, as PNG files in its folder `pictures`.

    `map_from_above` (Se, Lowe and Little 2001, Fig. 5), `map_views` (in perspective, Fig. 6),
    `position_error` where truth is known, and `matches`.

    Raises:
        FgslamError: there are no results, one of the files is damaged, or writing failed.
    """
    from fgslam.report import figures as drawn  # loads Plotly
    from fgslam.report.pictures import draw_figure, draw_views  # loads Matplotlib

    data = load_report(run)
    live = data.estimators[0]
    data = replace(data, estimators=(live,))
    folder = make_subfolder(run, PICTURES)

    def title(what: str) -> str:
        return picture_title(
            f"{data.title}: {what}", int(live.predicted.sum()), SYNTHETIC in live.title
        )

    what = title(f"{len(live.landmarks):,} landmarks")
    above = drawn.drive_from_above(data, drawn.ON_PAPER)
    draw_figure(folder / "map_from_above.png", above, what, {drawn.LANDMARK_ELLIPSES})
    draw_views(folder / "map_views.png", drawn.map_to_turn(data, drawn.ON_PAPER), what)
    if live.counts:
        matches = drawn.matches_over_time(live)
        draw_figure(folder / "matches.png", matches, title("landmark matches"))
    if data.truth is not None:
        errors = title("position error, first pose aligned")
        draw_figure(folder / "position_error.png", drawn.error_by_axis(data), errors)
    return sorted(path for path in folder.glob("*.png") if path.stem in _FIGURES_OF_THE_PAGE)


def load_report(folder: Path, run: Path | None = None, whole: bool = False) -> ReportData:
    """What a folder holds; arguments and errors as :func:`report_from_folder`.

    The cost of a frame and the small views, which a film does not show, are read only if ``whole``.
    """
    if run is None and not (folder / LOG_FILE).is_file():
        above = folder.resolve().parent
        run = above if (above / RUN_MARKER).is_file() else None
    folders = [folder] if run is None or run == folder else [folder, run]

    def find(name: str) -> Path | None:
        return next((place / name for place in folders if (place / name).is_file()), None)

    metrics = read_metrics(folder / "metrics.json")
    config_text, config = _read_config(find(RUN_MARKER))
    if "task" in config:
        raise DatasetError(
            f"{folder}: is a homing run ({config['task']}), and this needs one of SLAM; open its "
            "report.html, or give it to `fgslam compare`"
        )
    blind = {each.kind for each in get_args(MeasurementDatasetSettings)}
    images = _section(config, "dataset").get("kind") not in blind
    truth = None if (file := find("ground_truth.tum")) is None else Trajectory.load(file)
    titles = marked(
        metrics["estimators"], SYNTHETIC if metrics.get("remark") else "", say_failed=False
    )
    estimators = tuple(
        replace(_estimator(folder / name, values or {}, truth), title=title)
        for title, (name, values) in zip(titles, metrics["estimators"].items(), strict=True)
    )
    pictures = next((p for p in folders if (p / "pictures").is_dir()), folder) / "pictures"
    tables, closures = list(page_tables(titles)), tuple[tuple[int, int], ...]()
    if (file := find(LOOPS_FILE)) is not None:
        places, closures = read_closures(file)
        tables += [places] if places.rows else []
    if entries := of_values(metrics.get("ledger")):
        rows = tuple(
            (e.what, (e.value, "guessed: " * e.guessed + e.source, e.option or "-"))
            for e in entries
        )
        tables = [on_guesses(table, entries) for table in tables]
        heading = "What the figures rest on (figures with * on a guess)"
        tables.append(TextTable("ledger", heading, "", _LEDGER_COLUMNS, rows))
    provenance = _section(config, "provenance")
    dataset = str(_section(provenance, "dataset").get("name") or "")
    frames, odometry = metrics.get("frames"), metrics.get("odometry")
    subtitle = (
        dataset,
        f"{frames:,} frames" if isinstance(frames, int) else "",
        f"odometry: {odometry}" if odometry else "",
        "interrupted" if metrics.get("status") == "interrupted" else "",
    )
    share, steered = metrics.get("located"), next(iter(metrics["estimators"].values()), None)
    found = LocatedShare(share["frames"], share["of"], _LEAST_IN_MAP) if share else None
    notes = [metrics.get("remark"), *(metrics.get("notes") or ())]
    notes = [str(note) for note in (*notes, *(metrics.get("frame_problems") or ())) if note]
    if (more := len(notes) - _MOST_NOTES) > 0:
        notes[_MOST_NOTES:] = [f"and {more} more, see metrics.json"]
    return ReportData(
        title=str(metrics.get("name") or config.get("name") or folder.name),
        subtitle=", ".join(filter(None, subtitle)),
        estimators=estimators,
        truth=truth_in_their_world(estimators, truth),
        notes=tuple(notes),
        tables=tuple(tables),
        closures=closures,
        pictures=tuple(_pictures(pictures)),
        config_yaml=config_text,
        versions={
            name: None if version is None else str(version)
            for name, version in _section(provenance, "versions").items()
        },
        up=_up(find(LOG_FILE)),
        alarms=alarms(found, (steered or {}).get("landmarks")),
        calibration=None if (file := find(CALIBRATION_FILE)) is None else _columns(file),
        stages=_stages(file) if whole and (file := find("timing.csv")) else None,
        views={
            int(path.stem.rpartition("_")[2]): path.read_bytes()
            for path in (pictures.glob(f"{VIEW}_*.jpg") if whole else ())
        },
        about=tuple((one.title, _kind_in_words(one.kind)) for one in estimators),
        commands=next_commands(folder.resolve().name, images) if find(LOG_FILE) else (),
    )


def _kind_in_words(kind: str) -> str:
    """What an estimator of a kind is, in a sentence: as its settings say."""
    return (getattr(ESTIMATORS.get(kind), "__doc__", None) or "").partition("\n")[0]


def _stages(path: Path) -> dict[str, FloatArray] | None:
    """A column of milliseconds for every stage of timing.csv, one row a frame."""
    table = read_table(path, ("timestamp", "milliseconds"), ("stage",))
    names = dict.fromkeys(table["stage"].tolist())
    rows = {name: table["stage"] == name for name in names}
    if len({int(own.sum()) for own in rows.values()}) != 1:
        return None
    stages = {name: table["milliseconds"][own] for name, own in rows.items()}
    return {"timestamp": table["timestamp"][next(iter(rows.values()))], **stages}


def on_guesses(table: TextTable, entries: Sequence[Entry]) -> TextTable:
    """The table with a mark at the columns whose figures rest on a guess."""
    columns = (replace(column, name=column.name + " *" * rests_on_guess(column.name, entries))
               for column in table.columns)  # fmt: skip
    return replace(table, columns=tuple(columns))


def _read_config(path: Path | None) -> tuple[str, dict[str, Any]]:
    """A configuration as text and as plain values; what cannot be parsed is shown as text only."""
    if path is None:
        return "", {}
    try:
        text = path.read_text(encoding="utf-8")
        values = plain_values(text)
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: cannot be read ({error}); run the experiment again") from error
    except yaml.YAMLError:
        return text, {}
    return text, values if isinstance(values, dict) else {}


def _section(values: dict[str, Any], name: str) -> dict[str, Any]:
    found = values.get(name)
    return found if isinstance(found, dict) else {}


def _columns(path: Path) -> dict[str, FloatArray] | None:
    """The columns of a table of numbers; None where it has no row."""
    table = read_table(path)
    return table if all(map(len, table.values())) else None


def _up(log: Path | None) -> FloatArray:
    """The vertical in the first camera's frame, from the lever arm; its -y axis where unknown."""
    if log is None:
        return _UP
    try:
        return vertical_of(MeasurementLog.load(log).rig.bTc)
    except FgslamError:  # the page shows results; a log that cannot be replayed is no reason not to
        return _UP


def _estimator(folder: Path, values: dict[str, Any], truth: Trajectory | None) -> EstimatorReport:
    """One estimator's files; what is not there is not known.

    Args:
        folder: of the estimator.
        values: its numbers in metrics.json.
        truth: true poses.
    """
    title, kind = folder.name, str(values.get("kind") or folder.name)
    failure = str(values.get("failure") or "")
    if not (folder / "final.tum").is_file():
        return EstimatorReport.failed(title, kind, failure or "it left no trajectory")
    final = Trajectory.load(folder / "final.tum")
    covariances = np.full((len(final), 6, 6), np.nan)
    if (path := folder / "covariance.csv").is_file():
        stamps, known = read_covariances(path)
        rows, of = same_times(final.timestamps, stamps)
        covariances[rows] = known[of]
    landmarks = NO_LANDMARKS
    if (path := folder / "map.ply").is_file():
        points = read_ply(path)
        # Valid landmarks only (Se et al. 6.1), as in the pictures; all while none is.
        points = points.select(points.valid) if points.valid.any() else points
        landmarks = LandmarkMap(points.ids, points.positions, points.covariances)
    remarks = tuple(map(str, values.get("remarks") or ()))
    estimate = Estimate(final, covariances, landmarks, remarks)
    path = folder / "online.tum"
    online = Trajectory.load(path) if path.is_file() else None
    report = judged_report(title, kind, estimate, online, truth)
    predicted = np.isin(np.arange(len(final)), values.get("predicted_rows") or [])
    noise = {}
    if (path := folder / NOISE_TABLE).is_file() and (columns := _columns(path)) is not None:
        stamps = columns.pop("timestamp", np.empty(0))
        noise = {name: _at(final, stamps, column) for name, column in columns.items()}
    update_ms, counts = report.update_ms, {}
    if (path := folder / FRAMES_FILE).is_file():
        table = read_table(path, ("timestamp", "update_ms", *COUNTS))
        stamps = table["timestamp"]
        update_ms = _at(final, stamps, table["update_ms"])
        counts = {name: _at(final, stamps, table[name]) for name in COUNTS}
    return replace(
        report,
        update_ms=update_ms,
        failure=failure,
        predicted=predicted,
        truth_remark=str(values.get("truth_remark") or ""),
        noise=noise,
        counts=counts,
    )


def _at(final: Trajectory, stamps: FloatArray, values: FloatArray) -> FloatArray:
    """Values (k,) of a table at the path's time stamps (n,); NaN where the table has none."""
    # Files keep 9 decimals of a second, which makes time stamps of one frame equal.
    rows, of = same_times(final.timestamps.round(9), stamps.round(9))
    out = np.full(len(final), np.nan)
    out[rows] = values[of]
    return out


# --------------------------------------------------------------------------------------------
# Pictures

_CAPTIONS = {
    "flow": "Matches of two frames: dot where a landmark was, cross where it is, line its motion",
    "disparities": "Stereo matches: a line as long as the disparity from each feature",
    "features": "SIFT features: a square for each, its side the scale, the stroke its orientation",
}
"""By kind, in the order of the page; pictures of frames have a number at the end."""
_FIGURES_OF_THE_PAGE = frozenset({"map_from_above", "map_views", "position_error", "matches"})
"""The page shows these as figures, drawn from the same values."""


def _pictures(folder: Path) -> list[Picture]:
    """The pictures of a run's folder with captions, matches first; nothing where it is absent."""
    found = []
    for path in folder.glob("*.png"):
        if path.stem in _FIGURES_OF_THE_PAGE:
            continue
        kind, _, frame = (
            path.stem.rpartition("_") if path.stem[-1].isdigit() else (path.stem, "", "")
        )
        caption = _CAPTIONS.get(kind, path.stem.replace("_", " "))
        if kind in _CAPTIONS and frame:
            caption += f" (frame number {int(frame)} of the run)"
        order = list(_CAPTIONS).index(kind) if kind in _CAPTIONS else len(_CAPTIONS)
        found.append((order, path.stem, caption, path))
    try:
        return [Picture(caption, path.read_bytes()) for *_, caption, path in sorted(found)]
    except OSError as error:
        raise DatasetError(
            f"{folder}: cannot read its pictures ({error}); check the path"
        ) from error
