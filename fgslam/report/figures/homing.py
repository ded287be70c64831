"""Figures of homing: errors over a homing and against what was claimed, the local map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.homing import HomingEstimate, HomingTruth
from fgslam.report.figures.traces import (
    SIGMAS,
    Figure,
    Owner,
    Switch,
    Trace,
    equal_axes,
    joined,
    line,
    outlines,
    peaks,
    thinned,
    trace,
    xy,
)

MAX_POINTS = 2_500


@dataclass(frozen=True, slots=True, eq=False)
class Line:
    """A curve: its name, the number of its series (colour), and its points.

    Attributes:
        name: shown at the pointer.
        series: number of the series that it belongs to.
        x, y: (n,).
        dash: `solid`, `dash` or `dot`.
        switch: of the figure, that shows it; empty: always.
    """

    name: str
    series: int
    x: FloatArray
    y: FloatArray
    dash: str = "solid"
    switch: str = ""


def curve_figure(
    words: tuple[str, str, str],
    lines: Sequence[Line],
    axes: tuple[str, str],
    switches: tuple[Switch, ...] = (),
    y: Mapping[str, Any] | None = None,
) -> Figure:
    """Lines over a common axis.

    Args:
        words: key, heading and description of the figure.
        lines: what is drawn; those without a finite value are left out.
        axes: titles with units.
        switches: checkboxes above it.
        y: more of Plotly's y axis.
    """
    traces = [_drawn(one) for one in lines if np.isfinite(one.y).any()]
    layout = {
        "xaxis": {"title": {"text": axes[0]}},
        "yaxis": {"title": {"text": axes[1]}, **(y or {})},
        "hovermode": "x unified",
    }
    key, heading, description = words
    return Figure(key, heading, description, tuple(traces), layout, switches)


def sorted_errors(errors: Mapping[str, FloatArray], unit: str, words: tuple[str, str]) -> Figure:
    """Cumulative distribution of error sizes, one line a series, in the order of ``errors``."""
    lines = []
    for i, (name, values) in enumerate(errors.items()):
        ordered = np.sort(np.abs(values[np.isfinite(values)]))
        share = 100.0 * (np.arange(len(ordered)) + 1.0) / max(len(values), 1)
        lines.append(Line(name, i, ordered, share))
    key, heading = words
    description = (
        "Share of the answers whose error is at most so large; a line that ends below 100 % gave "
        "no answer for the rest."
    )
    return curve_figure(
        (key, heading, description), lines, (f"error ({unit})", "share of answers (%)")
    )


def claimed_against_true(
    claimed: Mapping[str, FloatArray], true: Mapping[str, FloatArray], key: str = "claimed"
) -> Figure:
    """Errors in degrees against the stated standard deviations, one cloud a series."""
    traces: list[Trace] = []
    for i, name in enumerate(claimed):
        traces.append(
            trace(
                Owner(name, i),
                {"x": claimed[name], "y": np.abs(true[name])},
                mode="markers",
                marker={"size": 6, "opacity": 0.75},
                hovertemplate="stated %{x:.2f}°, true %{y:.2f}°<extra></extra>",
            )
        )
    top = max((float(np.max(values)) for values in claimed.values() if len(values)), default=1.0)
    for k in (1.0, 2.0, 3.0):
        owner = Owner(f"{k:.0f} sigma", paint="grey")
        traces.append(line(owner, np.array([[0.0, 0.0], [top, k * top]]), 1, "dot"))
    layout = {
        "xaxis": {"title": {"text": "stated standard deviation (degrees)"}, "rangemode": "tozero"},
        "yaxis": {"title": {"text": "true error (degrees)"}, "rangemode": "tozero"},
        "hovermode": "closest",
    }
    return Figure(
        key,
        "Stated and true errors",
        "Each answer: the standard deviation that it states, and how far off it is. Dotted: one, "
        "two and three standard deviations; one in twenty answers may lie above the second.",
        tuple(traces) if any(map(len, claimed.values())) else (),
        layout,
    )


def _drawn(curve: Line) -> Trace:
    rows = peaks(curve.y, MAX_POINTS)
    owner = Owner(curve.name, curve.series, (curve.switch,) if curve.switch else ())
    return trace(
        owner,
        {"x": curve.x[rows], "y": curve.y[rows]},
        mode="lines",
        line={"width": 1.8, "dash": curve.dash},
        hovertemplate="%{y:.4g}",
    )


MAX_MOMENTS = 60
_HEADING = 0.12  # length of the tick that points ahead, legs
_BULK = (2.0, 98.0)
_HOVER = "<b>%{fullData.name}</b><br>%{y:.3f} legs ahead, %{x:.3f} legs right<extra></extra>"


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
    traces = [*_true_path(truth)]
    for step, row in enumerate(rows):
        known = [] if truth is None else [truth.robots[min(int(row), len(truth.robots) - 1)]]
        traces += _moment(estimates, int(row), step, known, truth)
    start = estimates[0].time if len(estimates) else 0.0
    return Figure(
        key,
        heading,
        "Squares: start, present pose (with a tick ahead) and target. Numbered diamonds: features "
        "that are followed; stars: features that were lost, where they were last. Ellipses reach "
        f"{SIGMAS:.0f} standard deviations as the estimator claims them. Lengths are in legs: 1 is "
        "the way from start to target. Dashed: the truth.",
        tuple(traces),
        _layout(estimates),
        (
            Switch("features", "features"),
            Switch("ellipses", "ellipses"),
            Switch("feature-ellipses", "ellipses of the features", on=False),
            *([Switch("truth", "truth")] if truth is not None else []),
        ),
        steps=tuple(f"{estimates[int(k)].time - start:.1f} s" for k in rows),
    )


def upwards(points: FloatArray) -> dict[str, FloatArray]:
    """Coordinates of points (n, 2), x ahead and y left, on a page where ahead is up."""
    return xy(_turned(np.asarray(points, dtype=np.float64).reshape(-1, 2)))


def _turned(points: FloatArray) -> FloatArray:
    return np.stack([-points[..., 1], points[..., 0]], axis=-1)


def _moment(
    estimates: Sequence[HomingEstimate],
    row: int,
    step: int,
    true_robot: Sequence[FloatArray],
    truth: HomingTruth | None,
) -> Iterator[Trace]:
    now = estimates[row]
    yield _dots("start", step, np.zeros((1, 2)), "square-open", paint="grey", size=13)
    yield from _features(estimates, row, step)
    path = np.array([e.robot[:2] for e in estimates[: row + 1]])
    owner = Owner("estimated path", colour=0, step=step)
    yield line(owner, _turned(path), 1.6)
    for name, pose, block, number in (
        ("robot", now.robot, now.covariance[:3, :3], 0),
        ("target", now.target, now.covariance[3:, 3:], 1),
    ):
        yield from _place(name, pose, block[:2, :2], number, step)
    if truth is not None:
        places = np.array([pose[:2] / truth.leg_m for pose in (*true_robot, truth.target)])
        yield _dots("truth", step, places, "x-thin-open", paint="truth", when=("truth",), size=9)


def _place(
    name: str, pose: FloatArray, covariance: FloatArray, number: int, step: int
) -> Iterator[Trace]:
    """A square with its heading and its ellipse."""
    ahead = pose[:2] + _HEADING * np.array([np.cos(pose[2]), np.sin(pose[2])])
    owner = Owner(name, colour=number, step=step)
    yield line(owner, _turned(np.array([pose[:2], ahead])), 2)
    marker = {"symbol": "square", "size": 13}
    yield trace(owner, upwards(pose[:2]), mode="markers", marker=marker, hovertemplate=_HOVER)
    if np.isfinite(covariance).all():
        outline = outlines(pose[None, :2], covariance[None])[0]
        claimed = Owner(f"{name}, {SIGMAS:.0f} sigma", when=("ellipses",), colour=number, step=step)
        yield line(claimed, _turned(outline), 1)


def _features(estimates: Sequence[HomingEstimate], row: int, step: int) -> Iterator[Trace]:
    now = estimates[row]
    names = [str(identity) for identity in now.ids.tolist()]
    yield trace(
        Owner("feature", paint="grey", when=("features",), step=step),
        upwards(now.landmarks),
        mode="markers+text",
        marker={"symbol": "diamond-open", "size": 8},
        text=names,
        textposition="top right",
        textfont={"size": 9},
        hovertemplate=_HOVER,
    )
    lost = _lost(estimates, row)
    if len(lost):
        yield _dots("lost feature", step, lost, "star", paint="grey", when=("features",), size=7)
    known = np.isfinite(now.landmark_covariances).all(axis=(1, 2))
    if known.any():
        around = joined(outlines(now.landmarks[known], now.landmark_covariances[known]))
        owner = Owner("features, 3 sigma", paint="grey", when=("feature-ellipses",), step=step)
        yield line(owner, _turned(around), 1)


def _lost(estimates: Sequence[HomingEstimate], row: int) -> FloatArray:
    """(m, 2) last positions of the features that are no longer followed."""
    last: dict[int, FloatArray] = {}
    for estimate in estimates[:row]:
        last |= dict(zip(estimate.ids.tolist(), estimate.landmarks, strict=True))
    present = set(estimates[row].ids.tolist())
    return np.array([last[i] for i in sorted(last.keys() - present)]).reshape(-1, 2)


def _dots(
    name: str,
    step: int,
    points: FloatArray,
    symbol: str,
    *,
    paint: Any,
    when: tuple[str, ...] = (),
    size: int = 8,
) -> Trace:
    owner = Owner(name, paint=paint, when=when, step=step)
    marker = {"symbol": symbol, "size": size}
    return trace(owner, upwards(points), mode="markers", marker=marker, hovertemplate=_HOVER)


def _true_path(truth: HomingTruth | None) -> Iterator[Trace]:
    if truth is not None:
        path = np.vstack([np.zeros((1, 2)), truth.robots[:, :2] / truth.leg_m])
        owner = Owner("true path", paint="truth", when=("truth",))
        yield line(owner, _turned(path), 1.4, "dash")


def _layout(estimates: Sequence[HomingEstimate]) -> dict[str, Any]:
    """Axes that do not jump from moment to moment; far features may lie outside."""
    points = [np.array([[0.0, 0.0], [1.0, 0.0]])]
    points += [np.vstack([e.landmarks, e.robot[None, :2], e.target[None, :2]]) for e in estimates]
    every = np.vstack(points)
    seen = upwards(every[np.isfinite(every).all(axis=1)])
    limits = []
    for axis in ("x", "y"):
        low, high = np.percentile(seen[axis], _BULK).tolist()
        margin = 0.1 * (high - low) + 0.2
        limits.append([low - margin, high + margin])
    return equal_axes("right (legs)", "ahead (legs)", (limits[0], limits[1]))
