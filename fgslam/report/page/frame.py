"""What every report page has: the document around it, figures and their switches, pictures.

Everything from outside is escaped, and the page's own policy lets only the two scripts run whose
digests it names: not even a mistake here would run what a configuration or a file name says.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from importlib import resources

from fgslam.report.page import palette
from fgslam.report.page.pictures import Embedded
from fgslam.report.page.traces import Figure, Switch

NOT_KNOWN = "not known"


def document(title: str, body: Iterable[str], figures: Sequence[Figure]) -> str:
    """A whole page as text: one file that needs nothing beside it nor from the network.

    Args:
        title: of the window.
        body: its sections, in order; those of the figures among them (:func:`figure_section`).
        figures: what the page's script draws.
    """
    from plotly.offline import get_plotlyjs  # half of the file, needed by nothing else

    scripts = [_inline(get_plotlyjs()), _inline(_asset("page.js"))]
    return "\n".join([*_opening(title, scripts), *body, *_closing(figures, scripts)]) + "\n"


def _opening(title: str, scripts: list[str]) -> Iterator[str]:
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
    yield f"<title>{escape(title)}</title>\n<style>\n{style}</style>"
    yield "</head>\n<body>"


def _closing(figures: Sequence[Figure], scripts: list[str]) -> Iterator[str]:
    values = {
        "colours": palette.COUNT,
        "figures": {
            figure.key: {"traces": figure.traces, "layout": figure.layout}
            for figure in figures
            if has_numbers(figure)
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


def header(
    title: str, subtitle: str, verdict: Iterable[str], notes: Iterable[str]
) -> Iterator[str]:
    """Headings, the sentences that say it in short, and what was tolerated."""
    yield f'<header><h1>{escape(title)}</h1><p class="subtitle">{escape(subtitle)}</p>'
    yield "</header>\n<noscript><p>The plots need JavaScript; all else is here.</p></noscript>"
    yield '<section class="verdict" aria-label="In short">'
    yield from (f"<p>{escape(line)}</p>" for line in verdict)
    yield "</section>"
    yield from bullets(notes)


def gallery(pictures: Iterable[Embedded], left_out: Iterable[str]) -> Iterator[str]:
    """The pictures, and a line about each that is not shown."""
    yield '<section aria-labelledby="pictures"><h2 id="pictures">Pictures</h2>'
    pictures = list(pictures)
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
    yield from bullets(left_out)
    yield "</section>"


def provenance(config_yaml: str, versions: Mapping[str, str | None]) -> Iterator[str]:
    """Configuration and versions: what it takes to repeat the run."""
    yield '<section aria-labelledby="provenance"><h2 id="provenance">Where it comes from</h2>'
    config = escape(config_yaml) or NOT_KNOWN
    yield f"<details><summary>Configuration</summary><pre>{config}</pre></details>"
    yield "<details><summary>Versions</summary><dl>"
    for name, version in versions.items():
        yield f"<dt>{escape(name)}</dt><dd>{escape(version or 'not installed')}</dd>"
    yield f"</dl>{'' if versions else NOT_KNOWN}</details></section>"


def bullets(lines: Iterable[str]) -> Iterator[str]:
    """A list; nothing where there are no lines."""
    found = [f"<li>{escape(line)}</li>" for line in lines]
    if found:
        yield f"<ul>{''.join(found)}</ul>"


# --------------------------------------------------------------------------------------------
# Figures and their switches


def figure_section(figure: Figure, missing: str, selector: str = "") -> str:
    """A figure with its heading, controls and words.

    Args:
        figure: what the script will draw there.
        missing: why it has no numbers, should it have none.
        selector: markup of a further control, already escaped.
    """
    key, heading = figure.key, escape(figure.heading)
    start = f'<section aria-labelledby="head-{key}"><h2 id="head-{key}">{heading}</h2>'
    if not has_numbers(figure):
        return f"{start}<p>This is {NOT_KNOWN}: {escape(missing)}.</p></section>"
    note = f'<p class="note">{escape(figure.note)}</p>' if figure.note else ""
    return (
        f'{start}{_controls(figure, selector)}<figure><div class="plot" id="plot-{key}" role="img" '
        f'aria-label="{heading}"></div>'
        f'<figcaption class="caption">{escape(figure.description)}</figcaption></figure>'
        f"{note}</section>"
    )


def swatch(i: int) -> str:
    """The colour of the i-th estimator, as a small square."""
    colour = f"background: var(--e{i % palette.COUNT})"
    return f'<span class="swatch" style="{colour}" aria-hidden="true"></span>'


def has_numbers(figure: Figure) -> bool:
    """Whether anything but bands is drawn in it."""
    return any(trace["meta"]["paint"] != "band" for trace in figure.traces)


def _controls(figure: Figure, selector: str) -> str:
    switches = "".join(_switch(figure.key, switch) for switch in figure.switches) + selector
    fieldset = f"<fieldset><legend>Show</legend>{switches}</fieldset>" if switches else ""
    return fieldset + _slider(figure)


def _switch(figure: str, switch: Switch) -> str:
    checked = " checked" if switch.on else ""
    return (
        f'<label><input type="checkbox" data-figure="{figure}" data-switch="{switch.key}"{checked}>'
        f"{escape(switch.label)}</label>"
    )


def _slider(figure: Figure) -> str:
    """Which moment is shown, and a button that runs through all of them."""
    if not figure.steps:
        return ""
    last = len(figure.steps) - 1
    labels = escape(json.dumps(list(figure.steps)), quote=True)
    return (
        f'<div class="moments"><button type="button" data-play="{figure.key}">Play</button>'
        f'<label>moment <input type="range" min="0" max="{last}" value="0" step="1" '
        f'data-figure="{figure.key}" data-steps="{labels}"></label>'
        f"<output>{escape(figure.steps[0])}</output></div>"
    )
