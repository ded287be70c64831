"""The noise that a drive was estimated with, frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgslam.report.figures.over_time import panels
from fgslam.report.figures.traces import Figure, Owner, Trace, thinned, trace
from fgslam.report.run_results import ReportData

_MAX_POINTS = 1000
_NO_MOTION_NOISE = (
    "No noise of a motion model is shown: it estimates none, or odometry measured the motion."
)
_FULL, _DASHED = "solid", "dash"


@dataclass(frozen=True, slots=True)
class _Curve:
    """A column of noise.csv: its words beside an estimator's title, unit at the pointer, line."""

    column: str
    words: str
    unit: str
    dash: str = _FULL


@dataclass(frozen=True, slots=True)
class _Panel:
    """Curves over one axis; ``logarithmic`` where they span decades."""

    title: str
    curves: tuple[_Curve, ...]
    logarithmic: bool = False


_PANELS = (
    _Panel(
        "rotation (deg/s\u00b2)",
        (_Curve("rotation_sigma_dps2", "rotation", " deg/s\u00b2"),),
        logarithmic=True,
    ),
    _Panel(
        "translation (m/s\u00b2)",
        (_Curve("translation_sigma_mps2", "translation", " m/s\u00b2"),),
        logarithmic=True,
    ),
    _Panel("gyroscope (\u00d7 stated)", (_Curve("gyroscope_factor", "gyroscope", " \u00d7"),)),
    _Panel("matches (\u00d7 stated)", (_Curve("match_factor", "matches", " \u00d7"),)),
    _Panel(
        "graph (\u00d7 stated)",
        (
            _Curve("correlated_factor", "weighed by", " \u00d7"),
            _Curve("single_factor", "single measurement", " \u00d7", _DASHED),
        ),
    ),
)


def noise_over_time(data: ReportData) -> Figure:
    """Noise of motion model, matches and graph of each estimator, as in use in each frame."""
    shown = [panel for panel in _PANELS if _known(data, panel)]
    traces = [
        drawn
        for k, panel in enumerate(shown)
        for curve in panel.curves
        for drawn in _curves(data, curve, k)
    ]
    layout = panels([panel.title for panel in shown]) if shown else {}
    for k, panel in enumerate(shown):
        axis = layout[f"yaxis{k + 1 if k else ''}"]
        axis |= {"type": "log"} if panel.logarithmic else {"rangemode": "tozero"}
    return Figure(
        "noise",
        "Noise estimated from the drive",
        "Standard deviations in use in each frame. Rotation, translation: the acceleration by "
        "which the camera's velocity is expected to change, where no odometry says it. Times the "
        "stated deviation: of a gyroscope's turns; of matches, where a frame's pose is found; in "
        "a graph, as measurements are weighed (solid: errors that persist from frame to frame "
        "count for more) and as a single one is judged (dashed).",
        tuple(traces),
        layout,
        note=_without_motion(data),
    )


def _known(data: ReportData, panel: _Panel) -> bool:
    """Whether some estimator has a number of the panel."""
    return any(_curves(data, curve, 0) for curve in panel.curves)


def _curves(data: ReportData, curve: _Curve, panel: int) -> Sequence[Trace]:
    """The column of every estimator that has it."""
    out = []
    for i, estimator in enumerate(data.estimators):
        values = estimator.noise.get(curve.column, np.empty(0))
        if not np.isfinite(values).any():
            continue
        rows = thinned(len(values), _MAX_POINTS)
        axes = {"x": (estimator.timestamps - data.start)[rows], "y": values[rows]}
        style = {"width": 1.6, "dash": curve.dash}
        hover = f"%{{y:.3g}}{curve.unit}"
        owner = Owner(f"{estimator.title}, {curve.words}", i)
        axis = f"y{panel + 1 if panel else ''}"
        out.append(trace(owner, axes, mode="lines", line=style, hovertemplate=hover, yaxis=axis))
    return out


def _without_motion(data: ReportData) -> str:
    """Why no panel of the motion is drawn, as far as the table tells; empty where one is."""
    absent = data.estimators and not any(_known(data, panel) for panel in _PANELS[:2])
    return _NO_MOTION_NOISE if absent else ""
