"""The check that the site needs no network finds what would be fetched."""

from __future__ import annotations

from pathlib import Path

import pytest

from scripts.check_site import loaded_from_outside, main


def write_site(folder: Path, body: str, css: str = "") -> Path:
    (folder / "index.html").write_text(f"<html><body>{body}</body></html>", encoding="utf-8")
    (folder / "s.css").write_text(css, encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    "body",
    [
        '<script src="https://cdn.example/x.js"></script>',
        '<img src="//cdn.example/x.png">',
        '<link rel="stylesheet" href="http://cdn.example/x.css">',
        '<pre class="mermaid"><code>graph</code></pre>',
    ],
)
def test_resource_from_outside_is_found(tmp_path: Path, body: str) -> None:
    site = write_site(tmp_path, body)
    (line,) = loaded_from_outside(site)
    assert line.startswith(str(tmp_path / "index.html"))
    assert main([str(site)]) == 1


def test_font_from_outside_is_found(tmp_path: Path) -> None:
    site = write_site(tmp_path, "", "@font-face { src: url('https://fonts.example/f.woff2') }")
    assert len(list(loaded_from_outside(site))) == 1


def test_links_and_own_files_are_allowed(tmp_path: Path) -> None:
    body = '<a href="https://example.org">e</a><img src="a.png"><script src="b.js"></script>'
    site = write_site(tmp_path, body + '<link rel="canonical" href="https://example.org/x">')
    assert main([str(site)]) == 0


def test_missing_site_says_what_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(tmp_path)]) == 2
    assert "make docs" in capsys.readouterr().err
