"""A comparison as text: tables of accuracy, consistency and cost, and why values are missing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from fgslam.evaluation.metrics import value_at
from fgslam.report.content import Column, TextTable
from fgslam.runs.comparison import Compared

UNKNOWN = "-"
_REMARKS_SHOWN = 3


class TextColumn(NamedTuple):
    """A column of numbers of metrics.json.

    Attributes:
        heading: of the column.
        paths: dotted, of the values that stand in it.
        text: makes them a cell.
        why_unknown: why a cell may be empty.
    """

    heading: str
    paths: tuple[str, ...]
    text: Callable[..., str]
    why_unknown: str


def comparison_tables(one: Compared) -> tuple[TextTable, ...]:
    """Accuracy, consistency, time and memory of the estimators of one run."""
    values = {title: metrics.as_json() for title, metrics in one.metrics.items()}
    consistency = f"{one.name}: consistency (1 is right; {_band(values)})"
    tables = (
        metrics_table(f"{one.name}: accuracy ({_alignment(values)})", _ACCURACY, values),
        metrics_table(consistency, _CONSISTENCY, values),
        metrics_table(f"{one.name}: time and memory, {one.frames} frames", _COST, values),
    )
    return tuple(table for table in tables if table.columns)


def comparison_particulars(one: Compared) -> tuple[tuple[str, str], ...]:
    """Label and text: why values are missing, failures, remarks, and where the results are."""
    values = {title: metrics.as_json() for title, metrics in one.metrics.items()}
    return (*_reasons(values), *_remarks(one, values), ("results", str(one.out)))


def ate_table(compared: Sequence[Compared]) -> TextTable:
    """Final ATE of each estimator on each run."""
    rows = []
    for title in dict.fromkeys(title for one in compared for title in one.metrics):
        found = [
            one.metrics[title].ate_rmse_m if title in one.metrics else None for one in compared
        ]
        rows.append((title, tuple(UNKNOWN if ate is None else _cm(ate) for ate in found)))
    columns = tuple(Column(one.name, "final ATE, cm") for one in compared)
    return TextTable("ate", "final ATE, cm, SE3 aligned", "estimator", columns, tuple(rows))


def metrics_table(
    heading: str, columns: Sequence[TextColumn], values: Mapping[str, Any]
) -> TextTable:
    """Values of metrics.json by estimator, as text; without columns that no estimator fills."""
    columns = [column for column in columns if not _is_empty(column, values)]
    rows = []
    for title, metrics in values.items():
        failed = " (failed)" if value_at(metrics, "failure") else ""
        rows.append((title + failed, tuple(_cell(column, metrics) for column in columns)))
    headings = tuple(Column(column.heading, column.why_unknown) for column in columns)
    return TextTable(heading, heading, "estimator", headings, tuple(rows))


def _is_empty(column: TextColumn, values: Mapping[str, Any]) -> bool:
    return all(_cell(column, metrics) == UNKNOWN for metrics in values.values())


def _cell(column: TextColumn, metrics: Mapping[str, Any]) -> str:
    found = [value_at(metrics, path) for path in column.paths]
    return UNKNOWN if any(value is None for value in found) else column.text(*found)


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
            headings = found.setdefault((label, column.why_unknown), [])
            headings.append(column.heading.replace("\n", " "))
    return [(label, f"{', '.join(headings)}: {why}") for (label, why), headings in found.items()]


def _remarks(one: Compared, values: Mapping[str, Any]) -> list[tuple[str, str]]:
    lines = [("failed", f"{title}: {why}") for title, why in one.failures.items()]
    for title, metrics in values.items():
        remarks = [str(remark) for remark in value_at(metrics, "remarks") or ()]
        lines += [("remark", f"{title}: {remark}") for remark in remarks[:_REMARKS_SHOWN]]
        if len(remarks) > _REMARKS_SHOWN:
            more = len(remarks) - _REMARKS_SHOWN
            lines.append(("remark", f"{title}: and {more} more, see metrics.json"))
    sigma = next((s for m in values.values() if (s := value_at(m, "landmark_truth_sigma_m"))), None)
    if sigma is not None:
        lines.append(("note", f"the landmarks' truth itself is known to {1e3 * sigma:.1f} mm"))
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


def _seconds(milliseconds: float) -> str:
    return f"{milliseconds / 1e3:.2f}"


def _whole(value: float) -> str:
    return f"{value:,.0f}"


def _signed(value: float) -> str:
    return f"{value:+.2f}"


def _interval(scale: float, digits: int) -> Callable[..., str]:
    def text(found: Mapping[str, Any]) -> str:
        mean, lower, upper = found["mean"], found["lower"], found["upper"]
        ends = "" if lower is None else f" [{scale * lower:.{digits}f}, {scale * upper:.{digits}f}]"
        return f"{scale * mean:.{digits}f}{ends}"

    return text


def _pooled(found: Mapping[str, Any]) -> str:
    band = f"{found['lower']:.2f}-{found['upper']:.2f}"
    return f"{_ratio(found['per_dof'])} {found['verdict']} ({band})"


_NO_TRUTH = "no ground truth, or fewer than three poses matched"
_NO_LANDMARKS = "true landmark positions are not known, or none of them is in the map"
_ACCURACY = (
    TextColumn("ATE\nfinal cm", ("ate_rmse_m",), _cm, _NO_TRUTH),
    TextColumn("ATE\nonline cm", ("online.ate_rmse_m",), _cm, _NO_TRUTH),
    TextColumn("RPE final\ncm deg", ("rpe_trans_m", "rpe_rot_deg"), _cm_deg, _NO_TRUTH),
    TextColumn(
        "RPE online\ncm deg", ("online.rpe_trans_m", "online.rpe_rot_deg"), _cm_deg, _NO_TRUTH
    ),
    TextColumn("end error\ncm deg", ("end_error_m", "end_error_deg"), _cm_deg, _NO_TRUTH),
    TextColumn(
        "landmarks cm\nrms median", ("landmark_rmse_m", "landmark_median_m"), _two_cm, _NO_LANDMARKS
    ),
)
_CONSISTENCY = (
    TextColumn("NEES pose\nfinal", ("nees_pose_per_dof", "nees_pose.verdict"), _judged, _NO_TRUTH),
    TextColumn(
        "NEES pose\nonline",
        ("online.nees_pose_per_dof", "online.nees_pose.verdict"),
        _judged,
        _NO_TRUTH,
    ),
    TextColumn(
        "NEES\nlandmarks",
        ("nees_landmark_per_dof", "nees_landmark.verdict"),
        _judged,
        _NO_LANDMARKS,
    ),
    TextColumn("NIS", ("nis_per_dof",), _ratio, "the estimator forms no innovation"),
    TextColumn(
        "sigma of last\npose cm deg",
        ("last_pose_sigma.position_m", "last_pose_sigma.rotation_deg"),
        _cm_deg,
        "its covariance is not known",
    ),
)
_COST = (
    TextColumn(
        "update ms\nmedian p95 max",
        ("update_ms.median", "update_ms.p95", "update_ms.max"),
        _times,
        "no frame was processed",
    ),
    TextColumn("growth\nlast/2nd fifth", ("update_growth.ratio",), _ratio, "fewer than 25 frames"),
    TextColumn(
        "slope ms /\n1000 frames",
        ("update_growth.slope_ms_per_1000",),
        _signed,
        "fewer than 25 frames",
    ),
    TextColumn(
        "pose solve\nmedian ms", ("solve_ms.median",), _ratio, "timed with the live front-end"
    ),
    TextColumn("final\nestimate s", ("final_ms",), _seconds, "not timed apart in a live run"),
    TextColumn("peak memory\nMiB", ("peak_memory_mb",), _whole, "this system does not tell"),
    TextColumn("landmarks\nin the map", ("landmarks",), _whole, "no frame was processed"),
)
TRIAL_COLUMNS = (
    TextColumn("ATE final cm", ("intervals.ate_rmse_m",), _interval(100.0, 3), _NO_TRUTH),
    TextColumn("ATE online cm", ("intervals_online.ate_rmse_m",), _interval(100.0, 3), _NO_TRUTH),
    TextColumn(
        "landmarks median cm", ("intervals.landmark_median_m",), _interval(100.0, 2), _NO_LANDMARKS
    ),
    TextColumn("NEES pose", ("nees_pose",), _pooled, _NO_TRUTH),
    TextColumn("NEES landmarks", ("nees_landmark",), _pooled, _NO_LANDMARKS),
)
