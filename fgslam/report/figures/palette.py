"""Colours of the estimators, Okabe and Ito's hues, and figures as they are seen without a page.

The colour-blind can tell them apart. On white they are darker, on black lighter than the originals,
so that each keeps a contrast of at least 3 to 1 (WCAG 2.2, 1.4.11). The page's script colours
traces in the browser as :func:`printed` does here, in the colours of the reader's system.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fgslam.report.figures.traces import Figure, Trace, unpacked

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


def printed(figure: Figure, switches: Mapping[str, bool] | None = None) -> list[Trace]:
    """Traces that are seen, in the order in which they are drawn, coloured for white paper.

    Their coordinates are arrays (n,).

    Args:
        figure: of any kind; of its moments the last one is shown.
        switches: states by key that differ from how they start.
    """
    states = {switch.key: switch.on for switch in figure.switches} | dict(switches or {})
    return [_coloured(trace) for trace in figure.traces if _is_seen(figure, trace, states)]


def _is_seen(figure: Figure, trace: Trace, states: Mapping[str, bool]) -> bool:
    owner = trace["meta"]
    if not all(states.get(key, False) for key in owner["when"]):
        return False
    if any(states.get(key, False) for key in owner["unless"]):
        return False
    if owner["chosen"] and owner["estimator"] != figure.chosen:
        return False
    last = len(figure.steps) - 1
    return bool(owner.get("step", last) == last)


def _coloured(trace: Trace) -> Trace:
    owner = trace["meta"]
    out = {name: _plain(value) for name, value in trace.items()}
    if owner["paint"] == "own":
        return out
    if owner["paint"] == "band":
        return out | {"fillcolor": BAND}
    fixed = {"truth": INK, "grey": GREY}
    number = owner.get("colour", owner["estimator"]) or 0
    colour = fixed.get(owner["paint"], ON_LIGHT[number % COUNT])
    for part in ("line", "marker"):
        if part in out:
            out[part] = {**out[part], "color": colour}
    return out


def _plain(value: Any) -> Any:
    """Packed numbers as an array, those inside a marker, too."""
    if not isinstance(value, dict):
        return value
    if "bdata" in value:
        return unpacked(value)
    return {name: _plain(inner) for name, inner in value.items()}
