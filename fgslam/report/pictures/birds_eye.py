"""The map from above, with the robot's path, the truth and the uncertainties (Fig. 5 of Se et al.).

X (right) runs to the right and Z (ahead) up the page; height is upwards from the first camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.ticker import MaxNLocator

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import congruence
from fgslam.report.pictures.style import (
    BLUE,
    GREY,
    INK,
    MAP_COLOURS,
    ORANGE,
    VERMILLION,
    colour_bar,
    picture,
    white_rim,
)

_GROUND = [0, 2]  # X and Z of the world
_POSE_ELLIPSES = 25
_EXAGGERATIONS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
# Two dimensions: this many standard deviations hold 95 % of a Gaussian.
_SIGMAS_95 = 2.4477


@dataclass(frozen=True, slots=True, eq=False)
class MapDrawing:
    """What the pictures of a map show; all in one world, metres.

    Attributes:
        landmarks: (n, 3) positions.
        poses: (k, 4, 4) estimated ``wTc``.
        landmark_covariances: (n, 3, 3) or None.
        pose_covariances: (k, 6, 6), [rotation, translation] in the tangent space, or None.
        truth: (m, 4, 4) true ``wTc`` in the same world, or None.
        title: heading.
    """

    landmarks: FloatArray
    poses: FloatArray
    landmark_covariances: FloatArray | None = None
    pose_covariances: FloatArray | None = None
    truth: FloatArray | None = None
    title: str = ""


def draw_birds_eye(path: Path, drawing: MapDrawing) -> None:
    """The map from above, landmarks coloured by height.

    Ellipses hold 95 %; those of the poses are enlarged by a factor that the legend states.

    Args:
        path: the PNG to write.
        drawing: what to show.

    Raises:
        OutputError: the file cannot be written.
    """
    x_limits, z_limits = view_limits(drawing)
    width, height = figure_size(x_limits, z_limits)
    with picture(path, width, height) as figure:
        axes = figure.subplots()
        axes.set(xlim=x_limits, ylim=z_limits, aspect="equal")
        axes.set(xlabel="X, to the right (m)", ylabel="Z, ahead (m)")
        axes.grid(visible=True)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(MaxNLocator(nbins=9, steps=[1, 2, 5, 10]))
        _draw_landmarks(axes, drawing)
        _draw_paths(axes, drawing)
        axes.set_title(drawing.title or "Map from above", pad=24.0)
        note = f"{len(drawing.landmarks):,} landmarks"
        axes.annotate(note, (0.0, 1.0), (0.0, 8.0), "axes fraction", textcoords="offset points")
        figure.legend(loc="outside lower center", ncols=3, handlelength=2.6)


def view_limits(drawing: MapDrawing) -> tuple[tuple[float, float], tuple[float, float]]:
    """Limits of X and of Z: all of the paths, and the bulk of the landmarks.

    A few far landmarks of tiny disparity must not shrink the rest to a dot.
    """
    points = path_points(drawing)[:, _GROUND]
    low, high = points.min(axis=0), points.max(axis=0)
    if len(drawing.landmarks):
        ground = drawing.landmarks[:, _GROUND]
        low = np.minimum(low, np.percentile(ground, 1.5, axis=0))
        high = np.maximum(high, np.percentile(ground, 98.5, axis=0))
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    # A straight road is long and thin; half its length keeps the page readable.
    half = 1.06 * np.maximum(half, max(half.max() / 2.0, 0.5))
    left, right = centre - half, centre + half
    return (float(left[0]), float(right[0])), (float(left[1]), float(right[1]))


def path_points(drawing: MapDrawing) -> FloatArray:
    """Positions (m, 3) of both paths, after the world's origin, where every run starts."""
    truth = np.empty((0, 4, 4)) if drawing.truth is None else drawing.truth
    return np.concatenate([np.zeros((1, 3)), drawing.poses[:, :3, 3], truth[:, :3, 3]])


def world_position_covariances(poses: FloatArray, covariances: FloatArray) -> FloatArray:
    """Position covariances (k, 3, 3) in the world of poses with tangent covariances (k, 6, 6)."""
    return congruence(poses[:, :3, :3], covariances[:, 3:, 3:])


def figure_size(
    x_limits: tuple[float, float], z_limits: tuple[float, float]
) -> tuple[float, float]:
    """Inches of a picture of these limits, with room for a bar and a legend."""
    aspect = (z_limits[1] - z_limits[0]) / (x_limits[1] - x_limits[0])
    panel_height = float(np.clip(8.2 * aspect, 3.6, 9.0))
    return panel_height / aspect + 2.4, panel_height + 1.8


