"""A calibrated rig as a picture: each camera's image with the rectified view in it, and the rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from fgslam.core.arrays import FloatArray
from fgslam.report.pictures.style import FAINT, INK, ORANGE, SKY, VERMILLION, picture

_COLOURS = (SKY, ORANGE, VERMILLION, INK)
_PANEL_IN = 4.2


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
    """Writes the picture. Raises OutputError where it cannot be written."""
    count = len(cameras) + 1
    with picture(path, _PANEL_IN * count, _PANEL_IN) as canvas:
        canvas.suptitle(title)
        panels = canvas.subplots(1, count, squeeze=False)[0]
        for k, (axes, camera) in enumerate(zip(panels, cameras, strict=False)):
            _image(axes, camera, _COLOURS[k % len(_COLOURS)])
        _from_above(panels[-1], cameras)


def _image(axes: Axes, camera: CameraDrawing, colour: str) -> None:
    width, height = camera.size
    axes.add_patch(Rectangle((-0.5, -0.5), width, height, facecolor=FAINT, edgecolor=INK))
    if len(camera.outline):
        closed = np.concatenate([camera.outline, camera.outline[:1]])
        axes.plot(*closed.T, color=colour, linewidth=2.0)
    axes.plot(*camera.centre, marker="+", color=INK, markersize=12)
    margin = 0.06 * max(width, height)
    axes.set(xlim=(-margin, width + margin), ylim=(height + margin, -margin), aspect="equal")
    axes.set_title(camera.name[-28:], fontsize=11.0)
    axes.set_xlabel("raw image, px; outline: the rectified view" if len(camera.outline) else "px")


def _from_above(axes: Axes, cameras: Sequence[CameraDrawing]) -> None:
    """Positions, axes and fields of view, x to the right and z ahead, in millimetres."""
    places = np.array([1e3 * camera.place[:3, 3] for camera in cameras])
    reach = 0.6 * max(float(np.ptp(places[:, [0, 2]], axis=0).max()), 20.0)
    for k, camera in enumerate(cameras):
        x, _, z = places[k]
        colour = _COLOURS[k % len(_COLOURS)]
        half = min(camera.half_angle, np.radians(100.0))
        turns = np.linspace(-half, half, 31)
        rays = np.column_stack([np.sin(turns), np.zeros(31), np.cos(turns)])
        rim = reach * (rays @ camera.place[:3, :3].T)[:, [0, 2]] + [x, z]
        wedge = np.concatenate([[[x, z]], rim, [[x, z]]])
        axes.fill(*wedge.T, color=colour, alpha=0.15)
        axes.plot(*wedge.T, color=colour, linewidth=1.0)
        axes.plot([x], [z], marker="o", color=colour)
        axes.annotate(str(k), (x, z), textcoords="offset points", xytext=(0, -16), ha="center")
    axes.set(aspect="equal", xlabel="right, mm", ylabel="ahead, mm")
    axes.set_title("from above", fontsize=11.0)
    axes.grid(visible=True)
