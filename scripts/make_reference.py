"""Writes the reference pages that are made from code: settings and command line.

Run `python -m scripts.make_reference` from the root of the checkout; a test fails while a page is
stale.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from scripts.reference_commands import commands_page
from scripts.reference_settings import settings_page

REFERENCE = Path(__file__).parents[1] / "docs" / "reference"
PAGES: dict[str, Callable[[], str]] = {"settings": settings_page, "commands": commands_page}


def main() -> None:
    """Writes every page."""
    for name, page in PAGES.items():
        (REFERENCE / f"{name}.md").write_text(page(), encoding="utf-8")


if __name__ == "__main__":
    main()
