"""What a person sees in the terminal: progress, and what any run, comparison or trial reports."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console, Group
from rich.live import Live
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


class Bars:
    """A bar for each stage of the work, with the time left."""

    def __init__(self, console: Console, begin: Callable[[], None] | None = None) -> None:
        """``begin`` draws them first: not before there is one, as a mistake shall stand alone."""
        columns = (
            TextColumn("{task.description:>10}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
        )
        self.drawn = Progress(*columns, console=console)
        self.tasks: dict[str, TaskID] = {}
        self._begin = begin or self.drawn.start

    def tell(self, what: str, done: int, total: int) -> None:
        """Shows how much of a stage is done; the first call of it draws its bar."""
        if not self.tasks:
            self._begin()
        if what not in self.tasks:
            self.tasks[what] = self.drawn.add_task(what, total=total)
        self.drawn.update(self.tasks[what], completed=done, total=total)


@contextmanager
def progress_bar() -> Iterator[Tell]:
    """A bar on standard error for each stage of the work."""
    bars = Bars(Console(stderr=True))
    try:
        yield bars.tell
    finally:
        if bars.tasks:
            bars.drawn.stop()


@contextmanager
def progress_with_table() -> Iterator[tuple[Tell, Callable[[TextTable], None]]]:
    """Bars on standard error, and below them a table that changes while there is more to come."""
    console = Console(stderr=True)
    live = Live(console=console)
    bars = Bars(console, live.start)
    live.update(bars.drawn)
    try:
        yield bars.tell, lambda table: live.update(Group(bars.drawn, rich_table(table)))
    finally:
        if bars.tasks:
            live.update(bars.drawn)
            live.stop()


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
