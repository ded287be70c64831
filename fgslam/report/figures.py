"""Figures of the page, by Plotly: each is a few traces and one template.

A figure's legend is its switchboard: a click hides or shows a line, what is `legendonly` waits for
one. To add a figure: a function of values that
returns a :class:`fgslam.report.content.Figure`.
"""

from __future__ import annotations

import html
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from plotly import graph_objects as go
from plotly.subplots import make_subplots

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.types import Estimate, Trajectory
from fgslam.evaluation.judging import Answer, Comparable, require_named
from fgslam.evaluation.statistics import to_estimate_world
from fgslam.report.content import (
    COLOURS,
    GREY,
    INK,
    ON_LIGHT,
    SIGMAS,
    Figure,
    bulk_limits,
    exaggeration,
    in_plane,
    joined,
    level_axes,
    outlines,
    peaks,
    thinned,
    world_position_covariances,
)
from fgslam.report.results import (
    EstimatorReport,
    ReportData,
    judged_report,
    truth_in_their_world,
)

_AXIS = {
    "gridcolor": "#e4e7ea",
    "zerolinecolor": "#9aa2ab",
    "linecolor": "#9aa2ab",
    "automargin": True,
    "exponentformat": "power",  # not 100µ, beside a unit of its own
}
TEMPLATE = go.layout.Template(
    layout={
        "font": {"family": "system-ui, sans-serif", "size": 12, "color": INK},
        "paper_bgcolor": "white",
        "plot_bgcolor": "white",
        "margin": {"l": 8, "r": 44, "t": 8, "b": 8},
        "modebar": {"orientation": "v"},
        "legend": {"orientation": "h", "x": 0.0, "y": 1.02, "yanchor": "bottom"},
        "xaxis": _AXIS,
        "yaxis": _AXIS,
        "colorway": ON_LIGHT,
    }
)
"""How every figure looks."""

_BAND = "rgba(90, 100, 110, 0.18)"
_SECONDS = "time since the start (s)"
HOVER_PLACE = "<b>%{fullData.name}</b><br>%{x:.3f}, %{y:.3f}<extra></extra>"


def colour(number: int) -> str:
    """Of the i-th series."""
    return ON_LIGHT[number % COLOURS]


def scatter(
    name: str, points: FloatArray, *, shown: bool = True, group: str = "", **style: Any
) -> go.Scatter | go.Scatter3d:
    """A trace through points (n, 2) or (n, 3), or through polylines (k, m, 2 or 3).

    Args:
        name: in the legend; Plotly reads a little HTML in names, which it is not.
        points: in single precision, 0.01 mm in 100 m, to keep pages small.
        shown: False: waits for a click on the legend.
        group: of traces that one click hides; of each the first alone is in the legend.
        style: of Plotly's Scatter.
    """
    flat = np.asarray(joined(points) if points.ndim == 3 else points, np.float32)
    kind = go.Scatter if flat.shape[1] == 2 else go.Scatter3d
    if group:
        style = {"legendgroup": group, "showlegend": False} | style
    coordinates = {axis: np.ascontiguousarray(c) for axis, c in zip("xyz", flat.T, strict=False)}
    visible = True if shown else "legendonly"
    return kind(name=html.escape(name), visible=visible, **coordinates, **style)


def line(
    name: str, points: FloatArray, colour: str, width: float = 2.0, dash: str = "solid", **more: Any
) -> go.Scatter | go.Scatter3d:
    """A polyline, or several, silent at the pointer unless ``more`` says otherwise."""
    style = {"color": colour, "width": width, "dash": dash}
    usual = {"mode": "lines", "line": style, "hoverinfo": "skip"}
    return scatter(name, points, **(usual | more))


def dots(
    name: str, points: FloatArray, colour: str, size: float, symbol: str = "circle", **more: Any
) -> go.Scatter | go.Scatter3d:
    """A mark at each point."""
    marker = {"color": colour, "size": size, "symbol": symbol} | more.pop("marker", {})
    usual = {"mode": "markers", "marker": marker, "hovertemplate": HOVER_PLACE}
    return scatter(name, points, **(usual | more))


def curve(name: str, x: FloatArray, y: FloatArray, colour: str, **more: Any) -> go.Scatter:
    """A line over a common axis, its value shown at the pointer."""
    hover = {"hoverinfo": None, "hovertemplate": "%{y:.4g}"}
    return line(name, np.column_stack([x, y]), colour, **(hover | more))


def band(name: str, x: FloatArray, low: FloatArray, high: FloatArray, **more: Any) -> go.Scatter:
    """The area between two curves."""
    around = np.column_stack([np.r_[x, x[::-1]], np.r_[high, low[::-1]]])
    style = {"fill": "toself", "fillcolor": _BAND} | more
    return line(name, around, _BAND, 0.0, **style)


