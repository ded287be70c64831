"""Curves over time: position error, consistency, time a frame."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.report.figures.traces import Figure, Owner, Switch, Trace, peaks, trace
from fgslam.report.run_results import EstimatorReport, ReportData

MAX_POINTS = 2500
SIGMAS = 3.0
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
        for key, values, told, style in (
            ("claimed", SIGMAS * position_sigma(estimator), "3 sigma", _CLAIMED),
            ("online", estimator.online_error_m, "as first estimated", _ONLINE),
            ("final", estimator.final_error_m, "final", _FINAL),
        ):
            owner = Owner(f"{estimator.title}, {told}", i, (key,))
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


def nees_over_time(data: ReportData) -> Figure:
    """NEES of the final poses per degree of freedom, with the band of a consistent estimator."""
    bands = sorted({e.nees_band for e in data.estimators if e.nees_band is not None})
    end = max((float(e.timestamps[-1]) - data.start for e in data.estimators if len(e)), default=1)
    traces = [_band(band, end) for band in bands]
    for i, estimator in enumerate(data.estimators):
        # The first pose is known exactly, or as good as: its NEES of 0 or 1e-20 has no place on a
        # logarithmic axis.
        values = np.where(estimator.nees > _LEAST_NEES, estimator.nees, np.nan)
        owner = Owner(estimator.title, i)
        traces += _curve(owner, data, estimator, values, {"width": 1.6}, "%{y:.3g}")
    told = " and ".join(f"{low:.2f} to {high:.2f}" for low, high in bands) or "not known"
    return Figure(
        "nees",
        "Consistency over time (NEES)",
        "Squared error of each final pose in units of its own claimed covariance, per degree of "
        "freedom: 1 is right on average, more is overconfident, less is conservative. Band: 95 % "
        f"of the values of a consistent estimator, frame by frame ({told}).",
        tuple(traces),
        _layout({"title": {"text": "NEES per degree of freedom"}, "type": "log"}),
    )


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
    told: str,
) -> Iterator[Trace]:
    """A line of the values (n,), or nothing where none is known."""
    if not np.isfinite(values).any():
        return
    rows = peaks(values, MAX_POINTS)
    axes = {"x": (estimator.timestamps - data.start)[rows], "y": values[rows]}
    template = f"{told} at %{{x:.2f}} s"
    yield trace(owner, axes, mode="lines", line=dict(style), hovertemplate=template)


def _band(band: tuple[float, float], end: float) -> Trace:
    low, high = band
    corners = {
        "x": np.array([0.0, end, end, 0.0]),
        "y": np.array([low, low, high, high]),
    }
    owner = Owner("95 % band", paint="band")
    return trace(owner, corners, mode="lines", fill="toself", line={"width": 0}, hoverinfo="skip")


def _layout(y: Mapping[str, Any]) -> dict[str, Any]:
    return {"xaxis": _SECONDS, "yaxis": dict(y), "hovermode": "x unified"}
