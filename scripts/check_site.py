"""Checks that the built site needs no network: `python -m scripts.check_site [build/site]`.

Every script, style, font, image and frame of every page has to be a file of the site.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path

SITE = Path("build/site")
_LOADED = {"script": "src", "img": "src", "iframe": "src", "link": "href", "source": "src"}
_NOT_LOADED = frozenset({"canonical", "next", "prev", "alternate"})
_CSS_URL = re.compile(r"url\(\s*['\"]?((?:https?:)?//[^)'\"]+)")
_DIAGRAM = 'class="mermaid"'  # the theme fetches its renderer from the network


class _Resources(HTMLParser):
    """Addresses of everything that a browser loads for a page."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        address = given.get(_LOADED.get(tag, ""))
        if address and not (tag == "link" and given.get("rel") in _NOT_LOADED):
            self.found.append(address)


def loaded_from_outside(site: Path) -> Iterator[str]:
    """A line for each thing that some page of the site would fetch from the network."""
    for page in sorted(site.rglob("*.html")):
        text = page.read_text(encoding="utf-8")
        resources = _Resources()
        resources.feed(text)
        outside = [a for a in resources.found if re.match(r"(https?:)?//", a)]
        yield from (f"{page}: loads {address}" for address in outside)
        if _DIAGRAM in text:
            yield f"{page}: a mermaid diagram, whose renderer is fetched; draw it as text"
    for style in sorted(site.rglob("*.css")):
        addresses = _CSS_URL.findall(style.read_text(encoding="utf-8"))
        yield from (f"{style}: loads {address}" for address in addresses)


def main(arguments: list[str]) -> int:
    """Exit status: 0 if nothing is fetched, 1 if something is, 2 without a built site."""
    site = Path(arguments[0]) if arguments else SITE
    if not (site / "index.html").is_file():
        sys.stderr.write(f"{site}: no site; run `make docs` first\n")
        return 2
    lines = list(loaded_from_outside(site))
    sys.stderr.write("".join(f"{line}\n" for line in lines))
    return 1 if lines else 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
