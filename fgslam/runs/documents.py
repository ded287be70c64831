"""metrics.json and the page of the tasks whose results are tables: homing and localisation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fgslam.evaluation.metrics import JsonValue
from fgslam.report.content import Page
from fgslam.report.page import write_html
from fgslam.report.tables import write_json
from fgslam.runs.engine import RunResult
from fgslam.runs.folder import METRICS_FILE, REPORT_FILE, RUN_MARKER, versions


def write_document(
    result: RunResult,
    numbers: Mapping[str, JsonValue],
    estimators: Mapping[str, JsonValue] | None = None,
) -> None:
    """metrics.json: what every homing task has, then its own numbers. Raises OutputError."""
    about: dict[str, JsonValue] = {
        "name": result.config.name,
        "task": result.config.task_name,
        "status": result.status,
        "remarks": list(result.notes),
    }
    document = {**about, **numbers, "estimators": dict(estimators or {})}
    write_json(result.folder / METRICS_FILE, document)


def write_page(result: RunResult, subtitle: str, **parts: Any) -> None:
    """report.html, unless the configuration does without; ``parts`` as of Page."""
    if not result.config.wants_report:
        return
    page = Page(
        title=result.config.name,
        subtitle=subtitle,
        headline=result.lines,
        tables=result.tables,
        notes=result.notes,
        config_yaml=(result.folder / RUN_MARKER).read_text(encoding="utf-8"),
        versions=versions(),
        **parts,
    )
    write_html(result.folder / REPORT_FILE, page)
