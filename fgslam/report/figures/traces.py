"""Plotly traces as plain values: packed numbers, who they belong to, thinned rows, ellipses.

A trace names its estimator and the switches that show it; the page's script gives it its colour
and shows or hides it. Nothing here depends on Plotly itself.
"""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.geometry import congruence

Trace: TypeAlias = dict[str, Any]

Paint: TypeAlias = Literal["estimator", "truth", "grey", "band", "own"]
"""What colour the page gives a trace: its estimator's, the ink's (dashed), grey, or none."""


@dataclass(frozen=True, slots=True)
class Owner:
    """Who a trace belongs to, and when it is seen.

    Attributes:
        name: shown at the pointer.
        estimator: its number in the report; None of what belongs to no estimator.
        when: switches of the figure that must all be on.
        unless: switches that must all be off.
        chosen: seen while the figure's selector names the estimator, whether its lines are or not.
        paint: its colour.
        colour: number of its colour where that is not its estimator's.
        step: which of the figure's moments it belongs to; None of what is there all the time.
    """

    name: str
    estimator: int | None = None
    when: tuple[str, ...] = ()
    unless: tuple[str, ...] = ()
    chosen: bool = False
    paint: Paint = "estimator"
    colour: int | None = None
    step: int | None = None

    def as_values(self) -> dict[str, Any]:
        """As the page's script reads it."""
        values: dict[str, Any] = {
            "estimator": self.estimator,
            "when": list(self.when),
            "unless": list(self.unless),
            "chosen": self.chosen,
            "paint": self.paint,
        }
        optional = {"colour": self.colour, "step": self.step}
        return values | {name: value for name, value in optional.items() if value is not None}


@dataclass(frozen=True, slots=True)
class Switch:
    """A checkbox of a figure: its key in ``Owner.when``, its words, and how it starts."""

    key: str
    label: str
    on: bool = True


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of the page.

    Attributes:
        key: unique in the page.
        heading: its title.
        description: what it shows, for those who see it and those who do not.
        traces: what is drawn.
        layout: Plotly's, without colours.
        switches: checkboxes above it.
        choices: numbers of the series of which one at a time is chosen for part of it (none where
            no series has that part); None where all are shown together.
        chosen: which of them at first.
        note: what is not drawn, in words.
        steps: names of its moments, shown one at a time by a slider; none where it has no time.
        missing: why it has no numbers, should it have none.
    """

    key: str
    heading: str
    description: str
    traces: tuple[Trace, ...]
    layout: Mapping[str, Any]
    switches: tuple[Switch, ...] = ()
    choices: tuple[int, ...] | None = None
    chosen: int = 0
    note: str = ""
    steps: tuple[str, ...] = ()
    missing: str = "nothing was recorded"

    @property
    def has_numbers(self) -> bool:
        """Whether anything but bands is drawn in it."""
        return any(trace["meta"]["paint"] != "band" for trace in self.traces)

    @property
    def turns(self) -> bool:
        """Whether it is drawn in space, and turned by the reader."""
        return "scene" in self.layout

    @property
    def tall(self) -> bool:
        """Whether it needs height: a plane of equal axes, panels over each other, or space."""
        layout = self.layout
        return self.turns or "scaleanchor" in layout.get("yaxis", {}) or "yaxis3" in layout


def equal_axes(
    x: str = "right (m)",
    y: str = "ahead (m)",
    ranges: tuple[Sequence[float], Sequence[float]] | None = None,
) -> dict[str, Any]:
    """Layout of a plane seen from above: titles of its axes, and their limits where given."""
    layout: dict[str, Any] = {
        "xaxis": {"title": {"text": x}, "constrain": "domain"},
        "yaxis": {"title": {"text": y}, "scaleanchor": "x"},
        "hovermode": "closest",
    }
    for axis, limits in zip(("xaxis", "yaxis"), ranges or (), strict=False):
        layout[axis]["range"] = list(limits)
    return layout


def trace(owner: Owner, axes: Mapping[str, FloatArray], **more: Any) -> Trace:
    """A trace; ``axes`` are its coordinates (`x`, `y`, `z`) and values shown at the pointer."""
    return {
        "type": "scatter3d" if "z" in axes else "scatter",
        # Plotly reads a little HTML in names; a title is never meant as such.
        "name": html.escape(owner.name),
        "meta": owner.as_values(),
        **{axis: packed(values) for axis, values in axes.items()},
        **more,
    }


def xy(points: FloatArray) -> dict[str, FloatArray]:
    """Coordinates of points (n, 2) as axes of a trace."""
    return {"x": points[:, 0], "y": points[:, 1]}


def line(owner: Owner, points: FloatArray, width: float, dash: str = "solid") -> Trace:
    """A polyline (n, 2), or several (k, m, 2) with gaps between them, silent at the pointer."""
    style: dict[str, Any] = {"width": width}
    if dash != "solid":
        style["dash"] = dash
    axes = xy(points if points.ndim == 2 else joined(points))
    return trace(owner, axes, mode="lines", line=style, hoverinfo="skip")


def plain_texts(texts: Iterable[str]) -> list[str]:
    """Texts as Plotly shall show them: it reads a little HTML, which they are not."""
    return [html.escape(text) for text in texts]


def packed(values: FloatArray) -> dict[str, str]:
    """Numbers as Plotly's base64 arrays of single precision: 5 bytes each, 0.01 mm in 100 m."""
    content = np.ascontiguousarray(values, dtype="<f4").tobytes()
    return {"dtype": "f4", "bdata": base64.b64encode(content).decode("ascii")}


