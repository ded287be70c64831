"""The drive from above and the map in three dimensions.

Drawn along the world's vertical: "up" is ``ReportData.up``, "right" the first camera's x axis made
level, "ahead" completes them, so that z is up whatever the camera's tilt.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.report.figures.traces import (
    SIGMAS,
    Figure,
    Owner,
    Paint,
    Switch,
    Trace,
    equal_axes,
    exaggeration,
    in_plane,
    joined,
    line,
    outlines,
    packed,
    thinned,
    trace,
    world_position_covariances,
    xy,
)
from fgslam.report.run_results import EstimatorReport, ReportData

ELLIPSES = 40
_MARKED = 500  # predicted poses of an estimator
_DENSE = 3_000  # dots; finer ones keep the paths in sight
# Dead reckoning beside smoothers: enlarged as these need it, its ellipses would cover everything.
_FLOOD = 0.25
_BULK = (1.5, 98.5)
_HOVER = (
    "<b>%{fullData.name}</b><br>%{x:.3f} m right, %{y:.3f} m ahead"
    "<br>%{customdata:.2f} s<extra></extra>"
)
_HOVER_3D = (
    "<b>%{fullData.name}</b><br>%{x:.3f} m right, %{y:.3f} m ahead, %{z:.3f} m up"
    "<br>%{customdata:.2f} s<extra></extra>"
)
_HOVER_DOT = "%{fullData.name}<br>%{x:.2f} m right, %{y:.2f} m ahead, %{z:.2f} m up<extra></extra>"


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


def level_axes(up: FloatArray) -> FloatArray:
    """Rotation (3, 3) from the world to (right, ahead, up)."""
    vertical = up / np.linalg.norm(up)
    # A camera that looks along the vertical about its x axis has no level x: then its z serves.
    first = np.array([1.0, 0.0, 0.0] if abs(vertical[0]) < 0.9 else [0.0, 0.0, 1.0])
    right = first - vertical * (vertical @ first)
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(vertical, right), vertical])


def drive_from_above(data: ReportData, detail: Detail = ON_PAGE) -> Figure:
    """Truth, every estimator's final and online path, ellipses and landmarks, equal axes.

    Of a single estimator the landmarks are coloured by height and have ellipses, too: Fig. 5 of
    Se, Lowe and Little (2001).
    """
    level = level_axes(data.up)
    x, y = _readable(_limits(data, level)[:2])
    ellipses, of_ellipses = _uncertainty(data, level)
    alone = len(data.estimators) == 1
    dots = "coloured by height" if alone else "of the estimator chosen"
    any_predicted = any(len(_predicted_rows(one)) for one in data.estimators)
    return Figure(
        "above",
        "The drive from above",
        "Solid: the path as known at the end. Dotted: each pose as first estimated. Dashed: the "
        f"truth. An ellipse reaches {SIGMAS:.0f} standard deviations of the position as the "
        f"estimator claims it. Dots: landmarks, {dots}. Cross: start; dot: end."
        + (" x: a pose that no landmark measured." if any_predicted else ""),
        (
            *_dots_above(data, level, detail),
            *_paths(data, level[:2], detail),
            *ellipses,
            *_returns(data, level),
        ),
        equal_axes(ranges=(x, y)),
        (
            Switch("truth", "truth"),
            Switch("final", "final path"),
            Switch("online", "path as first estimated", on=False),
            *of_ellipses,
            Switch("landmarks", "landmarks"),
            *([Switch("landmark-ellipses", "their uncertainty", on=False)] if alone else []),
            *([Switch("returns", "loops closed")] if data.closures else []),
        ),
        choices=_with_landmarks(data),
        chosen=data.best,
        note=_thinning_note(data, detail.poses, detail.dots_above),
    )


def map_to_turn(data: ReportData, detail: Detail = ON_PAGE) -> Figure:
    """The landmarks of the chosen estimator and the paths, in three dimensions."""
    level = level_axes(data.up)
    limits = _limits(data, level)
    axes = ("right (m)", "ahead (m)", "up (m)")
    spans = np.array([high - low for low, high in limits])
    scene: dict[str, Any] = {
        f"{name}axis": {"title": {"text": title}, "range": limit}
        for name, title, limit in zip("xyz", axes, limits, strict=True)
    }
    scene["aspectmode"] = "manual"
    scene["aspectratio"] = dict(zip("xyz", (spans / spans.max()).tolist(), strict=True))
    scene["camera"] = {
        "eye": {"x": -0.5, "y": -1.05, "z": 0.85},
        "center": {"x": 0, "y": 0, "z": -0.1},
    }
    scene["dragmode"] = "turntable"
    return Figure(
        "map",
        "The map in three dimensions",
        "Drag to turn, pinch or scroll to come closer, drag with the right button to shift; or use "
        "arrow keys, plus and minus. "
        "Dots: landmarks of the estimator chosen, coloured by height. Lines as above.",
        (*_dots_in_space(data, level, limits, detail), *_paths(data, level, detail)),
        {"scene": scene},
        (
            Switch("truth", "truth"),
            Switch("final", "final path"),
            Switch("online", "path as first estimated", on=False),
            Switch("landmarks", "landmarks"),
        ),
        choices=_with_landmarks(data),
        chosen=data.best,
        note=" ".join(
            filter(
                None,
                [
                    _thinning_note(data, detail.poses, detail.dots_map),
                    _outside(data, level, limits),
                ],
            )
        ),
    )


def _with_landmarks(data: ReportData) -> tuple[int, ...]:
    """Numbers of the estimators that have a map."""
    return tuple(i for i, e in enumerate(data.estimators) if len(e.landmarks))


def _thinning_note(data: ReportData, most_poses: int, dots: int) -> str:
    """What is left out to keep the page small; empty where all is drawn."""
    poses = max((len(e) for e in data.estimators), default=0)
    landmarks = max((len(e.landmarks) for e in data.estimators), default=0)
    parts = []
    if poses > most_poses:
        parts.append(f"{most_poses:,} of up to {poses:,} poses")
    if landmarks > dots:
        parts.append(f"{dots:,} of up to {landmarks:,} landmarks")
    if not parts:
        return ""
    return f"Drawn, evenly spread, to keep this page small: {' and '.join(parts)}."


def _outside(data: ReportData, level: FloatArray, limits: list[list[float]]) -> str:
    """How many far landmarks the box of the map does not hold; empty where it holds all."""
    low, high = np.array(limits).T
    counts = []
    for estimator in data.estimators:
        points = estimator.landmarks.positions @ level.T
        counts.append(int((~((points >= low) & (points <= high)).all(axis=1)).sum()))
    worst = max(counts, default=0)
    return f"Far landmarks outside the box, not drawn: up to {worst:,}." if worst else ""


# --------------------------------------------------------------------------------------------
# Lines


def _paths(data: ReportData, level: FloatArray, detail: Detail) -> Iterator[Trace]:
    """Lines in the axes that the rows of ``level`` (2 or 3, 3) span; the truth on top."""
    for i, estimator in enumerate(data.estimators):
        for key, poses, style in (
            ("online", estimator.online_poses, {"dash": "dot", "width": 2}),
            ("final", estimator.final_poses, {"dash": "solid", "width": 2.5}),
        ):
            owner = Owner(f"{estimator.title}, {key}", i, (key,))
            rows = thinned(len(poses), detail.poses)
            times = estimator.timestamps[rows] - data.start
            yield _path(owner, times, poses[rows], level, style)
        if len(rows := _predicted_rows(estimator)):
            yield _predicted(i, estimator, rows, level)
        if len(estimator):
            yield _place(f"{estimator.title}, end", estimator.final_poses[-1], level, i)
    if data.truth is not None and len(data.truth):
        owner = Owner("truth", None, ("truth",), paint="truth")
        rows = thinned(len(data.truth), detail.poses)
        times = data.truth.timestamps[rows] - data.start
        yield _path(owner, times, data.truth.poses[rows], level, {"dash": "dash", "width": 2})
    start = next((e.final_poses[0] for e in data.estimators if len(e)), None)
    if start is not None:
        yield _place("start", start, level)


def _predicted_rows(estimator: EstimatorReport) -> IntArray:
    """(k,) which poses no landmark measured."""
    return np.flatnonzero(() if estimator.predicted is None else estimator.predicted)


def _predicted(number: int, estimator: EstimatorReport, rows: IntArray, level: FloatArray) -> Trace:
    """A mark at each of these poses."""
    points = estimator.final_poses[rows[thinned(len(rows), _MARKED)], :3, 3] @ level.T
    owner = Owner(f"{estimator.title}, predicted poses", number, ("final",))
    flat = len(level) == 2
    marker = {"symbol": "x-thin-open" if flat else "x", "size": 8 if flat else 3}
    axes = dict(zip("xyz", points.T, strict=False))
    return trace(owner, axes, mode="markers", marker=marker, hoverinfo="name")


def _place(name: str, pose: FloatArray, level: FloatArray, number: int | None = None) -> Trace:
    """A dot where an estimator's path ends, a cross where all of them start."""
    axes = dict(zip("xyz", (level @ pose[:3, 3])[:, None], strict=False))
    owner, symbol = Owner(name, number, ("final",)), "circle"
    if number is None:
        owner, symbol = Owner(name, paint="truth"), "cross"
    marker = {"symbol": symbol, "size": 10 if len(level) == 2 else 4}
    return trace(owner, axes, mode="markers", marker=marker, hoverinfo="name")


