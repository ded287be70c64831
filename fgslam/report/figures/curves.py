"""Curves and clouds of homing pages: errors over a homing, errors against what was claimed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.report.figures.traces import Figure, Owner, Switch, Trace, peaks, trace

MAX_POINTS = 2_500


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A curve: its name, the number of its series (colour), and its points.

    Attributes:
        name: shown at the pointer.
        series: number of the series that it belongs to.
        x, y: (n,).
        dash: `solid`, `dash` or `dot`.
        switch: of the figure, that shows it; empty: always.
    """

    name: str
    series: int
    x: FloatArray
    y: FloatArray
    dash: str = "solid"
    switch: str = ""


def curve_figure(
    words: tuple[str, str, str],
    lines: Sequence[Line],
    axes: tuple[str, str],
    switches: tuple[Switch, ...] = (),
    y: Mapping[str, Any] | None = None,
) -> Figure:
    """Lines over a common axis.

    Args:
        words: key, heading and description of the figure.
        lines: what is drawn; those without a finite value are left out.
        axes: titles with units.
        switches: checkboxes above it.
        y: more of Plotly's y axis.
    """
    traces = [_drawn(line) for line in lines if np.isfinite(line.y).any()]
    layout = {
        "xaxis": {"title": {"text": axes[0]}},
        "yaxis": {"title": {"text": axes[1]}, **(y or {})},
        "hovermode": "x unified",
    }
    key, heading, description = words
    return Figure(key, heading, description, tuple(traces), layout, switches)


def sorted_errors(errors: Mapping[str, FloatArray], unit: str, words: tuple[str, str]) -> Figure:
    """Cumulative distribution of error sizes, one line a series, in the order of ``errors``."""
    lines = []
    for i, (name, values) in enumerate(errors.items()):
        ordered = np.sort(np.abs(values[np.isfinite(values)]))
        share = 100.0 * (np.arange(len(ordered)) + 1.0) / max(len(values), 1)
        lines.append(Line(name, i, ordered, share))
    key, heading = words
    description = (
        "Share of the answers whose error is at most so large; a line that ends below 100 % gave "
        "no answer for the rest."
    )
    return curve_figure(
        (key, heading, description), lines, (f"error ({unit})", "share of answers (%)")
    )


def claimed_against_true(
    claimed: Mapping[str, FloatArray], true: Mapping[str, FloatArray], key: str = "claimed"
) -> Figure:
    """Errors in degrees against the stated standard deviations, one cloud a series."""
    traces: list[Trace] = []
    for i, name in enumerate(claimed):
        traces.append(
            trace(
                Owner(name, i),
                {"x": claimed[name], "y": np.abs(true[name])},
                mode="markers",
                marker={"size": 6, "opacity": 0.75},
                hovertemplate="stated %{x:.2f}°, true %{y:.2f}°<extra></extra>",
            )
        )
    top = max((float(np.max(values)) for values in claimed.values() if len(values)), default=1.0)
    for k in (1.0, 2.0, 3.0):
        ends = {"x": np.array([0.0, top]), "y": np.array([0.0, k * top])}
        owner = Owner(f"{k:.0f} sigma", paint="grey")
        line = {"width": 1, "dash": "dot"}
        traces.append(trace(owner, ends, mode="lines", line=line, hoverinfo="skip"))
    layout = {
        "xaxis": {"title": {"text": "stated standard deviation (degrees)"}, "rangemode": "tozero"},
        "yaxis": {"title": {"text": "true error (degrees)"}, "rangemode": "tozero"},
        "hovermode": "closest",
    }
    return Figure(
        key,
        "Stated and true errors",
        "Each answer: the standard deviation that it states, and how far off it is. Dotted: one, "
        "two and three standard deviations; one in twenty answers may lie above the second.",
        tuple(traces) if any(map(len, claimed.values())) else (),
        layout,
    )


def _drawn(line: Line) -> Trace:
    rows = peaks(line.y, MAX_POINTS)
    owner = Owner(line.name, line.series, (line.switch,) if line.switch else ())
    return trace(
        owner,
        {"x": line.x[rows], "y": line.y[rows]},
        mode="lines",
        line={"width": 1.8, "dash": line.dash},
        hovertemplate="%{y:.4g}",
    )
