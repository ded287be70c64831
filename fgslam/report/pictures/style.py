"""How all pictures look, and how they are written: one canvas at a time, no global state kept."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.files import replacing

# Okabe and Ito's colours, which the colour-blind can tell apart.
ORANGE = "#E69F00"
SKY = "#56B4E9"
YELLOW = "#F0E442"
VERMILLION = "#D55E00"
INK = "#222222"
FAINT = "#DDDDDD"

MAP_COLOURS = "viridis"
"""Perceptually uniform, readable without colour vision and in grey print."""

DPI = 160

_NO_METADATA: dict[str, Any] = {"Software": None}
_PACKING: dict[str, Any] = {"compress_level": 3}  # half the time of 6, the same size within a tenth
# On the screen whites become this grey, so that bright marks stand out on windows and posters.
_WHITE = 0.78

PICTURE_STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 12.0,
    "axes.titlesize": 14.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 12.0,
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.8,
    "axes.axisbelow": True,
    "axes.xmargin": 0.01,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.unicode_minus": True,
    "text.color": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "xtick.labelsize": 11.0,
    "ytick.labelsize": 11.0,
    "grid.color": FAINT,
    "grid.linewidth": 0.8,
    "legend.fontsize": 11.0,
    "legend.frameon": False,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "path.simplify": False,
}


@contextmanager
def picture(path: Path, width: float, height: float) -> Iterator[Figure]:
    """A figure of the given size in inches, written to ``path`` when the block ends well.

    Neither the user's matplotlibrc nor the state of pyplot has a say, and no date or version
    enters the file, so that the bytes depend on the input only.

    Raises:
        OutputError: the file cannot be written.
    """
    with matplotlib.style.context(PICTURE_STYLE, after_reset=True):
        figure = Figure(figsize=(width, height), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
        with replacing(path) as partial:
            figure.savefig(
                partial,
                format="png",
                bbox_inches="tight",
                pad_inches=0.1,
                metadata=_NO_METADATA,
                pil_kwargs=_PACKING,
            )


def show_image(axes: Axes, image: Image, title: str, note: str = "") -> None:
    """An image, dimmed so that bright marks stand out (in colour: as it is), without axes."""
    height, width = image.shape[:2]
    darkest, brightest = np.percentile(image, [0.5, 99.5])
    span = max(float(brightest - darkest), 32.0) / _WHITE
    axes.imshow(
        image,
        cmap="gray",
        vmin=darkest,
        vmax=darkest + span,
        interpolation="bicubic",
        interpolation_stage="data",
    )
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
    axes.set_title(title)
    if note:
        axes.set_title(note, loc="right", fontweight="normal", fontsize=12.0)


def colour_bar(axes: Axes, colours: ScalarMappable, label: str, extend: str = "neither") -> None:
    """A colour bar exactly as tall as the axes, whatever their aspect."""
    inset = axes.inset_axes((1.02, 0.0, 0.022, 1.0))
    figure = axes.get_figure(root=True)
    if figure is None:
        raise ValueError("these axes belong to no figure")
    bar = figure.colorbar(colours, cax=inset, label=label, extend=extend)
    bar.outline.set_visible(False)


def add_segments(axes: Axes, segments: FloatArray, width: float, **colours: Any) -> LineCollection:
    """Polylines (n, k, 2) with a dark rim, visible on bright and dark ground alike.

    ``colours`` are those of a LineCollection (`color`, or `array`, `cmap` and `norm`).
    """
    # Two collections: as an effect of its path each line would be drawn by itself, and ten times
    # as long.
    ends: dict[str, Any] = {"capstyle": "round", "joinstyle": "round"}
    paths = list(segments)
    rims = LineCollection(paths, linewidths=width + 1.4, color="black", alpha=0.55, **ends)
    lines = LineCollection(paths, linewidths=width, **ends, **colours)
    for drawn in (rims, lines):
        axes.add_collection(drawn, autolim=False)
    return lines
