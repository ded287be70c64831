"""Figures as PNG: Plotly's traces of a page, drawn by matplotlib from the same values.

Plotly's own export would need a browser. Of the traces, lines, markers, bands and the colour bar
are drawn: what the figures of this package are made of.
"""

from __future__ import annotations

import html
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator

from fgslam.core.arrays import FloatArray
from fgslam.report.content import Figure
from fgslam.report.pictures.style import MAP_COLOURS, colour_bar, picture

_DASHES = {"solid": "-", "dash": "--", "dot": ":"}
_MARKERS = {"circle": "o", "cross": "P", "square": "s", "x-thin-open": "x", "x": "x"}
_POINTS_A_PIXEL = 0.75
_STEEP = 45.0
_BAND = {"color": "#c9d3dc", "linewidth": 0.0}
_FEW_ENTRIES = 3
_FINE = 3.0e4
# From where the three views of a map look: name, elevation and azimuth in degrees.
_VIEWS = (
    ("From above", 65.0, -90.0),
    ("From the left", 22.0, -160.0),
    ("From the right", 22.0, -20.0),
)


def draw_figure(path: Path, figure: Figure, title: str, shown: Collection[str] = ()) -> None:
    """A figure of a plane, or panels over each other, with a legend.

    Args:
        path: the PNG to write.
        figure: of the plane.
        title: heading.
        shown: names of traces that are drawn although the page hides them at first.

    Raises:
        OutputError: the file cannot be written.
    """
    layout = figure.drawing.layout
    traces = _seen(figure, shown)
    panels = sorted(name.replace("axis", "") for name in layout if name.startswith("yaxis"))
    with picture(path, *_size(layout, len(panels))) as canvas:
        found = canvas.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        for axes, panel in zip(found, panels, strict=True):
            own = [trace for trace in traces if (trace.yaxis or "y") == panel]
            for order, trace in enumerate(own):
                _draw(axes, trace, order)
            _dress(axes, layout, panel)
            if len(panels) > 1 and own:
                # Above the panel, where no curve is.
                axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=_FEW_ENTRIES)
        found[0].set_title(title, pad=22.0)
        found[0].annotate(
            figure.note, (0.0, 1.0), (0.0, 8.0), "axes fraction", textcoords="offset points"
        )
        found[-1].set_xlabel(layout.xaxis.title.text)
        canvas.align_ylabels()
        if len(panels) == 1:
            _legend(canvas, found[0])


def draw_views(path: Path, figure: Figure, title: str) -> None:
    """A figure in space, in perspective from above, from the left and from the right.

    Args:
        path: the PNG to write.
        figure: in space.
        title: heading.

    Raises:
        OutputError: the file cannot be written.
    """
    traces, scene = _seen(figure, ()), figure.drawing.layout.scene
    with picture(path, 17.0, 6.4) as canvas:
        for k, (name, elevation, azimuth) in enumerate(_VIEWS):
            place = (1, len(_VIEWS), k + 1)
            axes: Any = canvas.add_subplot(*place, projection="3d", proj_type="persp")
            for order, trace in enumerate(traces):
                _draw(axes, trace, order, "xyz")
            axes.set(**{f"{a}lim": scene[f"{a}axis"].range for a in "xyz"})
            axes.set_box_aspect([scene.aspectratio[a] for a in "xyz"], zoom=1.1)
            axes.view_init(elevation, azimuth)
            axes.set_title(name, y=0.98)
            for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
                axis.set_pane_color((1.0, 1.0, 1.0, 0.0))
                axis.set_tick_params(labelsize=8.0)
            axes.set_xlabel("right (m)")
            if elevation > _STEEP:
                axes.set_zticks([])
                continue
            # Beside the first view its neighbour leaves no room for these.
            axes.set_ylabel("ahead (m)")
            axes.set_zlabel("up (m)", labelpad=-2.0)
        canvas.suptitle(title, fontsize=16, fontweight="bold", x=0.01, ha="left")
        canvas.supxlabel(figure.note, fontsize=12.0)
        _legend(canvas, canvas.axes[0], "outside upper right")


