"""Colours of the estimators, the same in every figure: Okabe and Ito's hues.

The colour-blind can tell them apart. On white they are darker, on black lighter than the originals,
so that each keeps a contrast of at least 3 to 1 (WCAG 2.2, 1.4.11).
"""

from __future__ import annotations

ON_LIGHT = (
    "#0072b2",
    "#c64f00",
    "#00805e",
    "#a8457f",
    "#8f6b00",
    "#5b4bb5",
    "#7a3e12",
    "#1f86bf",
    "#5f6b00",
    "#6a7480",
)
ON_DARK = (
    "#4aa8e8",
    "#f5803e",
    "#22c79a",
    "#e28cc0",
    "#e6b52e",
    "#a99cf2",
    "#d0966a",
    "#9bd6f7",
    "#b9c84a",
    "#b4bcc6",
)
INK = "#1b1f24"
"""Of the truth and of text on light pages; the page's ``--ink``."""

GREY = "#a3abb4"
"""Of walls and landmarks on light pages; the page's ``--dots``."""

BAND = "rgba(90, 100, 110, 0.18)"
"""Of bands on light pages; the page's ``--band``."""

GRID = "#e4e7ea"

COUNT = len(ON_LIGHT)
"""How many estimators have a colour of their own; more share them."""


def style_sheet() -> str:
    """The colours as CSS variables ``--e0``, ``--e1``, ... of light and dark pages."""
    dark = "@media (prefers-color-scheme: dark)"
    return f":root {{ {_variables(ON_LIGHT)} }}\n{dark} {{ :root {{ {_variables(ON_DARK)} }} }}\n"


def _variables(colours: tuple[str, ...]) -> str:
    return " ".join(f"--e{i}: {colour};" for i, colour in enumerate(colours))
