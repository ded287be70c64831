"""Curves over time: position error, consistency, time a frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import Trajectory
from fgslam.evaluation.trajectory import to_estimate_world
from fgslam.report.figures.traces import (
    SIGMAS,
    Figure,
    Owner,
    Switch,
    Trace,
    peaks,
    thinned,
    trace,
    world_position_covariances,
)
from fgslam.report.figures.trajectory import level_axes
from fgslam.report.run_results import EstimatorReport, ReportData

MAX_POINTS = 2500
MAX_POINTS_ALONG = 800
"""Of each of an estimator's three curves and bands."""

_ALONG = ("right", "ahead", "up")
_FINAL = {"dash": "solid", "width": 2}
_ONLINE = {"dash": "dot", "width": 2}
_CLAIMED = {"dash": "dash", "width": 1.2}
_WIDELY = 8.0
_LEAST_NEES = 1e-9
_SECONDS = {"title": {"text": "time since the start (s)"}}


def error_over_time(data: ReportData) -> Figure:
    """Distance from the true position, final and online, beside what the estimator claims."""
    traces: list[Trace] = []
    for i, estimator in enumerate(data.estimators):
        for key, values, words, style in (
            ("claimed", SIGMAS * position_sigma(estimator), "3 sigma", _CLAIMED),
            ("online", estimator.online_error_m, "as first estimated", _ONLINE),
            ("final", estimator.final_error_m, "final", _FINAL),
        ):
            owner = Owner(f"{estimator.title}, {words}", i, (key,))
            traces += _curve(owner, data, estimator, values, style, "%{y:.4f} m")
    known = any(np.isfinite(e.final_error_m).any() for e in data.estimators)
    return Figure(
        "error",
        "Position error over time",
        "Distance of each pose from the truth, the first pose aligned. Solid: the final path. "
        "Dotted: each pose as first estimated. Dashed: three standard deviations of the position "
        "as claimed (three times the root of the summed variances): errors should mostly stay "
        "below it.",
        tuple(traces),
        _layout({"title": {"text": "position error (m)"}, "rangemode": "tozero"}),
        (
            Switch("final", "final path"),
            Switch("online", "path as first estimated", on=False),
            Switch("claimed", "claimed (3 sigma)"),
            Switch("log", "logarithmic", on=_differ_widely(data)),
        ),
        missing=_missing(data),
        note="" if known else "Errors are not known: only what the estimators claim is drawn.",
    )


def _differ_widely(data: ReportData) -> bool:
    """Whether a linear scale would press the better estimators onto its axis."""
    largest = [
        float(np.nanmax(e.final_error_m))
        for e in data.estimators
        if np.isfinite(e.final_error_m).any()
    ]
    return bool(largest) and max(largest) > _WIDELY * min(largest)


