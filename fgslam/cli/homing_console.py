"""What a person sees in the terminal of a homing run: sentences, tables, where everything is."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from fgslam.report.content import TextTable
from fgslam.runs.homing_results import METRICS_FILE, REPORT_FILE, HomingResult

_REMARKS_SHOWN = 8
_WIDTH_OF_FILES = 130


def show_homing(result: HomingResult) -> None:
    """The result of one task."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=_WIDTH_OF_FILES)  # a file or a pipe has no width to keep to
    for line in result.verdict:
        console.out(line)
    for table in result.tables:
        console.print(text_table(table))
    for line in result.remarks[:_REMARKS_SHOWN]:
        console.out(f"note        {line}")
    if len(result.remarks) > _REMARKS_SHOWN:
        console.out(
            f"note        and {len(result.remarks) - _REMARKS_SHOWN} more, see metrics.json"
        )
    console.out(f"results     {result.folder}")
    console.out(f"metrics     {result.folder / METRICS_FILE}")
    if (result.folder / REPORT_FILE).is_file():
        console.out(f"report      {result.folder / REPORT_FILE}  (open it in a browser)")
    if result.status == "interrupted":
        console.out("interrupted: what was done is in valid files; --overwrite starts again")


def text_table(found: TextTable) -> Table:
    """A table for the terminal."""
    table = Table(title=found.heading, title_justify="left")
    table.add_column(found.first, no_wrap=True)
    for column in found.columns:
        table.add_column(column.name, justify="right")
    for name, values in found.rows:
        table.add_row(name, *values)
    return table
