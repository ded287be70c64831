"""Numbers of metrics.json as tables to read: in the terminal, on the page, of trials."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from fgslam.evaluation.metrics import value_at
from fgslam.report.content import Column, TextTable
from fgslam.runs.marks import marked

UNKNOWN = "-"
_REMARKS_SHOWN = 3


class MetricColumn(NamedTuple):
    """A column of numbers of metrics.json.

    Attributes:
        heading: of the column.
        paths: dotted, of the values that stand in it.
        text: makes them a cell.
        meaning: what they are, or why a cell may be empty.
        optional: whether the column is left out where no estimator fills it.
    """

    heading: str
    paths: tuple[str, ...]
    text: Callable[..., str]
    meaning: str
    optional: bool = True


def comparison_tables(name: str, frames: int, values: Mapping[str, Any]) -> tuple[TextTable, ...]:
    """Accuracy, consistency, time and memory of estimators; ``values`` by title, of one run."""
    consistency = f"{name}: consistency (1 is right; {_band(values)})"
    tables = (
        metrics_table(f"{name}: accuracy ({_alignment(values)})", _ACCURACY, values),
        metrics_table(consistency, _CONSISTENCY, values),
        metrics_table(f"{name}: time and memory, {frames} frames", _COST, values),
    )
    return tuple(table for table in tables if table.columns)


def comparison_particulars(values: Mapping[str, Any], out: Path) -> tuple[tuple[str, str], ...]:
    """Label and text: why values are missing, failures, remarks, and where the results are."""
    return (*_reasons(values), *_remarks(values), ("results", str(out))) if values else ()


def page_tables(values: Mapping[str, Any]) -> tuple[TextTable, ...]:
    """The tables of the page, of metrics by marked title; values that are not known read `-`.

    Three, for one of all columns is wider than a window.
    """
    return tuple(
        _table(heading.partition(" ")[0].lower(), heading, columns, values)
        for heading, columns in _PAGE.items()
    )


def ate_table(runs: Sequence[tuple[str, Mapping[str, Any]]]) -> TextTable:
    """Final ATE of each estimator on each run, given by its name and metrics by title."""
    rows = []
    for title in dict.fromkeys(title for _, values in runs for title in values):
        found = [_ate_cell(title, values) for _, values in runs]
        rows.append((title, tuple(found)))
    columns = tuple(Column(name, "final ATE, cm") for name, _ in runs)
    return TextTable("ate", "final ATE, cm, SE3 aligned", "estimator", columns, tuple(rows))


def _ate_cell(title: str, values: Mapping[str, Any]) -> str:
    """An ATE with the marks of its estimator in its run."""
    ate = value_at(values.get(title) or {}, "ate_rmse_m")
    if ate is None:
        return UNKNOWN
    name = list(marked(values))[list(values).index(title)]
    return f"{_cm(ate)}{name.removeprefix(title)}"


def metrics_table(
    heading: str, columns: Sequence[MetricColumn], values: Mapping[str, Any]
) -> TextTable:
    """Values of metrics.json by estimator, as text; without columns that no estimator fills."""
    return _table(heading, heading, columns, marked(values))


def _table(
    key: str, heading: str, columns: Sequence[MetricColumn], values: Mapping[str, Any]
) -> TextTable:
    kept = [column for column in columns if not (column.optional and _is_empty(column, values))]
    rows = tuple(
        (title, tuple(_cell(column, metrics) for column in kept))
        for title, metrics in values.items()
    )
    headings = tuple(Column(column.heading, column.meaning) for column in kept)
    return TextTable(key, heading, "estimator", headings, rows)


def _is_empty(column: MetricColumn, values: Mapping[str, Any]) -> bool:
    return all(_cell(column, metrics) == UNKNOWN for metrics in values.values())


def _cell(column: MetricColumn, metrics: Mapping[str, Any]) -> str:
    found = [value_at(metrics, path) for path in column.paths]
    if any(value is None for value in found):
        return UNKNOWN
    try:
        return column.text(*found)
    except (TypeError, ValueError):  # a metrics.json of another program
        return " ".join(map(str, found))


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
    for column in (*_ACCURACY, *_CONSISTENCY, *_COST):
        if any(_cell(column, m) == UNKNOWN for m in done):
            label = "left out" if _is_empty(column, values) else UNKNOWN
            headings = found.setdefault((label, column.meaning), [])
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
# Columns


def _cm(metres: float) -> str:
    return f"{100.0 * metres:.2f}"


def _cm_deg(metres: float, degrees: float) -> str:
    return f"{100.0 * metres:.2f} {degrees:.3f}"


def _two_cm(first: float, second: float) -> str:
    return f"{_cm(first)} {_cm(second)}"


def _ratio(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000.0 else f"{value:.2f}"


def _judged(value: float, verdict: str) -> str:
    return f"{_ratio(value)} {verdict}"


def _times(median: float, p95: float, longest: float) -> str:
    return f"{median:.2f} {p95:.2f} {longest:.1f}"


def _number(spec: str) -> Callable[[float], str]:
    return lambda value: format(float(value), spec)


def _short(value: float) -> str:
    return _whole(value) if abs(value) >= 1000.0 else f"{value:.3g}"


def _seconds(milliseconds: float) -> str:
    return f"{milliseconds / 1e3:.2f}"


def _whole(value: float) -> str:
    return f"{value:,.0f}"


def _signed(value: float) -> str:
    return f"{value:+.2f}"


def _interval(scale: float, digits: int) -> Callable[..., str]:
    def text(found: Mapping[str, Any]) -> str:
        mean, lower, upper = found["mean"], found["lower"], found["upper"]
        ends = (
            "" if lower is None else f"\n[{scale * lower:.{digits}f}, {scale * upper:.{digits}f}]"
        )
        return f"{scale * mean:.{digits}f}{ends}"

    return text


def _pooled(found: Mapping[str, Any]) -> str:
    band = f"{found['lower']:.2f}-{found['upper']:.2f}"
    return f"{_ratio(found['per_dof'])} {found['verdict']}\n{band}"


_NO_TRUTH = "no ground truth, or fewer than three poses matched"
_NO_LANDMARKS = "true landmark positions are not known, or none of them is in the map"
_ACCURACY = (
    MetricColumn("ATE\nfinal cm", ("ate_rmse_m",), _cm, _NO_TRUTH),
    MetricColumn("ATE\nonline cm", ("online.ate_rmse_m",), _cm, _NO_TRUTH),
    MetricColumn("RPE final\ncm deg", ("rpe_trans_m", "rpe_rot_deg"), _cm_deg, _NO_TRUTH),
    MetricColumn(
        "RPE online\ncm deg", ("online.rpe_trans_m", "online.rpe_rot_deg"), _cm_deg, _NO_TRUTH
    ),
    MetricColumn("end error\ncm deg", ("end_error_m", "end_error_deg"), _cm_deg, _NO_TRUTH),
    MetricColumn(
        "landmarks cm\nrms median", ("landmark_rmse_m", "landmark_median_m"), _two_cm, _NO_LANDMARKS
    ),
)
_CONSISTENCY = (
    MetricColumn(
        "NEES pose\nfinal", ("nees_pose_per_dof", "nees_pose.verdict"), _judged, _NO_TRUTH
    ),
    MetricColumn(
        "NEES pose\nonline",
        ("online.nees_pose_per_dof", "online.nees_pose.verdict"),
        _judged,
        _NO_TRUTH,
    ),
    MetricColumn("in 2 sigma\nfinal", ("coverage.all",), _number(".0%"), _NO_TRUTH),
    MetricColumn("in 2 sigma\nonline", ("online.coverage.all",), _number(".0%"), _NO_TRUTH),
    MetricColumn(
        "NEES\nlandmarks",
        ("nees_landmark_per_dof", "nees_landmark.verdict"),
        _judged,
        _NO_LANDMARKS,
    ),
    MetricColumn(
        "noise\nfactor",
        ("noise_factor",),
        _number(".2f"),
        "no landmark measurement is weighed: by it the stated deviations were multiplied",
    ),
    MetricColumn("NIS", ("nis_per_dof",), _ratio, "the estimator forms no innovation"),
    MetricColumn(
        "sigma of last\npose cm deg",
        ("last_pose_sigma.position_m", "last_pose_sigma.rotation_deg"),
        _cm_deg,
        "its covariance is not known",
    ),
)
_COST = (
    MetricColumn(
        "update ms\nmedian p95 max",
        ("update_ms.median", "update_ms.p95", "update_ms.max"),
        _times,
        "no frame was processed",
    ),
    MetricColumn("growth\n1 is flat", ("update_growth.ratio",), _ratio, "fewer than 25 frames"),
    MetricColumn(
        "slope ms /\n1000 frames",
        ("update_growth.slope_ms_per_1000",),
        _signed,
        "fewer than 25 frames",
    ),
    MetricColumn(
        "pose solve\nmedian ms", ("solve_ms.median",), _ratio, "timed with the live front-end"
    ),
    MetricColumn("final\nestimate s", ("final_ms",), _seconds, "not timed apart in a live run"),
    MetricColumn("memory\nMiB", ("peak_memory_mb",), _whole, "this system does not tell"),
    MetricColumn("map\nlandmarks", ("landmarks",), _whole, "no frame was processed"),
)
TRIAL_COLUMNS = (
    MetricColumn("ATE final cm", ("intervals.ate_rmse_m",), _interval(100.0, 3), _NO_TRUTH),
    MetricColumn("ATE online cm", ("intervals_online.ate_rmse_m",), _interval(100.0, 3), _NO_TRUTH),
    MetricColumn(
        "landmarks median cm", ("intervals.landmark_median_m",), _interval(100.0, 2), _NO_LANDMARKS
    ),
    MetricColumn("NEES pose", ("nees_pose",), _pooled, _NO_TRUTH),
    MetricColumn("NEES landmarks", ("nees_landmark",), _pooled, _NO_LANDMARKS),
)
_always = partial(MetricColumn, optional=False)
_PAGE_ACCURACY = (
    _always(
        "ATE (cm)",
        ("ate_rmse_m",),
        _cm,
        "absolute trajectory error of the final path: root mean square distance from the truth "
        "after SE3 alignment",
    ),
    MetricColumn(
        "ATE online (cm)",
        ("online.ate_rmse_m",),
        _cm,
        "the same of the path made of each pose as first estimated, at its own time",
    ),
    _always(
        "RPE (cm)",
        ("rpe_trans_m",),
        _cm,
        "relative pose error from frame to frame, translation",
    ),
    _always(
        "RPE (deg)",
        ("rpe_rot_deg",),
        _number(".3f"),
        "relative pose error from frame to frame, rotation",
    ),
    _always(
        "end error (cm)",
        ("end_error_m",),
        _cm,
        "distance of the last pose from the true one, the first pose aligned",
    ),
    _always(
        "drift (%)",
        ("drift_percent",),
        _number(".2f"),
        "end error over the length of the true path",
    ),
    MetricColumn(
        "landmark error (cm)",
        ("landmark_rmse_m",),
        _cm,
        "root mean square distance of the landmarks from their true positions",
    ),
)
_PAGE_CONSISTENCY = (
    _always(
        "NEES pose",
        ("nees_pose_per_dof",),
        _short,
        "normalised error squared of the poses per degree of freedom: 1 is right, more is "
        "overconfident, less is conservative",
    ),
    _always(
        "verdict",
        ("nees_pose.verdict",),
        str,
        "whether the pose NEES lies in its 95 % chi-square band; one run counts as one sample",
    ),
    MetricColumn("in 2 sigma", ("coverage.all",), _number(".0%"), "pose errors within two sigma"),
    MetricColumn(
        "NEES online",
        ("online.nees_pose_per_dof",),
        _short,
        "NEES of each pose as first estimated, by its covariance of that time",
    ),
    _always(
        "NEES landmarks",
        ("nees_landmark_per_dof",),
        _short,
        "normalised error squared of the landmarks per degree of freedom",
    ),
    MetricColumn(
        "NIS",
        ("nis_per_dof",),
        _short,
        "normalised innovation squared of the measurements per degree of freedom",
    ),
    MetricColumn(
        "last sigma (cm)",
        ("last_pose_sigma.position_m",),
        _cm,
        "standard deviation of the last pose's position, as claimed",
    ),
)
_PAGE_COST = (
    _always("landmarks", ("landmarks",), _whole, "number of landmarks in the final map"),
    _always(
        "median (ms)",
        ("update_ms.median",),
        _number(".2f"),
        "time for a frame, median over the run",
    ),
    _always(
        "p95 (ms)",
        ("update_ms.p95",),
        _number(".2f"),
        "time for a frame that 95 % stay below",
    ),
    _always("worst (ms)", ("update_ms.max",), _number(".1f"), "longest time for a frame"),
    MetricColumn(
        "growth",
        ("update_growth.ratio",),
        _number(".2f"),
        "median time of the last fifth of the frames over that of the second fifth: 1 is flat",
    ),
    _always(
        "memory (MiB)",
        ("peak_memory_mb",),
        _whole,
        "largest resident memory of the process",
    ),
)
_PAGE = {
    "Accuracy": _PAGE_ACCURACY,
    "Consistency": _PAGE_CONSISTENCY,
    "Time and memory": _PAGE_COST,
}
