"""One table of metrics: what metrics.json knows of an estimator, and where it is shown.

A metric is a row of ``_METRICS``: its name in comparison.csv and sweeps, its place in
metrics.json, and the column of the console's and the page's tables that it stands in.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.files import make_subfolder, write_text
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import PoseFrame
from fgslam.core.types import LAGS, Estimate, LandmarkMap, Trajectory, write_covariances
from fgslam.evaluation.statistics import value_at
from fgslam.report.content import UNKNOWN, Column, TextTable, write_csv
from fgslam.report.formats import MapPoints, write_map
from fgslam.slam.pipeline import FrameNoise
from fgslam.slam.replay import Replay, ReplayRow

# ------------------------------------------------------------------------------------------
# The files of one estimator in a run folder, and what they are made from

FRAMES_FILE = "frames.csv"
NOISE_TABLE = "noise.csv"
_GREY = 128
_VALID_HITS = 3  # Se et al. 6.1, where no front-end's own number is known


def write_estimate(
    folder: Path, online: Trajectory, estimate: Estimate, points: MapPoints, remark: str
) -> None:
    """Trajectories, covariances and map into an estimator's folder. Raises OutputError.

    Poses are written as those of the frame that they are given of; the map's world is theirs.
    """
    online.save(folder / "online.tum", remark)
    estimate.trajectory.save(folder / "final.tum", remark)
    covariances = estimate.covariances
    write_covariances(folder / "covariance.csv", estimate.trajectory, covariances, remark)
    write_map(folder / "map.ply", points, remark)


def write_replay(
    run: Path,
    replay: Replay,
    log: MeasurementLog,
    remark: str,
    look: MapPoints | None,
    frame: PoseFrame,
) -> None:
    """All files of a replay into ``run/<title>/``.

    Args:
        run: the folder above the estimator's.
        replay: what the estimator made of ``log``.
        log: where hits and misses of the landmarks are counted.
        remark: put into the files' comments.
        look: landmarks with the colours that the front-end saw, e.g. the live run's map; None
            where nothing was seen in colour.
        frame: that the files' poses are of.
    """
    folder = make_subfolder(run, replay.title)
    points = points_from_log(replay.estimate.landmarks, log, look)
    online, estimate = replay.online.of(frame, log.rig), replay.estimate.of(frame, log.rig)
    write_estimate(folder, online, estimate, points, remark)
    write_frames(folder / FRAMES_FILE, replay.online.timestamps, replay.rows)
    write_noise(folder / NOISE_TABLE, replay.online.timestamps, replay.noise)


def write_noise(path: Path, timestamps: FloatArray, noise: Sequence[FrameNoise]) -> None:
    """Write noise.csv: time stamp, then a column for each name of :class:`FrameNoise`."""
    stamped = zip(timestamps.tolist(), noise, strict=True)
    rows = [(f"{stamp:.9f}", *values) for stamp, values in stamped]
    write_csv(path, ("timestamp", *FrameNoise._fields), rows)


def write_frames(path: Path, timestamps: FloatArray, frames: Sequence[ReplayRow]) -> None:
    """Write frames.csv: time stamp, then a column for each name of :class:`ReplayRow`."""
    lines = [",".join(("timestamp", *ReplayRow._fields))]
    for stamp, row in zip(timestamps.tolist(), frames, strict=True):
        cells = (f"{cell:.6g}" if isinstance(cell, float) else str(cell) for cell in row)
        lines.append(",".join((f"{stamp:.9f}", *cells)))
    write_text(path, "\n".join(lines) + "\n")


def points_from_log(
    landmarks: LandmarkMap, log: MeasurementLog, look: MapPoints | None
) -> MapPoints:
    """The map with hits and misses as the log has them; colour and permanence as ``look`` has them.

    What is not in ``look`` is grey.
    """
    seen = [increment.observations.ids[~increment.rejected] for increment in log]
    hits = _counts(seen, landmarks.ids)
    colours = np.full((len(landmarks), 3), _GREY, np.uint8)
    permanent = np.zeros(len(landmarks), np.bool_)
    if look is not None:
        _, rows, of = np.intersect1d(landmarks.ids, look.ids, return_indices=True)
        colours[rows], permanent[rows] = look.colours[of], look.permanent[of]
    return MapPoints(
        ids=landmarks.ids,
        positions=landmarks.positions,
        covariances=landmarks.covariances,
        colours=colours,
        hits=hits,
        misses=_counts([increment.missed_ids for increment in log], landmarks.ids),
        valid=hits >= _VALID_HITS,
        permanent=permanent,
    )


def _counts(parts: list[IntArray], ids: IntArray) -> IntArray:
    """How often each of ``ids`` (ascending) occurs in all parts together."""
    every = np.concatenate([np.empty(0, np.int64), *parts])
    return np.bincount(np.searchsorted(ids, every[np.isin(every, ids)]), minlength=len(ids))


_REMARKS_SHOWN = 3


class Metric(NamedTuple):
    """A metric.

    Attributes:
        name: of its column in files; those of ``RESULT`` and ``TIME`` stand in comparison.csv.
        path: dotted, in metrics.json.
        group: ``RESULT``, ``TIME``, ``FURTHER`` or ``JUDGED``.
        column: table and heading that it is shown under, alone or after others; | ends a line.
        text: its format there.
        absent: key of the reason why it may be absent.
        meaning: of the column.
    """

    name: str
    path: str
    group: str
    column: str = ""
    text: str = ""
    absent: str = ""
    meaning: str = ""


RESULT, TIME, FURTHER, JUDGED = "result", "time", "further", "judged"
_METRICS = tuple(Metric(*row) for row in (
    *((name, name, RESULT) for name in (
        "kind", "odometry", "frames", "predicted_frames", "alignment", "matched_poses")),
    ("ate_final_m", "ate_rmse_m", RESULT, "accuracy: ATE|final cm", "cm", "truth", "absolute "
     "trajectory error of the final path: rms distance from the truth after SE3 alignment"),
    ("ate_online_m", "online.ate_rmse_m", RESULT, "accuracy: ATE|online cm", "cm", "truth",
     "the same of the path made of each pose as first estimated, at its own time"),
    ("ate_max_final_m", "ate_max_m", RESULT),
    ("rpe_final_m", "rpe_trans_m", RESULT, "accuracy: RPE final|cm deg", "cm", "truth",
     "relative pose error from frame to frame, translation and rotation"),
    ("rpe_final_deg", "rpe_rot_deg", RESULT, "accuracy: RPE final|cm deg", ".3f", "truth"),
    ("rpe_online_m", "online.rpe_trans_m", RESULT, "accuracy: RPE online|cm deg", "cm", "truth",
     "the same of each pose as first estimated"),
    ("rpe_online_deg", "online.rpe_rot_deg", RESULT, "accuracy: RPE online|cm deg", ".3f", "truth"),
    ("end_error_final_m", "end_error_m", RESULT, "accuracy: end error|cm deg", "cm", "truth",
     "distance of the last pose from the true one, the first pose aligned"),
    ("end_error_final_deg", "end_error_deg", RESULT, "accuracy: end error|cm deg", ".3f", "truth"),
    ("end_error_online_m", "online.end_error_m", RESULT),
    ("end_error_online_deg", "online.end_error_deg", RESULT),
    ("drift_percent", "drift_percent", RESULT),
    ("path_length_m", "path_length_m", RESULT),
    ("landmarks", "landmarks", RESULT, "cost: map|landmarks", ",.0f", "frame",
     "number of landmarks in the final map"),
    ("landmarks_with_truth", "landmarks_with_truth", RESULT),
    ("landmark_rmse_m", "landmark_rmse_m", RESULT, "accuracy: landmarks cm|rms median", "cm",
     "landmarks", "distance of the landmarks from their true positions"),
    ("landmark_median_m", "landmark_median_m", RESULT, "accuracy: landmarks cm|rms median", "cm",
     "landmarks"),
    ("landmark_truth_sigma_m", "landmark_truth_sigma_m", RESULT),
    ("nees_pose_final_per_dof", "nees_pose_per_dof", RESULT, "consistency: NEES pose|final",
     "ratio", "truth", "normalised error squared of the poses per degree of freedom: 1 is right, "
     "more overconfident; and whether it lies in its 95 % chi-square band, one run as one sample"),
    ("nees_pose_band_lower", "nees_pose.lower", RESULT),
    ("nees_pose_band_upper", "nees_pose.upper", RESULT),
    ("nees_pose_final_verdict", "nees_pose.verdict", RESULT, "consistency: NEES pose|final",
     "text", "truth"),
    ("nees_pose_online_per_dof", "online.nees_pose_per_dof", RESULT,
     "consistency: NEES pose|online", "ratio", "truth",
     "NEES of each pose as first estimated, by its covariance of that time"),
    ("nees_pose_online_verdict", "online.nees_pose.verdict", RESULT,
     "consistency: NEES pose|online", "text", "truth"),
    ("nees_pose_best_per_dof", "nees_best.per_dof", RESULT, "consistency: best|aligned",
     "ratio", "truth", "the same of the final path, aligned where it is least"),
    ("nees_pose_best_verdict", "nees_best.verdict", RESULT),
    *((f"nees_motion_{lag}_per_dof", f"nees_relative.{lag}.per_dof", RESULT,
       "consistency: NEES motions|1 5 20 frames", "ratio", "joint", "of motions over so many "
       "frames, by the joint covariance of both poses") for lag in LAGS),
    *((f"nees_motion_{lag}_online", f"online.nees_relative.{lag}.per_dof", RESULT,
       "consistency: motions online|1 5 20 frames", "ratio", "joint", "the same between poses as "
       "first estimated") for lag in LAGS),
    ("judged_poses", "judged_poses", RESULT),
    ("coverage_final", "coverage.all", RESULT, "consistency: in 2 sigma|final online", ".0%",
     "truth", "pose errors within two sigma; and of each pose as first estimated"),
    ("coverage_online", "online.coverage.all", RESULT, "consistency: in 2 sigma|final online",
     ".0%", "truth"),
    ("nees_landmark_per_dof", "nees_landmark_per_dof", RESULT, "consistency: NEES|landmarks",
     "ratio", "landmarks", "normalised error squared of the landmarks per degree of freedom"),
    ("nees_landmark_verdict", "nees_landmark.verdict", RESULT, "consistency: NEES|landmarks",
     "text", "landmarks"),
    ("noise_factor", "noise_factor", FURTHER, "consistency: noise|factor", ".2f", "weighed",
     "what the stated standard deviations of the measurements were multiplied by"),
    ("nis_per_dof", "nis_per_dof", RESULT, "consistency: NIS", "ratio", "innovation",
     "normalised innovation squared of the measurements per degree of freedom"),
    ("last_pose_sigma_m", "last_pose_sigma.position_m", RESULT,
     "consistency: sigma of last|pose cm deg", "cm", "covariance",
     "standard deviation of the last pose, as claimed"),
    ("last_pose_sigma_deg", "last_pose_sigma.rotation_deg", RESULT,
     "consistency: sigma of last|pose cm deg", ".3f", "covariance"),
    ("failure", "failure", RESULT),
    ("update_median_ms", "update_ms.median", TIME, "cost: update ms|median p95 max", ".2f", "frame",
     "time for a frame: median over the run, what 95 % stay below, and the longest"),
    ("update_p95_ms", "update_ms.p95", TIME, "cost: update ms|median p95 max", ".2f", "frame"),
    ("update_max_ms", "update_ms.max", TIME, "cost: update ms|median p95 max", ".1f", "frame"),
    ("solve_median_ms", "solve_ms.median", TIME, "cost: pose solve|median ms", "ratio", "live",
     "time to find a frame's pose"),
    ("final_estimate_ms", "final_ms", TIME, "cost: final|estimate s", "s", "final",
     "time for the whole path and map at the end"),
    ("update_growth_ratio", "update_growth.ratio", TIME, "cost: growth|1 is flat", "ratio", "few",
     "median time of the last fifth of the frames over that of the second fifth"),
    ("update_slope_ms_per_1000_frames", "update_growth.slope_ms_per_1000", TIME,
     "cost: slope ms /|1000 frames", "+.2f", "few", "by how much the time for a frame grows"),
    ("peak_memory_mib", "peak_memory_mb", TIME, "cost: memory|MiB", ",.0f", "system",
     "largest resident memory of the process"),
    ("memory_before_mib", "memory_before_mb", TIME),
    ("nees_pose", "nees.pose.per_dof", JUDGED, "judged: NEES|pose", "ratio", "truth", "squared "
     "errors over stated variances per degree of freedom: 1 is right, more is overconfident"),
    ("band_lower", "nees.pose.lower", JUDGED, "judged: 95 % band of a|consistent one", "ratio",
     "truth", "for as many errors as are independent, by their autocorrelation"),
    ("band_upper", "nees.pose.upper", JUDGED, "judged: 95 % band of a|consistent one", "ratio"),
    ("verdict", "nees.pose.verdict", JUDGED, "judged: verdict", "text", "truth", "by that band"),
    ("nees_rotation", "nees.rotation.per_dof", JUDGED, "judged: NEES rotation|position", "ratio",
     "truth", "the same of both alone"),
    ("nees_position", "nees.position.per_dof", JUDGED, "judged: NEES rotation|position", "ratio"),
    ("sigma_factor", "sigma_factor.pose", JUDGED, "judged: mend:|sigma x", "ratio", "truth",
     "what stated deviations are to be multiplied by"),
    ("ate_m", "ate_rmse_m", JUDGED, "errors: ATE m", ".3f", "truth", "rms position error, SE3 "
     "aligned"),
    ("nees_best", "nees_best.per_dof", JUDGED, "errors: NEES best|aligned", "ratio", "truth",
     "of the poses, aligned where it is least"),
    *((f"nees_motion_{lag}", f"nees_relative.{lag}.per_dof", JUDGED, "errors: NEES motions|"
       "1 5 20 frames", "ratio", "joint", "of motions over so many frames") for lag in LAGS),
    *((f"within_{k}_sigma", f"within_sigma.{k}", JUDGED, "errors: within|1 2 3 sigma", ".0%",
       "truth", "shares of errors; right are 68, 95 and 99.7 %") for k in (1, 2, 3)),
))  # fmt: skip
RESULT_COLUMNS = tuple((m.name, m.path) for m in _METRICS if m.group == RESULT)
"""What the same measurements give to the byte: column, and where its value is in the metrics."""
TIME_COLUMNS = tuple((m.name, m.path) for m in _METRICS if m.group == TIME)
"""What differs from one execution to the next."""
JUDGED_COLUMNS = tuple((m.name, m.path) for m in _METRICS if m.group == JUDGED)
"""Of estimates of any program, held against their covariances."""
_TABLES = ("accuracy", "consistency", "cost")
_ABSENT = {
    "truth": "no ground truth, or fewer than three poses matched",
    "landmarks": "true landmark positions are not known, or none of them is in the map",
    "weighed": "no landmark measurement is weighed: by it the stated deviations were multiplied",
    "innovation": "the estimator forms no innovation",
    "covariance": "its covariance is not known",
    "joint": "no ground truth, too short a drive, or no covariance of two poses is kept",
    "frame": "no frame was processed",
    "few": "fewer than 25 frames",
    "live": "timed with the live front-end",
    "final": "not timed apart in a live run",
    "system": "this system does not tell",
}


class _Column(NamedTuple):
    """A column of a table that is shown: heading, and what stands in it."""

    heading: str
    metrics: tuple[Metric, ...]

    def cell(self, values: Mapping[str, Any]) -> str:
        """The numbers of one estimator, or that they are not known."""
        found = [value_at(values, metric.path) for metric in self.metrics]
        if any(value is None for value in found):
            return UNKNOWN
        try:
            texts = [_text(m.text, value) for m, value in zip(self.metrics, found, strict=True)]
        except (TypeError, ValueError, KeyError):  # a metrics.json of another program
            return " ".join(map(str, found))
        return " ".join(texts)

    def is_empty(self, estimators: Mapping[str, Any]) -> bool:
        """Whether no estimator fills it."""
        return all(self.cell(values) == UNKNOWN for values in estimators.values())


def _columns(table: str) -> list[_Column]:
    shown = [metric for metric in _METRICS if metric.column.startswith(f"{table}: ")]
    return [
        _Column(
            column.removeprefix(f"{table}: ").replace("|", "\n"),
            tuple(metric for metric in shown if metric.column == column),
        )
        for column in dict.fromkeys(metric.column for metric in shown)
    ]


def _ratio(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000.0 else f"{value:.2f}"


_TEXTS: dict[str, Callable[..., str]] = {
    "cm": lambda metres: f"{100.0 * metres:.2f}",
    "s": lambda milliseconds: f"{milliseconds / 1e3:.2f}",
    "ratio": _ratio,
    "text": str,
}


def _text(kind: str, value: Any) -> str:
    return _TEXTS[kind](value) if kind in _TEXTS else format(float(value), kind)


# --------------------------------------------------------------------------------------------
# Tables


def comparison_tables(name: str, frames: int, values: Mapping[str, Any]) -> tuple[TextTable, ...]:
    """Accuracy, consistency, time and memory of estimators; ``values`` by title, of one run."""
    headings = (
        f"{name}: accuracy ({_alignment(values)})",
        f"{name}: consistency (1 is right; {_band(values)})",
        f"{name}: time and memory, {frames} frames",
    )
    known = marked(values)
    tables = (_table(h, key, known) for h, key in zip(headings, _TABLES, strict=True))
    return tuple(table for table in tables if table.columns)


def judged_tables(values: Mapping[str, Any]) -> tuple[TextTable, ...]:
    """Estimates of any program by name: stated covariances against errors, motions, coverage."""
    headings = {"judged": "stated covariances against errors", "errors": "errors and coverage"}
    return tuple(_table(heading, key, values) for key, heading in headings.items())


def page_tables(values: Mapping[str, Any]) -> tuple[TextTable, ...]:
    """The tables of the page, of metrics by marked title; values that are not known read `-`."""
    return tuple(_table(key.capitalize(), key, values) for key in _TABLES)


def _table(heading: str, table: str, values: Mapping[str, Any]) -> TextTable:
    kept = [one for one in _columns(table) if not one.is_empty(values)]
    rows = tuple((title, tuple(one.cell(m) for one in kept)) for title, m in values.items())
    columns = tuple(Column(one.heading, one.metrics[0].meaning) for one in kept)
    return TextTable(table, heading, "estimator", columns, rows)


def ate_table(runs: Sequence[tuple[str, Mapping[str, Any]]]) -> TextTable:
    """Final ATE of each estimator on each run, given by its name and metrics by title."""
    rows = []
    for title in dict.fromkeys(title for _, values in runs for title in values):
        cells = []
        for _, values in runs:
            ate = value_at(values.get(title) or {}, "ate_rmse_m")
            marks = list(marked(values))[list(values).index(title)] if title in values else title
            known = "" if ate is None else f"{_text('cm', ate)}{marks.removeprefix(title)}"
            cells.append(known or UNKNOWN)
        rows.append((title, tuple(cells)))
    columns = tuple(Column(name, "final ATE, cm") for name, _ in runs)
    return TextTable("ate", "final ATE, cm, SE3 aligned", "estimator", columns, tuple(rows))


def write_comparison_csv(
    path: Path, runs: Sequence[tuple[str, Mapping[str, Mapping[str, Any]]]]
) -> None:
    """Write the table atomically; a value that is not known is an empty cell.

    Args:
        path: the file.
        runs: name of each run and its estimators' numbers of metrics.json by title.

    Raises:
        OutputError: the file cannot be written.
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    columns = RESULT_COLUMNS + TIME_COLUMNS
    writer.writerow(["run", "estimator", *(name for name, _ in columns)])
    for run, estimators in runs:
        for title, values in estimators.items():
            found = [value_at(values, where) for _, where in columns]
            cells = ["" if v is None else f"{v:.9g}" if isinstance(v, float) else v for v in found]
            writer.writerow([run, title, *cells])
    write_text(path, buffer.getvalue())


