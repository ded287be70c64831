"""Markdown of the generated pages: paragraphs and list items of at most 118 characters."""

from __future__ import annotations

import re
import textwrap

WIDTH = 118


def paragraph(text: str) -> list[str]:
    """Lines of a paragraph; code in backticks stays on one line."""
    return _wrapped(text, "", "")


def item(text: str) -> list[str]:
    """Lines of a list item."""
    return _wrapped(text, "- ", "  ")


def _wrapped(text: str, first: str, rest: str) -> list[str]:
    words = " ".join(text.split())
    whole = re.sub(r"(`+).+?\1", lambda code: code.group().replace(" ", "\0"), words)
    lines = textwrap.wrap(
        whole,
        WIDTH,
        initial_indent=first,
        subsequent_indent=rest,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace("\0", " ") for line in lines]
