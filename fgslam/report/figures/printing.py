"""What of a figure is seen without a page: its traces with their colours, switches as they start.

The page's script does the same in the browser, in the colours of the reader's system.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from fgslam.report.figures import palette
from fgslam.report.figures.traces import Figure, Trace, unpacked


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
        return out | {"fillcolor": palette.BAND}
    fixed = {"truth": palette.INK, "grey": palette.GREY}
    number = owner.get("colour", owner["estimator"]) or 0
    colour = fixed.get(owner["paint"], palette.ON_LIGHT[number % palette.COUNT])
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
