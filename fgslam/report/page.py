"""The page of any task: one HTML file that needs nothing else, neither beside it nor the network.

A jinja2 template with automatic escaping; the page's own policy lets only the two scripts run whose
digests it names, so that not even a mistake here would run what a configuration or a file name
says. Plotly and the numbers of the figures are compressed: the browser unpacks them.
"""

from __future__ import annotations

import base64
import gzip
import hashlib
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fgslam.core.files import write_text
from fgslam.report.content import Page, Picture
from fgslam.report.figures import palette

if TYPE_CHECKING:
    import jinja2
    from PIL import Image

NOT_KNOWN = "not known"

MAX_WIDTH = 1100
BUDGET_BYTES = 440_000
"""Of all pictures together, so that a page with its plots stays below three megabytes."""
_TOO_MUCH = "Left out to keep this page small, see the run folder"
_KEPT_AS_IT_IS = 40_000
_QUALITY = 55


def write_html(path: Path, page: Page) -> None:
    """Writes the page atomically; the same values give the same bytes.

    Args:
        path: the .html file.
        page: all that it shows.

    Raises:
        OutputError: the file cannot be written.
    """
    write_text(path, render(page))


def render(page: Page) -> str:
    """The page as text."""
    shown, left_out = embed(page.pictures)
    script = _asset("page.js")
    return _template().render(
        page=page,
        pictures=shown,
        left_out=left_out,
        not_known=NOT_KNOWN,
        style=palette.style_sheet() + _asset("page.css"),
        colours=palette.COUNT,
        script=script,
        script_digest=_digest(script),
        plotly=_packed_plotly()[0],
        plotly_digest=_packed_plotly()[1],
        figures=_packed(_numbers(page)),
    )


def _template() -> jinja2.Template:
    import jinja2

    environment = jinja2.Environment(
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        undefined=jinja2.StrictUndefined,
    )
    environment.filters["json"] = json.dumps  # into attributes: escaped like any text
    return environment.from_string(_asset("page.html"))


def _numbers(page: Page) -> str:
    """Traces and layouts of the figures that show something, by key, as JSON."""
    values: dict[str, Any] = {
        figure.key: {"traces": figure.traces, "layout": figure.layout}
        for figure in page.figures
        if figure.has_numbers
    }
    return json.dumps(values, allow_nan=False, sort_keys=True)


@lru_cache(maxsize=1)
def _packed_plotly() -> tuple[str, str]:
    """Plotly's script as :func:`_packed`, and the digest under which the page lets it run."""
    from plotly.offline import get_plotlyjs  # most of the file, needed by nothing else

    # As the browser's parser hands a script on, so that its digest is the same there.
    script = str(get_plotlyjs()).replace("\r\n", "\n").replace("\r", "\n")
    return _packed(script), _digest(script)


def _packed(text: str) -> str:
    """Text as gzip in base64, without a date, so that equal texts give equal bytes."""
    content = gzip.compress(text.encode("utf-8"), compresslevel=9, mtime=0)
    return base64.b64encode(content).decode("ascii")


def _digest(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")


def _asset(name: str) -> str:
    folder = resources.files(__package__) / "templates"
    return (folder / name).read_text(encoding="utf-8")


@dataclass(frozen=True, slots=True)
class Embedded:
    """A picture as it stands in the page, with its size for a steady layout."""

    caption: str
    uri: str
    width: int
    height: int


def embed(pictures: Sequence[Picture]) -> tuple[list[Embedded], list[str]]:
    """Pictures as data URIs, and a line about each one that could not be shown.

    Later ones are left out when the budget of bytes is used up.
    """
    shown: list[Embedded] = []
    left_out: list[str] = []
    spent = 0
    for picture in pictures:
        found = _embed(picture)
        if found is None:
            left_out.append(f"Picture not readable: {picture.caption}")
        elif spent + len(found.uri) > BUDGET_BYTES * 4 / 3:
            left_out.append(f"{_TOO_MUCH}: {picture.caption}")
        else:
            spent += len(found.uri)
            shown.append(found)
    return shown, left_out


def _embed(picture: Picture) -> Embedded | None:
    from PIL import Image, UnidentifiedImageError  # what draws no page needs none

    try:
        with Image.open(io.BytesIO(picture.content)) as opened:
            opened.load()  # a truncated file is found only now
            width, height = opened.size
            if len(picture.content) <= _KEPT_AS_IT_IS and opened.format in ("PNG", "JPEG", "WEBP"):
                mime, content = f"image/{opened.format.lower()}", picture.content
            else:
                mime, content = "image/webp", _as_webp(opened)
    except (UnidentifiedImageError, OSError, ValueError, Image.DecompressionBombError):
        return None
    text = base64.b64encode(content).decode("ascii")
    return Embedded(picture.caption, f"data:{mime};base64,{text}", width, height)


def _as_webp(image: Image.Image) -> bytes:
    from PIL.Image import Resampling

    small = image.convert("RGB")
    if small.width > MAX_WIDTH:
        height = round(small.height * MAX_WIDTH / small.width)
        small = small.resize((MAX_WIDTH, max(height, 1)), Resampling.LANCZOS)
    out = io.BytesIO()
    small.save(out, format="WEBP", quality=_QUALITY, method=4)
    return out.getvalue()