def _seen(figure: Figure, shown: Collection[str]) -> list[Any]:
    return [one for one in figure.drawing.data if one.visible is True or one.name in shown]


def _draw(axes: Any, trace: Any, order: int, names: str = "xy") -> None:
    points = [trace[name] for name in names]
    if trace.type == "scatter" and trace.fill == "toself":
        axes.fill(*points, label=_label(trace), zorder=2.0 + 0.01 * order, **_BAND)
        return
    if "lines" in trace.mode:
        style = {"color": trace.line.color, "linestyle": _DASHES[trace.line.dash]}
        width = trace.line.width * (0.5 if len(names) == 3 else _POINTS_A_PIXEL)
        axes.plot(*points, linewidth=width, label=_label(trace), zorder=2.0 + 0.01 * order, **style)
    elif len(points[0]):
        _draw_markers(axes, trace, order, points)


def _draw_markers(axes: Any, trace: Any, order: int, points: Sequence[FloatArray]) -> None:
    marker = trace.marker
    style: dict[str, Any] = {
        "label": _label(trace),
        "marker": _MARKERS[marker.symbol],
        "zorder": 2.0 + 0.01 * order,
    }
    # Dense maps get finer dots.
    size = (_POINTS_A_PIXEL * marker.size) ** 2
    style["s"] = min(size, max(_FINE / len(points[0]), 1.0))
    if len(points) == 3:
        style["depthshade"] = False
    if isinstance(marker.color, str):
        axes.scatter(*points, color=marker.color, linewidths=1.4, **style)
        return
    norm = Normalize(marker.cmin, marker.cmax)
    axes.scatter(*points, c=marker.color, cmap=MAP_COLOURS, norm=norm, linewidths=0, **style)
    if len(points) == 2:
        bar = marker.colorbar.title.text
        colour_bar(axes, ScalarMappable(norm, MAP_COLOURS), bar, extend="both")


def _label(trace: Any) -> str:
    """Words of the legend."""
    return html.unescape(trace.name)


def _dress(axes: Axes, layout: Any, panel: str) -> None:
    vertical = layout[f"yaxis{panel[1:]}"]
    axes.set_ylabel(vertical.title.text)
    axes.grid(visible=True)
    axes.yaxis.set_major_locator(MaxNLocator(nbins=6, steps=[1, 2, 5, 10]))
    if vertical.rangemode == "tozero":
        axes.set_ylim(0.0, None)
    if vertical.scaleanchor:
        axes.set(xlim=layout.xaxis.range, ylim=vertical.range, aspect="equal")
        axes.xaxis.set_major_locator(MaxNLocator(nbins=9, steps=[1, 2, 5, 10]))


def _legend(canvas: Canvas, axes: Axes, where: Any = "outside lower center") -> None:
    """One entry a name, in the order of drawing."""
    handles, labels = axes.get_legend_handles_labels()
    unique: dict[str, Any] = {}
    for label, handle in zip(labels, handles, strict=True):
        unique.setdefault(label, handle)
    if unique:
        canvas.legend(list(unique.values()), list(unique), loc=where, ncols=_FEW_ENTRIES)


def _size(layout: Any, panels: int) -> tuple[float, float]:
    """Inches: panels are wide; a plane keeps its shape, with room for a bar and a legend."""
    if not layout.yaxis.scaleanchor:
        return 11.0, 1.6 + 2.0 * panels
    (left, right), (low, high) = layout.xaxis.range, layout.yaxis.range
    # A straight road is long and thin; half its length keeps the picture readable.
    aspect = float(np.clip((high - low) / (right - left), 0.2, 5.0))
    height = float(np.clip(8.2 * aspect, 3.6, 9.0))
    return min(height / aspect, 16.0) + 2.4, height + 1.8
