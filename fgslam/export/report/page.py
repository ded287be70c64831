"""The page itself: one HTML file that needs nothing else, neither beside it nor from the network.

Everything from outside is escaped, and the page's own policy lets only the two scripts run whose
digests it names: not even a mistake here would run what a configuration or a file name says.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterable, Iterator
from html import escape
from importlib import resources
from pathlib import Path

from fgslam.export.atomic import write_text
from fgslam.export.report import palette
from fgslam.export.report.curves import error_over_time, nees_over_time, time_per_frame
from fgslam.export.report.data import Column, Comparison, EstimatorReport, ReportData
from fgslam.export.report.paths import drive_from_above, map_to_turn
from fgslam.export.report.pictures import Embedded, embed
from fgslam.export.report.traces import Figure, Switch
from fgslam.export.report.words import best, headline

NOT_KNOWN = "not known"


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
    from plotly.offline import get_plotlyjs  # half of the file, needed by nothing else

    figures = [
        drive_from_above(data),
        map_to_turn(data),
        error_over_time(data),
        nees_over_time(data),
        time_per_frame(data),
    ]
    pictures, left_out = embed(data.pictures)
    scripts = [_inline(get_plotlyjs()), _inline(_asset("page.js"))]
    body = [
        *_head(data),
        *_comparison(data),
        _toolbar(data),
        *(_figure(figure, data) for figure in figures),
        *_gallery(pictures, left_out),
        *_remarks(data),
        *_provenance(data),
    ]
    return "\n".join([*_opening(data, scripts), *body, *_closing(data, figures, scripts)]) + "\n"


# --------------------------------------------------------------------------------------------
# The frame around it


def _opening(data: ReportData, scripts: list[str]) -> Iterator[str]:
    digests = " ".join(f"'sha256-{_digest(script)}'" for script in scripts)
    policy = (
        f"default-src 'none'; script-src {digests}; style-src 'unsafe-inline'; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
    yield '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">'
    yield f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
    yield '<meta name="viewport" content="width=device-width, initial-scale=1">'
    yield '<link rel="icon" href="data:,">'
    style = palette.style_sheet() + _asset("page.css")
    yield f"<title>{escape(data.title)}</title>\n<style>\n{style}</style>"
    yield "</head>\n<body>"


def _closing(data: ReportData, figures: list[Figure], scripts: list[str]) -> Iterator[str]:
    values = {
        "colours": palette.COUNT,
        "figures": {
            figure.key: {"traces": figure.traces, "layout": figure.layout}
            for figure in figures
            if _has_numbers(figure)
        },
    }
    # What ends a script element or opens a comment cannot occur: no "<" does.
    text = json.dumps(values, allow_nan=False, sort_keys=True).replace("<", "\\u003c")
    yield '<dialog id="closer" aria-label="Picture, enlarged"><img alt=""><p></p>'
    yield "<button>Close</button></dialog>"
    yield f'<script type="application/json" id="report-data">{text}</script>'
    yield from (f"<script>{script}</script>" for script in scripts)
    yield "</body>\n</html>"


def _asset(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def _inline(script: str) -> str:
    """A script as the browser's parser hands it on, so that its digest is the same there."""
    return script.replace("\r\n", "\n").replace("\r", "\n")


