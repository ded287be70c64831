"""The page of a SLAM run: sentences on accuracy and consistency, tables, figures."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from fgslam.report.content import Page
from fgslam.report.figures.calibration import calibration_over_time
from fgslam.report.figures.noise import noise_over_time
from fgslam.report.figures.over_time import (
    error_by_axis,
    error_over_time,
    nees_over_time,
    time_per_frame,
)
from fgslam.report.figures.traces import Figure
from fgslam.report.figures.trajectory import drive_from_above, map_to_turn
from fgslam.report.page import write_html
from fgslam.report.run_results import EstimatorReport, ReportData

_ABOUT_EQUAL = 1.05
_ROUND_FROM = 1000.0
_JUDGED = {
    "consistent": "errors as large as the covariances say",
    "overconfident": "errors larger than the covariances say",
    "conservative": "errors smaller than the covariances say",
}


def write_report(path: Path, data: ReportData) -> None:
    """Writes a run's page atomically; the same data give the same bytes. Raises OutputError."""
    write_html(path, slam_page(data))


def slam_page(data: ReportData) -> Page:
    """Sentences, tables and figures of a run."""
    remarks = [f"{e.title}: {remark}" for e in data.estimators for remark in e.remarks]
    remarks += [f"{e.title} failed: {e.failure}" for e in data.estimators if e.failure]
    return Page(
        title=data.title,
        subtitle=data.subtitle,
        headline=headline(data),
        tables=data.tables,
        figures=(
            drive_from_above(data),
            map_to_turn(data),
            error_over_time(data),
            error_by_axis(data),
            nees_over_time(data),
            time_per_frame(data),
            *_noise(data),
            *_calibration(data),
        ),
        pictures=data.pictures,
        series=tuple(e.title for e in data.estimators),
        undrawn=frozenset(e.title for e in data.estimators if not len(e)),
        failed=frozenset(e.title for e in data.estimators if e.failure),
        has_truth=data.truth is not None,
        notes=data.notes,
        remarks=tuple(remarks),
        config_yaml=data.config_yaml,
        versions=data.versions,
    )


def _noise(data: ReportData) -> Iterator[Figure]:
    """The noise estimated, where the run kept it."""
    if any(estimator.noise for estimator in data.estimators):
        yield noise_over_time(data)


def _calibration(data: ReportData) -> Iterator[Figure]:
    """The rig's calibration, where the run kept one."""
    if data.calibration is not None:
        yield calibration_over_time(data.calibration, data.start)


def headline(data: ReportData) -> tuple[str, ...]:
    """Sentences about accuracy, consistency and failures, most important first."""
    working = [e for e in data.estimators if not e.failure]
    lines = [_accuracy(data, working)] if working else ["No estimator gave a result."]
    lines += _consistency(working)
    lines += [f"{e.title} failed: {e.failure}" for e in data.estimators if e.failure]
    return tuple(lines)


def metres(value: float) -> str:
    """A length to be read: centimetres below a metre."""
    return f"{100.0 * value:.2f} cm" if value < 1.0 else f"{value:.3f} m"


def _accuracy(data: ReportData, working: list[EstimatorReport]) -> str:
    ranked = sorted((e.ate_m, e.title) for e in working if e.ate_m is not None)
    if not ranked:
        why = "there is no ground truth" if data.truth is None else "too few poses have a truth"
        return f"How accurate the path is, is not known: {why}."
    how = f"root mean square position error, {data.alignment}"
    first, title = ranked[0]
    if len(ranked) == 1:
        return f"{title} is off by {metres(first)} ({how})."
    second, other = ranked[1]
    if second <= _ABOUT_EQUAL * first:
        equal = [name for error, name in ranked if error <= _ABOUT_EQUAL * first]
        return f"{_listed(equal)} are about equally accurate: {metres(first)} ({how})."
    ratio = f", {second / first:.2g} times as much" if first > 0.0 else ""
    return (
        f"{title} is the most accurate: off by {metres(first)} ({how}). "
        f"The next, {other}, is off by {metres(second)}{ratio}."
    )


def _consistency(working: list[EstimatorReport]) -> Iterator[str]:
    for word, meaning in _JUDGED.items():
        found = [e for e in working if e.verdict == word]
        if found:
            names = [f"{e.title} ({_nees(e.nees_per_dof)})" for e in found]
            yield f"{word.capitalize()} ({meaning}): {_listed(names)}."
    unknown = [e.title for e in working if e.verdict not in _JUDGED]
    if unknown:
        yield f"Whether the covariances of {_listed(unknown)} can be believed is not known."


def _nees(value: float | None) -> str:
    if value is None:
        return "NEES not known"
    return f"NEES {value:,.0f}" if value >= _ROUND_FROM else f"NEES {value:.3g}"


def _listed(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
