"""Pictures on images: features, disparities, flow (Figs. 1 to 3 of Se et al.), matches, tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm, Normalize, hsv_to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullLocator, ScalarFormatter

from fgslam.core.arrays import BoolArray, FloatArray, Image
from fgslam.core.features import Features
from fgslam.report.pictures.style import (
    INK,
    ORANGE,
    SKY,
    VERMILLION,
    YELLOW,
    add_segments,
    colour_bar,
    picture,
    show_image,
)

_CAMERAS = ("Right", "Left", "Top")
# The descriptor looks at a window of about twelve scales; a square of four stays readable.
_SQUARE_SIDE_IN_SCALES = 4.0
# Wider images than this are stacked rather than set side by side.
_PANORAMIC_ASPECT = 2.2
_IMAGE_INCHES = 5.6
# Without the dark end, which would be lost in the shadows of the image.
_DISPARITY_COLOURS = ListedColormap(matplotlib.colormaps["plasma"](np.linspace(0.3, 1.0, 256)))


def draw_features(
    path: Path, images: tuple[Image, ...], features: tuple[Features, ...], title: str = ""
) -> None:
    """SIFT features as squares: side proportional to scale, turned by orientation (Fig. 1).

    Args:
        path: the PNG to write.
        images: (height, width) uint8, in the order right, left[, top]; drawn as top, left, right.
        features: of each image, or of the first ones alone: only these are drawn.
        title: heading of the whole picture, e.g. the frame.

    Raises:
        OutputError: the file cannot be written.
    """
    order = tuple(reversed(range(len(features))))
    stacked = images[0].shape[1] > _PANORAMIC_ASPECT * images[0].shape[0]
    rows, columns = (len(order), 1) if stacked else (1, len(order))
    width, height = _size(images[0], rows, columns, bool(title))
    with picture(path, width, height) as figure:
        panels = figure.subplots(rows, columns, squeeze=False).ravel()
        for axes, camera in zip(panels, order, strict=True):
            show_image(axes, images[camera], _CAMERAS[camera], f"{len(features[camera])} features")
            add_segments(axes, oriented_squares(features[camera]), 1.1, color=YELLOW)
        _heading(figure, title)


def oriented_squares(features: Features) -> FloatArray:
    """Outlines (n, 7, 2): once around the square, then a stroke from its centre ahead."""
    corners = np.array([[1, 0], [1, 1], [-1, 1], [-1, -1], [1, -1], [1, 0], [0, 0]], dtype=float)
    half = 0.5 * _SQUARE_SIDE_IN_SCALES * features.scale[:, None]
    ahead = half * np.column_stack([np.cos(features.orientation), np.sin(features.orientation)])
    # A quarter turn clockwise on the screen, where rows grow downwards.
    aside = np.column_stack([-ahead[:, 1], ahead[:, 0]])
    offsets = corners[None, :, :1] * ahead[:, None] + corners[None, :, 1:] * aside[:, None]
    return np.asarray(features.xy[:, None] + offsets)


def draw_disparities(path: Path, image: Image, pixels: FloatArray, title: str = "") -> None:
    """Matches over the cameras: lines as long as the disparities, coloured by them (Fig. 2).

    Args:
        path: the PNG to write.
        image: the reference (right) image, (height, width) uint8.
        pixels: (n, 3, 2) raw (column, row) in right, left and top image; NaN without a top one.
        title: heading, e.g. the frame.

    Raises:
        OutputError: the file cannot be written.
    """
    horizontal = pixels[:, 1, 0] - pixels[:, 0, 0]
    vertical = pixels[:, 2, 1] - pixels[:, 0, 1]
    trinocular = bool(np.isfinite(vertical).any())
    colours: dict[str, Any] = {"cmap": _DISPARITY_COLOURS, "norm": _disparity_norm(horizontal)}
    width, height = _size(image, 1, 1, has_title=True, inches=9.0)
    with picture(path, width + 1.2, height) as figure:
        axes = figure.subplots()
        show_image(axes, image, title or "Stereo matches", f"{len(pixels)} matches")
        start = pixels[:, 0]
        lines = add_segments(axes, _rays(start, horizontal, 0), 1.6, array=horizontal, **colours)
        if trinocular:
            add_segments(axes, _rays(start, vertical, 1), 1.6, array=horizontal, **colours)
        axes.scatter(
            start[:, 0],
            start[:, 1],
            s=16,
            c=horizontal,
            edgecolors="black",
            linewidths=0.6,
            **colours,
        )
        colour_bar(axes, lines, "horizontal disparity (px)")
        if isinstance(colours["norm"], LogNorm):
            scale = axes.child_axes[0].yaxis
            scale.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            scale.set_major_formatter(ScalarFormatter())
            scale.set_minor_locator(NullLocator())


def draw_flow(
    path: Path, image: Image, before: FloatArray, after: FloatArray, title: str = ""
) -> None:
    """How matched features moved between two frames: dot, line, cross (Fig. 3).

    Args:
        path: the PNG to write.
        image: the earlier frame's reference image, (height, width) uint8.
        before: (n, 2) (column, row) in the earlier frame, pixels.
        after: (n, 2) in the later frame.
        title: heading, e.g. the frames and the motion between them.

    Raises:
        OutputError: the file cannot be written.
    """
    length = np.linalg.norm(after - before, axis=1)
    note = f"{len(before)} matches"
    if len(before):
        note += f", median flow {np.median(length):.1f} px"
    width, height = _size(image, 1, 1, has_title=True, inches=9.0)
    with picture(path, width, height + 0.15) as figure:
        axes = figure.subplots()
        show_image(axes, image, title or "Flow between frames", note)
        add_segments(axes, np.stack([before, after], axis=1), 1.6, color=SKY)
        cross: dict[str, Any] = {"s": 42, "marker": "x", "zorder": 4}
        axes.scatter(
            before[:, 0], before[:, 1], s=26, c=YELLOW, edgecolors="black", linewidths=0.7, zorder=3
        )
        axes.scatter(after[:, 0], after[:, 1], c="black", alpha=0.6, linewidths=3.4, **cross)
        axes.scatter(after[:, 0], after[:, 1], c=ORANGE, linewidths=1.8, **cross)
        figure.legend(handles=_flow_legend(), loc="outside lower center", ncols=3)


def _flow_legend() -> list[Line2D]:
    dot: dict[str, Any] = {
        "marker": "o",
        "markeredgecolor": INK,
        "color": YELLOW,
        "linestyle": "none",
    }
    cross: dict[str, Any] = {
        "marker": "x",
        "color": ORANGE,
        "linestyle": "none",
        "markeredgewidth": 2.0,
    }
    return [
        Line2D([], [], label="position in the earlier frame", markersize=7, **dot),
        Line2D([], [], label="position in the later frame", markersize=8, **cross),
        Line2D([], [], label="motion", color=SKY, linewidth=2.0),
    ]


def _rays(start: FloatArray, length: FloatArray, axis: int) -> FloatArray:
    """Segments (n, 2, 2) from ``start`` along +column (0) or +row (1)."""
    end = start.copy()
    end[:, axis] += length
    return np.stack([start, end], axis=1)


def _disparity_norm(disparity: FloatArray) -> Normalize:
    """Logarithmic where disparities span a wide range, so that far features differ too."""
    if len(disparity) == 0:
        return Normalize(0.0, 1.0)
    low, high = float(disparity.min()), float(disparity.max())
    if low > 0.0 and high > 8.0 * low:
        return LogNorm(low, high)
    return Normalize(low, max(high, low + 1.0))


def _size(
    image: Image, rows: int, columns: int, has_title: bool, inches: float = _IMAGE_INCHES
) -> tuple[float, float]:
    """Width and height of the figure in inches: panels of ``inches`` width, headings above."""
    height, width = image.shape
    if columns == 1:
        inches = max(inches, 9.0)
    panel = inches * height / width
    return columns * inches + 0.2, rows * (panel + 0.42) + (0.45 if has_title and rows else 0.0)


def _heading(figure: Figure, title: str) -> None:
    if title:
        figure.suptitle(title, fontsize=16, fontweight="bold", x=0.01, ha="left")


_PAIR_WIDTH_IN = 9.0
_SHOWN_PX = 1100  # columns of a picture; more would not show
_PAIR_DIMMED = 0.6
_EDGE_PART = 0.04  # of a picture: a mark with its number is no wider, nor as high


@dataclass(frozen=True, slots=True, eq=False)
class MatchedPixels:
    """Matches of two pictures.

    Attributes:
        a, b: (n, 2) column and row in either picture, from centre to centre.
        columns: (n,) which are column segments: drawn as bars, the others as rings.
    """

    a: FloatArray
    b: FloatArray
    columns: BoolArray


def draw_view_matches(
    path: Path, images: tuple[Image, Image], matches: MatchedPixels, titles: tuple[str, str]
) -> None:
    """One picture above the other, each match with a number of its own colour in both.

    Args:
        path: of the PNG.
        images: (h, w, 3) red, green, blue.
        matches: accepted ones.
        titles: above each picture.

    Raises:
        OutputError: the file cannot be written.
    """
    aspect = images[0].shape[0] / images[0].shape[1]
    with picture(path, _PAIR_WIDTH_IN, 2.0 * (_PAIR_WIDTH_IN * aspect + 0.4)) as figure:
        upper, lower = figure.subplots(2, 1)
        # Neighbours in bearing get neighbouring hues, so that a wrong match stands out.
        order = np.argsort(np.argsort(matches.a[:, 0]))
        hue = order / max(len(order), 1)
        colours = hsv_to_rgb(np.column_stack([hue, np.ones(len(hue)), np.ones(len(hue))]))
        for axes, image, points, title in (
            (upper, images[0], matches.a, titles[0]),
            (lower, images[1], matches.b, titles[1]),
        ):
            _show(axes, image, title)
            _mark(axes, points, matches.columns, colours)


def _show(axes: Axes, image: Image, title: str) -> None:
    step = max(1, image.shape[1] // _SHOWN_PX)
    height, width = image.shape[:2]
    dimmed = (_PAIR_DIMMED * image[::step, ::step]).astype(np.uint8)
    axes.imshow(dimmed, extent=(-0.5, width - 0.5, height - 0.5, -0.5))
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.set_title(title)


def _mark(axes: Axes, points: FloatArray, columns: BoolArray, colours: FloatArray) -> None:
    # Lists of tuples: the drawing library takes arrays, its types do not.
    tints = [tuple(colour) for colour in colours.tolist()]
    outer = _near_edge(axes, points).tolist()
    for number, (point, tint) in enumerate(zip(points.tolist(), tints, strict=True)):
        common: dict[str, Any] = {"color": tint, "in_layout": outer[number]}
        if columns[number]:
            axes.plot(*point, marker="|", markersize=9, markeredgewidth=1.6, **common)
        else:
            axes.plot(*point, marker="o", markersize=5, fillstyle="none", **common)
        axes.annotate(
            str(number), point, (3.0, 3.0), textcoords="offset points", fontsize=5.5, **common
        )


def _near_edge(axes: Axes, points: FloatArray) -> BoolArray:
    """(n,) which marks may reach beyond the picture (n, 2); the layout need not measure others."""
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    part = np.abs((points - [left, bottom]) / [right - left, top - bottom] - 0.5)
    return np.asarray((part > 0.5 - _EDGE_PART).any(axis=1))


_VIEW_WIDTH_IN = 11.0
_VIEW_DIMMED = 0.7


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
            for part in _unbroken(trail, width / 2.0):
                axes.plot(part[:, 0], part[:, 1], color=YELLOW, linewidth=0.7)
            tint = SKY if len(trail) > 1 else VERMILLION
            axes.plot(*trail[-1].tolist(), "o", markersize=3.5, fillstyle="none", color=tint)
        axes.set(xticks=[], yticks=[], xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
        axes.set_title(title)


def _unbroken(trail: FloatArray, most: float) -> list[FloatArray]:
    """Parts of a trail between crossings of the seam."""
    return np.split(trail, np.flatnonzero(np.abs(np.diff(trail[:, 0])) > most) + 1)


_SHEET_COLUMNS = 4
_SHEET_WIDTH_IN = 11.0


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