def _returns(data: ReportData, level: FloatArray) -> Iterator[Trace]:
    """A line from each frame that closed a loop to the one whose place it recognised."""
    if data.closures:
        pairs = np.array(data.closures)
        ends = data.estimators[0].final_poses[pairs, :3, 3] @ level[:2].T
        owner = Owner("loop closed", 0, ("returns",), paint="grey")
        axes = xy(joined(ends))
        yield trace(owner, axes, mode="lines+markers", line={"width": 1.5}, hoverinfo="name")


def _path(
    owner: Owner, times: FloatArray, poses: FloatArray, level: FloatArray, style: dict[str, Any]
) -> Trace:
    points = poses[:, :3, 3] @ level.T
    solid = len(level) == 3
    if solid:  # lines in space are drawn thinner than those of a plane
        style = style | {"width": 2 * style["width"]}
    axes = dict(zip("xyz", points.T, strict=False)) | {"customdata": times}
    hover = _HOVER_3D if solid else _HOVER
    return trace(owner, axes, mode="lines", line=style, hovertemplate=hover)


def _uncertainty(data: ReportData, level: FloatArray) -> tuple[list[Trace], list[Switch]]:
    """Ellipses of all estimators with their switches.

    One factor enlarges all, so that they stay comparable. Estimators whose ellipses would hide the
    view even at true size have no say in it, and are shown when asked for.
    """
    span = _span(data, level)
    wide = [_is_wide(estimator, level, span) for estimator in data.estimators]
    claimed = [_claimed(estimator, level[:2]) for estimator in data.estimators]
    narrow = [found[1] for found, hidden in zip(claimed, wide, strict=True) if not hidden]
    factor = exaggeration(np.concatenate([np.empty((0, 2, 2)), *narrow]), span)
    switches = [Switch("ellipses", "uncertainty (3 sigma)")]
    if any(wide):
        switches.append(Switch("wide", "very large ones, too", on=False))
    if factor > 1:
        widths = [
            _width(e, level) for e, hidden in zip(data.estimators, wide, strict=True) if not hidden
        ]
        readable = max(widths) * factor < _FLOOD * span
        switches.append(Switch("enlarged", f"enlarged {factor} times", on=readable))
    traces = []
    for i, estimator in enumerate(data.estimators):
        when = ("ellipses", "wide") if wide[i] else ("ellipses",)
        for scale in sorted({1, factor}):
            key = ("enlarged",)
            owner = Owner(
                f"{estimator.title}, 3 sigma",
                i,
                when if scale == 1 else when + key,
                key if scale == 1 and factor > 1 else (),
            )
            traces.append(_ellipses(owner, *claimed[i], scale))
    return traces, switches


