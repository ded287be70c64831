"""Cross-references in docstrings become Markdown."""

from __future__ import annotations

from scripts.griffe_roles import as_markdown


def test_roles_become_code() -> None:
    text = "See :meth:`fgslam.Slam.track` and :class:`~a.b.C`; ``x``."
    assert as_markdown(text) == "See `track` and `C`; `x`."


def test_announced_code_blocks_stay_indented() -> None:
    assert as_markdown("So::\n\n    a = 1\n") == "So:\n\n    a = 1\n"
    assert as_markdown("First.\n\n::\n\n    a = 1\n") == "First.\n\n\n    a = 1\n"
