"""An unwrapped view with the points that are tracked in it, and where they came from."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray, Image
from fgslam.report.pictures.style import SKY, VERMILLION, YELLOW, picture

_WIDTH_IN = 11.0
_DIMMED = 0.7


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
    with picture(path, _WIDTH_IN, _WIDTH_IN * height / width + 0.4) as figure:
        axes = figure.subplots()
        axes.imshow((_DIMMED * view).astype(np.uint8), cmap="gray", vmin=0, vmax=255)
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
