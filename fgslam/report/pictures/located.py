"""Poses found in a map without a prior, from above: where it is known, and where it is not."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.report.pictures.birds_eye import (
    MapDrawing,
    add_ellipses,
    dot_size,
    exaggeration,
    figure_size,
    view_limits,
    world_position_covariances,
)
from fgslam.report.pictures.style import BLUE, GREY, INK, ORANGE, VERMILLION, add_segments, picture

_GROUND = [0, 2]  # X and Z of the world
_HEADING = 0.025  # length of a heading, as a share of the picture


@dataclass(frozen=True, slots=True, eq=False)
class LocatedDrawing:
    """What the picture shows; all in the map's world, metres.

    Attributes:
        landmarks: (m, 3) positions.
        path: (k, 4, 4) poses of the drive that made the map.
        found: (n,) whether the query's pose is believed.
        poses: (n, 4, 4) poses found; anything where refused.
        covariances: (n, 6, 6) of them, in the tangent space.
        truth: (n, 4, 4) true poses; NaN where unknown.
        false: (n,) believed and somewhere else.
        title: heading.
    """

    landmarks: FloatArray
    path: FloatArray
    found: BoolArray
    poses: FloatArray
    covariances: FloatArray
    truth: FloatArray
    false: BoolArray
    title: str


def draw_located(path: Path, drawing: LocatedDrawing) -> None:
    """The map from above with the poses found in it.

    Dots with their headings are poses believed, with 95 % ellipses, enlarged by a factor that the
    legend states; crosses are true poses of queries that were refused; lines lead from false poses
    to the true ones.

    Raises:
        OutputError: the file cannot be written.
    """
    known = np.asarray(np.isfinite(drawing.truth).all(axis=(1, 2)))
    shown = np.concatenate([drawing.poses[drawing.found], drawing.truth[known], drawing.path])
    x_limits, z_limits = view_limits(MapDrawing(drawing.landmarks, shown))
    with picture(path, *figure_size(x_limits, z_limits)) as figure:
        axes = figure.subplots()
        axes.set(xlim=x_limits, ylim=z_limits, aspect="equal")
        axes.set(xlabel="X, to the right (m)", ylabel="Z, ahead (m)")
        axes.grid(visible=True)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(nbins=9, steps=[1, 2, 5, 10]))
        axes.scatter(
            drawing.landmarks[:, 0],
            drawing.landmarks[:, 2],
            s=dot_size(len(drawing.landmarks)),
            color=GREY,
            alpha=0.5,
            linewidths=0,
            label="landmark",
        )
        axes.plot(
            *drawing.path[:, _GROUND, 3].T, color=INK, linewidth=0.8, alpha=0.5, label="drive"
        )
        _draw_queries(axes, drawing, known)
        axes.set_title(drawing.title)
        figure.legend(loc="outside lower center", ncols=3, handlelength=2.0)


def _draw_queries(axes: Axes, drawing: LocatedDrawing, known: BoolArray) -> None:
    length = _HEADING * float(np.ptp(axes.get_xlim()))
    right = drawing.found & ~drawing.false
    _draw_poses(axes, drawing.poses[right], length, BLUE, "found")
    _draw_poses(axes, drawing.poses[drawing.false], length, VERMILLION, "found, but false")
    _draw_poses(axes, drawing.truth[~drawing.found & known], length, ORANGE, "refused", "x")
    astray = drawing.false & known
    if astray.any():
        ends = drawing.poses[astray][:, _GROUND, 3], drawing.truth[astray][:, _GROUND, 3]
        add_segments(axes, np.stack(ends, axis=1), 1.0, color=VERMILLION)
    if right.any():
        covariances = world_position_covariances(drawing.poses[right], drawing.covariances[right])[
            :, _GROUND
        ][:, :, _GROUND]
        factor = exaggeration(covariances, span=float(np.ptp(axes.get_xlim())))
        enlarged = f", drawn {factor} times larger" if factor > 1 else ""
        add_ellipses(
            axes,
            drawing.poses[right][:, _GROUND, 3],
            factor**2 * covariances,
            color=BLUE,
            alpha=0.5,
            linewidths=0.8,
            zorder=2.5,
            label=f"95 % of a position{enlarged}",
        )


def _draw_poses(
    axes: Axes, poses: FloatArray, length: float, colour: str, label: str, marker: str = "o"
) -> None:
    if not len(poses):
        return
    at, ahead = poses[:, _GROUND, 3], poses[:, _GROUND, 2]
    axes.plot(*at.T, marker, color=colour, markersize=4.5, label=label, zorder=3.0)
    ticks = np.stack([at, at + length * ahead], axis=1)
    joined = np.concatenate([ticks, np.full((len(ticks), 1, 2), np.nan)], axis=1).reshape(-1, 2)
    axes.plot(*joined.T, color=colour, linewidth=1.2, zorder=3.0)