def _digest(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")


# --------------------------------------------------------------------------------------------
# Sections of text


def _head(data: ReportData) -> Iterator[str]:
    yield f'<header><h1>{escape(data.title)}</h1><p class="subtitle">{escape(data.subtitle)}</p>'
    yield "</header>\n<noscript><p>The plots need JavaScript; all else is here.</p></noscript>"
    yield '<section class="verdict" aria-label="In short">'
    yield from (f"<p>{escape(line)}</p>" for line in headline(data))
    yield "</section>"
    yield from _list(data.notes)


def _comparison(data: ReportData) -> Iterator[str]:
    table = data.comparison
    yield '<section aria-labelledby="comparison"><h2 id="comparison">Comparison</h2>'
    if table.rows:
        yield '<div class="scroll" role="region" aria-labelledby="comparison" tabindex="0"><table>'
        yield f'<thead><tr><th scope="col">estimator</th>{_headings(table.columns)}</tr></thead>'
        yield "<tbody>"
        yield from _rows(table, data.estimators)
        yield f'</tbody></table></div>\n<p class="note">- : {NOT_KNOWN}</p>'
        yield "<details><summary>What the columns mean</summary><dl>"
        yield from (
            f"<dt>{escape(column.name)}</dt><dd>{escape(column.meaning)}</dd>"
            for column in table.columns
        )
        yield "</dl></details>"
    else:
        yield f"<p>The numbers of this run are {NOT_KNOWN}.</p>"
    yield "</section>"


def _headings(columns: Iterable[Column]) -> str:
    return "".join(
        f'<th scope="col"><abbr title="{escape(column.meaning)}">{escape(column.name)}</abbr></th>'
        for column in columns
    )


def _rows(table: Comparison, estimators: tuple[EstimatorReport, ...]) -> Iterator[str]:
    numbers = {estimator.title: i for i, estimator in enumerate(estimators)}
    for title, values in table.rows:
        row = numbers.get(title)
        swatch = "" if row is None else _swatch(row)
        failed = " (failed)" if row is not None and estimators[row].failure else ""
        cells = "".join(f"<td>{escape(value)}</td>" for value in values)
        yield f'<tr><th scope="row">{swatch}{escape(title + failed)}</th>{cells}</tr>'


def _gallery(pictures: list[Embedded], left_out: list[str]) -> Iterator[str]:
    yield '<section aria-labelledby="pictures"><h2 id="pictures">Pictures</h2>'
    if not pictures:
        yield "<p>This run has no pictures.</p>"
    yield '<div class="gallery">'
    for picture in pictures:
        caption = escape(picture.caption)
        yield (
            '<figure><button class="enlarge" title="enlarge">'
            f'<img src="{picture.uri}" alt="{caption}" width="{picture.width}" '
            f'height="{picture.height}" decoding="async"></button>'
            f"<figcaption>{caption}</figcaption></figure>"
        )
    yield "</div>"
    yield from _list(left_out)
    yield "</section>"


def _remarks(data: ReportData) -> Iterator[str]:
    lines = [f"{e.title}: {remark}" for e in data.estimators for remark in e.remarks]
    lines += [f"{e.title} failed: {e.failure}" for e in data.estimators if e.failure]
    yield '<section aria-labelledby="remarks"><h2 id="remarks">Remarks of the estimators</h2>'
    yield from _list(lines) if lines else iter(["<p>None.</p>"])
    yield "</section>"


def _provenance(data: ReportData) -> Iterator[str]:
    yield '<section aria-labelledby="provenance"><h2 id="provenance">Where it comes from</h2>'
    config = escape(data.config_yaml) or NOT_KNOWN
    yield f"<details><summary>Configuration</summary><pre>{config}</pre></details>"
    yield "<details><summary>Versions</summary><dl>"
    for name, version in data.versions.items():
        yield f"<dt>{escape(name)}</dt><dd>{escape(version or 'not installed')}</dd>"
    yield f"</dl>{'' if data.versions else NOT_KNOWN}</details></section>"


def _list(lines: Iterable[str]) -> Iterator[str]:
    found = [f"<li>{escape(line)}</li>" for line in lines]
    if found:
        yield f"<ul>{''.join(found)}</ul>"


# --------------------------------------------------------------------------------------------
# Figures and their switches


def _toolbar(data: ReportData) -> str:
    boxes = "".join(
        f'<label><input type="checkbox" data-estimator="{i}" checked>{_swatch(i)}'
        f"{escape(estimator.title)}</label>"
        for i, estimator in enumerate(data.estimators)
        if len(estimator)
    )
    truth = '<span><span class="swatch truth"></span>truth</span>' if data.truth else ""
    return (
        f'<div class="toolbar"><fieldset><legend>Estimators</legend>{boxes}{truth}</fieldset></div>'
    )


def _figure(figure: Figure, data: ReportData) -> str:
    key, heading = figure.key, escape(figure.heading)
    start = f'<section aria-labelledby="head-{key}"><h2 id="head-{key}">{heading}</h2>'
    if not _has_numbers(figure):
        why = "there is no ground truth" if data.truth is None else "nothing was recorded"
        return f"{start}<p>This is {NOT_KNOWN}: {why}.</p></section>"
    note = f'<p class="note">{escape(figure.note)}</p>' if figure.note else ""
    return (
        f'{start}{_controls(figure, data)}<figure><div class="plot" id="plot-{key}" role="img" '
        f'aria-label="{heading}"></div>'
        f'<figcaption class="caption">{escape(figure.description)}</figcaption></figure>'
        f"{note}</section>"
    )


def _controls(figure: Figure, data: ReportData) -> str:
    if not figure.switches:
        return ""
    controls = "".join(_switch(figure.key, switch) for switch in figure.switches)
    if figure.selects:
        controls += _selector(figure.key, data)
    return f"<fieldset><legend>Show</legend>{controls}</fieldset>"


def _switch(figure: str, switch: Switch) -> str:
    checked = " checked" if switch.on else ""
    return (
        f'<label><input type="checkbox" data-figure="{figure}" data-switch="{switch.key}"{checked}>'
        f"{escape(switch.label)}</label>"
    )


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


def _swatch(i: int) -> str:
    colour = f"background: var(--e{i % palette.COUNT})"
    return f'<span class="swatch" style="{colour}" aria-hidden="true"></span>'


def _has_numbers(figure: Figure) -> bool:
    """Whether anything but bands is drawn in it."""
    return any(trace["meta"]["paint"] != "band" for trace in figure.traces)