def error_by_axis(data: ReportData) -> Figure:
    """Error of the chosen estimator's final position along right, ahead and up, with 3 sigma."""
    known = [i for i, e in enumerate(data.estimators) if np.isfinite(e.final_error_m).any()]
    largest = max((float(np.nanmax(data.estimators[i].final_error_m)) for i in known), default=0.0)
    unit, factor = ("cm", 100.0) if largest < 1.0 else ("m", 1.0)
    level = level_axes(data.up)
    traces: list[Trace] = []
    for i, estimator in enumerate(data.estimators):
        rows, errors, sigmas = _errors_along(estimator, data.truth, level)
        seconds = estimator.timestamps[rows] - data.start
        for k, name in enumerate(_ALONG if len(rows) else ()):
            error, sigma = factor * errors[:, k], factor * sigmas[:, k]
            rmse = f"{float(np.sqrt(np.mean(error**2))):.2f} {unit}"
            owner = Owner(f"{estimator.title}, {name}, rmse {rmse}", i, chosen=True)
            traces += _error_with_band(owner, seconds, error, SIGMAS * sigma, k)
    return Figure(
        "axes",
        "Position error along the axes",
        "Estimate minus truth of the final positions of the estimator chosen, the first pose "
        "aligned. Band: three standard deviations as claimed, which should hold nearly all of it.",
        tuple(traces),
        panels([f"{name} ({unit})" for name in _ALONG]),
        choices=tuple(known),
        chosen=data.best if data.best in known else min(known, default=0),
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
    kept = thinned(len(found[0]), MAX_POINTS_ALONG)
    rows, poses = found[0][kept], found[1][kept]
    errors = estimator.final_poses[rows, :3, 3] - poses[:, :3, 3]
    world = world_position_covariances(estimator.final_poses[rows], estimator.covariances[rows])
    variances = np.einsum("ij,njk,ik->ni", level, world, level)
    # A planar covariance, rotated, may round to just below zero.
    return rows, errors @ level.T, np.sqrt(np.maximum(variances, 0.0))


def _error_with_band(
    owner: Owner, seconds: FloatArray, error: FloatArray, bound: FloatArray, panel: int
) -> Iterator[Trace]:
    axis = {"yaxis": f"y{panel + 1 if panel else ''}"}
    known = np.isfinite(bound)
    if known.any():
        x, y = seconds[known], bound[known]
        corners = {"x": np.concatenate([x, x[::-1]]), "y": np.concatenate([y, -y[::-1]])}
        band = replace(owner, name="3 sigma", paint="band")
        style: dict[str, Any] = {"fill": "toself", "line": {"width": 0}, "hoverinfo": "skip"}
        yield trace(band, corners, mode="lines", **style, **axis)
    axes, hover = {"x": seconds, "y": error}, "%{y:.3g}"
    yield trace(owner, axes, mode="lines", line={"width": 1.8}, hovertemplate=hover, **axis)


def matches_over_time(
    frames: IntArray, matched: IntArray, inliers: IntArray, landmarks: IntArray
) -> Figure:
    """Matched landmarks of every frame, those that the pose kept, and the growth of the map.

    Args:
        frames: (n,) frame numbers.
        matched: (n,) landmarks matched in the frame.
        inliers: (n,) of them used for the pose.
        landmarks: (n,) landmarks in the map after the frame.
    """
    traces = []
    for colour, name, counts, axis in (
        (1, "matched", matched, "y"),
        (0, "used for the pose", inliers, "y"),
        (2, "landmarks in the map", landmarks, "y2"),
    ):
        axes = {"x": frames.astype(np.float64), "y": counts.astype(np.float64)}
        owner = Owner(name, colour=colour)
        traces.append(trace(owner, axes, mode="lines", line={"width": 1.8}, yaxis=axis))
    layout = panels(["landmarks a frame", "landmarks in the map"], "frame")
    for name in ("yaxis", "yaxis2"):
        layout[name]["rangemode"] = "tozero"
    note = f"median {np.median(matched):.0f} matched, least {matched.min()}" if len(frames) else ""
    words = "Landmarks matched and used in each frame, and landmarks in the map."
    return Figure("matches", "Matches and map", words, tuple(traces), layout, note=note)


def nees_over_time(data: ReportData) -> Figure:
    """NEES of the final poses per degree of freedom, with the band of a consistent estimator."""
    bands = _nees_bands(data)
    end = max((float(e.timestamps[-1]) - data.start for e in data.estimators if len(e)), default=1)
    traces = [_band(band, end) for band in bands]
    for i, estimator in enumerate(data.estimators):
        # The first pose is known exactly, or as good as: its NEES of 0 or 1e-20 has no place on a
        # logarithmic axis.
        values = np.where(estimator.nees > _LEAST_NEES, estimator.nees, np.nan)
        owner = Owner(estimator.title, i)
        traces += _curve(owner, data, estimator, values, {"width": 1.6}, "%{y:.3g}")
    return Figure(
        "nees",
        "Consistency over time (NEES)",
        "Squared error of each final pose in units of its own claimed covariance, per degree of "
        "freedom: 1 is right on average, more is overconfident, less is conservative. Band: 95 % "
        f"of the values of a consistent estimator, frame by frame ({_band_words(bands)}).",
        tuple(traces),
        _layout({"title": {"text": "NEES per degree of freedom"}, "type": "log"}),
        missing=_missing(data),
    )


def _nees_bands(data: ReportData) -> dict[tuple[float, float], list[str]]:
    """Bands of the NEES, ascending, each with the titles of the estimators that it is of."""
    bands: dict[tuple[float, float], list[str]] = {}
    for estimator in data.estimators:
        if estimator.nees_band is not None:
            bands.setdefault(estimator.nees_band, []).append(estimator.title)
    return dict(sorted(bands.items()))


def _band_words(bands: dict[tuple[float, float], list[str]]) -> str:
    """The bands in words; with the estimators of each where there are several."""
    several = len(bands) > 1
    each = [
        f"{low:.2f} to {high:.2f}" + (f" of {', '.join(titles)}" if several else "")
        for (low, high), titles in bands.items()
    ]
    return "; ".join(each) or "not known"


def time_per_frame(data: ReportData) -> Figure:
    """Milliseconds that each estimator took for each frame."""
    traces = [
        curve
        for i, e in enumerate(data.estimators)
        for curve in _curve(Owner(e.title, i), data, e, e.update_ms, {"width": 1.4}, "%{y:.2f} ms")
    ]
    return Figure(
        "time",
        "Time for each frame",
        "Wall-clock time of the estimator's own work for a frame, on the machine of the run.",
        tuple(traces),
        _layout({"title": {"text": "time (ms)"}, "type": "log"}),
        (Switch("log", "logarithmic"),),
    )


def position_sigma(estimator: EstimatorReport) -> FloatArray:
    """Root of the summed variances of each final position (n,), metres; NaN where unknown."""
    variance = np.trace(estimator.covariances[:, 3:, 3:], axis1=1, axis2=2)
    # A planar covariance may round to just below zero.
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _curve(
    owner: Owner,
    data: ReportData,
    estimator: EstimatorReport,
    values: FloatArray,
    style: Mapping[str, Any],
    hover: str,
) -> Iterator[Trace]:
    """A line of the values (n,), or nothing where none is known."""
    if not np.isfinite(values).any():
        return
    rows = peaks(values, MAX_POINTS)
    axes = {"x": (estimator.timestamps - data.start)[rows], "y": values[rows]}
    template = f"{hover} at %{{x:.2f}} s"
    yield trace(owner, axes, mode="lines", line=dict(style), hovertemplate=template)


def _band(band: tuple[float, float], end: float) -> Trace:
    low, high = band
    corners = {
        "x": np.array([0.0, end, end, 0.0]),
        "y": np.array([low, low, high, high]),
    }
    owner = Owner("95 % band", paint="band")
    return trace(owner, corners, mode="lines", fill="toself", line={"width": 0}, hoverinfo="skip")


def panels(titles: Sequence[str], time: str = "time since the start (s)") -> dict[str, Any]:
    """Panels over each other that share their axis of time."""
    n = len(titles)
    layout: dict[str, Any] = {
        "xaxis": {"title": {"text": time}, "anchor": f"y{n}"},
        "hovermode": "x unified",
    }
    for k, title in enumerate(titles):
        top, bottom = 1.0 - k / n, 1.0 - (k + 1) / n + (0.07 if k < n - 1 else 0.0)
        layout[f"yaxis{k + 1 if k else ''}"] = {"title": {"text": title}, "domain": [bottom, top]}
    return layout


def _layout(y: Mapping[str, Any]) -> dict[str, Any]:
    return {"xaxis": _SECONDS, "yaxis": dict(y), "hovermode": "x unified"}
