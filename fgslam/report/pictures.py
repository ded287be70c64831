"""Figures for print, by matplotlib, and pictures of a calibration."""

from __future__ import annotations

import html
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from fgslam.core.arrays import FloatArray
from fgslam.core.files import replacing
from fgslam.report.content import Figure
from fgslam.report.overlays import FAINT, INK, ORANGE, SKY, VERMILLION

MAP_COLOURS = "viridis"
"""Perceptually uniform, readable without colour vision and in grey print."""

DPI = 160

PICTURE_STYLE: dict[str, Any] = {
    "font.size": 12.0,
    "axes.titlesize": 14.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 12.0,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.axisbelow": True,
    "axes.xmargin": 0.01,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 11.0,
    "ytick.labelsize": 11.0,
    "grid.color": FAINT,
    "legend.fontsize": 11.0,
    "legend.frameon": False,
    "path.simplify": False,
}


@contextmanager
def picture(path: Path, width: float, height: float) -> Iterator[Canvas]:
    """A figure of the given size in inches, written to ``path`` when the block ends well.

    Neither the user's matplotlibrc nor the state of pyplot has a say, and no date or version
    enters the file, so that the bytes depend on the input only.

    Raises:
        OutputError: the file cannot be written.
    """
    with matplotlib.style.context(PICTURE_STYLE, after_reset=True):
        figure = Canvas(figsize=(width, height), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
        with replacing(path) as partial:
            # Level 3 takes half the time of 6, for the same size within a tenth.
            packing: dict[str, Any] = {"compress_level": 3}
            nothing: dict[str, Any] = {"Software": None}
            look: dict[str, Any] = {"bbox_inches": "tight", "pad_inches": 0.1}
            figure.savefig(partial, format="png", metadata=nothing, pil_kwargs=packing, **look)


_DASHES = {"solid": "-", "dash": "--", "dot": ":"}
_MARKERS = {"circle": "o", "cross": "P", "square": "s", "x-thin-open": "x", "x": "x"}
_POINTS_A_PIXEL = 0.75
_STEEP = 45.0
_SUPTITLE: dict[str, Any] = {"fontsize": 16, "fontweight": "bold", "x": 0.01, "ha": "left"}
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
    with picture(path, *_paper_size(layout, len(panels))) as canvas:
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
        canvas.suptitle(title, **_SUPTITLE)
        canvas.supxlabel(figure.note, fontsize=12.0)
        _legend(canvas, canvas.axes[0], "outside upper right")


def _seen(figure: Figure, shown: Collection[str]) -> list[Any]:
    return [one for one in figure.drawing.data if one.visible is True or one.name in shown]


def _draw(axes: Any, trace: Any, order: int, names: str = "xy") -> None:
    points = [trace[name] for name in names]
    style: dict[str, Any] = {"label": html.unescape(trace.name), "zorder": 2.0 + 0.01 * order}
    if trace.type == "scatter" and trace.fill == "toself":
        axes.fill(*points, **style, **_BAND)
    elif "lines" in trace.mode:
        width = trace.line.width * (0.5 if len(names) == 3 else _POINTS_A_PIXEL)
        style |= {"color": trace.line.color, "linestyle": _DASHES[trace.line.dash]}
        axes.plot(*points, linewidth=width, **style)
    elif len(points[0]):
        marker = trace.marker
        # Dense maps get finer dots.
        size = min((_POINTS_A_PIXEL * marker.size) ** 2, max(_FINE / len(points[0]), 1.0))
        style |= {"marker": _MARKERS[marker.symbol], "s": size}
        if len(points) == 3:
            style["depthshade"] = False
        if isinstance(marker.color, str):
            axes.scatter(*points, color=marker.color, linewidths=1.4, **style)
            return
        norm = Normalize(marker.cmin, marker.cmax)
        axes.scatter(*points, c=marker.color, cmap=MAP_COLOURS, norm=norm, linewidths=0, **style)
        if len(points) == 2:
            # Exactly as tall as the axes, whatever their aspect.
            inset = axes.inset_axes((1.02, 0.0, 0.022, 1.0))
            of: dict[str, Any] = {"label": marker.colorbar.title.text, "extend": "both"}
            bar = axes.figure.colorbar(ScalarMappable(norm, MAP_COLOURS), cax=inset, **of)
            bar.outline.set_visible(False)


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


def _paper_size(layout: Any, panels: int) -> tuple[float, float]:
    """Inches: panels are wide; a plane keeps its shape, with room for a bar and a legend."""
    if not layout.yaxis.scaleanchor:
        return 11.0, 1.6 + 2.0 * panels
    (left, right), (low, high) = layout.xaxis.range, layout.yaxis.range
    # A straight road is long and thin; half its length keeps the picture readable.
    aspect = float(np.clip((high - low) / (right - left), 0.2, 5.0))
    height = float(np.clip(8.2 * aspect, 3.6, 9.0))
    return min(height / aspect, 16.0) + 2.4, height + 1.8


# --------------------------------------------------------------------------------------------
# A calibration: where its boards were seen, and the cameras

_CORNERS_INCHES = 4.5
_COLOURS = (SKY, ORANGE, VERMILLION, INK)
_PANEL_IN = 4.2


def draw_corners(
    path: Path, size: tuple[int, int], corners: Sequence[FloatArray], names: Sequence[str]
) -> None:
    """All corners of all images, side by side for each camera: empty parts are not calibrated.

    Args:
        path: the PNG to write.
        size: width and height of the images.
        corners: (n, 2) pixels, of each camera.
        names: of the cameras.

    Raises:
        OutputError: the file cannot be written.
    """
    width, height = size
    tall = _CORNERS_INCHES * height / width + 0.6
    with picture(path, _CORNERS_INCHES * len(corners), tall) as figure:
        panels = figure.subplots(1, len(corners), squeeze=False)[0]
        for axes, pixels, name in zip(panels, corners, names, strict=False):
            axes.plot(*pixels.T, ".", color=SKY, markersize=2.5)
            axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
            axes.set(title=f"{name}: {len(pixels)} corners", xticks=[], yticks=[])
            axes.spines[["top", "right"]].set_visible(True)


@dataclass(frozen=True, slots=True, eq=False)
class CameraDrawing:
    """What is drawn of a camera.

    Attributes:
        name: its title.
        size: width and height of its image, pixels.
        centre: (2,) principal point, pixels.
        outline: (k, 2) border of the rectified view in its image, pixels; empty without one.
        place: (4, 4) pose in the first camera.
        half_angle: half of its horizontal angle of view, radians.
    """

    name: str
    size: tuple[int, int]
    centre: FloatArray
    outline: FloatArray
    place: FloatArray
    half_angle: float


def draw_cameras(path: Path, title: str, cameras: Sequence[CameraDrawing]) -> None:
    """Writes a picture of the cameras' images, and of the cameras from above.

    From above: positions, axes and fields of view, x to the right and z ahead, in millimetres.

    Raises:
        OutputError: the file cannot be written.
    """
    count = len(cameras) + 1
    places = np.array([1e3 * camera.place[:3, 3] for camera in cameras])
    reach = 0.6 * max(float(np.ptp(places[:, [0, 2]], axis=0).max()), 20.0)
    with picture(path, _PANEL_IN * count, _PANEL_IN) as canvas:
        canvas.suptitle(title)
        *panels, above = canvas.subplots(1, count, squeeze=False)[0]
        for k, (axes, camera) in enumerate(zip(panels, cameras, strict=True)):
            colour, (width, height) = _COLOURS[k % len(_COLOURS)], camera.size
            axes.add_patch(Rectangle((-0.5, -0.5), width, height, facecolor=FAINT, edgecolor=INK))
            axes.set_xlabel("px")
            if len(camera.outline):
                closed = np.concatenate([camera.outline, camera.outline[:1]])
                axes.plot(*closed.T, color=colour, linewidth=2.0)
                axes.set_xlabel("raw image, px; outline: the rectified view")
            axes.plot(*camera.centre, marker="+", color=INK, markersize=12)
            margin = 0.06 * max(width, height)
            axes.set(xlim=(-margin, width + margin), ylim=(height + margin, -margin))
            axes.set_aspect("equal")
            axes.set_title(camera.name[-28:], fontsize=11.0)
            x, _, z = places[k]
            half = min(camera.half_angle, np.radians(100.0))
            turns = np.linspace(-half, half, 31)
            rays = np.column_stack([np.sin(turns), np.zeros(31), np.cos(turns)])
            rim = reach * (rays @ camera.place[:3, :3].T)[:, [0, 2]] + [x, z]
            wedge = np.concatenate([[[x, z]], rim, [[x, z]]])
            above.fill(*wedge.T, color=colour, alpha=0.15)
            above.plot(*wedge.T, color=colour, linewidth=1.0)
            above.plot([x], [z], marker="o", color=colour)
            below = {"textcoords": "offset points", "xytext": (0, -16), "ha": "center"}
            above.annotate(str(k), (x, z), **below)
        above.set(aspect="equal", xlabel="right, mm", ylabel="ahead, mm")
        above.set_title("from above", fontsize=11.0)
        above.grid(visible=True)
