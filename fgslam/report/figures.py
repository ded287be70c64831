"""Figures of the page, by Plotly: each is a few traces and one template.

A figure's legend is its switchboard: a click hides or shows a line, what is `legendonly` waits for
one. To add a figure: a function of values that
returns a :class:`fgslam.report.content.Figure`.
"""

from __future__ import annotations

import html
import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from plotly import graph_objects as go
from plotly.subplots import make_subplots

from fgslam.core.arrays import FloatArray, thinned
from fgslam.core.types import Estimate, Trajectory
from fgslam.evaluation.judging import Answer, Comparable, require_named
from fgslam.evaluation.statistics import to_estimate_world
from fgslam.report.content import (
    COLOURS,
    GREY,
    INK,
    ON_LIGHT,
    SIGMAS,
    Drive,
    Figure,
    bulk_limits,
    exaggeration,
    in_plane,
    joined,
    level_axes,
    outlines,
    peaks,
    world_position_covariances,
)
from fgslam.report.results import (
    EstimatorReport,
    ReportData,
    judged_report,
    same_times,
    truth_in_their_world,
)

_AXIS = {
    "gridcolor": "#e4e7ea",
    "zerolinecolor": "#9aa2ab",
    "linecolor": "#9aa2ab",
    "automargin": True,
    "exponentformat": "power",  # not 100µ, next to a unit of its own
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
"""Style of every figure."""

_BAND = "rgba(90, 100, 110, 0.18)"
_SECONDS = "time since the start (s)"
_LEVEL = ("right", "ahead", "up")
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
    values = {"name": html.escape(name), "visible": visible} | coordinates | style
    return kind(values, _validate=False)


def line(
    name: str, points: FloatArray, colour: str, width: float = 2.0, dash: str = "solid", **more: Any
) -> go.Scatter | go.Scatter3d:
    """A polyline, or several, silent at the pointer unless ``more`` has a hover text."""
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


def to_millimetre(lengths: FloatArray) -> FloatArray:
    """Lengths in metres to 2^-10 of it: bits below, which no eye sees, cannot be packed."""
    return np.asarray(np.rint(lengths * 1024.0) / 1024.0)


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
    whole = {"template": TEMPLATE, "hovermode": "x unified", **axes, **layout}
    return go.Figure(tuple(traces), whole, _validate=False)


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


def panels(traces: Iterable[Any], titled: Mapping[str, Mapping[str, Any]]) -> go.Figure:
    """Traces over each other in panels (``yaxis`` y, y2, ...) that share their axis of time.

    Args:
        traces: of all panels.
        titled: title of each panel's axis of values, and how else that axis is.
    """
    n, axes = len(titled), {}
    for k, (title, style) in enumerate(titled.items()):
        top, bottom = 1.0 - k / n, 1.0 - (k + 1) / n + (0.07 if k < n - 1 else 0.0)
        axes[_panel(k, "yaxis")] = {"title": {"text": title}, "domain": [bottom, top], **style}
    return drawing(traces, _SECONDS, "", xaxis={"anchor": _panel(n - 1)}, **axes)


_TO_ZERO = {"rangemode": "tozero"}


def _panel(k: int, prefix: str = "y") -> str:
    return f"{prefix}{k + 1 if k else ''}"


BUTTONS = {
    "type": "buttons",
    "direction": "right",
    "x": 1.0,
    "xanchor": "right",
    "y": 1.02,
    "yanchor": "bottom",
}
"""A menu of buttons, above the figure at its right."""


def _scales(*, log: bool) -> dict[str, Any]:
    """Layout of a figure whose values may span decades: two buttons choose the scale."""
    kinds = ("linear", "log")
    buttons = [{"label": k, "method": "relayout", "args": [{"yaxis.type": k}]} for k in kinds]
    menu = BUTTONS | {"active": int(log), "buttons": buttons}
    return {"yaxis": {"type": kinds[log]}, "updatemenus": [menu]}


# --------------------------------------------------------------------------------------------
# The drive from above, and the map in three dimensions. Drawn along the world's vertical: "up" is
# ``ReportData.up``, "right" the first camera's x axis made level, "ahead" completes them.

_ELLIPSES = 40
_MARKED = 500  # predicted poses of an estimator
_DENSE = 3_000  # dots; finer ones do not hide the paths
# Dead reckoning next to smoothers: enlarged as these need it, its ellipses would cover everything.
_FLOOD = 0.25
LANDMARK_ELLIPSES = "uncertainty of a landmark"


class Detail(NamedTuple):
    """How much is drawn at most, evenly spread.

    Attributes:
        poses: of each path.
        dots_above, dots_map: landmarks of an estimator seen from above, and in space.
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
    limits = np.array(_limits(data, level)[:2])
    # No side shorter than half the other: a road is long and thin.
    sides = np.diff(limits)
    more = np.maximum(0.5 * sides.max() - sides, 0.0) / 2.0
    alone = len(data.estimators) == 1
    ellipses, factor = _ellipses(data, level[:2], float(sides.max()))
    traces = [*_landmarks_above(data, level, detail), *_paths(data, level[:2], detail), *ellipses]
    if data.closures:  # from each frame that closed a loop to the one whose place it recognised
        ends = data.estimators[0].final_poses[np.array(data.closures), :3, 3] @ level[:2].T
        style = {"mode": "lines+markers", "hoverinfo": "name"}
        traces.append(line("loops closed", ends, GREY, 1.5, **style))
    larger = f"Ellipses are drawn {factor} times larger." if factor > 1 else ""
    thinning = _thinning_note(data, detail.poses, detail.dots_above)
    return Figure(
        "above",
        "The drive from above",
        "Where did it drive, and how sure is it of that? Solid: the path as known at the end. "
        "Dotted: each pose as first estimated. Dashed: the "
        f"truth. An ellipse reaches {SIGMAS:.0f} standard deviations of the position as the "
        "estimator claims it. Dots: landmarks"
        + (", coloured by height" if alone else "")
        + ". Cross: start; dot: end."
        + (
            " x: a pose that no landmark measured."
            * any(e.predicted.any() for e in data.estimators)
        )
        + " A click on the legend hides or shows what it names.",
        plane(traces, (limits + more * [-1.0, 1.0]).tolist()),
        note=" ".join(filter(None, [larger, thinning])),
    )


_STEPS = 300


def drive_along(data: ReportData) -> Drive | None:
    """Where each estimator's final path is, step by step; None without a path."""
    level, first = level_axes(data.up), data.estimators[0] if data.estimators else None
    if first is None or not len(first):
        return None
    rows = thinned(len(first), _STEPS)
    places = np.full((len(data.estimators), len(rows), 3), np.nan)
    for path, one in zip(places, data.estimators, strict=True):
        steps, of = same_times(first.timestamps[rows], one.timestamps)
        path[steps] = one.final_poses[of, :3, 3] @ level.T
    views = {int(np.searchsorted(rows, row)): view for row, view in sorted(data.views.items())}
    tints = tuple(colour(i) for i in range(len(data.estimators)))
    return Drive(tints, first.timestamps[rows] - data.start, places, views)


def map_to_turn(data: ReportData, detail: Detail = ON_PAGE) -> Figure:
    """The landmarks and the paths in three dimensions."""
    level = level_axes(data.up)
    limits = _limits(data, level)
    low, high = np.array(limits).T
    traces, outside = [], 0
    for i, estimator in enumerate(data.estimators):
        points = estimator.landmarks.positions @ level.T
        inside = ((points >= low) & (points <= high)).all(axis=1)
        outside = max(outside, int((~inside).sum()))
        # Plotly would draw what lies outside the axes across the page.
        rows = thinned(len(points), detail.dots_map)
        points = to_millimetre(points[rows[inside[rows]]])
        traces.append(
            dots(
                f"landmarks of {estimator.title}",
                points,
                GREY,
                2.5 if len(points) < _DENSE else 1.6,
                marker=_by_height(points[:, 2], float(low[2]), float(high[2])),
                hovertemplate="%{x:.2f} m right, %{y:.2f} m ahead, %{z:.2f} m up<extra></extra>",
                shown=i == data.best,
            )
        )
    scene: dict[str, Any] = {
        f"{name}axis": {"title": {"text": f"{title} (m)"}, "range": limit, "showbackground": False}
        for name, title, limit in zip("xyz", _LEVEL, limits, strict=True)
    }
    sides = ((high - low) / (high - low).max()).tolist()
    scene |= {
        "aspectmode": "manual",
        "aspectratio": dict(zip("xyz", sides, strict=True)),
        "camera": {
            "eye": {"x": -0.5, "y": -1.05, "z": 0.85},
            "center": {"x": 0, "y": 0, "z": -0.1},
        },
        "dragmode": "turntable",
    }
    far = f"Far landmarks outside the box, not drawn: up to {outside:,}." if outside else ""
    thinning = _thinning_note(data, detail.poses, detail.dots_map)
    return Figure(
        "map",
        "The map in three dimensions",
        "Do the landmarks look like the place? Drag to turn, pinch or scroll to come closer, drag "
        "with the right button to shift. Dots: "
        "landmarks, coloured by height. Lines as above.",
        go.Figure(
            [*traces, *_paths(data, level, detail)],
            {"template": TEMPLATE, "scene": scene},
            _validate=False,
        ),
        note=" ".join(filter(None, [thinning, far])),
    )


def _limits(data: ReportData, level: FloatArray) -> list[list[float]]:
    """Limits along right, ahead and up."""
    paths = [np.zeros((1, 3)), *(e.final_poses[:, :3, 3] for e in data.estimators)]
    if data.truth is not None:
        paths.append(data.truth.poses[:, :3, 3])
    maps = [e.landmarks.positions @ level.T for e in data.estimators]
    return bulk_limits(np.concatenate(paths) @ level.T, *maps)


def _thinning_note(data: ReportData, most_poses: int, most_landmarks: int) -> str:
    """What is left out to keep the page small; empty where all is drawn."""
    parts = [
        f"{most:,} of up to {count:,} {what}"
        for what, most, count in (
            ("poses", most_poses, max(map(len, data.estimators), default=0)),
            (
                "landmarks",
                most_landmarks,
                max((len(e.landmarks) for e in data.estimators), default=0),
            ),
        )
        if count > most
    ]
    kept = " and ".join(parts)
    return f"Drawn, evenly spread, to keep this page small: {kept}." if parts else ""


def _paths(data: ReportData, level: FloatArray, detail: Detail) -> Iterator[Any]:
    """Lines in the axes that the rows of ``level`` (2 or 3, 3) span; the truth on top."""
    flat = len(level) == 2
    up = "" if flat else ", %{z:.3f} m up"
    dot = 10.0 if flat else 4.0

    def path(name: str, stamps: FloatArray, poses: FloatArray, *style: Any, **more: Any) -> Any:
        rows = thinned(len(poses), detail.poses)
        hover = f"<b>%{{fullData.name}}</b><br>%{{x:.3f}} m right, %{{y:.3f}} m ahead{up}"
        return line(
            name,
            poses[rows, :3, 3] @ level.T,
            *style,
            customdata=np.asarray(stamps[rows] - data.start, np.float32),
            hoverinfo=None,
            hovertemplate=f"{hover}<br>%{{customdata:.2f}} s<extra></extra>",
            **more,
        )

    wider = len(level) - 1  # lines in space are drawn thinner than those of a plane
    for i, estimator in enumerate(data.estimators):
        title, stamps, poses = estimator.title, estimator.timestamps, estimator.final_poses
        online, tint = estimator.online_poses, colour(i)
        yield path(f"{title}, online", stamps, online, tint, 2.0 * wider, "dot", shown=False)
        yield path(f"{title}, final", stamps, poses, tint, 2.5 * wider)
        if len(rows := np.flatnonzero(estimator.predicted)):
            points = poses[rows[thinned(len(rows), _MARKED)], :3, 3] @ level.T
            kind = (8.0, "x-thin-open") if flat else (3.0, "x")
            yield dots(f"{title}, predicted poses", points, tint, *kind, hoverinfo="name")
        if len(estimator):
            end = poses[-1:, :3, 3] @ level.T
            yield dots(f"{title}, end", end, tint, dot, showlegend=False)
    if data.truth is not None and len(data.truth):
        yield path("truth", data.truth.timestamps, data.truth.poses, INK, 2.0 * wider, "dash")
    for first in [e.final_poses[:1, :3, 3] for e in data.estimators if len(e)][:1]:
        yield dots("start", first @ level.T, INK, dot, "cross", showlegend=False)


def _ellipses(data: ReportData, plane: FloatArray, span: float) -> tuple[list[Any], int]:
    """Ellipses of poses evenly spread, of all estimators, and how much larger they are drawn.

    One factor enlarges all, so that they stay comparable. Estimators whose ellipses would hide the
    view even at true size have no say in it, and are shown when asked for.
    """
    centres, claimed = [], []
    for estimator in data.estimators:
        poses, covariances = estimator.final_poses, estimator.covariances
        known = np.flatnonzero(np.isfinite(covariances[:, 3:, 3:]).all(axis=(1, 2)))
        rows = known[thinned(len(known), _ELLIPSES)]
        world = world_position_covariances(poses[rows], covariances[rows])
        centres.append(poses[rows, :3, 3] @ plane.T)
        claimed.append(in_plane(world, plane))
    widths = [
        2.0 * SIGMAS * float(np.sqrt(np.median(np.linalg.eigvalsh(one)[:, -1])))
        if len(one)
        else 0.0
        for one in claimed
    ]
    narrow = [width <= _FLOOD * span for width in widths]
    factor = exaggeration(
        np.concatenate([np.empty((0, 2, 2)), *itertools.compress(claimed, narrow)]), span
    )
    if max(itertools.compress(widths, narrow), default=0.0) * factor >= _FLOOD * span:
        factor = 1
    traces = []
    for i, (estimator, shown) in enumerate(zip(data.estimators, narrow, strict=True)):
        around = outlines(centres[i], claimed[i], factor if shown else 1)
        traces.append(line(f"{estimator.title}, 3 sigma", around, colour(i), 1.2, shown=shown))
    return traces, factor


def _landmarks_above(data: ReportData, level: FloatArray, detail: Detail) -> Iterator[Any]:
    """Landmarks of each estimator, the best one's at first; a single one's by their heights."""
    alone = len(data.estimators) == 1
    for i, estimator in enumerate(data.estimators):
        landmarks = estimator.landmarks
        if alone:
            rows = thinned(len(landmarks), detail.landmark_ellipses)
            flat = in_plane(landmarks.covariances[rows], level[:2])
            around = outlines(landmarks.positions[rows] @ level[:2].T, flat)
            yield line(LANDMARK_ELLIPSES, around, GREY, 0.6, shown=False)
        rows = thinned(len(landmarks), detail.dots_above)
        points = to_millimetre(landmarks.positions[rows] @ level.T)
        style: dict[str, Any] = {"hoverinfo": "skip", "hovertemplate": None}
        if alone and len(points):
            points = points[np.argsort(points[:, 2], kind="stable")]  # as seen from above
            low, high = np.percentile(points[:, 2], [2.0, 98.0]).tolist()
            style["marker"] = _by_height(points[:, 2], low, high)
        shown = i == data.best
        yield dots(
            f"landmarks of {estimator.title}", points[:, :2], GREY, 3.0, shown=shown, **style
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


# --------------------------------------------------------------------------------------------
# Curves over time: errors, consistency, time a frame, noise, the rig's calibration

MAX_POINTS = 2_500
_MAX_POINTS_ALONG = 800  # of each of an estimator's three curves and bands
_WIDELY = 8.0
_LEAST_NEES = 1e-9
_LEAST_MS = 0.05  # of a stage that is drawn, in the mean


def _over_time(
    data: ReportData, number: int, words: str, values: FloatArray, unit: str, **style: Any
) -> list[Any]:
    """A curve of an estimator's values (n,), or nothing where none is known."""
    estimator = data.estimators[number]
    if not np.isfinite(values).any():
        return []
    rows = peaks(values, MAX_POINTS)
    seconds = (estimator.timestamps - data.start)[rows]
    name = ", ".join(filter(None, [estimator.title, words]))
    style = {"hovertemplate": f"%{{y:.4g}}{unit} at %{{x:.2f}} s"} | style
    return [curve(name, seconds, values[rows], colour(number), **style)]


def error_over_time(data: ReportData) -> Figure:
    """Distance from the true position, final and online, next to what the estimator claims."""
    traces: list[Any] = []
    for i, one in enumerate(data.estimators):
        claimed = SIGMAS * one.position_sigma_m
        traces += _over_time(data, i, "3 sigma", claimed, " m", width=1.2, dash="dash")
        online, style = one.online_error_m, {"dash": "dot", "shown": False}
        traces += _over_time(data, i, "as first estimated", online, " m", **style)
        traces += _over_time(data, i, "final", one.final_error_m, " m")
    finals = [e.final_error_m for e in data.estimators if np.isfinite(e.final_error_m).any()]
    largest = [float(np.nanmax(errors)) for errors in finals]
    # A linear scale would press the better estimators onto its axis.
    scales = _scales(log=bool(largest) and max(largest) > _WIDELY * min(largest))
    scales["yaxis"] |= {"rangemode": "tozero"}
    return Figure(
        "error",
        "Position error over time",
        "How far off is it, and did it know? Distance of each pose from the truth, the first pose "
        "aligned. Solid: the final path. "
        "Dotted: each pose as first estimated. Dashed: three standard deviations of the position "
        "as claimed (three times the root of the summed variances): errors should mostly stay "
        "below it.",
        drawing(traces, _SECONDS, "position error (m)", **scales),
        missing=_missing(data),
        note="" if finals else "Errors are not known: only what the estimators claim is drawn.",
    )


def error_by_axis(data: ReportData) -> Figure:
    """Error of the final positions along right, ahead and up, with 3 sigma."""
    known = [i for i, e in enumerate(data.estimators) if np.isfinite(e.final_error_m).any()]
    largest = max((float(np.nanmax(data.estimators[i].final_error_m)) for i in known), default=0.0)
    unit, factor = ("cm", 100.0) if largest < 1.0 else ("m", 1.0)
    level = level_axes(data.up)
    chosen = data.best if data.best in known else min(known, default=0)
    traces: list[Any] = []
    for i, estimator in enumerate(data.estimators):
        found = None if data.truth is None else to_estimate_world(estimator.final, data.truth)
        if found is None:
            continue
        kept = thinned(len(found[0]), _MAX_POINTS_ALONG)
        rows, true_poses = found[0][kept], found[1][kept]
        poses, seconds = estimator.final_poses[rows], estimator.timestamps[rows] - data.start
        errors = factor * (poses[:, :3, 3] - true_poses[:, :3, 3]) @ level.T
        world = world_position_covariances(poses, estimator.covariances[rows])
        # A planar covariance, rotated, may round to just below zero.
        variances = np.maximum(np.einsum("ij,njk,ik->ni", level, world, level), 0.0)
        bounds = factor * SIGMAS * np.sqrt(variances)
        for k, (name, error, bound) in enumerate(zip(_LEVEL, errors.T, bounds.T, strict=True)):
            of = {"yaxis": _panel(k), "group": estimator.title, "shown": i == chosen}
            if np.isfinite(bound).any():
                traces.append(band("3 sigma", seconds, -bound, bound, **of))
            rmse = float(np.sqrt(np.mean(error**2)))
            words = f"{estimator.title}, {name}, rmse {rmse:.2f} {unit}"
            traces.append(curve(words, seconds, error, colour(i), showlegend=True, **of))
    return Figure(
        "axes",
        "Position error along the axes",
        "In which direction does it drift? Estimate minus truth of the final positions, the first "
        "pose aligned. Band: three standard deviations as claimed, which should hold nearly all of "
        "it.",
        panels(traces, {f"{name} ({unit})": {} for name in _LEVEL}),
        missing=_missing(data),
    )


def _missing(data: ReportData) -> str:
    return "there is no ground truth" if data.truth is None else "nothing was recorded"


_COUNTS = {
    "matched": (1, "matched", "y"),
    "inliers": (0, "used for the pose", "y"),
    "landmarks": (2, "landmarks in the map", "y2"),
}
"""Of each column of frames.csv: colour, words and panel."""


def matches_over_time(estimator: EstimatorReport) -> Figure:
    """Landmarks matched and used in each frame, and landmarks in the map."""
    # The first frame has no landmarks to match.
    seconds = (estimator.timestamps - estimator.timestamps[:1])[1:]
    counts = {name: values[1:] for name, values in estimator.counts.items()}
    traces = [
        curve(words, seconds, counts[name], colour(number), width=1.8, yaxis=axis)
        for name, (number, words, axis) in _COUNTS.items()
    ]
    matched, note = counts["matched"], ""
    if len(matched):
        note = f"median {np.median(matched):.0f} matched, least {matched.min():.0f}"
    return Figure(
        "matches",
        "Matches and map",
        "Does it see enough to be sure of its pose? Landmarks matched and used in each frame, and "
        "landmarks in the map.",
        panels(traces, dict.fromkeys(("landmarks a frame", "landmarks in the map"), _TO_ZERO)),
        note=note,
    )


def nees_over_time(data: ReportData) -> Figure:
    """NEES of the final poses per degree of freedom, with the band of a consistent estimator."""
    bands: dict[tuple[float, float], list[str]] = {}
    for estimator in data.estimators:
        if estimator.nees_band is not None:
            bands.setdefault(estimator.nees_band, []).append(estimator.title)
    end = max((float(e.timestamps[-1]) - data.start for e in data.estimators if len(e)), default=1)
    both = np.ones(2)
    traces: list[Any] = [
        band("95 % band", np.array([0.0, end]), low * both, high * both)
        for low, high in sorted(bands)
    ]
    for i, estimator in enumerate(data.estimators):
        # The first pose is known exactly, or as good as: its NEES of 0 or 1e-20 has no place on a
        # logarithmic axis.
        values = np.where(estimator.nees > _LEAST_NEES, estimator.nees, np.nan)
        traces += _over_time(data, i, "", values, "", width=1.6)
    each = [
        f"{low:.2f} to {high:.2f}" + (f" of {', '.join(titles)}" if len(bands) > 1 else "")
        for (low, high), titles in sorted(bands.items())
    ]
    return Figure(
        "nees",
        "Consistency over time (NEES)",
        "Can its covariances be believed? Squared error of each final pose in units of its own "
        "claimed covariance, per degree of freedom: 1 is right on average, more is overconfident, "
        "less is conservative. Band: 95 % "
        f"of the values of a consistent estimator, frame by frame ({'; '.join(each) or 'not known'}"
        ").",
        drawing(traces, _SECONDS, "NEES per degree of freedom", yaxis={"type": "log"}),
        missing=_missing(data),
    )


def time_per_frame(data: ReportData) -> Figure:
    """Milliseconds that each estimator took for each frame."""
    traces: list[Any] = []
    for i, estimator in enumerate(data.estimators):
        traces += _over_time(data, i, "", estimator.update_ms, " ms", width=1.4)
    return Figure(
        "time",
        "Time for each frame",
        "Which estimator keeps up, and which grows slower as the map grows? Wall-clock time of the "
        "estimator's own work for a frame, on the machine of the run.",
        drawing(traces, _SECONDS, "time (ms)", **_scales(log=True)),
    )


_STAGES = {
    "load": "reading the images",
    "sift": "SIFT features",
    "watch": "watch over the cameras",
    "predict": "prediction",
    "stereo": "stereo matches",
    "track": "tracking, matching, motion",
    "places": "place recognition",
    "update": "estimator's update",
    "calibrate": "self-calibration",
}
"""Stages of the loop in words; that of waiting for images is no work."""


def cost_by_stage(stages: Mapping[str, FloatArray], start: float) -> Figure:
    """Milliseconds of each frame by stage, one over the other.

    Args:
        stages: `timestamp` and the stages' milliseconds, (n,) each.
        start: of the drive, seconds.
    """
    rows = thinned(len(stages["timestamp"]), _MAX_POINTS_ALONG)
    seconds = (stages["timestamp"] - start)[rows]
    traces: list[Any] = []
    for name, words in _STAGES.items():
        spent = stages.get(name, np.zeros(1))
        if (mean := spent.mean()) >= _LEAST_MS:
            style = {"width": 0.8, "stackgroup": "all"}
            tint = colour(len(traces))
            traces.append(curve(f"{words}, {mean:.1f} ms", seconds, spent[rows], tint, **style))
    whole = np.sum([stages[name] for name in _STAGES if name in stages], axis=0)
    return Figure(
        "stages",
        "Cost of a frame by stage",
        "Where does the time of a frame go? Wall-clock time of each stage of the live loop on the "
        "machine of the run, one over the other; in the legend the means. Images are read and "
        "SIFT features found in threads next to the loop.",
        drawing(traces, _SECONDS, "time (ms)"),
        note=f"median of all together {np.median(whole):.0f} ms, longest {whole.max():.0f} ms",
    )


_ROTATION, _TRANSLATION = "rotation (deg/s\u00b2)", "translation (m/s\u00b2)"
_NOISE = (
    (_ROTATION, "rotation_sigma_dps2", "rotation", " deg/s\u00b2"),
    (_TRANSLATION, "translation_sigma_mps2", "translation", " m/s\u00b2"),
    ("gyroscope (\u00d7 stated)", "gyroscope_factor", "gyroscope", " \u00d7"),
    ("matches (\u00d7 stated)", "match_factor", "matches", " \u00d7"),
    ("graph (\u00d7 stated)", "correlated_factor", "weighed by", " \u00d7"),
    ("graph (\u00d7 stated)", "single_factor", "single measurement", " \u00d7"),
)
"""Curves: panel, column of noise.csv, words and unit."""


def noise_over_time(data: ReportData) -> Figure:
    """Noise of motion model, matches and graph of each estimator, as in use in each frame."""
    titles: list[str] = []
    traces: list[Any] = []
    for title, column, words, unit in _NOISE:
        dash = "dash" if column == "single_factor" else "solid"
        for i, estimator in enumerate(data.estimators):
            values = estimator.noise.get(column, np.empty(0))
            if np.isfinite(values).any() and title not in titles:
                titles.append(title)
            style = {"width": 1.6, "dash": dash, "yaxis": _panel(len(titles) - 1)}
            traces += _over_time(data, i, words, values, unit, **style)
    decades = {title: {"type": "log"} for title in (_ROTATION, _TRANSLATION)}
    axes = {title: decades.get(title, _TO_ZERO) for title in titles}
    has_motion = not data.estimators or {_ROTATION, _TRANSLATION} & set(titles)
    return Figure(
        "noise",
        "Noise estimated from the drive",
        "How much noise did the drive itself show? Standard deviations in use in each frame. "
        "Rotation, translation: the acceleration by which the camera's velocity is expected to "
        "change, where no odometry measures it. Times "
        "the stated deviation: of a gyroscope's turns; of matches, where a frame's pose is found; "
        "in a graph, as measurements are weighed (solid: errors that persist from frame to frame "
        "count for more) and as a single one is judged (dashed).",
        panels(traces, axes) if axes else drawing((), _SECONDS, ""),
        note=""
        if has_motion
        else "No noise of a motion model is shown: it estimates none, or odometry measured the "
        "motion.",
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
            values = found[f"{camera}_{change}"]
            bound = SIGMAS * found[f"{camera}_{change}_sigma"]
            name, of = f"{camera} camera", {"yaxis": _panel(k), "group": camera}
            shade = {"fillcolor": f"{colour(i)}30", **of}
            traces.append(
                band(f"{name}, 3 sigma", seconds, values - bound, values + bound, **shade)
            )
            style = {"width": 1.8, "showlegend": k == 0} | of
            traces.append(curve(name, seconds, values, colour(i), **style))
    knocks = int(found["knocks"][-1]) if len(seconds) else 0
    return Figure(
        "calibration",
        "The rig's calibration",
        "Was the rig still as calibrated? How far the other cameras are turned and zoomed against "
        "the rig's calibration, as the drive showed it. Bands: three standard deviations; where "
        "one holds zero, the calibration may be exact.",
        panels(traces, dict.fromkeys(_CHANGES.values(), _TO_ZERO)),
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
