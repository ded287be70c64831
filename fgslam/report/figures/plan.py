"""Seen from above: the drive past its targets, from where homing succeeds, views with links."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse.csgraph import dijkstra

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.report.figures.traces import (
    Figure,
    Owner,
    Switch,
    Trace,
    equal_axes,
    line,
    plain_texts,
    thinned,
    trace,
    xy,
)

MAX_MOMENTS = 80
MAX_POSES = 4_000
PASS_RADIUS_M = 0.2
_HEADING_M = 0.3
_CORNERS = 25
_HOVER = "<b>%{fullData.name}</b><br>%{x:.2f}, %{y:.2f} m<extra></extra>"


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A driven path in the world's plane, metres and radians.

    Attributes:
        time: (n,) seconds.
        poses: (n, 3) true poses.
        legs: (n,) number of the target that is driven to; the leg's colour follows it.
        headings: (n,) direction of home in the world as estimated; NaN where there is none.
        targets: (m, 3) where the targets' images were taken.
        outlines: polylines (k, 2) of walls and furniture.
    """

    time: FloatArray
    poses: FloatArray
    legs: IntArray
    headings: FloatArray
    targets: FloatArray
    outlines: tuple[FloatArray, ...] = ()


def drive_figure(
    drive: Drive, key: str = "drive", heading: str = "The drive, from above"
) -> Figure:
    """The true trajectory past its targets, and the robot at each moment."""
    rows = thinned(len(drive.time), MAX_MOMENTS)
    moving = [t for step, row in enumerate(rows) for t in _robot(drive, int(row), step)]
    return Figure(
        key,
        heading,
        "The path as it was truly driven, coloured by the leg. Squares: where the target images "
        f"were taken, with a tick ahead and a circle of {PASS_RADIUS_M:g} m. The robot's arrow "
        "points where the estimator says that the target lies. Grey: walls and furniture.",
        (*_outlines(drive), *_targets(drive), *_paths(drive), *moving),
        equal_axes("x (m)", "y (m)"),
        (Switch("outlines", "walls"), Switch("targets", "targets")),
        steps=tuple(f"{drive.time[int(k)] - drive.time[0]:.1f} s" for k in rows),
    )


def catchment_figure(
    offsets: FloatArray, succeeded: BoolArray, labels: Sequence[str], key: str = "catchment"
) -> Figure:
    """From where homing arrives.

    Args:
        offsets: (n, 2) starts relative to the target, metres, target's heading up the page.
        succeeded: (n,) whether it arrived.
        labels: shown at the pointer, one each.
        key: unique in the page.
    """
    traces = []
    for series, name, which, symbol in (
        (0, "arrived", succeeded, "circle"),
        (1, "did not arrive", ~succeeded, "x-thin-open"),
    ):
        if which.any():
            texts = [text for text, shown in zip(labels, which, strict=True) if shown]
            traces.append(
                trace(
                    Owner(name, colour=series),
                    {"x": -offsets[which, 1], "y": offsets[which, 0]},
                    mode="markers",
                    marker={"symbol": symbol, "size": 9},
                    text=plain_texts(texts),
                    hovertemplate="%{text}<br>%{y:.2f} m ahead, %{x:.2f} m right<extra></extra>",
                )
            )
    square = {"symbol": "square-open", "size": 14}
    target = trace(
        Owner("target", paint="grey"),
        {"x": np.zeros(1), "y": np.zeros(1)},
        mode="markers",
        marker=square,
    )
    return Figure(
        key,
        "From where homing succeeds",
        "Starts relative to their target (square), whose heading is up the page. Dots: homing "
        "arrived; crosses: it did not.",
        (target, *traces) if traces else (),
        equal_axes("right of the target (m)", "ahead of the target (m)"),
    )


def _paths(drive: Drive) -> Iterator[Trace]:
    rows = thinned(len(drive.time), MAX_POSES)
    for leg in np.unique(drive.legs[rows]).tolist():
        inside = np.flatnonzero(drive.legs[rows] == leg)
        # The first pose of the next leg belongs to both, else the path has gaps.
        last = min(inside[-1] + 1, len(rows) - 1)
        own = drive.poses[rows[inside[0] : last + 1], :2]
        owner = Owner(f"leg {leg + 1}", colour=leg)
        yield trace(owner, xy(own), mode="lines", line={"width": 2}, hovertemplate=_HOVER)


def _robot(drive: Drive, row: int, step: int) -> Iterator[Trace]:
    pose, leg = drive.poses[row], int(drive.legs[row])
    owner = Owner("robot", colour=leg, step=step)
    ahead = np.array([pose[:2], pose[:2] + _HEADING_M * _unit(pose[2])])
    yield line(owner, ahead, 4)
    marker = {"symbol": "circle", "size": 12}
    yield trace(owner, xy(pose[None, :2]), mode="markers", marker=marker, hovertemplate=_HOVER)
    if np.isfinite(drive.headings[row]):
        arrow = np.array([pose[:2], pose[:2] + 2.0 * _HEADING_M * _unit(drive.headings[row])])
        home = Owner("direction of home", colour=leg, step=step)
        yield line(home, arrow, 2, "dot")


def _targets(drive: Drive) -> Iterator[Trace]:
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    circle = PASS_RADIUS_M * np.column_stack([np.cos(angle), np.sin(angle)])
    circles = drive.targets[:, None, :2] + circle
    ticks = np.stack(
        [drive.targets[:, :2], drive.targets[:, :2] + _HEADING_M * _unit(drive.targets[:, 2])],
        axis=1,
    )
    owner = Owner("targets", paint="truth", when=("targets",))
    for lines in (circles, ticks):
        yield line(owner, lines, 1)
    yield trace(
        owner,
        xy(drive.targets[:, :2]),
        mode="markers+text",
        marker={"symbol": "square-open", "size": 10},
        text=[str(i + 1) for i in range(len(drive.targets))],
        textposition="top right",
        hovertemplate=_HOVER,
    )


def _outlines(drive: Drive) -> Iterator[Trace]:
    if drive.outlines:
        lines = np.vstack([np.vstack([one, np.full((1, 2), np.nan)]) for one in drive.outlines])
        owner = Owner("walls", paint="grey", when=("outlines",))
        yield line(owner, lines, 1)


def _unit(angle: FloatArray) -> FloatArray:
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


_HOVER_TEXT = "%{text}<extra></extra>"


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
        xy(places),
        mode="markers+text",
        marker={"symbol": "square", "size": 9},
        text=plain_texts(names),
        textposition="top center",
        hovertemplate=_HOVER_TEXT,
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
    middle = ends.mean(axis=1)
    marks = trace(
        owner,
        xy(middle),
        mode="markers",
        marker={"size": 4},
        text=plain_texts(kind.texts),
        hovertemplate=_HOVER_TEXT,
    )
    return [line(owner, ends, 1.4), marks]
