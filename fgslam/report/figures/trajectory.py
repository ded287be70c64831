"""The drive from above and the map in three dimensions.

Drawn along the world's vertical: "up" is ``ReportData.up``, "right" the first camera's x axis made
level, "ahead" completes them, so that z is up whatever the camera's tilt.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import congruence
from fgslam.report.figures.traces import (
    Figure,
    Owner,
    Paint,
    Switch,
    Trace,
    joined,
    packed,
    thinned,
    trace,
)
from fgslam.report.pictures.birds_eye import exaggeration, world_position_covariances
from fgslam.report.run_results import EstimatorReport, ReportData

MAX_POSES = 1_500
MAX_DOTS_ABOVE = 3_000
MAX_DOTS_MAP = 6_000
ELLIPSES = 40
SIGMAS = 3.0
_CORNERS = 33
_DENSE = 3_000  # dots; finer ones keep the paths in sight
# Dead reckoning beside smoothers: enlarged as these need it, its ellipses would cover everything.
_FLOOD = 0.25
_BULK = (1.5, 98.5)
_TOLD = (
    "<b>%{fullData.name}</b><br>%{x:.3f} m right, %{y:.3f} m ahead"
    "<br>%{customdata:.2f} s<extra></extra>"
)
_TOLD_3D = (
    "<b>%{fullData.name}</b><br>%{x:.3f} m right, %{y:.3f} m ahead, %{z:.3f} m up"
    "<br>%{customdata:.2f} s<extra></extra>"
)
_TOLD_DOT = "%{fullData.name}<br>%{x:.2f} m right, %{y:.2f} m ahead, %{z:.2f} m up<extra></extra>"


def level_axes(up: FloatArray) -> FloatArray:
    """Rotation (3, 3) from the world to (right, ahead, up)."""
    vertical = up / np.linalg.norm(up)
    # A camera that looks along the vertical about its x axis has no level x: then its z serves.
    first = np.array([1.0, 0.0, 0.0] if abs(vertical[0]) < 0.9 else [0.0, 0.0, 1.0])
    right = first - vertical * (vertical @ first)
    right /= np.linalg.norm(right)
    return np.array([right, np.cross(vertical, right), vertical])


def drive_from_above(data: ReportData) -> Figure:
    """Truth, every estimator's final and online path, ellipses and landmarks, equal axes."""
    level = level_axes(data.up)
    x, y = _limits(data, level)[:2]
    ellipses, of_ellipses = _uncertainty(data, level)
    layout = {
        "xaxis": {"title": {"text": "right (m)"}, "range": x, "constrain": "domain"},
        "yaxis": {"title": {"text": "ahead (m)"}, "range": y, "scaleanchor": "x"},
        "hovermode": "closest",
    }
    return Figure(
        "above",
        "The drive from above",
        "Solid: the path as known at the end. Dotted: each pose as first estimated. Dashed: the "
        f"truth. An ellipse reaches {SIGMAS:.0f} standard deviations of the position as the "
        "estimator claims it. Grey dots: landmarks of the estimator chosen.",
        (*_dots_above(data, level), *_paths(data, level[:2]), *ellipses, *_returns(data, level)),
        layout,
        (
            Switch("truth", "truth"),
            Switch("final", "final path"),
            Switch("online", "path as first estimated", on=False),
            *of_ellipses,
            Switch("landmarks", "landmarks"),
            *([Switch("returns", "loops closed")] if data.closures else []),
        ),
        choices=_with_landmarks(data),
        chosen=data.best,
        note=_thinning_note(data, MAX_DOTS_ABOVE),
    )


def map_to_turn(data: ReportData) -> Figure:
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
        (*_dots_in_space(data, level, limits), *_paths(data, level)),
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
            filter(None, [_thinning_note(data, MAX_DOTS_MAP), _outside(data, level, limits)])
        ),
    )


def _with_landmarks(data: ReportData) -> tuple[int, ...]:
    """Numbers of the estimators that have a map."""
    return tuple(i for i, e in enumerate(data.estimators) if len(e.landmarks))


def _thinning_note(data: ReportData, dots: int) -> str:
    """What is left out to keep the page small; empty where all is drawn."""
    poses = max((len(e) for e in data.estimators), default=0)
    landmarks = max((len(e.landmarks) for e in data.estimators), default=0)
    parts = []
    if poses > MAX_POSES:
        parts.append(f"{MAX_POSES:,} of up to {poses:,} poses")
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


def _paths(data: ReportData, level: FloatArray) -> Iterator[Trace]:
    """Lines in the axes that the rows of ``level`` (2 or 3, 3) span; the truth on top."""
    for i, estimator in enumerate(data.estimators):
        for key, poses, style in (
            ("online", estimator.online_poses, {"dash": "dot", "width": 2}),
            ("final", estimator.final_poses, {"dash": "solid", "width": 2.5}),
        ):
            owner = Owner(f"{estimator.title}, {key}", i, (key,))
            yield _path(owner, estimator.timestamps - data.start, poses, level, style)
    if data.truth is not None and len(data.truth):
        owner = Owner("truth", None, ("truth",), paint="truth")
        times = data.truth.timestamps - data.start
        yield _path(owner, times, data.truth.poses, level, {"dash": "dash", "width": 2})