def drawing(traces: Iterable[Any], x: str, y: str, **layout: Any) -> go.Figure:
    """Traces over two axes with these titles."""
    axes = {"xaxis": {"title": {"text": x}}, "yaxis": {"title": {"text": y}}}
    for name in layout.keys() & axes.keys():
        axes[name] |= layout.pop(name)
    return go.Figure(
        tuple(traces), {"template": TEMPLATE, "hovermode": "x unified", **axes, **layout}
    )


def plane(
    traces: Iterable[Any],
    ranges: Sequence[Sequence[float]] | None = None,
    x: str = "right (m)",
    y: str = "ahead (m)",
) -> go.Figure:
    """Traces seen from above, axes of one scale, within limits where some are given."""
    limits = [{"range": list(limit)} for limit in ranges] if ranges is not None else [{}, {}]
    return drawing(
        traces,
        x,
        y,
        xaxis={"constrain": "domain"} | limits[0],
        yaxis={"scaleanchor": "x"} | limits[1],
        hovermode="closest",
    )


def panels(traces: Iterable[Any], titles: Sequence[str], x: str = _SECONDS) -> go.Figure:
    """Traces over each other in panels (``yaxis`` y, y2, ...) that share their axis of time."""
    n, axes = len(titles), {}
    for k, title in enumerate(titles):
        top, bottom = 1.0 - k / n, 1.0 - (k + 1) / n + (0.07 if k < n - 1 else 0.0)
        axes[_panel(k, "yaxis")] = {"title": {"text": title}, "domain": [bottom, top]}
    out = drawing(traces, x, "", xaxis={"anchor": _panel(n - 1)})
    return out.update_layout(axes)


def _panel(k: int, prefix: str = "y") -> str:
    return f"{prefix}{k + 1 if k else ''}"


def _scales(*, log: bool) -> dict[str, Any]:
    """Layout of a figure whose values may span decades: two buttons choose the scale."""
    kinds = ("linear", "log")
    buttons = [{"label": k, "method": "relayout", "args": [{"yaxis.type": k}]} for k in kinds]
    menu = {"type": "buttons", "direction": "right", "active": int(log), "buttons": buttons}
    place = {"x": 1.0, "xanchor": "right", "y": 1.02, "yanchor": "bottom"}
    return {"yaxis": {"type": kinds[log]}, "updatemenus": [menu | place]}


# --------------------------------------------------------------------------------------------
# The drive from above, and the map in three dimensions. Drawn along the world's vertical: "up" is
# ``ReportData.up``, "right" the first camera's x axis made level, "ahead" completes them.

_ELLIPSES = 40
_MARKED = 500  # predicted poses of an estimator
_DENSE = 3_000  # dots; finer ones keep the paths in sight
# Dead reckoning beside smoothers: enlarged as these need it, its ellipses would cover everything.
_FLOOD = 0.25
LANDMARK_ELLIPSES = "uncertainty of a landmark"


@dataclass(frozen=True, slots=True)
class Detail:
    """How much is drawn at most, evenly spread.

    Attributes:
        poses: of each path.
        dots_above: landmarks of an estimator seen from above.
        dots_map: and in space.
        landmark_ellipses: of the landmarks seen from above, where there is one estimator.
    """

    poses: int = 1_500
    dots_above: int = 3_000
    dots_map: int = 6_000
    landmark_ellipses: int = 300


ON_PAGE = Detail()
ON_PAPER = Detail(20_000, 100_000, 100_000, 5_000)
"""A picture does not grow with what it shows."""


def drive_from_above(data: ReportData, detail: Detail = ON_PAGE) -> Figure:
    """Truth, every estimator's final and online path, ellipses and landmarks, equal axes.

    Of a single estimator the landmarks are coloured by height and have ellipses, too: Fig. 5 of
    Se, Lowe and Little (2001).
    """
    level = level_axes(data.up)
    limits = _limits(data, level)[:2]
    # No side shorter than half the other: a road is long and thin.
    least = 0.5 * max(high - low for low, high in limits)
    wider = [max(least - (high - low), 0.0) / 2.0 for low, high in limits]
    ranges = [[low - more, high + more] for (low, high), more in zip(limits, wider, strict=True)]
    alone = len(data.estimators) == 1
    any_predicted = any(len(_predicted_rows(one)) for one in data.estimators)
    ellipses, factor = _uncertainty(data, level)
    larger = f"Ellipses are drawn {factor} times larger." if factor > 1 else ""
    return Figure(
        "above",
        "The drive from above",
        "Solid: the path as known at the end. Dotted: each pose as first estimated. Dashed: the "
        f"truth. An ellipse reaches {SIGMAS:.0f} standard deviations of the position as the "
        "estimator claims it. Dots: landmarks"
        + (", coloured by height" if alone else "")
        + ". Cross: start; dot: end."
        + (" x: a pose that no landmark measured." if any_predicted else "")
        + " A click on the legend hides or shows what it names.",
        plane(
            (
                *_dots_above(data, level, detail),
                *_paths(data, level[:2], detail),
                *ellipses,
                *_returns(data, level),
            ),
            ranges,
        ),
        note=" ".join(
            filter(None, [larger, _thinning_note(data, detail.poses, detail.dots_above)])
        ),
    )


