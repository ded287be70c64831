"""What a person sees in the terminal: progress, and what any run, comparison or trial reports."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table

from fgslam.runs.folder import METRICS_FILE, REPORT_FILE

if TYPE_CHECKING:
    from fgslam.cli.signals import Tell
    from fgslam.report.content import TextTable
    from fgslam.runs.engine import RunResult

_NOTES_SHOWN = 8
_LABEL_WIDTH = 12
_WIDTH_OF_FILES = 120


class Display:
    """A bar for each stage of the work, with the time left.

    Drawn from the first stage on: before, a mistake shall stand alone.
    """

    def __init__(self, console: Console) -> None:
        """Draws on a console, once there is a stage."""
        columns = (
            TextColumn("{task.description:>10}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        self._bars = Progress(*columns, console=console)
        self._stages: dict[str, TaskID] = {}

    def tell(self, what: str, done: int, total: int) -> None:
        """Shows how much of a stage is done."""
        if not self._stages:
            self._bars.start()
        if what not in self._stages:
            self._stages[what] = self._bars.add_task(what, total=total)
        self._bars.update(self._stages[what], completed=done, total=total)

    def close(self) -> None:
        """Leaves the bars as they stand."""
        if self._stages:
            self._bars.stop()


@contextmanager
def progress_bar() -> Iterator[Tell]:
    """A bar on standard error for each stage of the work."""
    found = Display(Console(stderr=True))
    try:
        yield found.tell
    finally:
        found.close()


def show(result: RunResult, resume: str = "") -> None:
    """Sentences, tables, notes, where everything is; ``resume`` is what goes on with the rest."""
    notes = list(result.notes[:_NOTES_SHOWN])
    if len(result.notes) > _NOTES_SHOWN:
        notes.append(f"and {len(result.notes) - _NOTES_SHOWN} more, see {METRICS_FILE}")
    for alarm in result.alarms:
        _console().out(alarm, style="bold red")
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
