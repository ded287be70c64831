"""Frames of a film of a route that is followed: the image, the path image, the command."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from textwrap import shorten, wrap

import matplotlib.style
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Polygon

from fgslam.core.arrays import FloatArray, Image
from fgslam.report.pictures.film import drawn
from fgslam.report.pictures.style import (
    FAINT,
    INK,
    ORANGE,
    PICTURE_STYLE,
    SKY,
    VERMILLION,
    add_segments,
    show_image,
)

_INCHES = (12.8, 7.2)
_DPI = 100  # 1280 x 720
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


@dataclass(frozen=True, slots=True, eq=False)
class RouteMoment:
    """One image, and what the robot is told at it.

    Attributes:
        image: as recorded; None where it cannot be read.
        title: above the image.
        nearest, probability: path image, and that it or a neighbour is the nearest; None where
            nothing is known of the place.
        target: path image to go to; None likewise.
        direction, sigma: of the homing vector from the heading, to the left positive, and its
            deviation, radians; NaN where it is refused.
        beam, ahead: (m, 2) pixels along that direction, and along the heading, in the image; NaN
            where not in view.
        command: speed and turning rate, or why there is no homing vector.
        refused: whether it is the latter.
    """

    image: Image | None
    title: str
    nearest: int | None
    probability: float
    target: int | None
    direction: float
    sigma: float
    beam: FloatArray
    ahead: FloatArray
    command: str
    refused: bool


class RouteCanvas:
    """Draws moments one after the other onto one canvas.

    Args:
        path: what is shown of each path image, in order.
    """

    def __init__(self, path: Sequence[PathPicture]) -> None:
        self._path = path
        with matplotlib.style.context(PICTURE_STYLE, after_reset=True):
            self._figure = Figure(figsize=_INCHES, dpi=_DPI)
            self._canvas = FigureCanvasAgg(self._figure)
            grid = self._figure.add_gridspec(
                3, 2, width_ratios=(1.75, 1.0), height_ratios=(1.0, 1.0, 0.16),
                left=0.02, right=0.98, top=0.94, bottom=0.06, wspace=0.06, hspace=0.22,
            )  # fmt: skip
            self._image = self._figure.add_subplot(grid[:2, 0])
            self._remembered = self._figure.add_subplot(grid[0, 1])
            self._compass = self._figure.add_subplot(grid[1, 1])
            self._route = self._figure.add_subplot(grid[2, :])

    def draw(self, moment: RouteMoment) -> Image:
        """The frame (720, 1280, 3) in red, green, blue."""
        with matplotlib.style.context(PICTURE_STYLE, after_reset=True):
            for axes in (self._image, self._remembered, self._compass, self._route):
                axes.clear()
            _draw_image(self._image, moment)
            self._draw_remembered(moment)
            _draw_compass(self._compass, moment)
            self._draw_route(moment)
            return drawn(self._canvas)

    def _draw_remembered(self, moment: RouteMoment) -> None:
        axes = self._remembered
        if moment.nearest is None:
            axes.set_axis_off()
            axes.set_title("Path image: not known")
            return
        shown = self._path[moment.nearest]
        title = f"Path image {moment.nearest}: {shorten(shown.name, 24, placeholder='...')}"
        if shown.image is not None:
            show_image(axes, shown.image, title)
            return
        columns, rows = shown.size
        axes.plot(*shown.features.T, ".", color=SKY, markersize=3.0)
        axes.set(xlim=(-0.5, columns - 0.5), ylim=(rows - 0.5, -0.5), xticks=[], yticks=[])
        axes.set(aspect="equal", facecolor="#f4f4f4", xlabel="its features: no picture is kept")
        axes.set_title(title)

    def _draw_route(self, moment: RouteMoment) -> None:
        axes, last = self._route, len(self._path) - 1
        axes.plot([0, last], [0, 0], color=FAINT, linewidth=3.0, zorder=1)
        axes.plot(np.arange(last + 1), np.zeros(last + 1), "o", color="#8a939c", markersize=7.0)
        said = "Place: not known"
        if moment.nearest is not None:
            axes.plot(moment.nearest, 0.0, "o", color=SKY, markersize=15.0)
            said = (
                f"Place: path image {moment.nearest}, probability {100 * moment.probability:.0f} %"
            )
        if moment.target not in (None, moment.nearest):
            axes.plot(
                moment.target, 0.0, "o", markersize=20.0, fillstyle="none", color=ORANGE,
                markeredgewidth=2.5,
            )  # fmt: skip
            said += f"; next {moment.target}"
        step = -(-(last + 1) // _MOST_NAMED)
        axes.set(xlim=(-0.5, last + 0.5), ylim=(-1.0, 1.0), yticks=[])
        axes.set_xticks(np.arange(0, last + 1, step))
        axes.tick_params(length=0.0)
        axes.spines[:].set_visible(False)
        axes.set_title(said)


def _draw_image(axes: Axes, moment: RouteMoment) -> None:
    if moment.image is None:
        axes.set_axis_off()
        axes.set_title(moment.title)
        return
    show_image(axes, moment.image, moment.title, "white: ahead, orange: home")
    add_segments(axes, moment.ahead[None], 1.2, color="white")
    if np.isfinite(moment.beam).any():
        add_segments(axes, moment.beam[None], 2.5, color=ORANGE)


def _draw_compass(axes: Axes, moment: RouteMoment) -> None:
    """The robot from above, ahead is up: an arrow home with its deviation, and the command."""
    axes.add_patch(Circle((0.0, 0.0), 1.0, fill=False, color=FAINT, linewidth=1.5))
    axes.add_patch(Polygon([[-0.1, -0.1], [0.1, -0.1], [0.0, 0.16]], color=INK))
    axes.text(0.0, 1.06, "ahead", ha="center", va="bottom", fontsize=10.0)
    if np.isfinite(moment.direction):
        around = moment.direction + moment.sigma * np.linspace(-1.0, 1.0, 21)
        rim = np.column_stack([-np.sin(around), np.cos(around)])
        axes.add_patch(Polygon([[0.0, 0.0], *rim.tolist()], color=ORANGE, alpha=0.3))
        tip = (-np.sin(moment.direction), np.cos(moment.direction))
        arrow = {"arrowstyle": "-|>", "color": ORANGE, "linewidth": 3.0, "mutation_scale": 22.0}
        axes.annotate("", xy=tip, xytext=(0.0, 0.0), arrowprops=arrow)
    lines = [part for line in moment.command.splitlines() for part in wrap(line, _LINE)]
    if len(lines) > _LINES:
        lines = [*lines[: _LINES - 1], lines[_LINES - 1] + " ..."]
    colour = VERMILLION if moment.refused else INK
    axes.text(1.3, 0.0, "\n".join(lines), va="center", color=colour, linespacing=1.5)
    axes.set(xlim=(-1.2, 4.3), ylim=(-1.15, 1.3), aspect="equal", anchor="W")
    axes.set_axis_off()
    axes.set_title("Homing vector")
