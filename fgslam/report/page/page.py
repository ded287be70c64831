"""The page of a run: one HTML file that needs nothing else, neither beside it nor the network."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from html import escape
from pathlib import Path

from fgslam.core.atomic_files import write_text
from fgslam.report.page import frame
from fgslam.report.page.curves import error_over_time, nees_over_time, time_per_frame
from fgslam.report.page.data import Column, Comparison, EstimatorReport, ReportData
from fgslam.report.page.frame import NOT_KNOWN
from fgslam.report.page.paths import drive_from_above, map_to_turn
from fgslam.report.page.pictures import embed
from fgslam.report.page.traces import Figure
from fgslam.report.page.words import best, headline


def write_report(path: Path, data: ReportData) -> None:
    """Writes a run's page atomically; the same data give the same bytes.

    Args:
        path: the .html file.
        data: all that it shows.

    Raises:
        OutputError: the file cannot be written.
    """
    write_text(path, render(data))


def render(data: ReportData) -> str:
    """The page as text."""
    figures = [
        drive_from_above(data),
        map_to_turn(data),
        error_over_time(data),
        nees_over_time(data),
        time_per_frame(data),
    ]
    body = [
        *frame.header(data.title, data.subtitle, headline(data), data.notes),
        *_comparison(data),
        *_places(data.places),
        _toolbar(data),
        *(_figure(figure, data) for figure in figures),
        *frame.gallery(*embed(data.pictures)),
        *_remarks(data),
        *frame.provenance(data.config_yaml, data.versions),
    ]
    return frame.document(data.title, body, figures)


# --------------------------------------------------------------------------------------------
# Sections of text


def _comparison(data: ReportData) -> Iterator[str]:
    table = data.comparison
    yield '<section aria-labelledby="comparison"><h2 id="comparison">Comparison</h2>'
    if table.rows:
        yield from _table("comparison", "estimator", table, _rows(table, data.estimators))
    else:
        yield f"<p>The numbers of this run are {NOT_KNOWN}.</p>"
    yield "</section>"


def _places(table: Comparison) -> Iterator[str]:
    """Closures, where there are any: what they mended, before and after, or the refusal."""
    if not table.rows:
        return
    yield '<section aria-labelledby="places"><h2 id="places">Places recognised</h2>'
    yield from _table("places", "closed at", table, _rows(table, ()))
    yield "</section>"


def _table(key: str, first: str, table: Comparison, rows: Iterable[str]) -> Iterator[str]:
    """A table that scrolls by itself, and what its columns mean."""
    yield f'<div class="scroll" role="region" aria-labelledby="{key}" tabindex="0"><table>'
    yield f'<thead><tr><th scope="col">{first}</th>{_headings(table.columns)}</tr></thead>'
    yield "<tbody>"
    yield from rows
    yield f'</tbody></table></div>\n<p class="note">- : {NOT_KNOWN}</p>'
    yield "<details><summary>What the columns mean</summary><dl>"
    yield from (
        f"<dt>{escape(column.name)}</dt><dd>{escape(column.meaning)}</dd>"
        for column in table.columns
    )
    yield "</dl></details>"


def _headings(columns: Iterable[Column]) -> str:
    return "".join(
        f'<th scope="col"><abbr title="{escape(column.meaning)}">{escape(column.name)}</abbr></th>'
        for column in columns
    )


def _rows(table: Comparison, estimators: tuple[EstimatorReport, ...]) -> Iterator[str]:
    numbers = {estimator.title: i for i, estimator in enumerate(estimators)}
    for title, values in table.rows:
        row = numbers.get(title)
        swatch = "" if row is None else frame.swatch(row)
        failed = " (failed)" if row is not None and estimators[row].failure else ""
        cells = "".join(f"<td>{escape(value)}</td>" for value in values)
        yield f'<tr><th scope="row">{swatch}{escape(title + failed)}</th>{cells}</tr>'


def _remarks(data: ReportData) -> Iterator[str]:
    lines = [f"{e.title}: {remark}" for e in data.estimators for remark in e.remarks]
    lines += [f"{e.title} failed: {e.failure}" for e in data.estimators if e.failure]
    yield '<section aria-labelledby="remarks"><h2 id="remarks">Remarks of the estimators</h2>'
    yield from frame.bullets(lines) if lines else iter(["<p>None.</p>"])
    yield "</section>"


# --------------------------------------------------------------------------------------------
# Figures and their switches


def _toolbar(data: ReportData) -> str:
    boxes = "".join(
        f'<label><input type="checkbox" data-estimator="{i}" checked>{frame.swatch(i)}'
        f"{escape(estimator.title)}</label>"
        for i, estimator in enumerate(data.estimators)
        if len(estimator)
    )
    truth = '<span><span class="swatch truth"></span>truth</span>' if data.truth else ""
    return (
        f'<div class="toolbar"><fieldset><legend>Estimators</legend>{boxes}{truth}</fieldset></div>'
    )


def _figure(figure: Figure, data: ReportData) -> str:
    missing = "there is no ground truth" if data.truth is None else "nothing was recorded"
    selector = _selector(figure.key, data) if figure.selects and figure.switches else ""
    return frame.figure_section(figure, missing, selector)


def _selector(figure: str, data: ReportData) -> str:
    """Whose landmarks are shown; nothing where there are none at all."""
    chosen = best(data)
    options = "".join(
        f'<option value="{i}"{" selected" if i == chosen else ""}>{escape(e.title)}</option>'
        for i, e in enumerate(data.estimators)
        if len(e.landmarks)
    )
    if not options:
        return "<span>(no landmarks)</span>"
    return f'<label>of <select data-figure="{figure}">{options}</select></label>'
