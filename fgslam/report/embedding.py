"""Pictures made small enough for one page: full pixels where they are few, WebP where not."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

from PIL import Image, UnidentifiedImageError

from fgslam.report.content import Picture

MAX_WIDTH = 1400
BUDGET_BYTES = 2_800_000
_KEPT_AS_IT_IS = 120_000
_QUALITY = 80


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
            left_out.append(f"Left out to keep this page small: {picture.caption}")
        else:
            spent += len(found.uri)
            shown.append(found)
    return shown, left_out


def _embed(picture: Picture) -> Embedded | None:
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
    small = image.convert("RGB")
    if small.width > MAX_WIDTH:
        height = round(small.height * MAX_WIDTH / small.width)
        small = small.resize((MAX_WIDTH, max(height, 1)), Image.Resampling.LANCZOS)
    out = io.BytesIO()
    small.save(out, format="WEBP", quality=_QUALITY, method=4)
    return out.getvalue()