# --------------------------------------------------------------------------------------------
# What stands next to them


def comparison_particulars(values: Mapping[str, Any], out: Path) -> tuple[tuple[str, str], ...]:
    """Label and text: why values are missing, failures, remarks, and where the results are."""
    return (*_reasons(values), *_remarks(values), ("results", str(out))) if values else ()


def _alignment(values: Mapping[str, Any]) -> str:
    """How ATE and RPE were aligned and on how many poses, as the metrics say."""
    known = [m for m in values.values() if value_at(m, "matched_poses")]
    if not known:
        return "no matched poses"
    alignment = "/".join(dict.fromkeys(value_at(m, "alignment").upper() for m in known))
    counts = sorted({value_at(m, "matched_poses") for m in known})
    return f"{alignment} aligned, {' or '.join(map(str, counts))} matched poses"


def _band(values: Mapping[str, Any]) -> str:
    """The bands of the pose NEES; with the estimators of each where there are several."""
    bands: dict[str, list[str]] = {}
    for title, m in values.items():
        if value_at(m, "nees_pose.lower") is not None:
            band = f"{value_at(m, 'nees_pose.lower'):.2f}-{value_at(m, 'nees_pose.upper'):.2f}"
            bands.setdefault(band, []).append(title)
    if not bands:
        return "no truth to judge by"
    if len(bands) == 1:
        return f"95 % band of the pose NEES {next(iter(bands))}"
    each = "; ".join(f"{band} of {', '.join(titles)}" for band, titles in bands.items())
    return f"95 % bands of the pose NEES: {each}"