def unpacked(values: Mapping[str, str]) -> FloatArray:
    """The numbers (n,) of :func:`packed`."""
    return np.frombuffer(base64.b64decode(values["bdata"]), "<f4").astype(np.float64)


def thinned(count: int, limit: int) -> IntArray:
    """At most ``limit`` of ``count`` rows, evenly spread, with the first and the last."""
    if count <= limit:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, limit).round().astype(np.int64))


def peaks(values: FloatArray, limit: int) -> IntArray:
    """Rows of values (n,) so thinned that the largest of each stretch stays; NaN only if alone."""
    if len(values) <= limit:
        return np.arange(len(values))
    known = np.where(np.isnan(values), -np.inf, values)
    parts = np.array_split(known, limit)
    starts = np.cumsum([0, *(len(part) for part in parts[:-1])])
    return np.asarray(starts + np.array([int(np.argmax(part)) for part in parts]), np.int64)


def joined(polylines: FloatArray) -> FloatArray:
    """Polylines (k, m, d) as one (k (m + 1), d) with a gap (NaN) after each."""
    k, _, d = polylines.shape
    return np.concatenate([polylines, np.full((k, 1, d), np.nan)], axis=1).reshape(-1, d)


SIGMAS = 3.0
"""How many standard deviations an ellipse reaches."""

_CORNERS = 33
_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def world_position_covariances(poses: FloatArray, covariances: FloatArray) -> FloatArray:
    """Position covariances (k, 3, 3) in the world of poses with tangent covariances (k, 6, 6)."""
    return congruence(poses[:, :3, :3], covariances[:, 3:, 3:])


def in_plane(covariances: FloatArray, plane: FloatArray) -> FloatArray:
    """Covariances (k, 2, 2) in the plane whose axes are the rows of ``plane`` (2, 3)."""
    return congruence(np.broadcast_to(plane, (len(covariances), 2, 3)), covariances)


def outlines(centres: FloatArray, covariances: FloatArray, scale: float = 1.0) -> FloatArray:
    """Closed polylines (k, corners, 2) of SIGMAS standard deviations about centres (k, 2).

    Args:
        centres: (k, 2).
        covariances: (k, 2, 2); where one is not finite, its polyline is NaN.
        scale: enlarges all of them.
    """
    known = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    variances, directions = np.linalg.eigh(np.where(known[:, None, None], covariances, 0.0))
    radii = SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    around = np.einsum("kij,kj,mj->kmi", directions, radii, circle)
    around[~known] = np.nan
    return np.asarray(centres[:, None] + scale * around)


def exaggeration(covariances: FloatArray, span: float) -> int:
    """Factor that makes the larger half of the ellipses at least 2 % of ``span`` wide."""
    if not len(covariances):
        return 1
    width = 2.0 * SIGMAS * np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[:, -1], 0.0))
    typical = float(np.percentile(width, 75.0))
    for factor in _FACTORS:
        if factor * typical >= 0.02 * span:
            return factor
    return 1 if typical == 0.0 else _FACTORS[-1]