def _draw_landmarks(axes: Axes, drawing: MapDrawing) -> None:
    if len(drawing.landmarks) == 0:
        return
    ground, up = drawing.landmarks[:, _GROUND], -drawing.landmarks[:, 1]
    if drawing.landmark_covariances is not None:
        add_ellipses(
            axes,
            ground,
            drawing.landmark_covariances[:, _GROUND][:, :, _GROUND],
            color=GREY,
            alpha=0.22,
            linewidths=0.5,
            zorder=1.5,
            label="95 % of a landmark's position",
        )
    low, high = np.percentile(up, [2.0, 98.0])
    # The lowest first, so that what is above covers what is below, as seen from above.
    order = np.argsort(up, kind="stable")
    dots = axes.scatter(
        ground[order, 0],
        ground[order, 1],
        c=up[order],
        s=dot_size(len(up)),
        cmap=MAP_COLOURS,
        vmin=low,
        vmax=high,
        linewidths=0,
    )
    colour_bar(axes, dots, "height above the first camera (m)", extend="both")


def dot_size(count: int) -> float:
    """Area of a dot in points squared: dense maps get finer ones."""
    return float(np.clip(2.4e4 / max(count, 1), 2.0, 9.0))


def _draw_paths(axes: Axes, drawing: MapDrawing) -> None:
    if drawing.truth is not None:
        axes.plot(
            *drawing.truth[:, _GROUND, 3].T,
            color=ORANGE,
            linewidth=5.0,
            alpha=0.75,
            label="true path",
        )
    positions = drawing.poses[:, _GROUND, 3]
    axes.plot(
        *positions.T,
        color=INK,
        linewidth=1.8,
        linestyle=(0, (4, 2)),
        label="estimated path",
        path_effects=white_rim(1.8),
    )
    if drawing.pose_covariances is not None:
        _draw_pose_ellipses(axes, drawing, drawing.pose_covariances)
    axes.plot(
        *positions[:1].T, "+", color=VERMILLION, markersize=17, markeredgewidth=3.0, label="start"
    )
    axes.plot(
        *positions[-1:].T, "o", color=BLUE, markersize=8, markeredgecolor="white", label="end"
    )


def _draw_pose_ellipses(axes: Axes, drawing: MapDrawing, covariances: FloatArray) -> None:
    world = world_position_covariances(drawing.poses, covariances)
    ground = world[:, _GROUND][:, :, _GROUND]
    known = np.flatnonzero(np.isfinite(ground).all(axis=(1, 2)))
    if len(known) == 0:
        return
    shown = known[np.unique(np.linspace(0, len(known) - 1, _POSE_ELLIPSES).astype(int))]
    factor = exaggeration(ground[shown], span=float(np.ptp(axes.get_xlim())))
    enlarged = f", drawn {factor} times larger" if factor > 1 else ""
    add_ellipses(
        axes,
        drawing.poses[shown][:, _GROUND, 3],
        factor**2 * ground[shown],
        color=VERMILLION,
        alpha=0.9,
        linewidths=1.2,
        zorder=2.5,
        label=f"95 % of a robot position{enlarged}",
    )


def exaggeration(covariances: FloatArray, span: float) -> int:
    """Factor that makes the larger half of the ellipses at least 2 % of ``span`` wide."""
    width = 2.0 * _SIGMAS_95 * np.sqrt(np.maximum(np.linalg.eigvalsh(covariances)[:, -1], 0.0))
    typical = float(np.percentile(width, 75.0))
    for factor in _EXAGGERATIONS:
        if factor * typical >= 0.02 * span:
            return factor
    return 1 if typical == 0.0 else _EXAGGERATIONS[-1]


def add_ellipses(
    axes: Axes,
    centres: FloatArray,
    covariances: FloatArray,
    *,
    label: str,
    color: str,
    alpha: float,
    linewidths: float,
    zorder: float,
) -> None:
    """Outlines of the 95 % ellipses of (n, 2, 2) covariances, in the axes' units."""
    variances, directions = np.linalg.eigh(covariances)
    diameters = 2.0 * _SIGMAS_95 * np.sqrt(np.maximum(variances, 0.0))
    angles = np.degrees(np.arctan2(directions[:, 1, 1], directions[:, 0, 1]))
    ellipses = EllipseCollection(
        diameters[:, 1],
        diameters[:, 0],
        angles,
        units="xy",
        offsets=centres,
        offset_transform=axes.transData,
        facecolors="none",
        edgecolors=color,
        linewidths=linewidths,
        alpha=alpha,
        zorder=zorder,
    )
    axes.add_collection(ellipses, autolim=False)
    axes.plot([], [], color=color, linewidth=1.4, label=label)
