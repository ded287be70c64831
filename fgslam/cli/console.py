"""What a person sees in the terminal: progress, and what any run, comparison or trial reports."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from textwrap import wrap
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

from fgslam.runs.folder import LOG_FILE, METRICS_FILE, REPORT_FILE, next_commands

if TYPE_CHECKING:
    from fgslam.cli.signals import Tell
    from fgslam.report.content import TextTable
    from fgslam.runs.engine import RunResult

_NOTES_SHOWN = 8
_LABEL_WIDTH = 12
_WIDTH_OF_FILES = 120
_BORDER = 3  # of a column: a line and a space at each side


@contextmanager
def progress_bar(console: Console | None = None) -> Iterator[Tell]:
    """A bar for each stage of the work, with the time left; on standard error, if not elsewhere.

    Drawn from the first stage on: before, a mistake shall stand alone.
    """
    bars = Progress(
        TextColumn("{task.description:>10}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=console or Console(stderr=True),
    )
    stages: dict[str, TaskID] = {}

    def tell(what: str, done: int, total: int) -> None:
        if not stages:
            bars.start()
        if what not in stages:
            stages[what] = bars.add_task(what, total=total)
        bars.update(stages[what], completed=done, total=total)

    try:
        yield tell
    finally:
        if stages:
            bars.stop()


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
        for fitting in fitting_tables(table, console.width):
            console.print(fitting)
    for label, text in labelled:
        # Sentences are broken between words; paths stay whole.
        room = console.width if label == "note" and console.is_terminal else 0
        parts = wrap(text, room - _LABEL_WIDTH, break_long_words=False) if room else [text]
        for k, part in enumerate(parts):
            console.out(f"{'' if k else label:<{_LABEL_WIDTH}}{part}")


def _files(result: RunResult) -> Iterator[tuple[str, str]]:
    if (result.folder / METRICS_FILE).is_file():
        yield "metrics", str(result.folder / METRICS_FILE)
    if (result.folder / REPORT_FILE).is_file():
        yield "report", f"{result.folder / REPORT_FILE}  (open it in a browser)"
    if result.status == "finished" and (result.folder / LOG_FILE).is_file():
        images = not getattr(result.config, "on_measurements", False)
        for k, command in enumerate(next_commands(result.folder, images)):
            yield "" if k else "next", command


def _console() -> Console:
    console = Console()
    # A file or a pipe has no width to keep to.
    return console if console.is_terminal else Console(width=_WIDTH_OF_FILES)


def fitting_tables(found: TextTable, width: int) -> Iterator[Table]:
    """A table for a terminal: in parts below each other where words would be cut."""
    columns = [(c.name, *(v[k] for _, v in found.rows)) for k, c in enumerate(found.columns)]
    longest = [max(map(len, " ".join(texts).split()), default=0) for texts in columns]
    names = max(len(found.first), *(len(name) for name, _ in found.rows), 0)
    room = width - names - _BORDER - 1
    part: list[int] = []
    for k in range(len(columns)):
        if part and sum(longest[i] + _BORDER for i in (*part, k)) > room:
            yield _rich_table(found, part, longest)
            part = []
        part.append(k)
    whole = [max(map(len, texts)) + _BORDER for texts in columns]
    yield _rich_table(found, part, None if sum(whole) <= room else longest)


def _rich_table(found: TextTable, part: Sequence[int], widths: Sequence[int] | None) -> Table:
    """Some columns, of their own widths or of those given."""
    headed = bool(found.first) or any(column.name for column in found.columns)
    heading = found.heading if not part or part[0] == 0 else None
    table = Table(title=heading, title_justify="left", show_header=headed)
    table.add_column(found.first, no_wrap=True)
    for k in part:
        least = widths[k] if headed and widths is not None else None
        name, side = found.columns[k].name, "right" if headed else "left"
        table.add_column(name, justify=side, width=least)  # type: ignore[arg-type]
    for name, values in found.rows:
        table.add_row(name, *(values[k] for k in part))
    return table