def _ellipses(owner: Owner, centres: FloatArray, covariances: FloatArray, scale: int) -> Trace:
    return line(owner, outlines(centres, covariances, scale), 1.2)


def _claimed(estimator: EstimatorReport, plane: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions (k, 2) and their covariances (k, 2, 2) in the plane, of poses evenly spread."""
    poses, covariances = estimator.final_poses, estimator.covariances
    known = np.flatnonzero(np.isfinite(covariances[:, 3:, 3:]).all(axis=(1, 2)))
    rows = known[thinned(len(known), ELLIPSES)]
    world = world_position_covariances(poses[rows], covariances[rows])
    return poses[rows, :3, 3] @ plane.T, in_plane(world, plane)


def _is_wide(estimator: EstimatorReport, level: FloatArray, span: float) -> bool:
    """Whether the typical ellipse would hide the view: dead reckoning beside smoothers."""
    return _width(estimator, level) > _FLOOD * span


def _width(estimator: EstimatorReport, level: FloatArray) -> float:
    """Typical width of an estimator's ellipses at true size, metres; 0 where none is known."""
    covariances = _claimed(estimator, level[:2])[1]
    if not len(covariances):
        return 0.0
    return float(2.0 * SIGMAS * np.sqrt(np.median(np.linalg.eigvalsh(covariances)[:, -1])))


def _span(data: ReportData, level: FloatArray) -> float:
    """Larger side of the view from above, metres."""
    return max(high - low for low, high in _limits(data, level)[:2])


# --------------------------------------------------------------------------------------------
# Landmarks


def _dots_above(data: ReportData, level: FloatArray, detail: Detail) -> Iterator[Trace]:
    alone = len(data.estimators) == 1
    for i, estimator in enumerate(data.estimators):
        if alone:
            yield _landmark_ellipses(i, estimator, level[:2], detail.landmark_ellipses)
        points = _dots(estimator, detail.dots_above) @ level.T
        marker: dict[str, Any] = {"size": 3}
        if alone and len(points):
            points = points[np.argsort(points[:, 2], kind="stable")]  # as seen from above
            low, high = np.percentile(points[:, 2], [2.0, 98.0]).tolist()
            marker |= _by_height(points[:, 2], low, high)
        owner = _map_of(i, estimator, "own" if alone else "grey")
        yield trace(owner, xy(points), mode="markers", marker=marker, hoverinfo="skip")


def _landmark_ellipses(i: int, estimator: EstimatorReport, plane: FloatArray, most: int) -> Trace:
    landmarks = estimator.landmarks
    rows = thinned(len(landmarks), most)
    centres = landmarks.positions[rows] @ plane.T
    owner = Owner("uncertainty of a landmark", i, ("landmark-ellipses",), paint="grey")
    return line(owner, outlines(centres, in_plane(landmarks.covariances[rows], plane)), 0.6)


def _by_height(heights: FloatArray, low: float, high: float) -> dict[str, Any]:
    """Colours of dots; the bar is drawn on paper only."""
    return {
        "color": packed(heights),
        "colorscale": "Viridis",
        "cmin": low,
        "cmax": high,
        "showscale": False,
        "colorbar": {"title": {"text": "height above the first camera (m)"}},
    }


def _dots_in_space(
    data: ReportData, level: FloatArray, limits: list[list[float]], detail: Detail
) -> Iterator[Trace]:
    low, high = np.array(limits).T
    for i, estimator in enumerate(data.estimators):
        points = _dots(estimator, detail.dots_map) @ level.T
        # Plotly would draw what lies outside the axes across the page.
        points = points[((points >= low) & (points <= high)).all(axis=1)]
        marker = {
            "size": 2.5 if len(points) < _DENSE else 1.6,
            **_by_height(points[:, 2], float(low[2]), float(high[2])),
        }
        owner, axes = _map_of(i, estimator, "own"), dict(zip("xyz", points.T, strict=True))
        yield trace(owner, axes, mode="markers", marker=marker, hovertemplate=_HOVER_DOT)


def _dots(estimator: EstimatorReport, limit: int) -> FloatArray:
    positions = estimator.landmarks.positions
    return positions[thinned(len(positions), limit)]


def _map_of(i: int, estimator: EstimatorReport, paint: Paint) -> Owner:
    name = f"landmark of {estimator.title}"
    return Owner(name, i, ("landmarks",), chosen=True, paint=paint)


def _limits(data: ReportData, level: FloatArray) -> list[list[float]]:
    """Limits along right, ahead and up."""
    paths = [np.zeros((1, 3)), *(e.final_poses[:, :3, 3] for e in data.estimators)]
    if data.truth is not None:
        paths.append(data.truth.poses[:, :3, 3])
    poses = np.concatenate(paths)
    maps = [e.landmarks.positions @ level.T for e in data.estimators]
    return bulk_limits(poses @ level.T, *maps)


def _readable(limits: list[list[float]]) -> list[list[float]]:
    """The limits, no side shorter than half the other: a road is long and thin."""
    least = 0.5 * max(high - low for low, high in limits)
    wider = [max(least - (high - low), 0.0) / 2.0 for low, high in limits]
    return [[low - more, high + more] for (low, high), more in zip(limits, wider, strict=True)]


def bulk_limits(path: FloatArray, *maps: FloatArray) -> list[list[float]]:
    """Limits along each of d axes: all of the path (n, d) and the bulk of every map (m, d).

    A few far landmarks of tiny disparity must not shrink the rest to a dot.
    """
    corners = [path[np.isfinite(path).all(axis=1)]]
    corners += [np.percentile(points, _BULK, axis=0) for points in maps if len(points)]
    everything = np.concatenate(corners)
    low, high = everything.min(axis=0), everything.max(axis=0)
    centre, half = 0.5 * (low + high), 0.53 * np.maximum(high - low, 0.2)
    return [
        [float(a), float(b)] for a, b in np.column_stack([centre - half, centre + half]).tolist()
    ]