def _returns(data: ReportData, level: FloatArray) -> Iterator[Trace]:
    """A line from each frame that closed a loop to the one whose place it recognised."""
    if data.closures:
        pairs = np.array(data.closures)
        ends = data.estimators[0].final_poses[pairs, :3, 3] @ level[:2].T
        x, y = joined(ends).T
        owner = Owner("loop closed", 0, ("returns",), paint="grey")
        axes = {"x": x, "y": y}
        yield trace(owner, axes, mode="lines+markers", line={"width": 1.5}, hoverinfo="name")


def _path(
    owner: Owner, times: FloatArray, poses: FloatArray, level: FloatArray, style: dict[str, Any]
) -> Trace:
    rows = thinned(len(poses), MAX_POSES)
    points = poses[rows, :3, 3] @ level.T
    solid = len(level) == 3
    if solid:  # lines in space are drawn thinner than those of a plane
        style = style | {"width": 2 * style["width"]}
    axes = dict(zip("xyz", points.T, strict=False)) | {"customdata": times[rows]}
    told = _TOLD_3D if solid else _TOLD
    return trace(owner, axes, mode="lines", line=style, hovertemplate=told)


def _uncertainty(data: ReportData, level: FloatArray) -> tuple[list[Trace], list[Switch]]:
    """Ellipses of all estimators with their switches.

    One factor enlarges all, so that they stay comparable. Estimators whose ellipses would hide the
    view even at true size have no say in it, and are shown when asked for.
    """
    span = _span(data, level)
    wide = [_is_wide(estimator, level, span) for estimator in data.estimators]
    claimed = [_claimed(estimator, level[:2]) for estimator in data.estimators]
    narrow = [found[1] for found, hidden in zip(claimed, wide, strict=True) if not hidden]
    judged = np.concatenate([np.empty((0, 2, 2)), *narrow])
    factor = exaggeration(judged, span) if len(judged) else 1
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
    x, y = joined(centres[:, None] + scale * _outlines(covariances)).T
    return trace(owner, {"x": x, "y": y}, mode="lines", line={"width": 1.2}, hoverinfo="skip")


def _claimed(estimator: EstimatorReport, plane: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Positions (k, 2) and their covariances (k, 2, 2) in the plane, of poses evenly spread."""
    poses, covariances = estimator.final_poses, estimator.covariances
    known = np.flatnonzero(np.isfinite(covariances[:, 3:, 3:]).all(axis=(1, 2)))
    rows = known[thinned(len(known), ELLIPSES)]
    world = world_position_covariances(poses[rows], covariances[rows])
    return poses[rows, :3, 3] @ plane.T, congruence(
        np.broadcast_to(plane, (len(rows), 2, 3)), world
    )


def _outlines(covariances: FloatArray) -> FloatArray:
    """Ellipses (k, corners, 2) of SIGMAS standard deviations about zero."""
    variances, directions = np.linalg.eigh(covariances)
    radii = SIGMAS * np.sqrt(np.maximum(variances, 0.0))
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(np.einsum("kij,kj,mj->kmi", directions, radii, circle))


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


def _dots_above(data: ReportData, level: FloatArray) -> Iterator[Trace]:
    for i, estimator in enumerate(data.estimators):
        points = _dots(estimator, MAX_DOTS_ABOVE) @ level.T
        owner = _map_of(i, estimator, "grey")
        axes = {"x": points[:, 0], "y": points[:, 1]}
        yield trace(owner, axes, mode="markers", marker={"size": 3}, hoverinfo="skip")


def _dots_in_space(
    data: ReportData, level: FloatArray, limits: list[list[float]]
) -> Iterator[Trace]:
    low, high = np.array(limits).T
    for i, estimator in enumerate(data.estimators):
        points = _dots(estimator, MAX_DOTS_MAP) @ level.T
        # Plotly would draw what lies outside the axes across the page.
        points = points[((points >= low) & (points <= high)).all(axis=1)]
        marker = {
            "size": 2.5 if len(points) < _DENSE else 1.6,
            "color": packed(points[:, 2]),
            "colorscale": "Viridis",
            "cmin": low[2],
            "cmax": high[2],
        }
        owner, axes = _map_of(i, estimator, "own"), dict(zip("xyz", points.T, strict=True))
        yield trace(owner, axes, mode="markers", marker=marker, hovertemplate=_TOLD_DOT)


def _dots(estimator: EstimatorReport, limit: int) -> FloatArray:
    positions = estimator.landmarks.positions
    return positions[thinned(len(positions), limit)]


def _map_of(i: int, estimator: EstimatorReport, paint: Paint) -> Owner:
    name = f"landmark of {estimator.title}"
    return Owner(name, i, ("landmarks",), chosen=True, paint=paint)


def _limits(data: ReportData, level: FloatArray) -> list[list[float]]:
    """Limits along right, ahead and up: all of the paths and the bulk of the landmarks.

    A few far landmarks of tiny disparity must not shrink the rest to a dot.
    """
    paths = [np.zeros((1, 3)), *(e.final_poses[:, :3, 3] for e in data.estimators)]
    if data.truth is not None:
        paths.append(data.truth.poses[:, :3, 3])
    points = np.concatenate(paths)
    corners = [points[np.isfinite(points).all(axis=1)] @ level.T]
    for estimator in data.estimators:
        if len(estimator.landmarks):
            corners.append(np.percentile(estimator.landmarks.positions @ level.T, _BULK, axis=0))
    everything = np.concatenate(corners)
    low, high = everything.min(axis=0), everything.max(axis=0)
    centre, half = 0.5 * (low + high), 0.53 * np.maximum(high - low, 0.2)
    return [
        [float(a), float(b)] for a, b in np.column_stack([centre - half, centre + half]).tolist()
    ]
