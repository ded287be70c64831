"""Pictures and the frames of films, by matplotlib."""

from __future__ import annotations

import html
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from textwrap import shorten, wrap
from typing import Any

import matplotlib
import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize, hsv_to_rgb
from matplotlib.figure import Figure as Canvas
from matplotlib.patches import Circle, Polygon, Rectangle
from matplotlib.ticker import MaxNLocator

from fgslam.core.arrays import BoolArray, FloatArray, Image
from fgslam.core.files import replacing
from fgslam.report.content import Figure
from fgslam.report.overlays import INK, ORANGE, SKY, YELLOW, dimmed_range

VERMILLION = "#D55E00"
FAINT = "#DDDDDD"

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


def show_image(axes: Axes, image: Image, title: str, note: str = "") -> None:
    """An image, dimmed so that bright marks stand out (in colour: as it is), without axes."""
    height, width = image.shape[:2]
    darkest, span = dimmed_range(image)
    smooth: dict[str, Any] = {"interpolation": "bicubic", "interpolation_stage": "data"}
    axes.imshow(image, cmap="gray", vmin=darkest, vmax=darkest + span, **smooth)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.set_title(title)
    if note:
        axes.set_title(note, loc="right", fontweight="normal", fontsize=12.0)


def add_segments(axes: Axes, segments: FloatArray, width: float, colour: str) -> None:
    """Polylines (n, k, 2) with a dark rim, visible on bright and dark ground alike."""
    # Two collections: as an effect of its path each line would be drawn by itself, and ten times
    # as long.
    ends: dict[str, Any] = {"capstyle": "round", "joinstyle": "round"}
    paths = list(segments)
    for drawn in (
        LineCollection(paths, linewidths=width + 1.4, color="black", alpha=0.55, **ends),
        LineCollection(paths, linewidths=width, color=colour, **ends),
    ):
        axes.add_collection(drawn, autolim=False)


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
# Images with what was found in them

_PAIR_WIDTH_IN, _VIEW_WIDTH_IN, _SHEET_WIDTH_IN = 9.0, 11.0, 11.0
_SHEET_COLUMNS = 4
_SHOWN_PX = 1100  # columns of a picture; more would not show
_PAIR_DIMMED, _VIEW_DIMMED = 0.6, 0.7
_EDGE_PART = 0.04  # of a picture: a mark with its number is no wider, nor as high


