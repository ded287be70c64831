"""Frames of a film: what the camera sees and matches, beside the map from above as it grows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import matplotlib.style
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from fgslam.core.arrays import FloatArray, Image
from fgslam.report.content import bulk_limits
from fgslam.report.pictures.style import INK, ORANGE, PICTURE_STYLE, SKY, YELLOW, show_image

_INCHES = (12.8, 5.4)
_DPI = 100  # 1280 x 540


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One frame.

    Attributes:
        image: what the reference camera saw; None where it cannot be read.
        before, after: (k, 2) pixels of the matched landmarks in the last frame and in this one.
        new: (l, 2) pixels of landmarks seen for the first time.
        title: above the image.
    """

    image: Image | None
    before: FloatArray
    after: FloatArray
    new: FloatArray
    title: str


class FilmCanvas:
    """Draws moments one after the other onto one canvas.

    Args:
        path: (n, 2) metres to the right and ahead, of all poses.
        landmarks: (m, 2) all that will be drawn, for the limits.
        truth: (k, 2) true path, or None.
        title: above the map.
    """

    def __init__(
        self, path: FloatArray, landmarks: FloatArray, truth: FloatArray | None, title: str
    ) -> None:
        with matplotlib.style.context(PICTURE_STYLE, after_reset=True):
            self._figure = Figure(figsize=_INCHES, dpi=_DPI)
            self._canvas = FigureCanvasAgg(self._figure)
            self._image, plan = self._figure.subplots(1, 2, width_ratios=(1.15, 1.0))
            self._figure.subplots_adjust(0.02, 0.12, 0.98, 0.92, 0.13)
            x, y = _filling(bulk_limits(path, landmarks), plan.get_window_extent())
            plan.set(xlim=x, ylim=y, aspect="equal", title=title)
            plan.set(xlabel="right (m)", ylabel="ahead (m)")
            if truth is not None:
                plan.plot(*truth.T, "--", color=INK, linewidth=1.0, label="truth")
            (self._dots,) = plan.plot([], [], ".", color="#8a939c", markersize=2.0)
            (self._path,) = plan.plot([], [], color=SKY, linewidth=2.2, label="estimate")
            (self._here,) = plan.plot([], [], "o", color=ORANGE, markersize=7.0)
            plan.legend(loc="upper right")
        self._poses = path

    def draw(self, moment: Moment, known: FloatArray, row: int) -> Image:
        """The frame (540, 1280, 3) in red, green, blue, at pose ``row`` with landmarks (l, 2)."""
        with matplotlib.style.context(PICTURE_STYLE, after_reset=True):
            self._image.clear()
            if moment.image is None:
                self._image.set_axis_off()
                self._image.set_title(moment.title)
            else:
                show_image(self._image, moment.image, moment.title)
                self._mark(moment)
            self._dots.set_data(*known.T)
            self._path.set_data(*self._poses[: row + 1].T)
            self._here.set_data(*self._poses[row : row + 1].T)
            return drawn(self._canvas)

    def _mark(self, moment: Moment) -> None:
        axes = self._image
        flow = np.stack([moment.before, moment.after], axis=1)
        axes.add_collection(LineCollection(list(flow), linewidths=1.4, colors=SKY), autolim=False)
        axes.plot(
            *moment.after.T, "o", color=ORANGE, markersize=3.5, label="matched, with its motion"
        )
        axes.plot(*moment.new.T, "+", color=YELLOW, markersize=5.0, label="new landmark")
        legend = axes.legend(loc="upper left", bbox_to_anchor=(0.0, -0.01), ncols=2)
        legend.legend_handles[1].set_color(INK)  # yellow on white is hard to see


def drawn(canvas: FigureCanvasAgg) -> Image:
    """What a canvas shows, (height, width, 3) in red, green, blue."""
    agg: Any = canvas
    agg.draw()
    return np.asarray(agg.buffer_rgba())[..., :3].copy()


def _filling(limits: list[list[float]], panel: Bbox) -> FloatArray:
    """Limits (2, 2) with the shorter side widened to the panel's shape."""
    span = np.array(limits)
    size, room = np.diff(span)[:, 0], np.array([panel.width, panel.height])
    more = room * np.max(size / room) - size
    return np.column_stack([span[:, 0] - more / 2.0, span[:, 1] + more / 2.0])
