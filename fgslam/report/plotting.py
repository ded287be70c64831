"""Estimators side by side as one plotly figure: the drive from above, errors, NEES, time."""

from __future__ import annotations

import html
from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from fgslam.core.estimates import Estimate, Trajectory
from fgslam.evaluation.comparing import Comparable, require_named
from fgslam.evaluation.judging import Answer
from fgslam.report.figures import palette
from fgslam.report.figures.over_time import error_over_time, nees_over_time, time_per_frame
from fgslam.report.figures.palette import printed
from fgslam.report.figures.traces import Figure
from fgslam.report.figures.trajectory import drive_from_above
from fgslam.report.run_results import (
    EstimatorReport,
    ReportData,
    judged_report,
    truth_in_their_world,
)

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as PlotlyFigure

_HEIGHT_PX = 720
_GAP = 0.12


def plot(answers: Mapping[str, Comparable], truth: Trajectory | None = None) -> PlotlyFigure:
    """The drive from above with 3-sigma ellipses, and errors, NEES and times over time.

    Left: the final paths, the truth dashed, an ellipse of three standard deviations of the position
    at poses evenly spread, grey dots the landmarks of the most accurate estimator. Right, where
    they are known: distance from the truth (first pose aligned) with three standard deviations
    dashed; NEES per degree of freedom with the 95 % band; milliseconds a frame. Lengths are metres,
    right and ahead of the first camera, times seconds since the first frame. Clicks on the legend
    hide and show an estimator.

    Args:
        answers: results by name, as for :func:`fgslam.evaluation.comparing.compare`.
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
    curves = [error_over_time(data), nees_over_time(data), time_per_frame(data)]
    return _side_by_side(drive_from_above(data), [one for one in curves if one.has_numbers])


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


def _side_by_side(main: Figure, curves: list[Figure]) -> PlotlyFigure:
    from plotly.graph_objects import Figure as PlotlyFigure

    layout: dict[str, Any] = {
        "template": "none",
        "height": _HEIGHT_PX,
        "hovermode": "closest",
        "plot_bgcolor": "white",
        "legend": {"orientation": "h", "y": -0.08},
        "margin": {"t": 40},
    }
    traces: list[dict[str, Any]] = []
    named: set[str] = set()
    width = 1.0 if not curves else 0.5 - 0.5 * _GAP
    heights = np.linspace(1.0 + _GAP, 0.0, len(curves) + 1) if curves else np.ones(1)
    for i, figure in enumerate([main, *curves]):
        number = "" if i == 0 else str(i + 1)
        y = [0.0, 1.0] if i == 0 else [heights[i], heights[i - 1] - _GAP]
        x = [0.0, width] if i == 0 else [1.0 - width, 1.0]
        layout |= _axes(figure, number, x, y)
        if 0 < i < len(curves):  # the panels on the right share the lowest one's axis of time
            layout[f"xaxis{number}"] |= {"title": None, "matches": f"x{len(curves) + 1}"}
        traces += [_placed(trace, number, named) for trace in printed(figure)]
    return PlotlyFigure(data=traces, layout=layout)


def _axes(figure: Figure, number: str, x: list[float], y: list[float]) -> dict[str, Any]:
    style = {"gridcolor": palette.GRID, "zerolinecolor": palette.GRID}
    horizontal = {**style, **figure.layout["xaxis"], "domain": x, "anchor": f"y{number}"}
    vertical = {**style, **figure.layout["yaxis"], "domain": y, "anchor": f"x{number}"}
    log = next((switch.on for switch in figure.switches if switch.key == "log"), None)
    vertical["exponentformat"] = "power"
    if log is not None:
        vertical["type"] = "log" if log else "linear"
    return {f"xaxis{number}": horizontal, f"yaxis{number}": vertical}


def _placed(trace: dict[str, Any], number: str, named: set[str]) -> dict[str, Any]:
    """The trace in its panel; the legend names each estimator once, by its first line."""
    out = dict(trace)
    owner = out.pop("meta")
    group = owner["estimator"]
    name = out["name"] if group is None else html.unescape(out["name"])
    key = name if group is None else f"estimator {group}"
    is_line = owner["paint"] in ("estimator", "truth") and out["mode"] == "lines"
    first = is_line and key not in named
    if first:
        named.add(key)
        if group is not None:
            out["name"] = out["name"].rpartition(", ")[0] or out["name"]
    return out | {
        "xaxis": f"x{number}",
        "yaxis": f"y{number}",
        "legendgroup": key,
        "showlegend": first,
    }
