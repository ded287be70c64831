"""The page of a SLAM run: what :class:`~fgslam.report.run_results.ReportData` looks like."""

from __future__ import annotations

from pathlib import Path

from fgslam.report.content import Page
from fgslam.report.figures.over_time import (
    error_by_axis,
    error_over_time,
    nees_over_time,
    time_per_frame,
)
from fgslam.report.figures.trajectory import drive_from_above, map_to_turn
from fgslam.report.headline import headline
from fgslam.report.page import write_html
from fgslam.report.run_results import ReportData


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
