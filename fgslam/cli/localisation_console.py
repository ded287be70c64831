"""What a person sees in the terminal of a localisation: poses, why, and where everything is."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from fgslam.cli.homing_console import text_table
from fgslam.runs.tasks.localisation_files import LOCALISATION_FILE, METRICS_FILE, REPORT_FILE
from fgslam.runs.tasks.localisation_results import LocalisationResult, details, told

_NAME_WIDTH = 18
_WIDTH_OF_FILES = 130


def show_localisation(result: LocalisationResult, *, one_by_one: bool = False) -> None:
    """The result; ``one_by_one`` with a line for each query, and a single one in full."""
    console = Console()
    if not console.is_terminal:
        console = Console(width=_WIDTH_OF_FILES)  # a file or a pipe has no width to keep to
    _show_queries(console, result, one_by_one)
    for line in result.notes:
        console.out(f"note        {line}")
    if result.folder is not None:
        _show_files(console, result.folder)
    if result.status == "interrupted":
        console.out("interrupted: what was done is in valid files; --overwrite starts again")


def _show_queries(console: Console, result: LocalisationResult, one_by_one: bool) -> None:
    attempts = result.asked.attempts
    if one_by_one and len(attempts) == 1:
        for name, value in details(attempts[0]):
            console.out(f"{name:<{_NAME_WIDTH}}{value}")
        return
    for attempt in attempts if one_by_one else ():
        console.out(told(attempt))
    for line in result.verdict:
        console.out(line)
    for table in result.tables:
        console.print(text_table(table))


def _show_files(console: Console, folder: Path) -> None:
    console.out(f"queries     {folder / LOCALISATION_FILE}")
    console.out(f"metrics     {folder / METRICS_FILE}")
    if (folder / REPORT_FILE).is_file():
        console.out(f"report      {folder / REPORT_FILE}  (open it in a browser)")