def map_to_turn(data: ReportData, detail: Detail = ON_PAGE) -> Figure:
    """The landmarks and the paths in three dimensions."""
    level = level_axes(data.up)
    limits = _limits(data, level)
    spans = np.array([high - low for low, high in limits])
    scene: dict[str, Any] = {
        f"{name}axis": {"title": {"text": title}, "range": limit, "showbackground": False}
        for name, title, limit in zip(
            "xyz", ("right (m)", "ahead (m)", "up (m)"), limits, strict=True
        )
    }
    scene |= {
        "aspectmode": "manual",
        "aspectratio": dict(zip("xyz", (spans / spans.max()).tolist(), strict=True)),
        "camera": {
            "eye": {"x": -0.5, "y": -1.05, "z": 0.85},
            "center": {"x": 0, "y": 0, "z": -0.1},
        },
        "dragmode": "turntable",
    }
    traces = (*_dots_in_space(data, level, limits, detail), *_paths(data, level, detail))
    notes = (_thinning_note(data, detail.poses, detail.dots_map), _outside(data, level, limits))
    return Figure(
        "map",
        "The map in three dimensions",
        "Drag to turn, pinch or scroll to come closer, drag with the right button to shift. Dots: "
        "landmarks, coloured by height. Lines as above.",
        go.Figure(traces, {"template": TEMPLATE}).update_scenes(**scene),
        note=" ".join(filter(None, notes)),
    )


def _thinning_note(data: ReportData, most_poses: int, most_landmarks: int) -> str:
    """What is left out to keep the page small; empty where all is drawn."""
    poses = max((len(e) for e in data.estimators), default=0)
    landmarks = max((len(e.landmarks) for e in data.estimators), default=0)
    parts = [f"{most_poses:,} of up to {poses:,} poses"] if poses > most_poses else []
    if landmarks > most_landmarks:
        parts.append(f"{most_landmarks:,} of up to {landmarks:,} landmarks")
    if not parts:
        return ""
    return f"Drawn, evenly spread, to keep this page small: {' and '.join(parts)}."


def _outside(data: ReportData, level: FloatArray, limits: list[list[float]]) -> str:
    """How many far landmarks the box of the map does not hold; empty where it holds all."""
    low, high = np.array(limits).T
    maps = [estimator.landmarks.positions @ level.T for estimator in data.estimators]
    worst = max((int((~_inside(points, low, high)).sum()) for points in maps), default=0)
    return f"Far landmarks outside the box, not drawn: up to {worst:,}." if worst else ""


def _inside(points: FloatArray, low: FloatArray, high: FloatArray) -> BoolArray:
    return np.asarray(((points >= low) & (points <= high)).all(axis=1))


def _paths(data: ReportData, level: FloatArray, detail: Detail) -> Iterator[Any]:
    """Lines in the axes that the rows of ``level`` (2 or 3, 3) span; the truth on top."""
    flat = len(level) == 2
    for i, estimator in enumerate(data.estimators):
        title, poses = estimator.title, estimator.final_poses
        stamps = estimator.timestamps
        yield _path(data, f"{title}, online", stamps, estimator.online_poses, level, detail, i)
        yield _path(data, f"{title}, final", stamps, poses, level, detail, i)
        if len(rows := _predicted_rows(estimator)):
            points = poses[rows[thinned(len(rows), _MARKED)], :3, 3] @ level.T
            kind = ("x-thin-open", 8.0) if flat else ("x", 3.0)
            name = f"{title}, predicted poses"
            yield dots(name, points, colour(i), kind[1], kind[0], hoverinfo="name")
        if len(estimator):
            end = poses[-1:, :3, 3] @ level.T
            yield dots(f"{title}, end", end, colour(i), 10.0 if flat else 4.0, showlegend=False)
    if data.truth is not None and len(data.truth):
        yield _path(data, "truth", data.truth.timestamps, data.truth.poses, level, detail, None)
    start = next((e.final_poses[:1, :3, 3] for e in data.estimators if len(e)), None)
    if start is not None:
        size = 10.0 if flat else 4.0
        yield dots("start", start @ level.T, INK, size, "cross", showlegend=False)


