"""Where in the images a calibration board was seen."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fgslam.core.arrays import FloatArray
from fgslam.report.pictures.style import SKY, picture

_INCHES = 4.5


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
    tall = _INCHES * height / width + 0.6
    with picture(path, _INCHES * len(corners), tall) as figure:
        panels = figure.subplots(1, len(corners), squeeze=False)[0]
        for axes, pixels, name in zip(panels, corners, names, strict=False):
            axes.plot(*pixels.T, ".", color=SKY, markersize=2.5)
            axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
            axes.set(title=f"{name}: {len(pixels)} corners", xticks=[], yticks=[])
            for side in ("top", "right"):
                axes.spines[side].set_visible(True)