def _reasons(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Why values are missing, each reason once with the headings that it empties or leaves out."""
    found: dict[tuple[str, str], list[str]] = {}
    done = [m for m in values.values() if not value_at(m, "failure")]
    for column in (one for key in _TABLES for one in _columns(key)):
        if any(column.cell(m) == UNKNOWN for m in done):
            label = "left out" if column.is_empty(values) else UNKNOWN
            headings = found.setdefault((label, _ABSENT[column.metrics[0].absent]), [])
            headings.append(column.heading.replace("\n", " "))
    return [(label, f"{', '.join(headings)}: {why}") for (label, why), headings in found.items()]


def _remarks(values: Mapping[str, Any]) -> list[tuple[str, str]]:
    failures = {title: value_at(metrics, "failure") for title, metrics in values.items()}
    lines = [("failed", f"{title}: {why}") for title, why in failures.items() if why]
    for title, metrics in values.items():
        remarks = [str(remark) for remark in value_at(metrics, "remarks") or ()]
        lines += [("remark", f"{title}: {remark}") for remark in remarks[:_REMARKS_SHOWN]]
        if len(remarks) > _REMARKS_SHOWN:
            more = len(remarks) - _REMARKS_SHOWN
            lines.append(("remark", f"{title}: and {more} more, see metrics.json"))
    sigma = next((s for m in values.values() if (s := value_at(m, "landmark_truth_sigma_m"))), None)
    if sigma is not None:
        known = max(value_at(m, "landmarks_with_truth") or 0 for m in values.values())
        lines.append(
            (
                "note",
                f"{known:,} landmarks are judged, by a truth that itself is known to "
                f"{1e3 * sigma:.1f} mm; of others, seen too seldom or where a surface ends before "
                "another, no true point is known",
            )
        )
    return lines


# --------------------------------------------------------------------------------------------
# What titles say of results that are not all there, or not all measured

SYNTHETIC = "synthetic odometry"
"""Said of all results whose odometry was made from the ground truth."""


def with_marks(title: str, marks: Iterable[str]) -> str:
    """The title with its marks in brackets; without any, as it is."""
    joined = ", ".join(filter(None, marks))
    return f"{title} ({joined})" if joined else title


def predicted_mark(count: int | None) -> str:
    """Says that so many poses no landmark measured; empty for none."""
    if not count:
        return ""
    return "1 pose predicted" if count == 1 else f"{count:,} poses predicted"


def measured_marks(predicted: int | None, synthetic: bool) -> tuple[str, str]:
    """What is not measured of results: poses, odometry."""
    return predicted_mark(predicted), SYNTHETIC if synthetic else ""


def picture_title(what: str, predicted: int, synthetic: bool) -> str:
    """What a picture shows, and what of it is not measured: poses, odometry."""
    return ", ".join(filter(None, (what, *measured_marks(predicted, synthetic))))


def marked(values: Mapping[str, Any], remark: str = "", say_failed: bool = True) -> dict[str, Any]:
    """The metrics of estimators under titles that say what is not all there.

    That it failed (but for a page, which states it itself), how many of the frames it saw, how many
    of its poses no landmark measured, and ``remark``, what all of a run's are marked with.
    """
    frames = max((value_at(m, "frames") or 0 for m in values.values()), default=0)
    out = {}
    for title, metrics in values.items():
        own = value_at(metrics or {}, "frames")
        marks = (
            "failed" if say_failed and value_at(metrics or {}, "failure") else "",
            f"{own} of {frames} frames" if own is not None and own < frames else "",
            predicted_mark(value_at(metrics or {}, "predicted_frames")),
            remark,
        )
        out[with_marks(title, marks)] = metrics or {}
    return out