def draw_view_matches(
    path: Path,
    images: tuple[Image, Image],
    pixels: tuple[FloatArray, FloatArray],
    columns: BoolArray,
    titles: tuple[str, str],
) -> None:
    """One picture above the other, each match with a number of its own colour in both.

    Args:
        path: of the PNG.
        images: (h, w, 3) red, green, blue.
        pixels: (n, 2) column and row of the accepted matches in either, from centre to centre.
        columns: (n,) which are column segments: drawn as bars, the others as rings.
        titles: above each picture.

    Raises:
        OutputError: the file cannot be written.
    """
    aspect = images[0].shape[0] / images[0].shape[1]
    with picture(path, _PAIR_WIDTH_IN, 2.0 * (_PAIR_WIDTH_IN * aspect + 0.4)) as figure:
        # Neighbours in bearing get neighbouring hues, so that a wrong match stands out.
        order = np.argsort(np.argsort(pixels[0][:, 0]))
        hue = order / max(len(order), 1)
        colours = hsv_to_rgb(np.column_stack([hue, np.ones(len(hue)), np.ones(len(hue))]))
        panels = zip(figure.subplots(2, 1), images, pixels, titles, strict=True)
        for axes, image, points, title in panels:
            step = max(1, image.shape[1] // _SHOWN_PX)
            height, width = image.shape[:2]
            dimmed = (_PAIR_DIMMED * image[::step, ::step]).astype(np.uint8)
            axes.imshow(dimmed, extent=(-0.5, width - 0.5, height - 0.5, -0.5))
            axes.set(xticks=[], yticks=[], title=title)
            axes.spines[:].set_visible(False)
            # Marks may reach beyond the picture near its edge; the layout need not measure others.
            off = np.abs((points + 0.5) / [width, height] - 0.5)
            outer = np.asarray((off > 0.5 - _EDGE_PART).any(axis=1))
            for number, point in enumerate(points.tolist()):
                tint: Any = tuple(colours[number].tolist())
                mark: dict[str, Any] = {"color": tint, "in_layout": bool(outer[number])}
                if columns[number]:
                    axes.plot(*point, marker="|", markersize=9, markeredgewidth=1.6, **mark)
                else:
                    axes.plot(*point, marker="o", markersize=5, fillstyle="none", **mark)
                place: dict[str, Any] = {"textcoords": "offset points", "fontsize": 5.5}
                axes.annotate(str(number), point, (3.0, 3.0), **place, **mark)


def draw_view_tracks(path: Path, view: Image, trails: Sequence[FloatArray], title: str) -> None:
    """Each point with its trail; those that are new are red.

    Args:
        path: of the PNG.
        view: (h, w) grey panorama; its last column is followed by its first.
        trails: (k, 2) column and row of one point in the last k images, the present one last.
        title: above it.

    Raises:
        OutputError: the file cannot be written.
    """
    height, width = view.shape
    with picture(path, _VIEW_WIDTH_IN, _VIEW_WIDTH_IN * height / width + 0.4) as figure:
        axes = figure.subplots()
        axes.imshow((_VIEW_DIMMED * view).astype(np.uint8), cmap="gray", vmin=0, vmax=255)
        for trail in trails:
            # Parts between crossings of the seam.
            seams = np.flatnonzero(np.abs(np.diff(trail[:, 0])) > width / 2.0) + 1
            for part in np.split(trail, seams):
                axes.plot(part[:, 0], part[:, 1], color=YELLOW, linewidth=0.7)
            tint = SKY if len(trail) > 1 else VERMILLION
            axes.plot(*trail[-1].tolist(), "o", markersize=3.5, fillstyle="none", color=tint)
        axes.set(xticks=[], yticks=[], xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
        axes.set_title(title)


def draw_sheet(path: Path, images: Sequence[Image], titles: Sequence[str]) -> None:
    """Pictures side by side, row after row.

    Args:
        path: of the PNG.
        images: (h, w, 3) red, green, blue; at least one.
        titles: above each.

    Raises:
        OutputError: the file cannot be written.
    """
    across = min(_SHEET_COLUMNS, len(images))
    down = -(-len(images) // across)
    aspect = images[0].shape[0] / images[0].shape[1]
    height = down * (_SHEET_WIDTH_IN / across * aspect + 0.35)
    with picture(path, _SHEET_WIDTH_IN, height) as figure:
        every = figure.subplots(down, across, squeeze=False).ravel()
        for axes, image, title in zip(every, images, titles, strict=False):
            step = max(1, image.shape[1] // _SHOWN_PX)
            show_image(axes, image[::step, ::step], title)
        for axes in every[len(images) :]:
            axes.set_visible(False)


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


# --------------------------------------------------------------------------------------------
# Frames of films, one after the other onto one canvas

_ROUTE_INCHES = (12.8, 7.2)
_FILM_DPI = 100  # 1280 x 720
_DOTS = "#8a939c"
_styled = matplotlib.style.context(PICTURE_STYLE, after_reset=True)


_MOST_NAMED = 25  # path images whose numbers stand below the route
_LINE = 26  # letters of a reason in a line
_LINES = 5


@dataclass(frozen=True, slots=True, eq=False)
class PathPicture:
    """What is shown of a path image.

    Attributes:
        name: for people.
        size: columns and rows of its picture.
        features: (k, 2) pixels of the features that are remembered; NaN where not in view.
        image: the picture itself; None where only the features are at hand.
    """

    name: str
    size: tuple[int, int]
    features: FloatArray
    image: Image | None


class RouteCanvas:
    """A route that is followed: image, path image, homing vector and place."""

    @_styled
    def __init__(self, path: Sequence[PathPicture]) -> None:
        """Takes what is shown of each path image, in order."""
        self._path = path
        self._figure = Canvas(figsize=_ROUTE_INCHES, dpi=_FILM_DPI)
        FigureCanvasAgg(self._figure)
        grid = self._figure.add_gridspec(
            3, 2, width_ratios=(1.75, 1.0), height_ratios=(1.0, 1.0, 0.16),
            left=0.02, right=0.98, top=0.94, bottom=0.06, wspace=0.06, hspace=0.22,
        )  # fmt: skip
        places = (grid[:2, 0], grid[0, 1], grid[1, 1], grid[2, :])
        self._panels = [self._figure.add_subplot(place) for place in places]

    @_styled
    def draw(
        self,
        row: Mapping[str, Any],
        image: Image | None,
        lines: tuple[FloatArray, FloatArray],
        command: str,
    ) -> Image:
        """The frame (720, 1280, 3) in red, green, blue.

        Args:
            row: of follow.csv by name of the column; numbers are NaN where they are not known.
            image: as recorded; None where it cannot be read.
            lines: (m, 2) pixels along the heading, and along the homing vector; NaN where not in
                view.
            command: speed and turning rate, or why there is no homing vector.
        """
        nearest, target = (
            int(row[column]) if np.isfinite(row[column]) else None
            for column in ("path_image", "target")
        )
        title = f"{row['name']} at {row['time_s']:.1f} s"
        for axes in self._panels:
            axes.clear()
        seen, remembered, compass, route = self._panels
        if image is None:
            seen.set_axis_off()
            seen.set_title(title)
        else:
            show_image(seen, image, title, "white: ahead, orange: home")
            add_segments(seen, lines[0][None], 1.2, "white")
            if np.isfinite(lines[1]).any():
                add_segments(seen, lines[1][None], 2.5, ORANGE)
        if nearest is None:
            remembered.set_axis_off()
            remembered.set_title("Path image: not known")
        else:
            _draw_remembered(remembered, self._path[nearest], nearest)
        _draw_compass(compass, row, command)
        _draw_route(route, nearest, target, row["probability"], len(self._path) - 1)
        agg: Any = self._figure.canvas
        agg.draw()
        return np.asarray(agg.buffer_rgba())[..., :3].copy()


def _draw_remembered(axes: Axes, shown: PathPicture, number: int) -> None:
    title = f"Path image {number}: {shorten(shown.name, 24, placeholder='...')}"
    if shown.image is not None:
        show_image(axes, shown.image, title)
        return
    columns, rows = shown.size
    axes.plot(*shown.features.T, ".", color=SKY, markersize=3.0)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), xticks=[], yticks=[])
    axes.set(aspect="equal", facecolor="#f4f4f4", xlabel="its features: no picture is kept")
    axes.set_title(title)


def _draw_compass(axes: Axes, row: Mapping[str, Any], command: str) -> None:
    """The robot from above, ahead is up: an arrow home with its deviation, and the command."""
    axes.add_patch(Circle((0.0, 0.0), 1.0, fill=False, color=FAINT, linewidth=1.5))
    axes.add_patch(Polygon([[-0.1, -0.1], [0.1, -0.1], [0.0, 0.16]], color=INK))
    axes.text(0.0, 1.06, "ahead", ha="center", va="bottom", fontsize=10.0)
    direction, sigma = np.deg2rad([row["direction_deg"], row["sigma_direction_deg"]]).tolist()
    if np.isfinite(direction):
        around = direction + sigma * np.linspace(-1.0, 1.0, 21)
        rim = np.column_stack([-np.sin(around), np.cos(around)])
        axes.add_patch(Polygon([[0.0, 0.0], *rim.tolist()], color=ORANGE, alpha=0.3))
        tip = (-np.sin(direction), np.cos(direction))
        arrow = {"arrowstyle": "-|>", "color": ORANGE, "linewidth": 3.0, "mutation_scale": 22.0}
        axes.annotate("", xy=tip, xytext=(0.0, 0.0), arrowprops=arrow)
    lines = [part for line in command.splitlines() for part in wrap(line, _LINE)]
    if len(lines) > _LINES:
        lines = [*lines[: _LINES - 1], lines[_LINES - 1] + " ..."]
    colour = VERMILLION if row["refusal"] and row["state"] != "arrived" else INK
    axes.text(1.3, 0.0, "\n".join(lines), va="center", color=colour, linespacing=1.5)
    axes.set(xlim=(-1.2, 4.3), ylim=(-1.15, 1.3), aspect="equal", anchor="W")
    axes.set_axis_off()
    axes.set_title("Homing vector")


def _draw_route(
    axes: Axes, nearest: int | None, target: int | None, probability: float, last: int
) -> None:
    """The path images in a row; where the robot is, and where it goes next."""
    axes.plot([0, last], [0, 0], color=FAINT, linewidth=3.0, zorder=1)
    axes.plot(np.arange(last + 1), np.zeros(last + 1), "o", color=_DOTS, markersize=7.0)
    title = "Place: not known"
    if nearest is not None:
        axes.plot(nearest, 0.0, "o", color=SKY, markersize=15.0)
        title = f"Place: path image {nearest}, probability {100 * probability:.0f} %"
    if target is not None and target != nearest:
        ring: dict[str, Any] = {"fillstyle": "none", "color": ORANGE, "markeredgewidth": 2.5}
        axes.plot(target, 0.0, "o", markersize=20.0, **ring)
        title += f"; next {target}"
    axes.set(xlim=(-0.5, last + 0.5), ylim=(-1.0, 1.0), yticks=[], title=title)
    axes.set_xticks(np.arange(0, last + 1, -(-(last + 1) // _MOST_NAMED)))
    axes.tick_params(length=0.0)
    axes.spines[:].set_visible(False)