def _path(
    data: ReportData,
    name: str,
    stamps: FloatArray,
    poses: FloatArray,
    level: FloatArray,
    detail: Detail,
    number: int | None,
) -> Any:
    """A path of the truth (no number), as first estimated (dotted, waits for a click), or final."""
    rows = thinned(len(poses), detail.poses)
    online = name.endswith(", online")
    seconds = np.asarray((stamps[rows] - data.start), np.float32)
    up = ", %{z:.3f} m up" if len(level) == 3 else ""
    return line(
        name,
        poses[rows, :3, 3] @ level.T,
        INK if number is None else colour(number),
        # Lines in space are drawn thinner than those of a plane.
        (2.0 if online or number is None else 2.5) * (len(level) - 1),
        "dash" if number is None else "dot" if online else "solid",
        shown=not online,
        customdata=seconds,
        hoverinfo=None,
        hovertemplate=f"<b>%{{fullData.name}}</b><br>%{{x:.3f}} m right, %{{y:.3f}} m ahead{up}"
        "<br>%{customdata:.2f} s<extra></extra>",
    )


def _predicted_rows(estimator: EstimatorReport) -> IntArray:
    """(k,) which poses no landmark measured."""
    return np.flatnonzero(() if estimator.predicted is None else estimator.predicted)


def _returns(data: ReportData, level: FloatArray) -> Iterator[Any]:
    """A line from each frame that closed a loop to the one whose place it recognised."""
    if data.closures:
        ends = data.estimators[0].final_poses[np.array(data.closures), :3, 3] @ level[:2].T
        yield line("loops closed", ends, GREY, 1.5, mode="lines+markers", hoverinfo="name")


def _uncertainty(data: ReportData, level: FloatArray) -> tuple[list[Any], int]:
    """Ellipses of all estimators, and the factor by which they are drawn larger.

    One factor enlarges all, so that they stay comparable. Estimators whose ellipses would hide the
    view even at true size have no say in it, and are shown when asked for.
    """
    span = max(high - low for low, high in _limits(data, level)[:2])
    claimed = [_claimed(estimator, level[:2]) for estimator in data.estimators]
    widths = [_width(covariances) for _, covariances in claimed]
    wide = [width > _FLOOD * span for width in widths]
    narrow = [k for k, hidden in enumerate(wide) if not hidden]
    every = np.concatenate([np.empty((0, 2, 2)), *(claimed[k][1] for k in narrow)])
    factor = exaggeration(every, span)
    if max((widths[k] for k in narrow), default=0.0) * factor >= _FLOOD * span:
        factor = 1
    traces = []
    for i, (estimator, (centres, covariances)) in enumerate(
        zip(data.estimators, claimed, strict=True)
    ):
        around = outlines(centres, covariances, 1 if wide[i] else factor)
        name = f"{estimator.title}, 3 sigma"
        traces.append(line(name, around, colour(i), 1.2, shown=not wide[i]))
    return traces, factor


