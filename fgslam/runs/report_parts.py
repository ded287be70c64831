"""Parts of a report that are words: the table of metrics.json, captions of pictures."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from fgslam.core.errors import DatasetError
from fgslam.report.content import Column, Picture, TextTable

UNKNOWN = "-"
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


class _Metric(NamedTuple):
    """A column: where its value is, how it reads, and whether it is left out where all lack it."""

    path: str
    heading: str
    meaning: str
    text: Callable[[Any], str]
    optional: bool = False


def _number(spec: str, scale: float = 1.0) -> Callable[[Any], str]:
    return lambda value: format(scale * float(value), spec)


def _ratio(value: Any) -> str:
    return f"{float(value):,.0f}" if abs(float(value)) >= 1000.0 else f"{float(value):.3g}"


_CM, _INTEGER = _number(".2f", 100.0), _number(",.0f")
_METRICS = (
    _Metric(
        "ate_rmse_m",
        "ATE (cm)",
        "absolute trajectory error of the final path: root mean square distance from the truth "
        "after SE3 alignment",
        _CM,
    ),
    _Metric(
        "online.ate_rmse_m",
        "ATE online (cm)",
        "the same of the path made of each pose as first estimated, at its own time",
        _CM,
        optional=True,
    ),
    _Metric("rpe_trans_m", "RPE (cm)", "relative pose error from frame to frame, translation", _CM),
    _Metric(
        "rpe_rot_deg",
        "RPE (deg)",
        "relative pose error from frame to frame, rotation",
        _number(".3f"),
    ),
    _Metric(
        "end_error_m",
        "end error (cm)",
        "distance of the last pose from the true one, the first pose aligned",
        _CM,
    ),
    _Metric(
        "drift_percent", "drift (%)", "end error over the length of the true path", _number(".2f")
    ),
    _Metric(
        "landmark_rmse_m",
        "landmark error (cm)",
        "root mean square distance of the landmarks from their true positions",
        _CM,
        optional=True,
    ),
    _Metric("landmarks", "landmarks", "number of landmarks in the final map", _INTEGER),
    _Metric(
        "nees_pose_per_dof",
        "NEES pose",
        "normalised error squared of the poses per degree of freedom: 1 is right, more is "
        "overconfident, less is conservative",
        _ratio,
    ),
    _Metric(
        "nees_pose.verdict",
        "verdict",
        "whether the pose NEES lies in its 95 % chi-square band; one run counts as one sample",
        str,
    ),
    _Metric(
        "online.nees_pose_per_dof",
        "NEES online",
        "NEES of each pose as first estimated, by its covariance of that time",
        _ratio,
        optional=True,
    ),
    _Metric(
        "nees_landmark_per_dof",
        "NEES landmarks",
        "normalised error squared of the landmarks per degree of freedom",
        _ratio,
    ),
    _Metric(
        "nis_per_dof",
        "NIS",
        "normalised innovation squared of the measurements per degree of freedom",
        _ratio,
        optional=True,
    ),
    _Metric(
        "last_pose_sigma.position_m",
        "last sigma (cm)",
        "standard deviation of the last pose's position, as claimed",
        _CM,
        optional=True,
    ),
    _Metric(
        "update_ms.median", "median (ms)", "time for a frame, median over the run", _number(".2f")
    ),
    _Metric("update_ms.p95", "p95 (ms)", "time for a frame that 95 % stay below", _number(".2f")),
    _Metric("update_ms.max", "worst (ms)", "longest time for a frame", _number(".1f")),
    _Metric(
        "update_growth.ratio",
        "growth",
        "median time of the last fifth of the frames over that of the second fifth: 1 is flat",
        _number(".2f"),
        optional=True,
    ),
    _Metric("peak_memory_mb", "memory (MiB)", "largest resident memory of the process", _INTEGER),
)


def comparison_table(estimators: Mapping[str, Any]) -> TextTable:
    """The table of a metrics.json's estimators; values that are not known read `-`."""
    found = {
        title: [_value(values or {}, metric.path) for metric in _METRICS]
        for title, values in estimators.items()
    }
    kept = [
        k
        for k, metric in enumerate(_METRICS)
        if not metric.optional or any(row[k] is not None for row in found.values())
    ]
    rows = tuple(
        (title, tuple(_text(_METRICS[k], row[k]) for k in kept)) for title, row in found.items()
    )
    columns = tuple(Column(_METRICS[k].heading, _METRICS[k].meaning) for k in kept)
    return TextTable("comparison", "Comparison", "estimator", columns, rows)


def sample_pictures(folder: Path) -> Iterator[Picture]:
    """The pictures of a run's folder with captions, matches first; nothing where it is absent."""
    drawn = (path for path in folder.glob("*.png") if path.stem not in _FIGURES_OF_THE_PAGE)
    for path in sorted(drawn, key=_order):
        try:
            yield Picture(_caption(path.stem), path.read_bytes())
        except OSError as error:
            raise DatasetError(f"cannot read {path}: {error.strerror}; check the path") from error


def _value(values: Mapping[str, Any], path: str) -> Any:
    """The value under a dotted path, or None."""
    at: Any = values
    for key in path.split("."):
        at = at.get(key) if isinstance(at, Mapping) else None
    return at


def _text(metric: _Metric, value: Any) -> str:
    if value is None:
        return UNKNOWN
    try:
        return metric.text(value)
    except (TypeError, ValueError):
        return str(value)


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
