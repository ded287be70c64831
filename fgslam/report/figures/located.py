"""Poses found in a saved map without a prior, from above: where it is known, and where not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.report.figures.traces import (
    SIGMAS,
    Figure,
    Owner,
    Switch,
    Trace,
    equal_axes,
    exaggeration,
    in_plane,
    line,
    outlines,
    thinned,
    trace,
    world_position_covariances,
    xy,
)
from fgslam.report.figures.trajectory import bulk_limits, level_axes

MAX_LANDMARKS = 6_000
_HEADING = 0.025  # length of a heading, as a share of the picture
_HOVER = "<b>%{fullData.name}</b><br>%{x:.2f} m right, %{y:.2f} m ahead<extra></extra>"


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """Answers of the relocalisation; all in the map's world, metres.

    Attributes:
        landmarks: (m, 3) positions.
        path: (k, 4, 4) poses of the drive that made the map.
        found: (n,) whether the query's pose was accepted.
        poses: (n, 4, 4) poses found; anything where refused.
        covariances: (n, 6, 6) of them, in the tangent space.
        truth: (n, 4, 4) true poses; NaN where unknown.
        false: (n,) accepted and somewhere else.
    """

    landmarks: FloatArray
    path: FloatArray
    found: BoolArray
    poses: FloatArray
    covariances: FloatArray
    truth: FloatArray
    false: BoolArray


def located_figure(located: Located, key: str, heading: str) -> Figure:
    """The map from above with the poses found in it, and the true poses of refused queries."""
    plane = level_axes(np.array([0.0, -1.0, 0.0]))[:2]
    known = np.asarray(np.isfinite(located.truth).all(axis=(1, 2)))
    shown = [located.poses[located.found], located.truth[known], located.path]
    x, y = bulk_limits(np.concatenate(shown)[:, :3, 3] @ plane.T, located.landmarks @ plane.T)
    span = max(x[1] - x[0], y[1] - y[0])
    right = located.found & ~located.false
    covariances = in_plane(
        world_position_covariances(located.poses[right], located.covariances[right]), plane
    )
    factor = exaggeration(covariances, span)
    ellipses = outlines(located.poses[right, :3, 3] @ plane.T, covariances, factor)
    return Figure(
        key,
        heading,
        "Dots with their headings: poses that were accepted, with ellipses of "
        f"{SIGMAS:.0f} standard deviations. "
        "Crosses: true poses of queries that were refused. Lines lead from false poses to the true "
        "ones. Grey: landmarks, and the drive that made the map.",
        (
            *_surroundings(located, plane),
            line(Owner("uncertainty", colour=0, when=("ellipses",)), ellipses, 1.0),
            *_answers(located, known, plane, _HEADING * span),
        ),
        equal_axes(ranges=(x, y)),
        (Switch("landmarks", "landmarks"), Switch("ellipses", "uncertainty")),
        note=f"Ellipses are drawn {factor} times larger." if factor > 1 else "",
    )


def _surroundings(located: Located, plane: FloatArray) -> Iterator[Trace]:
    rows = thinned(len(located.landmarks), MAX_LANDMARKS)
    points = located.landmarks[rows] @ plane.T
    owner = Owner("landmark", paint="grey", when=("landmarks",))
    yield _dots(owner, points, {"size": 3})
    yield line(Owner("drive of the map", paint="grey"), located.path[None, :, :3, 3] @ plane.T, 1.5)


def _answers(
    located: Located, known: BoolArray, plane: FloatArray, length: float
) -> Iterator[Trace]:
    for owner, poses, symbol in (
        (Owner("found", colour=0), located.poses[located.found & ~located.false], "circle"),
        (Owner("found, but false", colour=1), located.poses[located.false], "circle"),
        (Owner("refused", colour=4), located.truth[~located.found & known], "x-thin-open"),
    ):
        if len(poses):
            at, ahead = poses[:, :3, 3] @ plane.T, poses[:, :3, 2] @ plane.T
            yield _dots(owner, at, {"size": 7, "symbol": symbol})
            yield line(owner, np.stack([at, at + length * ahead], axis=1), 1.5)
    astray = located.false & known
    if astray.any():
        ends = np.stack([located.poses[astray, :3, 3], located.truth[astray, :3, 3]], axis=1)
        yield line(Owner("to the true pose", colour=1), ends @ plane.T, 1.0)


def _dots(owner: Owner, points: FloatArray, marker: dict[str, object]) -> Trace:
    return trace(owner, xy(points), mode="markers", marker=marker, hovertemplate=_HOVER)
