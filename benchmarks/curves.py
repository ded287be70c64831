"""Accuracy against cost as pictures, drawn from stored measurements (Strasdat et al. 2012)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from benchmarks.evidence.staircase import STEPS
from benchmarks.measured import value_at
from fgslam.report.content import INK, ON_LIGHT
from fgslam.report.pictures import picture

IMAGES = Path(__file__).parents[1] / "docs" / "images"

_COST, _LIVE, _END = "CPU ms a frame", "ATE live cm", "ATE end cm"
_DRIVES = {
    "simulated": "The paper's drive, simulated",
    "rendered": "The paper's drive, rendered",
    "indoor": "A room, euroc_v101",
    "road": "A road, kitti06",
}
_MARKERS = "osD^v<>P"


def draw_drives(path: Path) -> None:
    """Four drives: of each estimator its cost, its error live (hollow) and at the end (filled)."""
    with picture(path, 13.0, 9.0) as figure:
        every = figure.subplots(2, 2).ravel()
        for axes, (drive, title) in zip(every, _DRIVES.items(), strict=True):
            found = value_at(f"staircase/{drive}")
            frames = max(found["frames"])
            for k, name in enumerate(found["estimator"]):
                cost, live, end = (found[column][k] for column in (_COST, _LIVE, _END))
                look = _look(name.strip("`"))
                axes.plot([cost, cost], [live, end], color=look["color"])
                axes.plot([cost], [live], **look, markerfacecolor="white")
                axes.plot([cost], [end], **look, label=name.strip("`"))
            short = min(found["frames"])
            note = "" if short == frames else f": joint filters end at frame {short}"
            _log_log(axes, title + note, "ATE, cm")
        figure.legend(*every[0].get_legend_handles_labels(), loc="outside upper center", ncols=8)


def draw_numbers(path: Path) -> None:
    """Error over cost, by the number of landmarks; FastSLAM's error and NEES by its particles."""
    thin, particles = value_at("staircase/landmarks"), value_at("staircase/particles")
    with picture(path, 13.0, 9.0) as figure:
        (live, end), (error, nees) = figure.subplots(2, 2)
        for axes, column, when in ((live, _LIVE, "live"), (end, _END, "at the end")):
            for name in dict.fromkeys(thin["estimator"]):
                rows = [row for row, one in enumerate(thin["estimator"]) if one == name]
                _curve(axes, thin, rows, column, name)
            _log_log(axes, f"One landmark in 16, 8, 4, 2, 1: {when}", "ATE, cm")
        figure.legend(*live.get_legend_handles_labels(), loc="outside upper center", ncols=7)
        rows = [k for k, one in enumerate(particles["particles"]) if one != "`batch`"]
        for axes, column, label in ((error, _END, "ATE, cm"), (nees, "NEES end", "NEES")):
            _curve(axes, particles, rows, column, "fast_slam")
            for row in rows:
                at = particles[_COST][row], particles[column][row]
                axes.annotate(f" {particles['particles'][row]}", at, va="bottom")
            batch = particles[column][len(rows)]
            axes.axhline(batch, color=INK, linestyle="--", label=f"batch, {batch:.2f}")
            _log_log(axes, "FastSLAM with 1 to 300 particles", label)
        error.legend()


def _look(name: str) -> dict[str, Any]:
    number = STEPS.index(name)
    return {"color": ON_LIGHT[number], "marker": _MARKERS[number], "markersize": 8.0}


def _curve(
    axes: Axes,
    table: Mapping[str, Sequence[Any]],
    rows: Sequence[int],
    column: str,
    name: str,
) -> None:
    cost, value = ([table[one][row] for row in rows] for one in (_COST, column))
    axes.plot(cost, value, label=name, **_look(name))


def _log_log(axes: Axes, title: str, label: str) -> None:
    axes.set(xscale="log", yscale="log", title=title, xlabel="processor ms a frame", ylabel=label)
    axes.margins(0.06)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.set_minor_formatter(NullFormatter())
    axes.grid(which="both", linewidth=0.5)


PICTURES: dict[str, Callable[[Path], None]] = {
    "staircase_drives.png": draw_drives,
    "staircase_numbers.png": draw_numbers,
}
"""Pictures of pages of results, by name: what draws each from `benchmarks/measured`."""
