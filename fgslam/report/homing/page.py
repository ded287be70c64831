"""The page of a homing run: verdict, tables, figures with their switches, pictures."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from pathlib import Path

from fgslam.core.atomic_files import write_text
from fgslam.report.homing.data import HomingPage, TextTable
from fgslam.report.page import frame
from fgslam.report.page.pictures import embed


def write_homing_report(path: Path, page: HomingPage) -> None:
    """Writes the page atomically; the same values give the same bytes. Raises OutputError."""
    write_text(path, render(page))


def render(page: HomingPage) -> str:
    """The page as text."""
    body = [
        *frame.header(page.title, page.subtitle, page.verdict, page.notes),
        *(line for table in page.tables for line in _table(table, page.series)),
        *_toolbar(page.series),
        *(frame.figure_section(figure, "nothing was recorded") for figure in page.figures),
        *(frame.gallery(*embed(page.pictures)) if page.pictures else ()),
        *frame.provenance(page.config_yaml, page.versions),
    ]
    return frame.document(page.title, body, page.figures)


def _table(table: TextTable, series: tuple[str, ...]) -> Iterator[str]:
    key = f"table-{table.key}"
    yield f'<section aria-labelledby="{key}"><h2 id="{key}">{escape(table.heading)}</h2>'
    yield f'<div class="scroll" role="region" aria-labelledby="{key}" tabindex="0"><table>'
    headings = "".join(
        f'<th scope="col"><abbr title="{escape(column.meaning)}">{escape(column.name)}</abbr></th>'
        for column in table.columns
    )
    yield f'<thead><tr><th scope="col">{escape(table.first)}</th>{headings}</tr></thead><tbody>'
    for name, values in table.rows:
        swatch = frame.swatch(series.index(name)) if name in series else ""
        cells = "".join(f"<td>{escape(value)}</td>" for value in values)
        yield f'<tr><th scope="row">{swatch}{escape(name)}</th>{cells}</tr>'
    yield f'</tbody></table></div>\n<p class="note">- : {frame.NOT_KNOWN}</p>'
    yield "<details><summary>What the columns mean</summary><dl>"
    yield from (
        f"<dt>{escape(column.name)}</dt><dd>{escape(column.meaning)}</dd>"
        for column in table.columns
    )
    yield "</dl></details></section>"


def _toolbar(series: tuple[str, ...]) -> Iterator[str]:
    boxes = "".join(
        f'<label><input type="checkbox" data-estimator="{i}" checked>{frame.swatch(i)}'
        f"{escape(name)}</label>"
        for i, name in enumerate(series)
    )
    if boxes:
        yield f'<div class="toolbar"><fieldset><legend>Show</legend>{boxes}</fieldset></div>'
