"""The tables of a comparison in the terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from rich.console import Console
from rich.table import Table

from fgslam.evaluation.metrics import value_at
from fgslam.runs.baseline import Deviation
from fgslam.runs.comparison import Compared
from fgslam.runs.trial_results import failures_of, together
from fgslam.runs.trials import Trials

UNKNOWN = "-"
_REMARKS_SHOWN = 3
_WIDTH_OF_FILES = 130


class _Column(NamedTuple):
    heading: str
    paths: tuple[str, ...]
    text: Callable[..., str]
    why_unknown: str


def show_comparisons(compared: Sequence[Compared]) -> None:
    """Tables of each run, then of all together where there are several."""
    console = _console()
    for one in compared:
        _show(console, one)
    if len(compared) > 1:
        console.print(_summary(compared))


def show_trials(trials: Trials) -> None:
    """Means over the trials, the verdict on each estimator, and who beats whom."""
    console = _console()
    summary = trials.summary
    values = {title: together(summary, title).as_json() for title in summary.means}
    count = len(summary.rows)
    heading = f"{trials.name}: {count} trials, mean [95 % interval]; NEES pooled, 1 is right"
    console.print(_table(heading, _TRIAL_COLUMNS, values))
    for pair in summary.pairs:
        console.out(pair.sentence)
    for line in (*trials.failures, *failures_of(summary)):
        console.out(f"failed      {line}")
    console.out(f"results     {trials.out}")


def show_deviations(deviations: Sequence[Deviation]) -> None:
    """What differs from the baseline, each in a line, or that nothing does."""
    console = _console()
    for deviation in deviations:
        console.out(f"{'REGRESSION' if deviation.regression else 'deviation':<12}{deviation.text}")
    if not deviations:
        console.out("baseline    all values are within their tolerances")


def _console() -> Console:
    console = Console()
    # A file or a pipe has no width to keep to.
    return console if console.is_terminal else Console(width=_WIDTH_OF_FILES)


def _show(console: Console, one: Compared) -> None:
    values = {title: metrics.as_json() for title, metrics in one.metrics.items()}
    for heading, columns in (
        (f"{one.name}: accuracy ({_alignment(values)})", _ACCURACY),
        (f"{one.name}: consistency (1 is right; {_band(values)})", _CONSISTENCY),
        (f"{one.name}: time and memory, {one.frames} frames", _COST),
    ):
        console.print(_table(heading, columns, values))
    for line in (*_reasons(values), *_remarks(one, values)):
        console.out(line)
    console.out(f"results     {one.out}")
    console.out(f"report      {one.out / 'report.html'}")


def _table(heading: str, columns: Sequence[_Column], values: Mapping[str, Any]) -> Table:
    table = Table(title=heading, title_justify="left")
    table.add_column("estimator", no_wrap=True)
    for column in columns:
        table.add_column(column.heading, justify="right")
    for title, metrics in values.items():
        failed = " (failed)" if value_at(metrics, "failure") else ""
        table.add_row(title + failed, *(_cell(column, metrics) for column in columns))
    return table


def _cell(column: _Column, metrics: Mapping[str, Any]) -> str:
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
    bands = dict.fromkeys(
        f"{value_at(m, 'nees_pose.lower'):.2f}-{value_at(m, 'nees_pose.upper'):.2f}"
        for m in values.values()
        if value_at(m, "nees_pose.lower") is not None
    )
    return f"95 % band of the pose NEES {', '.join(bands)}" if bands else "no truth to judge by"


def _reasons(values: Mapping[str, Any]) -> list[str]:
    """Why values are missing, each reason once with the headings that it empties."""
    found: dict[str, list[str]] = {}
    for column in (*_ACCURACY, *_CONSISTENCY, *_COST):
        if any(_cell(column, m) == UNKNOWN for m in values.values() if not value_at(m, "failure")):
            found.setdefault(column.why_unknown, []).append(column.heading.replace("\n", " "))
    return [f"{UNKNOWN:<12}{', '.join(headings)}: {why}" for why, headings in found.items()]


def _remarks(one: Compared, values: Mapping[str, Any]) -> list[str]:
    lines = [f"failed      {title}: {why}" for title, why in one.failures.items()]
    for title, metrics in values.items():
        remarks = [str(remark) for remark in value_at(metrics, "remarks") or ()]
        lines += [f"remark      {title}: {remark}" for remark in remarks[:_REMARKS_SHOWN]]
        if len(remarks) > _REMARKS_SHOWN:
            more = len(remarks) - _REMARKS_SHOWN
            lines.append(f"remark      {title}: and {more} more, see metrics.json")
    sigma = next((s for m in values.values() if (s := value_at(m, "landmark_truth_sigma_m"))), None)
    if sigma is not None:
        lines.append(f"note        the landmarks' truth itself is known to {1e3 * sigma:.1f} mm")
    return lines


def _summary(compared: Sequence[Compared]) -> Table:
    """Final ATE of each estimator on each run."""
    table = Table(title="final ATE, cm, SE3 aligned", title_justify="left")
    table.add_column("estimator", no_wrap=True)
    for one in compared:
        table.add_column(one.name, justify="right")
    for title in dict.fromkeys(title for one in compared for title in one.metrics):
        found = [
            one.metrics[title].ate_rmse_m if title in one.metrics else None for one in compared
        ]
        table.add_row(title, *(UNKNOWN if ate is None else _cm(ate) for ate in found))
    return table


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
    _Column("ATE\nfinal cm", ("ate_rmse_m",), _cm, _NO_TRUTH),
    _Column("ATE\nonline cm", ("online.ate_rmse_m",), _cm, _NO_TRUTH),
    _Column("RPE final\ncm deg", ("rpe_trans_m", "rpe_rot_deg"), _cm_deg, _NO_TRUTH),
    _Column("RPE online\ncm deg", ("online.rpe_trans_m", "online.rpe_rot_deg"), _cm_deg, _NO_TRUTH),
    _Column("end error\ncm deg", ("end_error_m", "end_error_deg"), _cm_deg, _NO_TRUTH),
    _Column(
        "landmarks cm\nrms median", ("landmark_rmse_m", "landmark_median_m"), _two_cm, _NO_LANDMARKS
    ),
)
_CONSISTENCY = (
    _Column("NEES pose\nfinal", ("nees_pose_per_dof", "nees_pose.verdict"), _judged, _NO_TRUTH),
    _Column(
        "NEES pose\nonline",
        ("online.nees_pose_per_dof", "online.nees_pose.verdict"),
        _judged,
        _NO_TRUTH,
    ),
    _Column(
        "NEES\nlandmarks",
        ("nees_landmark_per_dof", "nees_landmark.verdict"),
        _judged,
        _NO_LANDMARKS,
    ),
    _Column("NIS", ("nis_per_dof",), _ratio, "the estimator forms no innovation"),
    _Column(
        "sigma of last\npose cm deg",
        ("last_pose_sigma.position_m", "last_pose_sigma.rotation_deg"),
        _cm_deg,
        "its covariance is not known",
    ),
)
_COST = (
    _Column(
        "update ms\nmedian p95 max",
        ("update_ms.median", "update_ms.p95", "update_ms.max"),
        _times,
        "no frame was processed",
    ),
    _Column("growth\nlast/2nd fifth", ("update_growth.ratio",), _ratio, "fewer than 25 frames"),
    _Column(
        "slope ms /\n1000 frames",
        ("update_growth.slope_ms_per_1000",),
        _signed,
        "fewer than 25 frames",
    ),
    _Column("pose solve\nmedian ms", ("solve_ms.median",), _ratio, "timed with the live front-end"),
    _Column("final\nestimate s", ("final_ms",), _seconds, "not timed apart in a live run"),
    _Column("peak memory\nMiB", ("peak_memory_mb",), _whole, "this system does not tell"),
    _Column("landmarks\nin the map", ("landmarks",), _whole, "no frame was processed"),
)
_TRIAL_COLUMNS = (
    _Column("ATE final cm", ("intervals.ate_rmse_m",), _interval(100.0, 3), _NO_TRUTH),
    _Column("ATE online cm", ("intervals_online.ate_rmse_m",), _interval(100.0, 3), _NO_TRUTH),
    _Column(
        "landmarks median cm", ("intervals.landmark_median_m",), _interval(100.0, 2), _NO_LANDMARKS
    ),
    _Column("NEES pose", ("nees_pose",), _pooled, _NO_TRUTH),
    _Column("NEES landmarks", ("nees_landmark",), _pooled, _NO_LANDMARKS),
)
