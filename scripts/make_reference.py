"""Writes the pages that are made from code: settings, command line, and tutorials from examples.

Run `python -m scripts.make_reference` from the root of the checkout; a test fails while a page is
stale.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from scripts.reference_commands import commands_page
from scripts.reference_settings import settings_page
from scripts.tutorials import EXAMPLES, tutorial_page

DOCS = Path(__file__).parents[1] / "docs"


def pages() -> dict[str, Callable[[], str]]:
    """What makes each page, by the page's path below docs."""
    made: dict[str, Callable[[], str]] = {
        "reference/settings.md": settings_page,
        "reference/commands.md": commands_page,
    }
    for example in sorted(EXAMPLES.glob("*.py")):
        made[f"tutorials/{example.stem}.md"] = partial(tutorial_page, example.stem)
    return made


def main() -> None:
    """Writes every page."""
    for path, page in pages().items():
        (DOCS / path).write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
