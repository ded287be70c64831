"""Figures of curves, of answers against what was claimed, of homing and of sweeps, by Plotly."""

from __future__ import annotations

import html
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from plotly import graph_objects as go
from scipy.sparse.csgraph import dijkstra

from fgslam.core.arrays import BoolArray, FloatArray, IntArray, thinned
from fgslam.core.bearings import HomingEstimate, HomingTruth
from fgslam.core.geometry import unit
from fgslam.evaluation.localisation import Answers
from fgslam.report.content import (
    GREY,
    INK,
    SIGMAS,
    Figure,
    bulk_limits,
    exaggeration,
    in_plane,
    level_axes,
    outlines,
    peaks,
    world_position_covariances,
)
from fgslam.report.figures import (
    BUTTONS,
    HOVER_PLACE,
    MAX_POINTS,
    colour,
    curve,
    dots,
    drawing,
    line,
    plane,
)

_HOVER_TEXT = "%{text}<extra></extra>"

# --------------------------------------------------------------------------------------------
# Any curves; answers against what was claimed; sweeps


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A curve: its name, the number of its series (colour), and its points.

    Attributes:
        name: shown at the pointer.
        series: number of the series that it belongs to.
        x, y: (n,).
        dash: `solid`, `dash` or `dot`.
    """

    name: str
    series: int
    x: FloatArray
    y: FloatArray
    dash: str = "solid"


def curve_figure(
    words: tuple[str, str, str],
    lines: Sequence[Line],
    axes: tuple[str, str],
    y: Mapping[str, Any] | None = None,
) -> Figure:
    """Lines over a common axis.

    Args:
        words: key, heading and description of the figure.
        lines: what is drawn; those without a finite value are left out.
        axes: titles with units.
        y: more of Plotly's y axis.
    """
    traces = []
    for one in lines:
        if np.isfinite(one.y).any():
            rows = peaks(one.y, MAX_POINTS)
            style: dict[str, Any] = {"width": 1.8, "dash": one.dash}
            known = np.pad(np.isfinite(one.y[rows]), 1)
            alone = known[1:-1] & ~(known[:-2] | known[2:])
            if alone.any():  # no line is drawn to such a point
                style |= {"mode": "lines+markers", "marker": {"size": np.where(alone, 5, 0)}}
            traces.append(curve(one.name, one.x[rows], one.y[rows], colour(one.series), **style))
    return Figure(*words, drawing(traces, *axes, yaxis=dict(y or {})))


def sorted_errors(errors: Mapping[str, FloatArray], unit: str, words: tuple[str, str]) -> Figure:
    """Cumulative distribution of error sizes, one line a series, in the order of ``errors``."""
    lines = []
    for i, (name, values) in enumerate(errors.items()):
        ordered = np.sort(np.abs(values[np.isfinite(values)]))
        share = 100.0 * (np.arange(len(ordered)) + 1.0) / max(len(values), 1)
        lines.append(Line(name, i, ordered, share))
    description = (
        "Share of the answers whose error is at most so large; a line that ends below 100 % gave "
        "no answer for the rest."
    )
    return curve_figure((*words, description), lines, (f"error ({unit})", "share of answers (%)"))


def claimed_against_true(
    claimed: Mapping[str, FloatArray], true: Mapping[str, FloatArray]
) -> Figure:
    """Errors in degrees against the stated standard deviations, one cloud a series."""
    if not any(map(len, claimed.values())):
        claimed = {}
    style: dict[str, Any] = {
        "opacity": 0.75,
        "hovertemplate": "stated %{x:.2f}°, true %{y:.2f}°<extra></extra>",
    }
    traces: list[Any] = [
        dots(name, np.column_stack([sigma, np.abs(true[name])]), colour(i), 6.0, **style)
        for i, (name, sigma) in enumerate(claimed.items())
    ]
    top = max((float(np.max(sigma)) for sigma in claimed.values() if len(sigma)), default=1.0)
    for k in (1.0, 2.0, 3.0) if claimed else ():
        ray = np.array([[0.0, 0.0], [top, k * top]])
        traces.append(line(f"{k:.0f} sigma", ray, GREY, 1.0, "dot"))
    from_zero = {"rangemode": "tozero"}
    return Figure(
        "claimed",
        "Stated and true errors",
        "Each answer: the standard deviation that it states, and how far off it is. Dotted: one, "
        "two and three standard deviations; one in twenty answers may lie above the second.",
        drawing(traces, "stated standard deviation (degrees)", "true error (degrees)",
                xaxis=from_zero, yaxis=from_zero, hovermode="closest"),
    )  # fmt: skip


def effect_figure(
    curves: Mapping[str, FloatArray], axis: str, metric: str, *, several: bool
) -> Figure:
    """Means of a metric over the values of a setting, with their intervals.

    Args:
        curves: by name of the series, in its order: (n, 4) value, mean, lower and upper end of the
            interval (NaN where there is none).
        axis: title of the setting.
        metric: title of the metric.
        several: other settings were varied as well, and the means are over these.
    """
    traces = []
    for i, (name, rows) in enumerate(curves.items()):
        value, mean, lower, upper = rows.T
        up, down = np.nan_to_num(upper - mean), np.nan_to_num(mean - lower)
        error = {"symmetric": False, "array": up, "arrayminus": down, "thickness": 1}
        style = {"mode": "lines+markers", "marker": {"size": 6}, "error_y": error, "width": 1.8}
        traces.append(curve(name, value, mean, colour(i), **style))
    over = " and all other settings" if several else ""
    return Figure(
        f"effect_{metric}_{axis}".replace(".", "_"),
        f"{metric} over {axis}",
        f"Mean of {metric} over the repetitions{over}, with its 95 % interval.",
        drawing(traces if any(map(len, curves.values())) else (), axis, metric),
    )


# --------------------------------------------------------------------------------------------
# Poses found in a saved map without a prior

_MAX_LANDMARKS = 6_000
_HEADING = 0.025  # length of a heading, as a share of the picture


def located_figure(
    words: tuple[str, str],
    landmarks: FloatArray,
    path: FloatArray,
    answers: Answers,
    false: BoolArray,
) -> Figure:
    """The map from above with the poses found in it, and the true poses of refused queries.

    All in the map's world, metres.

    Args:
        words: key and heading of the figure.
        landmarks: (m, 3) positions.
        path: (k, 4, 4) poses of the drive that made the map.
        answers: n of them.
        false: (n,) accepted and somewhere else.
    """
    level = level_axes(np.array([0.0, -1.0, 0.0]))[:2]
    known = np.asarray(np.isfinite(answers.truth).all(axis=(1, 2)))
    shown = [answers.poses[answers.accepted], answers.truth[known], path]
    ranges = bulk_limits(np.concatenate(shown)[:, :3, 3] @ level.T, landmarks @ level.T)
    span = max(high - low for low, high in ranges)
    right = answers.accepted & ~false
    found = answers.poses[right]
    world = world_position_covariances(found, answers.covariances[right])
    covariances = in_plane(world, level)
    factor = exaggeration(covariances, span)
    rows = thinned(len(landmarks), _MAX_LANDMARKS)
    around = outlines(found[:, :3, 3] @ level.T, covariances, factor)
    traces: list[Any] = [
        dots("landmarks", landmarks[rows] @ level.T, GREY, 3.0),
        line("drive of the map", path[:, :3, 3] @ level.T, GREY, 1.5),
        line("uncertainty", around, colour(0), 1.0),
    ]
    for number, name, poses, symbol in (
        (0, "found", found, "circle"),
        (1, "found, but false", answers.poses[false], "circle"),
        (4, "refused", answers.truth[~answers.accepted & known], "x-thin-open"),
    ):
        if len(poses):
            at, ahead = poses[:, :3, 3] @ level.T, poses[:, :3, 2] @ level.T
            traces.append(dots(name, at, colour(number), 7.0, symbol, legendgroup=name))
            ticks = np.stack([at, at + _HEADING * span * ahead], axis=1)
            traces.append(line(name, ticks, colour(number), 1.5, group=name))
    if (wrong := false & known).any():
        ends = np.stack([answers.poses[wrong, :3, 3], answers.truth[wrong, :3, 3]], axis=1)
        traces.append(line("to the true pose", ends @ level.T, colour(1), 1.0))
    return Figure(
        *words,
        "Dots with their headings: poses that were accepted, with ellipses of "
        f"{SIGMAS:.0f} standard deviations. Crosses: true poses of queries that were refused. "
        "Lines lead from false poses to the true ones. Grey: landmarks, and the drive that made "
        "the map.",
        plane(traces, ranges),
        note=f"Ellipses are drawn {factor} times larger." if factor > 1 else "",
    )


# --------------------------------------------------------------------------------------------
# Homing: the local map, the drive past its targets, from where homing succeeds, views with links

MAX_MOMENTS = 60
_DRIVE_MOMENTS = 80
_MAX_POSES = 4_000
PASS_RADIUS_M = 0.2
_TICK = 0.12  # that points ahead, legs
_TICK_M = 0.3
_HOMING_BULK = (2.0, 98.0)


def _upwards(points: FloatArray) -> FloatArray:
    """Points (..., 2), x ahead and y left, on a page where ahead is up."""
    return np.stack([-points[..., 1], points[..., 0]], axis=-1)


def _with_moments(
    figure: go.Figure, moments: Sequence[Sequence[Any]], names: Sequence[str]
) -> go.Figure:
    """A figure with further traces, those of one moment at a time: a slider, and a button.

    Args:
        figure: what is there all the time.
        moments: the same traces of each.
        names: of the moments.
    """
    rows = list(range(len(figure.data), len(figure.data) + len(moments[0]) if moments else 0))
    figure.add_traces(list(moments[0]) if moments else [])
    figure.frames = [
        go.Frame(data=list(traces), name=str(k), traces=rows) for k, traces in enumerate(moments)
    ]
    frame = {"mode": "immediate", "frame": {"duration": 0}, "transition": {"duration": 0}}
    steps = [
        {"label": name, "method": "animate", "args": [[str(k)], frame]}
        for k, name in enumerate(names)
    ]
    slider = {"steps": steps, "currentvalue": {"prefix": "moment "}, "pad": {"t": 40}}
    run = {"fromcurrent": True, "frame": {"duration": 120}, "transition": {"duration": 0}}
    buttons = [
        {"label": "Play", "method": "animate", "args": [None, run]},
        {"label": "Stop", "method": "animate", "args": [[None], frame]},
    ]
    menu = BUTTONS | {"showactive": False, "buttons": buttons}
    return figure.update_layout(sliders=[slider], updatemenus=[menu])


def local_map_figure(
    estimates: Sequence[HomingEstimate],
    truth: HomingTruth | None = None,
    key: str = "local-map",
    heading: str = "The local map, moment by moment",
) -> Figure:
    """Start, robot, target and features as one estimator knew them at each image.

    Args:
        estimates: one or more, in order of time.
        truth: of the same homing, row k of ``robots`` at estimate k; None where it is not known.
        key: unique in the page.
        heading: its title.
    """
    rows = thinned(len(estimates), MAX_MOMENTS)
    always: list[Any] = [dots("start", np.zeros((1, 2)), GREY, 13.0, "square-open")]
    if truth is not None:
        path = np.vstack([np.zeros((1, 2)), truth.robots[:, :2] / truth.leg_m])
        always.append(line("true path", _upwards(path), INK, 1.4, "dash"))
    # Axes that do not jump from moment to moment; far features may lie outside.
    points = [np.array([[0.0, 0.0], [1.0, 0.0]]), *(e.landmarks for e in estimates)]
    points += [np.array([e.robot[:2], e.target[:2]]) for e in estimates]
    every = _upwards(np.vstack(points))
    low, high = np.percentile(every[np.isfinite(every).all(axis=1)], _HOMING_BULK, axis=0)
    margin = 0.1 * (high - low) + 0.2
    ranges = np.column_stack([low - margin, high + margin]).tolist()
    figure = plane(always, ranges, "right (legs)", "ahead (legs)")
    start = estimates[0].time if len(estimates) else 0.0
    return Figure(
        key,
        heading,
        "Squares: start, present pose (with a tick ahead) and target. Numbered diamonds: features "
        "that are followed; stars: features that were lost, where they were last. Ellipses reach "
        f"{SIGMAS:.0f} standard deviations as the estimator claims them. Lengths are in legs: 1 is "
        "the way from start to target. Dashed: the truth.",
        _with_moments(
            figure,
            [list(_moment(estimates, int(row), truth)) for row in rows],
            [f"{estimates[int(k)].time - start:.1f} s" for k in rows],
        ),
    )


def _moment(
    estimates: Sequence[HomingEstimate], row: int, truth: HomingTruth | None
) -> Iterator[Any]:
    now = estimates[row]
    names = {"text": [*map(str, now.ids.tolist())], "textfont": {"size": 9}}
    place = {"mode": "markers+text", "textposition": "top right"}
    yield dots("features", _upwards(now.landmarks), GREY, 8.0, "diamond-open", **place, **names)
    yield dots("lost features", _upwards(_lost(estimates, row)), GREY, 7.0, "star")
    known = np.isfinite(now.landmark_covariances).all(axis=(1, 2))
    around = outlines(now.landmarks[known], now.landmark_covariances[known])
    yield line("features, 3 sigma", _upwards(around), GREY, 1.0, shown=False)
    path = np.array([e.robot[:2] for e in estimates[: row + 1]])
    yield line("estimated path", _upwards(path), colour(0), 1.6)
    for name, pose, block, number in (
        ("robot", now.robot, now.covariance[:2, :2], 0),
        ("target", now.target, now.covariance[3:5, 3:5], 1),
    ):
        ahead = np.array([pose[:2], pose[:2] + _TICK * unit(pose[2])])
        yield line(name, _upwards(ahead), colour(number), 2.0, group=name)
        yield dots(name, _upwards(pose[None, :2]), colour(number), 13.0, "square", legendgroup=name)
        outline = outlines(pose[None, :2], block[None])
        yield line(f"{name}, {SIGMAS:.0f} sigma", _upwards(outline), colour(number), 1.0)
    if truth is not None:
        robot = truth.robots[min(row, len(truth.robots) - 1)]
        places = np.array([robot[:2], truth.target[:2]]) / truth.leg_m
        yield dots("truth", _upwards(places), INK, 9.0, "x-thin-open")


def _lost(estimates: Sequence[HomingEstimate], row: int) -> FloatArray:
    """(m, 2) last positions of the features that are no longer followed."""
    last: dict[int, FloatArray] = {}
    for estimate in estimates[:row]:
        last |= dict(zip(estimate.ids.tolist(), estimate.landmarks, strict=True))
    present = set(estimates[row].ids.tolist())
    return np.array([last[i] for i in sorted(last.keys() - present)]).reshape(-1, 2)


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


def drive_figure(drive: Drive, heading: str = "The drive, from above") -> Figure:
    """The true trajectory past its targets, and the robot at each moment."""
    traces = []
    if drive.outlines:
        gap = np.full((1, 2), np.nan)
        walls = np.vstack([part for one in drive.outlines for part in (one, gap)])
        traces.append(line("walls", walls, GREY, 1.0))
    places = drive.targets[:, :2]
    circle = PASS_RADIUS_M * unit(np.linspace(0.0, 2.0 * np.pi, 25))
    ticks = np.stack([places, places + _TICK_M * unit(drive.targets[:, 2])], axis=1)
    numbers: dict[str, Any] = {"text": [str(i + 1) for i in range(len(places))]}
    numbers |= {"mode": "markers+text", "textposition": "top right", "legendgroup": "targets"}
    traces += [
        line("targets", places[:, None] + circle, INK, 1.0, group="targets"),
        line("targets", ticks, INK, 1.0, group="targets"),
        dots("targets", places, INK, 10.0, "square-open", **numbers),
    ]
    rows = thinned(len(drive.time), _MAX_POSES)
    for leg in np.unique(drive.legs[rows]).tolist():
        inside = np.flatnonzero(drive.legs[rows] == leg)
        # The first pose of the next leg belongs to both, else the path has gaps.
        last = min(inside[-1] + 1, len(rows) - 1)
        own, hover = drive.poses[rows[inside[0] : last + 1], :2], HOVER_PLACE
        traces.append(line(f"leg {leg + 1}", own, colour(leg), hoverinfo=None, hovertemplate=hover))
    moments = []
    for row in (shown := thinned(len(drive.time), _DRIVE_MOMENTS)).tolist():
        place, leg = drive.poses[row, :2], colour(int(drive.legs[row]))
        ahead = np.array([place, place + _TICK_M * unit(drive.poses[row, 2])])
        home = np.array([place, place + 2.0 * _TICK_M * unit(drive.headings[row])])
        moments.append(
            [
                line("robot", ahead, leg, 4.0, group="robot"),
                dots("robot", place[None], leg, 12.0, legendgroup="robot"),
                line("direction of home", home, leg, 2.0, "dot"),
            ]
        )
    return Figure(
        "drive",
        heading,
        "The path as it was truly driven, coloured by the leg. Squares: where the target images "
        f"were taken, with a tick ahead and a circle of {PASS_RADIUS_M:g} m. The robot's arrow "
        "points where the estimator places the target. Grey: walls and furniture.",
        _with_moments(
            plane(traces, x="x (m)", y="y (m)"),
            moments,
            [f"{seconds - drive.time[0]:.1f} s" for seconds in drive.time[shown]],
        ),
    )


def catchment_figure(offsets: FloatArray, succeeded: BoolArray, labels: Sequence[str]) -> Figure:
    """From where homing arrives.

    Args:
        offsets: (n, 2) starts relative to the target, metres, target's heading up the page.
        succeeded: (n,) whether it arrived.
        labels: shown at the pointer, one each.
    """
    hover = "%{text}<br>%{y:.2f} m ahead, %{x:.2f} m right<extra></extra>"
    traces: list[Any] = [dots("target", np.zeros((1, 2)), GREY, 14.0, "square-open")]
    for number, name, which, symbol in (
        (0, "arrived", succeeded, "circle"),
        (1, "did not arrive", ~succeeded, "x-thin-open"),
    ):
        if which.any():
            texts = [html.escape(text) for text, kept in zip(labels, which, strict=True) if kept]
            style = {"text": texts, "hovertemplate": hover}
            at = _upwards(offsets[which])
            traces.append(dots(name, at, colour(number), 9.0, symbol, **style))
    if not len(offsets):
        traces = []
    return Figure(
        "catchment",
        "From where homing succeeds",
        "Starts relative to their target (square), whose heading is up the page. Dots: homing "
        "arrived; crosses: it did not.",
        plane(traces, x="right of the target (m)", y="ahead of the target (m)"),
    )


@dataclass(frozen=True, slots=True)
class Links:
    """Lines of one kind.

    Attributes:
        name: of the kind.
        colour: number of its colour.
        pairs: numbers of the nodes.
        texts: shown at the pointer, one each.
        shown: at first.
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
    traces: list[Any] = []
    for kind in links:
        if kind.pairs:
            ends = places[np.array(kind.pairs, np.int64).reshape(-1, 2)]
            name, tint = f"{kind.name} ({len(kind.pairs)})", colour(kind.colour)
            of: dict[str, Any] = {"legendgroup": kind.name, "shown": kind.shown}
            traces.append(line(name, ends, tint, 1.4, **of))
            of |= {"text": [*map(html.escape, kind.texts)], "hovertemplate": _HOVER_TEXT}
            traces.append(dots(name, ends.mean(axis=1), tint, 4.0, showlegend=False, **of))
    texts = {"text": [*map(html.escape, names)], "textposition": "top center"}
    style = {"mode": "markers+text", "hovertemplate": _HOVER_TEXT}
    nodes = dots("views", places, INK, 9.0, "square", **texts, **style)
    out = plane((*traces, nodes), x=axes[0], y=axes[1])
    if not any(axes):
        out.update_xaxes(showticklabels=False).update_yaxes(showticklabels=False)
    return Figure(f"drive-{words[0]}", *words[1:], out)


def unfolded(count: int, pairs: Sequence[tuple[int, int]]) -> FloatArray:
    """(count, 2) places such that distances are as those along the links (classical scaling).

    Parts of the graph without a link between them are placed next to each other.
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
