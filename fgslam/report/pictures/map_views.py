"""The map in three dimensions, in perspective from three sides (Fig. 6 of Se et al.)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PathCollection

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.report.pictures.birds_eye import MapDrawing, dot_size, path_points
from fgslam.report.pictures.style import (
    FAINT,
    INK,
    MAP_COLOURS,
    ORANGE,
    VERMILLION,
    colour_bar,
    picture,
    white_rim,
)

_NEAR = 0.05  # share of the viewing distance in front of which nothing is drawn
# Directions from the centre of the map to the viewer; world axes x right, y down, z ahead.
_VIEWS = {
    "From above": (np.array([0.0, -1.0, -0.32]), np.array([0.0, 0.0, 1.0])),
    "From the left": (np.array([-1.0, -0.55, -0.25]), np.array([0.0, -1.0, 0.0])),
    "From the right": (np.array([1.0, -0.55, -0.25]), np.array([0.0, -1.0, 0.0])),
}
_DISTANCE_IN_RADII = 2.6
_GRID_LINES = 12


@dataclass(frozen=True, slots=True, eq=False)
class Viewer:
    """A pinhole camera that looks at the map.

    Attributes:
        eye: (3,) its position in the world.
        axes: (3, 3) rows right, up and ahead, in the world.
        distance: from the eye to what it looks at, metres.
    """

    eye: FloatArray
    axes: FloatArray
    distance: float

    @staticmethod
    def looking_at(
        target: FloatArray, direction: FloatArray, up: FloatArray, distance: float
    ) -> Viewer:
        """A viewer ``distance`` metres from ``target`` towards ``direction``, ``up`` upright."""
        ahead = -direction / np.linalg.norm(direction)
        right = np.cross(ahead, up)
        right /= np.linalg.norm(right)
        return Viewer(
            target - distance * ahead, np.stack([right, np.cross(right, ahead), ahead]), distance
        )

    def project(self, points: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Where points (n, 3) appear on the page.

        Returns:
            Page coordinates (n, 2) in metres at the target's distance, x right and y up; the
            nearness (n,) relative to the target's; whether the point lies ahead (n,).
        """
        seen = (points - self.eye) @ self.axes.T
        ahead = seen[:, 2] > _NEAR * self.distance
        nearness = self.distance / np.where(ahead, seen[:, 2], self.distance)
        return seen[:, :2] * nearness[:, None], nearness, ahead


def draw_map_views(path: Path, drawing: MapDrawing) -> None:
    """The map from above, from the left and from the right, landmarks coloured by height.

    Args:
        path: the PNG to write.
        drawing: what to show; covariances are not drawn.

    Raises:
        OutputError: the file cannot be written.
    """
    low, high = _bounds(drawing)
    target, radius = 0.5 * (low + high), max(0.5 * float(np.linalg.norm(high - low)), 0.5)
    with picture(path, 17.0, 6.4) as figure:
        panels = figure.subplots(1, 3)
        for axes, (name, (direction, up)) in zip(panels, _VIEWS.items(), strict=True):
            viewer = Viewer.looking_at(target, direction, up, _DISTANCE_IN_RADII * radius)
            spacing = _draw_floor(axes, viewer, low, high)
            dots = _draw_scene(axes, viewer, drawing, low, high)
            axes.set(xticks=[], yticks=[])
            # All three panels keep their size, and so their titles one line.
            axes.set_aspect("equal", adjustable="datalim")
            axes.spines[:].set_visible(False)
            axes.set_title(name)
        if len(drawing.landmarks):
            colour_bar(panels[-1], dots, "height above the first camera (m)", extend="both")
        figure.suptitle(
            drawing.title or "Map in three dimensions",
            fontsize=16,
            fontweight="bold",
            x=0.01,
            ha="left",
        )
        note = f"{len(drawing.landmarks):,} landmarks; grid of {spacing:g} m"
        figure.supxlabel(note, fontsize=12.0)
        handles, labels = panels[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="upper right", ncols=3)


def _bounds(drawing: MapDrawing) -> tuple[FloatArray, FloatArray]:
    """Corners (3,), (3,) of the box around the paths and the bulk of the landmarks."""
    points = path_points(drawing)
    low, high = points.min(axis=0), points.max(axis=0)
    if len(drawing.landmarks):
        low = np.minimum(low, np.percentile(drawing.landmarks, 1.5, axis=0))
        high = np.maximum(high, np.percentile(drawing.landmarks, 98.5, axis=0))
    # A robot at rest still stands on a floor of a square metre.
    padding = np.maximum([0.5, 0.0, 0.5] - 0.5 * (high - low), 0.0)
    return low - padding, high + padding


def _draw_floor(axes: Axes, viewer: Viewer, low: FloatArray, high: FloatArray) -> float:
    """A level grid under the map, and the spacing of its lines in metres."""
    extent = float(max(high[0] - low[0], high[2] - low[2], 1.0))
    spacing = _round_up(extent / _GRID_LINES)
    x = spacing * np.arange(np.floor(low[0] / spacing), np.ceil(high[0] / spacing) + 1)
    z = spacing * np.arange(np.floor(low[2] / spacing), np.ceil(high[2] / spacing) + 1)
    along_z = [[[value, high[1], z[0]], [value, high[1], z[-1]]] for value in x]
    along_x = [[[x[0], high[1], value], [x[-1], high[1], value]] for value in z]
    lines = np.array(along_z + along_x)
    page, _, _ = viewer.project(lines.reshape(-1, 3))
    axes.add_collection(
        LineCollection(list(page.reshape(-1, 2, 2)), colors=FAINT, linewidths=0.9, zorder=0)
    )
    axes.autoscale_view()
    return spacing


def _draw_scene(
    axes: Axes, viewer: Viewer, drawing: MapDrawing, low: FloatArray, high: FloatArray
) -> PathCollection:
    margin = 0.1 * (high - low)
    inside = np.all((drawing.landmarks >= low - margin) & (drawing.landmarks <= high + margin), 1)
    landmarks = drawing.landmarks[inside]
    page, nearness, ahead = viewer.project(landmarks)
    # Far to near, so that the near ones cover the far ones.
    order = np.argsort(nearness, kind="stable")
    order = order[ahead[order]]
    dots = axes.scatter(
        page[order, 0],
        page[order, 1],
        c=-landmarks[order, 1],
        s=dot_size(len(landmarks)) * np.clip(nearness[order], 0.3, 3.0) ** 2,
        cmap=MAP_COLOURS,
        vmin=-high[1],
        vmax=max(-low[1], -high[1] + 1e-6),
        linewidths=0,
    )
    if drawing.truth is not None:
        _draw_line(axes, viewer, drawing.truth, color=ORANGE, linewidth=4.5, label="true path")
    _draw_line(
        axes,
        viewer,
        drawing.poses,
        color=INK,
        linewidth=1.6,
        linestyle="--",
        label="estimated path",
        path_effects=white_rim(1.6),
    )
    start, _, _ = viewer.project(drawing.poses[:1, :3, 3])
    axes.plot(*start.T, "+", color=VERMILLION, markersize=14, markeredgewidth=2.6, label="start")
    return dots


def _draw_line(axes: Axes, viewer: Viewer, poses: FloatArray, **style: Any) -> None:
    page, _, ahead = viewer.project(poses[:, :3, 3])
    axes.plot(*np.where(ahead[:, None], page, np.nan).T, **style)


def _round_up(length: float) -> float:
    """The next of 1, 2, 5, 10, ... times a power of ten."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= length * 0.999))
