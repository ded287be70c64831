"""What a person sees in the terminal: progress, and what any run, comparison or trial says."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from fgslam.runs.folder import METRICS_FILE, REPORT_FILE

if TYPE_CHECKING:
    from fgslam.report.content import TextTable
    from fgslam.runs.engine import RunResult
    from fgslam.runs.units import Progress as Tell

_NOTES_SHOWN = 8
_LABEL_WIDTH = 12
_WIDTH_OF_FILES = 120


@contextmanager
def progress_bar() -> Iterator[Tell]:
    """A bar on standard error for each stage of the work."""
    columns = (
        TextColumn("{task.description:>10}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    bars = Progress(*columns, console=Console(stderr=True))
    tasks: dict[str, int] = {}

    def tell(what: str, done: int, total: int) -> None:
        if not tasks:
            bars.start()  # not before: a mistake found at once shall be all there is to read
        if what not in tasks:
            tasks[what] = int(bars.add_task(what, total=total))
        bars.update(tasks[what], completed=done, total=total)  # type: ignore[arg-type]

    try:
        yield tell
    finally:
        if tasks:
            bars.stop()


def show(result: RunResult, resume: str = "") -> None:
    """Sentences, tables, notes, where everything is; ``resume`` is what goes on with the rest."""
    notes = list(result.notes[:_NOTES_SHOWN])
    if len(result.notes) > _NOTES_SHOWN:
        notes.append(f"and {len(result.notes) - _NOTES_SHOWN} more, see {METRICS_FILE}")
    labelled = [*(("note", note) for note in notes), *result.particulars, *_files(result)]
    show_parts(result.lines, result.tables, labelled)
    if result.status == "interrupted":
        rest = f"go on: {resume}" if resume else "what was done is in valid files"
        reached = f" {result.reached}" if result.reached else ""
        _console().out(f"interrupted{reached}; {rest}")


def show_parts(
    lines: Sequence[str],
    tables: Sequence[TextTable] = (),
    labelled: Sequence[tuple[str, str]] = (),
) -> None:
    """Lines, then tables, then lines with a label."""
    console = _console()
    # Lines are printed plain, so that paths can be copied whatever the terminal's width.
    for line in lines:
        console.out(line)
    for table in tables:
        console.print(rich_table(table))
    for label, text in labelled:
        console.out(f"{label:<{_LABEL_WIDTH}}{text}")


def _files(result: RunResult) -> Iterator[tuple[str, str]]:
    if not result.written:
        return
    if (result.folder / METRICS_FILE).is_file():
        yield "metrics", str(result.folder / METRICS_FILE)
    if (result.folder / REPORT_FILE).is_file():
        yield "report", f"{result.folder / REPORT_FILE}  (open it in a browser)"


def _console() -> Console:
    console = Console()
    # A file or a pipe has no width to keep to.
    return console if console.is_terminal else Console(width=_WIDTH_OF_FILES)


def rich_table(found: TextTable) -> Table:
    """A table for the terminal."""
    headed = bool(found.first) or any(column.name for column in found.columns)
    table = Table(title=found.heading, title_justify="left", show_header=headed)
    table.add_column(found.first, no_wrap=True)
    for column in found.columns:
        table.add_column(column.name, justify="right" if headed else "left")
    for name, values in found.rows:
        table.add_row(name, *values)
    return table
