"""What every homing task hands back, and how its folder begins and ends."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

from fgslam.evaluation.metrics import JsonValue
from fgslam.report.content import Page, TextTable
from fgslam.report.page import write_html
from fgslam.report.tables import write_json
from fgslam.runs.config_models import HomingExperiment
from fgslam.runs.folder import ExistingFolder, create_run_folder
from fgslam.runs.tasks.slam_outputs import versions, write_config

METRICS_FILE = "metrics.json"
REPORT_FILE = "report.html"

Status: TypeAlias = Literal["finished", "interrupted"]
Progress = Callable[[str, int, int], None]
"""Called with what is under way, how much is done, and of how much."""
Stopped = Callable[[], bool]


@dataclass(frozen=True, slots=True, eq=False)
class HomingResult:
    """How a homing task ended.

    Attributes:
        config: what was run.
        folder: the run folder.
        status: whether all of it was done.
        verdict: sentences for terminal and page.
        tables: for both, too.
        remarks: what was tolerated, or failed.
    """

    config: HomingExperiment
    folder: Path
    status: Status
    verdict: tuple[str, ...]
    tables: tuple[TextTable, ...] = ()
    remarks: tuple[str, ...] = ()


def jobs_of(config: HomingExperiment) -> int:
    """How many processes at a time."""
    return config.jobs or os.cpu_count() or 1


def begin(
    config: HomingExperiment,
    folder: Path,
    existing: ExistingFolder,
    provenance: Mapping[str, Any],
) -> None:
    """Makes the folder and writes the resolved configuration. Raises OutputError."""
    create_run_folder(folder, existing)
    write_config(folder, config, dict(provenance))


def write_document(
    result: HomingResult,
    numbers: Mapping[str, JsonValue],
    estimators: Mapping[str, JsonValue] | None = None,
) -> None:
    """metrics.json: what every task has, then its own numbers. Raises OutputError."""
    about: dict[str, JsonValue] = {
        "name": result.config.name,
        "task": result.config.task,
        "status": result.status,
        "remarks": list(result.remarks),
    }
    document = {**about, **numbers, "estimators": dict(estimators or {})}
    write_json(result.folder / METRICS_FILE, document)


def write_page(result: HomingResult, subtitle: str, **parts: Any) -> None:
    """report.html, unless the configuration does without; ``parts`` as of Page."""
    if not result.config.output.report:
        return
    page = Page(
        title=result.config.name,
        subtitle=subtitle,
        headline=result.verdict,
        tables=result.tables,
        notes=result.remarks,
        config_yaml=(result.folder / "config.yaml").read_text(encoding="utf-8"),
        versions=versions(),
        **parts,
    )
    write_html(result.folder / REPORT_FILE, page)
