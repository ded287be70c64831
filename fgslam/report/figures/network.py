"""Views as nodes and what was found between them as lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import dijkstra

from fgslam.core.arrays import FloatArray
from fgslam.report.figures.traces import (
    Figure,
    Owner,
    Switch,
    Trace,
    equal_axes,
    joined,
    plain_texts,
    trace,
)

_HOVER = "%{text}<extra></extra>"


@dataclass(frozen=True, slots=True)
class Links:
    """Lines of one kind.

    Attributes:
        name: of the kind.
        colour: number of its colour.
        pairs: numbers of the nodes.
        texts: shown at the pointer, one each.
        shown: at first; there is a switch for each kind.
    """

    name: str
    colour: int
    pairs: tuple[tuple[int, int], ...]
    texts: tuple[str, ...]
    shown: bool = True


def network_figure(
    words: tuple[str, str, str],
    places: FloatArray,
    names: Sequence[str],
    links: Sequence[Links],
    axes: tuple[str, str] = ("x (m)", "y (m)"),
) -> Figure:
    """Nodes at their places, with lines between them.

    Args:
        words: key, heading and description.
        places: (n, 2) of the nodes.
        names: of the nodes.
        links: kinds of lines; kinds without any are left out.
        axes: titles; two empty ones where places have no meaning beyond the links.
    """
    kinds = [kind for kind in links if kind.pairs]
    traces = [one for k, kind in enumerate(kinds) for one in _lines(kind, places, f"kind{k}")]
    nodes = trace(
        Owner("views", paint="truth"),
        {"x": places[:, 0], "y": places[:, 1]},
        mode="markers+text",
        marker={"symbol": "square", "size": 9},
        text=plain_texts(names),
        textposition="top center",
        hovertemplate=_HOVER,
    )
    key, heading, description = words
    layout = equal_axes(*axes)
    if not any(axes):
        for axis in ("xaxis", "yaxis"):
            layout[axis]["showticklabels"] = False
    switches = tuple(
        Switch(f"kind{k}", f"{kind.name} ({len(kind.pairs)})", kind.shown)
        for k, kind in enumerate(kinds)
    )
    return Figure(f"drive-{key}", heading, description, (*traces, nodes), layout, switches)


def unfolded(count: int, pairs: Sequence[tuple[int, int]]) -> FloatArray:
    """(count, 2) places such that distances are as those along the links (classical scaling).

    Parts of the graph without a link between them are set beside each other.
    """
    weights = np.zeros((count, count))
    for a, b in pairs:
        weights[a, b] = weights[b, a] = 1.0
    distance = dijkstra(weights, directed=False, unweighted=True)
    finite = np.isfinite(distance)
    distance[~finite] = distance[finite].max(initial=1.0) + 2.0
    centred = np.eye(count) - 1.0 / count
    values, vectors = np.linalg.eigh(-0.5 * centred @ distance**2 @ centred)
    top = vectors[:, ::-1][:, :2] * np.sqrt(np.maximum(values[::-1][:2], 0.0))
    # An eigenvector's sign is arbitrary: the largest entry is made positive.
    rows = np.argmax(np.abs(top), axis=0)
    signs = np.where(top[rows, np.arange(top.shape[1])] < 0.0, -1.0, 1.0)
    out = np.zeros((count, 2))
    out[:, : top.shape[1]] = top * signs
    return out


def _lines(kind: Links, places: FloatArray, key: str) -> list[Trace]:
    """The lines, and a mark in the middle of each with its text."""
    ends = places[np.array(kind.pairs, dtype=np.int64).reshape(-1, 2)]
    owner = Owner(kind.name, when=(key,), colour=kind.colour)
    x, y = joined(ends).T
    middle = ends.mean(axis=1)
    line = trace(owner, {"x": x, "y": y}, mode="lines", line={"width": 1.4}, hoverinfo="skip")
    marks = trace(
        owner,
        {"x": middle[:, 0], "y": middle[:, 1]},
        mode="markers",
        marker={"size": 4},
        text=plain_texts(kind.texts),
        hovertemplate=_HOVER,
    )
    return [line, marks]
