"""The shared end of every task: tables, pictures, metrics.json and the page of a run folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fgslam.core.files import make_subfolder
from fgslam.evaluation.statistics import JsonValue
from fgslam.report.content import (
    UNKNOWN,
    Column,
    Figure,
    Page,
    Picture,
    TextTable,
    write_csv,
    write_json,
)
from fgslam.runs.config import Experiment
from fgslam.runs.engine import RunResult
from fgslam.runs.folder import METRICS_FILE, REPORT_FILE, RUN_MARKER, versions

if TYPE_CHECKING:
    import pandas as pd

PICTURES = "pictures"
VIEW = "view"
"""Beginning of the names of small pictures of the drive, before the row of its path."""


def finish(
    config: Experiment,
    folder: Path,
    whole: bool,
    numbers: Mapping[str, JsonValue],
    subtitle: str,
    figures: Sequence[Figure] = (),
    pictures: Sequence[Picture] = (),
    estimators: Mapping[str, JsonValue] | None = None,
    **shown: Any,
) -> RunResult:
    """The result of a task whose results are tables; metrics.json is written, its page if wanted.

    Args:
        config: what was run.
        folder: the run folder.
        whole: whether all of it was done.
        numbers: the task's own, after those that each task has.
        subtitle: of the page.
        figures: of the page.
        pictures: of the page.
        estimators: numbers by title.
        shown: further attributes of :class:`RunResult`: lines, tables, notes, ...

    Raises:
        OutputError: a file cannot be written.
    """
    result = RunResult(config, folder, "finished" if whole else "interrupted", **shown)
    write_document(result, numbers, estimators)
    write_page(result, subtitle, figures, pictures)
    return result


def write_document(
    result: RunResult,
    numbers: Mapping[str, JsonValue],
    estimators: Mapping[str, JsonValue] | None = None,
) -> None:
    """metrics.json: what every task has, then its own numbers. Raises OutputError."""
    about: dict[str, JsonValue] = {
        "name": result.config.name,
        "task": result.config.task_name,
        "status": result.status,
        "remarks": list(result.notes),
    }
    document = {**about, **numbers, "estimators": dict(estimators or {})}
    write_json(result.folder / METRICS_FILE, document)


def write_page(
    result: RunResult,
    subtitle: str,
    figures: Sequence[Figure] = (),
    pictures: Sequence[Picture] = (),
) -> None:
    """report.html, unless the configuration does without. Raises OutputError."""
    if not result.config.wants_report:
        return
    from fgslam.report.page import write_html  # loads Plotly

    page = Page(
        title=result.config.name,
        subtitle=subtitle,
        headline=result.lines,
        tables=result.tables,
        figures=tuple(figures),
        pictures=tuple(pictures),
        notes=result.notes,
        config_yaml=(result.folder / RUN_MARKER).read_text(encoding="utf-8"),
        versions=versions(),
    )
    write_html(result.folder / REPORT_FILE, page)


def write_table(path: Path, table: pd.DataFrame) -> None:
    """Writes a table as CSV. Raises OutputError."""
    write_csv(path, table.columns.tolist(), table.itertuples(index=False, name=None))


def draw_picture(folder: Path, name: str, caption: str, draw: Callable[[Path], None]) -> Picture:
    """A picture of the page, which ``draw`` writes into the run's folder of pictures."""
    path = make_subfolder(folder, PICTURES) / name
    draw(path)
    return Picture(caption, path.read_bytes())


def numbers_table(
    key: str, heading: str, numbers: Mapping[str, JsonValue], names: Mapping[str, str]
) -> TextTable:
    """A table of metrics.json's numbers; ``names`` gives the key of each row's name."""
    rows = tuple((name, (number_text(numbers[of]),)) for name, of in names.items())
    return TextTable(key, heading, "quantity", (Column("value", "of the run"),), rows)


def metrics_table(
    key: str,
    heading: str,
    first: str,
    columns: Sequence[tuple[str, str, str, str]],
    rows: Mapping[str, Mapping[str, Any]],
) -> TextTable:
    """A row of numbers for each name; of a column heading, key of the number, format, meaning."""
    cells = tuple(
        (name, tuple(number_text(numbers.get(of), spec) for _, of, spec, _ in columns))
        for name, numbers in rows.items()
    )
    shown = tuple(Column(heading, meaning) for heading, _, _, meaning in columns)
    return TextTable(key, heading, first, shown, cells)


def number_text(value: JsonValue, spec: str = ".2f") -> str:
    """A number as text, decimal ones by ``spec``; a dash where it is not known."""
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return UNKNOWN
    return format(value, spec).replace("%", " %") if isinstance(value, float) else str(value)


def median(values: Sequence[float] | np.ndarray) -> float | None:
    """The median of values; None without any."""
    return float(np.median(values)) if len(values) else None
