"""The report page of a run, built from the files of its folder alone."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.errors import DatasetError, FgslamError
from fgslam.core.estimates import Estimate, LandmarkMap, Trajectory
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.sensors import vertical_of
from fgslam.core.trajectories import read_covariances
from fgslam.core.yaml_text import plain_values
from fgslam.report.content import Picture, read_metrics
from fgslam.report.formats import MapPoints, read_ply
from fgslam.report.results import (
    EstimatorReport,
    ReportData,
    judged_report,
    same_times,
    truth_in_their_world,
)
from fgslam.runs.estimator_files import NOISE_TABLE
from fgslam.runs.folder import CALIBRATION_FILE, LOG_FILE, REPORT_FILE, RUN_MARKER
from fgslam.runs.tables import SYNTHETIC, marked, page_tables
from fgslam.runs.tasks.slam_metrics import LOOPS_FILE, read_closures

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
    config_text = _text(_find(folders, RUN_MARKER))
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


def _text(path: Path | None) -> str:
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
        rows = csv.DictReader(io.StringIO(_text(path)))
        times = dict(_number_pairs(path, rows, "update_ms"))
    # Files keep 9 decimals of a second, which makes time stamps of one frame equal.
    return np.array([times.get(round(t, 9), np.nan) for t in final.timestamps.tolist()])


def _live_times(path: Path | None) -> dict[float, float]:
    """What the live estimator took for each frame, by time stamp, from timing.csv."""
    if path is None:
        return {}
    out: dict[float, float] = {}
    rows = [r for r in csv.DictReader(io.StringIO(_text(path))) if r.get("stage") in _TIMED_STAGES]
    for stamp, milliseconds in _number_pairs(path, rows, "milliseconds"):
        out[stamp] = out.get(stamp, 0.0) + milliseconds
    return out


def _columns(path: Path | None) -> dict[str, FloatArray] | None:
    """The columns of a table of numbers, NaN where empty; None where there is none, or no row."""
    if path is None:
        return None
    rows = list(csv.reader(io.StringIO(_text(path))))
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