def _claimed(estimator: EstimatorReport, plane: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions (k, 2) and their covariances (k, 2, 2) in the plane, of poses evenly spread."""
    poses, covariances = estimator.final_poses, estimator.covariances
    known = np.flatnonzero(np.isfinite(covariances[:, 3:, 3:]).all(axis=(1, 2)))
    rows = known[thinned(len(known), _ELLIPSES)]
    world = world_position_covariances(poses[rows], covariances[rows])
    return poses[rows, :3, 3] @ plane.T, in_plane(world, plane)


def _width(covariances: FloatArray) -> float:
    """Typical width of ellipses at true size, metres; 0 where none is known."""
    if not len(covariances):
        return 0.0
    return float(2.0 * SIGMAS * np.sqrt(np.median(np.linalg.eigvalsh(covariances)[:, -1])))


def _dots_above(data: ReportData, level: FloatArray, detail: Detail) -> Iterator[Any]:
    """Landmarks of each estimator, the best one's at first; a single one's by their heights."""
    alone = len(data.estimators) == 1
    for i, estimator in enumerate(data.estimators):
        landmarks = estimator.landmarks
        if alone:
            rows = thinned(len(landmarks), detail.landmark_ellipses)
            flat = in_plane(landmarks.covariances[rows], level[:2])
            around = outlines(landmarks.positions[rows] @ level[:2].T, flat)
            yield line(LANDMARK_ELLIPSES, around, GREY, 0.6, shown=False)
        points = landmarks.positions[thinned(len(landmarks), detail.dots_above)] @ level.T
        marker: dict[str, Any] = {}
        if alone and len(points):
            points = points[np.argsort(points[:, 2], kind="stable")]  # as seen from above
            low, high = np.percentile(points[:, 2], [2.0, 98.0]).tolist()
            marker = _by_height(points[:, 2], low, high)
        name, shown = f"landmarks of {estimator.title}", i == data.best
        yield dots(name, points[:, :2], GREY, 3.0, marker=marker, hoverinfo="skip",
                   hovertemplate=None, shown=shown)  # fmt: skip


def _dots_in_space(
    data: ReportData, level: FloatArray, limits: list[list[float]], detail: Detail
) -> Iterator[Any]:
    low, high = np.array(limits).T
    for i, estimator in enumerate(data.estimators):
        landmarks = estimator.landmarks
        points = landmarks.positions[thinned(len(landmarks), detail.dots_map)] @ level.T
        # Plotly would draw what lies outside the axes across the page.
        points = points[_inside(points, low, high)]
        marker = _by_height(points[:, 2], float(low[2]), float(high[2]))
        name, size = f"landmarks of {estimator.title}", 2.5 if len(points) < _DENSE else 1.6
        hover = "%{x:.2f} m right, %{y:.2f} m ahead, %{z:.2f} m up<extra></extra>"
        yield dots(
            name, points, GREY, size, marker=marker, hovertemplate=hover, shown=i == data.best
        )


def _by_height(heights: FloatArray, low: float, high: float) -> dict[str, Any]:
    """Colours of dots; the bar is drawn on paper only."""
    return {
        "color": np.asarray(heights, np.float32),
        "colorscale": "Viridis",
        "cmin": low,
        "cmax": high,
        "showscale": False,
        "colorbar": {"title": {"text": "height above the first camera (m)"}},
    }


def _limits(data: ReportData, level: FloatArray) -> list[list[float]]:
    """Limits along right, ahead and up."""
    paths = [np.zeros((1, 3)), *(e.final_poses[:, :3, 3] for e in data.estimators)]
    if data.truth is not None:
        paths.append(data.truth.poses[:, :3, 3])
    maps = [e.landmarks.positions @ level.T for e in data.estimators]
    return bulk_limits(np.concatenate(paths) @ level.T, *maps)


# --------------------------------------------------------------------------------------------
# Curves over time: errors, consistency, time a frame, noise, the rig's calibration

MAX_POINTS = 2_500
_MAX_POINTS_ALONG = 800  # of each of an estimator's three curves and bands
_MAX_POINTS_NOISE = 1_000
_WIDELY = 8.0
_LEAST_NEES = 1e-9


def _over_time(
    data: ReportData, number: int, words: str, values: FloatArray, unit: str, **style: Any
) -> Iterator[Any]:
    """A curve of an estimator's values (n,), or nothing where none is known."""
    estimator = data.estimators[number]
    if not np.isfinite(values).any():
        return
    rows = peaks(values, MAX_POINTS)
    seconds = (estimator.timestamps - data.start)[rows]
    name = f"{estimator.title}, {words}" if words else estimator.title
    style = {"hovertemplate": f"%{{y:.4g}}{unit} at %{{x:.2f}} s"} | style
    yield curve(name, seconds, values[rows], colour(number), **style)


def error_over_time(data: ReportData) -> Figure:
    """Distance from the true position, final and online, beside what the estimator claims."""
    traces: list[Any] = []
    for i, estimator in enumerate(data.estimators):
        for values, words, style in (
            (SIGMAS * position_sigma(estimator), "3 sigma", {"width": 1.2, "dash": "dash"}),
            (estimator.online_error_m, "as first estimated", {"dash": "dot", "shown": False}),
            (estimator.final_error_m, "final", {}),
        ):
            traces += _over_time(data, i, words, values, " m", **style)
    finals = [e.final_error_m for e in data.estimators if np.isfinite(e.final_error_m).any()]
    largest = [float(np.nanmax(errors)) for errors in finals]
    # A linear scale would press the better estimators onto its axis.
    differ_widely = bool(largest) and max(largest) > _WIDELY * min(largest)
    scales = _scales(log=differ_widely)
    scales["yaxis"] |= {"rangemode": "tozero"}
    return Figure(
        "error",
        "Position error over time",
        "Distance of each pose from the truth, the first pose aligned. Solid: the final path. "
        "Dotted: each pose as first estimated. Dashed: three standard deviations of the position "
        "as claimed (three times the root of the summed variances): errors should mostly stay "
        "below it.",
        drawing(traces, _SECONDS, "position error (m)", **scales),
        missing=_missing(data),
        note="" if finals else "Errors are not known: only what the estimators claim is drawn.",
    )


def position_sigma(estimator: EstimatorReport) -> FloatArray:
    """Root of the summed variances of each final position (n,), metres; NaN where unknown."""
    variance = np.trace(estimator.covariances[:, 3:, 3:], axis1=1, axis2=2)
    # A planar covariance may round to just below zero.
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def error_by_axis(data: ReportData) -> Figure:
    """Error of the final positions along right, ahead and up, with 3 sigma."""
    known = [i for i, e in enumerate(data.estimators) if np.isfinite(e.final_error_m).any()]
    largest = max((float(np.nanmax(data.estimators[i].final_error_m)) for i in known), default=0.0)
    unit, factor = ("cm", 100.0) if largest < 1.0 else ("m", 1.0)
    level, names = level_axes(data.up), ("right", "ahead", "up")
    chosen = data.best if data.best in known else min(known, default=0)
    traces: list[Any] = []
    for i, estimator in enumerate(data.estimators):
        rows, errors, sigmas = _errors_along(estimator, data.truth, level)
        seconds = estimator.timestamps[rows] - data.start
        for k, name in enumerate(names if len(rows) else ()):
            error, bound = factor * errors[:, k], factor * SIGMAS * sigmas[:, k]
            rmse = f"{float(np.sqrt(np.mean(error**2))):.2f} {unit}"
            of = {"yaxis": _panel(k), "group": estimator.title, "shown": i == chosen}
            if np.isfinite(bound).any():
                traces.append(band("3 sigma", seconds, -bound, bound, **of))
            words = f"{estimator.title}, {name}, rmse {rmse}"
            traces.append(curve(words, seconds, error, colour(i), showlegend=True, **of))
    return Figure(
        "axes",
        "Position error along the axes",
        "Estimate minus truth of the final positions, the first pose aligned. Band: three standard "
        "deviations as claimed, which should hold nearly all of it.",
        panels(traces, [f"{name} ({unit})" for name in names]),
        missing=_missing(data),
    )


def _missing(data: ReportData) -> str:
    return "there is no ground truth" if data.truth is None else "nothing was recorded"


def _errors_along(
    estimator: EstimatorReport, truth: Trajectory | None, level: FloatArray
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Rows (n,) with a truth, thinned, and errors and sigmas (n, 3) in the level axes, metres."""
    found = None if truth is None else to_estimate_world(estimator.final, truth)
    if found is None:
        return np.empty(0, np.int64), np.empty((0, 3)), np.empty((0, 3))
    kept = thinned(len(found[0]), _MAX_POINTS_ALONG)
    rows, poses = found[0][kept], found[1][kept]
    errors = estimator.final_poses[rows, :3, 3] - poses[:, :3, 3]
    world = world_position_covariances(estimator.final_poses[rows], estimator.covariances[rows])
    variances = np.einsum("ij,njk,ik->ni", level, world, level)
    # A planar covariance, rotated, may round to just below zero.
    return rows, errors @ level.T, np.sqrt(np.maximum(variances, 0.0))


def matches_over_time(
    frames: IntArray, matched: IntArray, inliers: IntArray, landmarks: IntArray
) -> Figure:
    """Landmarks matched and used in each frame, and landmarks in the map; (n,) each."""
    at = frames.astype(np.float64)
    traces = [
        curve(name, at, counts.astype(np.float64), colour(number), width=1.8, yaxis=axis)
        for number, name, counts, axis in (
            (1, "matched", matched, "y"),
            (0, "used for the pose", inliers, "y"),
            (2, "landmarks in the map", landmarks, "y2"),
        )
    ]
    out = panels(traces, ["landmarks a frame", "landmarks in the map"], "frame")
    out.update_yaxes(rangemode="tozero")
    note = f"median {np.median(matched):.0f} matched, least {matched.min()}" if len(frames) else ""
    words = "Landmarks matched and used in each frame, and landmarks in the map."
    return Figure("matches", "Matches and map", words, out, note=note)


def nees_over_time(data: ReportData) -> Figure:
    """NEES of the final poses per degree of freedom, with the band of a consistent estimator."""
    bands: dict[tuple[float, float], list[str]] = {}
    for estimator in data.estimators:
        if estimator.nees_band is not None:
            bands.setdefault(estimator.nees_band, []).append(estimator.title)
    bands = dict(sorted(bands.items()))
    end = max((float(e.timestamps[-1]) - data.start for e in data.estimators if len(e)), default=1)
    ends, both = np.array([0.0, end]), np.ones(2)
    traces: list[Any] = [band("95 % band", ends, low * both, high * both) for low, high in bands]
    for i, estimator in enumerate(data.estimators):
        # The first pose is known exactly, or as good as: its NEES of 0 or 1e-20 has no place on a
        # logarithmic axis.
        values = np.where(estimator.nees > _LEAST_NEES, estimator.nees, np.nan)
        traces += _over_time(data, i, "", values, "", width=1.6)
    each = [
        f"{low:.2f} to {high:.2f}" + (f" of {', '.join(titles)}" if len(bands) > 1 else "")
        for (low, high), titles in bands.items()
    ]
    return Figure(
        "nees",
        "Consistency over time (NEES)",
        "Squared error of each final pose in units of its own claimed covariance, per degree of "
        "freedom: 1 is right on average, more is overconfident, less is conservative. Band: 95 % "
        f"of the values of a consistent estimator, frame by frame ({'; '.join(each) or 'not known'}"
        ").",
        drawing(traces, _SECONDS, "NEES per degree of freedom", yaxis={"type": "log"}),
        missing=_missing(data),
    )


def time_per_frame(data: ReportData) -> Figure:
    """Milliseconds that each estimator took for each frame."""
    traces = [
        one
        for i, estimator in enumerate(data.estimators)
        for one in _over_time(data, i, "", estimator.update_ms, " ms", width=1.4)
    ]
    return Figure(
        "time",
        "Time for each frame",
        "Wall-clock time of the estimator's own work for a frame, on the machine of the run.",
        drawing(traces, _SECONDS, "time (ms)", **_scales(log=True)),
    )


_ACCELERATION, _TIMES = " m/s\u00b2", " \u00d7"
_NOISE = (
    ("rotation (deg/s\u00b2)", "log", (("rotation_sigma_dps2", "rotation", " deg/s\u00b2"),)),
    ("translation (m/s\u00b2)", "log", (("translation_sigma_mps2", "translation", _ACCELERATION),)),
    ("gyroscope (\u00d7 stated)", "linear", (("gyroscope_factor", "gyroscope", _TIMES),)),
    ("matches (\u00d7 stated)", "linear", (("match_factor", "matches", _TIMES),)),
    (
        "graph (\u00d7 stated)",
        "linear",
        (
            ("correlated_factor", "weighed by", _TIMES),
            ("single_factor", "single measurement", _TIMES),
        ),
    ),
)
"""Panels: title, scale, and of each curve the column of noise.csv, words and unit."""


def noise_over_time(data: ReportData) -> Figure:
    """Noise of motion model, matches and graph of each estimator, as in use in each frame."""
    titles: list[str] = []
    scales: list[str] = []
    traces: list[Any] = []
    for title, scale, curves in _NOISE:
        own = [
            curve(
                f"{estimator.title}, {words}",
                (estimator.timestamps - data.start)[rows],
                values[rows],
                colour(i),
                width=1.6,
                dash="dash" if order else "solid",
                hovertemplate=f"%{{y:.3g}}{unit}",
                yaxis=_panel(len(titles)),
            )
            for order, (column, words, unit) in enumerate(curves)
            for i, estimator in enumerate(data.estimators)
            if np.isfinite(values := estimator.noise.get(column, np.empty(0))).any()
            for rows in [thinned(len(values), _MAX_POINTS_NOISE)]
        ]
        if own:
            titles.append(title)
            scales.append(scale)
            traces += own
    out = panels(traces, titles) if titles else drawing((), _SECONDS, "")
    for k, scale in enumerate(scales):
        axis = {"type": "log"} if scale == "log" else {"rangemode": "tozero"}
        out.update_layout({_panel(k, "yaxis"): axis})
    without_motion = data.estimators and "log" not in scales
    return Figure(
        "noise",
        "Noise estimated from the drive",
        "Standard deviations in use in each frame. Rotation, translation: the acceleration by "
        "which the camera's velocity is expected to change, where no odometry says it. Times the "
        "stated deviation: of a gyroscope's turns; of matches, where a frame's pose is found; in "
        "a graph, as measurements are weighed (solid: errors that persist from frame to frame "
        "count for more) and as a single one is judged (dashed).",
        out,
        note="No noise of a motion model is shown: it estimates none, or odometry measured the "
        "motion."
        if without_motion
        else "",
    )


_CHANGES = {
    "yaw_deg": "yaw (deg)",
    "pitch_deg": "pitch (deg)",
    "roll_deg": "roll (deg)",
    "focal_percent": "focal length (%)",
}


def calibration_over_time(found: Mapping[str, FloatArray], start: float) -> Figure:
    """Turn and zoom of each camera against the rig's calibration, with 3 sigma.

    Args:
        found: the columns of calibration.csv, (n,) each.
        start: of the drive, seconds.
    """
    cameras = [name for name in ("left", "top") if f"{name}_yaw_deg" in found]
    seconds = found["timestamp"] - start
    traces: list[Any] = []
    for k, change in enumerate(_CHANGES):
        for i, camera in enumerate(cameras):
            values, bound = (found[f"{camera}_{change}{end}"] for end in ("", "_sigma"))
            of = {"yaxis": _panel(k), "group": camera}
            bound = SIGMAS * bound
            traces.append(band(f"{camera} camera, 3 sigma", seconds, values - bound,
                               values + bound, **of))  # fmt: skip
            traces.append(curve(f"{camera} camera", seconds, values, colour(i),
                                width=1.8, showlegend=k == 0, **of))  # fmt: skip
    out = panels(traces, list(_CHANGES.values()))
    out.update_yaxes(rangemode="tozero")
    knocks = int(found["knocks"][-1]) if len(seconds) else 0
    return Figure(
        "calibration",
        "The rig's calibration",
        "How far the other cameras are turned and zoomed against the rig's calibration, as the "
        "drive showed it. Band: three standard deviations; where it holds zero, the calibration "
        "may be exact.",
        out,
        note=f"The rig was found to have moved {knocks} times." if knocks else "",
    )


# --------------------------------------------------------------------------------------------
# Estimators side by side in one figure

_HEIGHT_PX = 720


def plot(answers: Mapping[str, Comparable], truth: Trajectory | None = None) -> go.Figure:
    """The drive from above with 3-sigma ellipses, and errors, NEES and times over time.

    Left: the final paths, the truth dashed, an ellipse of three standard deviations of the position
    at poses evenly spread, grey dots the landmarks of the most accurate estimator. Right, where
    they are known: distance from the truth (first pose aligned) with three standard deviations
    dashed; NEES per degree of freedom with the 95 % band; milliseconds a frame. Lengths are metres,
    right and ahead of the first camera, times seconds since the first frame. Clicks on the legend
    hide and show an estimator.

    Args:
        answers: results by name, as for :func:`fgslam.evaluation.judging.compare`.
        truth: true poses of the reference camera, in any world frame.

    Returns:
        The figure; ``show()`` opens it, ``write_html(path)`` keeps it.

    Raises:
        ConfigError: the answers have no names, or the truth is no trajectory.
    """
    require_named(answers, truth)
    reports = tuple(_report(name, answer, truth) for name, answer in answers.items())
    known = truth_in_their_world(reports, truth)
    data = ReportData(title="", subtitle="", estimators=reports, truth=known)
    every = (error_over_time(data), nees_over_time(data), time_per_frame(data))
    curves = [one for one in every if one.has_numbers]
    rows, columns = max(len(curves), 1), 2 if curves else 1
    specs: list[list[Any]] = [[{"rowspan": rows}, {}][:columns]]
    specs += [[None, {}] for _ in curves[1:]]
    out = make_subplots(rows, columns, specs=specs, shared_xaxes="columns", vertical_spacing=0.06)
    named: set[str] = set()
    for k, figure in enumerate([drive_from_above(data), *curves]):
        row, column = max(k, 1), min(k, 1) + 1
        for one in figure.drawing.data:
            if one.visible is True:
                out.add_trace(_grouped(one, list(answers), named), row, column)
        axes = figure.drawing.layout
        out.update_yaxes(axes.yaxis.to_plotly_json(), row=row, col=column)
        if k in (0, len(curves)):  # the panels on the right share the lowest one's axis of time
            out.update_xaxes({"title": axes.xaxis.title.to_plotly_json()}, row=row, col=column)
    out.update_layout(template=TEMPLATE, height=_HEIGHT_PX, hovermode="closest")
    return out


def _grouped(trace: Any, titles: list[str], named: set[str]) -> Any:
    """The trace as one of its estimator's; the legend names each once, by its first line."""
    owner = next((t for t in titles if trace.name.partition(", ")[0] == html.escape(t)), trace.name)
    is_line = trace.mode == "lines" and trace.fill is None and owner in (*titles, "truth")
    first = is_line and owner not in named
    named |= {owner} if first else set()
    name = html.escape(owner) if first else trace.name
    return trace.update(name=name, legendgroup=owner, showlegend=first)


def _report(name: str, answer: Comparable, truth: Trajectory | None) -> EstimatorReport:
    if isinstance(answer, Estimate):
        return judged_report(name, name, answer, None, truth)
    if not isinstance(answer, Answer):
        return replace(
            _report(name, Answer.of(answer), truth), kind=answer.kind, failure=answer.failure
        )
    report = judged_report(name, name, answer.estimate, answer.online, truth)
    times = np.full(len(report), np.nan)
    # A replay that ended early may know fewer poses than frames, and the reverse.
    known = min(len(times), len(answer.update_ms))
    times[:known] = answer.update_ms[:known]
    return replace(report, update_ms=times)
