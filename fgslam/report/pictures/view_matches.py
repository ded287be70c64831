"""Two omnidirectional views with their matches (fig. 2 of Goedemé et al. 2005)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import hsv_to_rgb

from fgslam.core.arrays import BoolArray, FloatArray, Image
from fgslam.report.pictures.style import picture

_WIDTH_IN = 9.0
_SHOWN_PX = 1100  # columns of a picture; more would not show
_DIMMED = 0.6


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
    with picture(path, _WIDTH_IN, 2.0 * (_WIDTH_IN * aspect + 0.4)) as figure:
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
    dimmed = (_DIMMED * image[::step, ::step]).astype(np.uint8)
    axes.imshow(dimmed, extent=(-0.5, width - 0.5, height - 0.5, -0.5))
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.set_title(title)


def _mark(axes: Axes, points: FloatArray, columns: BoolArray, colours: FloatArray) -> None:
    # Lists of tuples: the drawing library takes arrays, its types do not.
    tints = [tuple(colour) for colour in colours.tolist()]
    for number, (point, tint) in enumerate(zip(points.tolist(), tints, strict=True)):
        if columns[number]:
            axes.plot(*point, marker="|", markersize=9, markeredgewidth=1.6, color=tint)
        else:
            axes.plot(*point, marker="o", markersize=5, fillstyle="none", color=tint)
        axes.annotate(
            str(number), point, (3.0, 3.0), textcoords="offset points", color=tint, fontsize=5.5
        )
