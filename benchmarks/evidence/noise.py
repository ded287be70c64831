"""SIFT's position noise against the rendered truth: what `stereo.pixel_sigma` stands for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.runs import (
    EVERY_FRAME,
    FoundFeatures,
    experiment,
    find_features,
    make_system,
    process,
    say,
)
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.geometry import inverse, transform_to_camera
from fgslam.core.log import ImageSequence
from fgslam.core.sensors import CameraRig, Observations
from fgslam.datasets.rendered import RenderedLabSequence
from fgslam.frontend.stereo import StereoMatcher

APART = (1, 2, 5, 10, 20, 40)
"""Frames between two sightings of a landmark."""
_EVERY = 5
_TO_SIGMA = 1.4826  # of a median absolute deviation, for normal errors
_GROSS_PX = 3.0
_FLAT = 0.02  # relative range of the four depths around a feature, beyond which it is at an edge


@dataclass(frozen=True, eq=False)
class Spread:
    """Errors in pixels, summed up: scatter of one coordinate, bias, gross errors."""

    sigma: float
    bias: float
    gross: float
    count: int

    @staticmethod
    def of(errors: FloatArray, coordinates: float) -> Spread:
        """Of errors (n,) that are the difference of so many coordinates with equal noise."""
        inside = errors[np.abs(errors) <= _GROSS_PX]
        bias = float(np.median(inside))
        scatter = _TO_SIGMA * float(np.median(np.abs(inside - bias)))
        gross = 100.0 * float(1.0 - len(inside) / len(errors))
        return Spread(scatter / np.sqrt(coordinates), bias, gross, len(errors))


def tables() -> list[Table]:
    """Noise within one frame, and between frames."""
    config = experiment("lab_loop", EVERY_FRAME)
    found = find_features(config)
    sequence = found.sequence
    if not isinstance(sequence, RenderedLabSequence):
        raise ValueError("lab_loop is rendered")
    chosen = range(0, len(sequence), _EVERY)
    say(f"casting the true depth of {len(chosen)} frames")
    depths = {i: sequence.depth(i) for i in chosen}
    matcher = StereoMatcher(sequence.rig, config.frontend.stereo, config.frontend.appearance)
    pixels = {i: matcher.match(found.frames[i].features).pixels for i in chosen}
    observed = [
        report.increment.observations.select(~report.increment.rejected)
        for report in process(found, make_system(config, sequence))
    ]
    return [_one_frame(sequence.rig, pixels, depths), _between(found, observed, depths)]


def _one_frame(
    rig: CameraRig, pixels: dict[int, FloatArray], depths: dict[int, FloatArray]
) -> Table:
    horizontal, vertical = [], []
    for i, p in pixels.items():
        depth, flat = depth_at(depths[i], p[:, 0])
        true = rig.fx * rig.baseline / depth[flat]
        horizontal.append(p[flat, 1, 0] - p[flat, 0, 0] - true)
        vertical.append(p[flat, 2, 1] - p[flat, 0, 1] - true)
    every = np.concatenate(list(pixels.values()))
    errors = {
        "rows of left and right image": every[:, 1, 1] - every[:, 0, 1],
        "columns of top and right image": every[:, 2, 0] - every[:, 0, 0],
        "horizontal disparity against depth": np.concatenate(horizontal),
        "vertical disparity against depth": np.concatenate(vertical),
    }
    rows = [_row(name, Spread.of(values, 2.0)) for name, values in errors.items()]
    return Table("Noise of a SIFT coordinate within one frame", _columns("difference of"), rows)


def _between(
    found: FoundFeatures, observed: list[Observations], depths: dict[int, FloatArray]
) -> Table:
    rows = []
    for apart in APART:
        errors = [
            reprojection_errors(found.sequence, observed, (i, i + apart), depth)
            for i, depth in depths.items()
            if i + apart < len(observed)
        ]
        every = np.concatenate(errors)
        for axis, name in enumerate(("column", "row")):
            rows.append(_row(f"{name}, {apart} frames apart", Spread.of(every[:, axis], 2.0)))
    return Table("Noise of a SIFT coordinate between frames", _columns("landmark's"), rows)


def reprojection_errors(
    sequence: ImageSequence,
    observed: list[Observations],
    frames: tuple[int, int],
    depth: FloatArray,
) -> FloatArray:
    """(n, 2) pixels: where the second frame saw landmarks less where they truly are in it.

    Their true place is that of the first sighting, by exact depth and poses.
    """
    truth, (i, j) = sequence.ground_truth, frames
    if truth is None:
        raise ValueError("the rendered lab has ground truth")
    _, a, b = np.intersect1d(observed[i].ids, observed[j].ids, return_indices=True)
    first, second = observed[i].pixels[a, 0], observed[j].pixels[b, 0]
    distance, flat = depth_at(depth, first)
    first, second, distance = first[flat], second[flat], distance[flat]
    rig = sequence.rig
    rays = (first - [rig.cx, rig.cy]) / [rig.fx, rig.fy]
    points = np.column_stack([rays, np.ones(len(rays))]) * distance[:, None]
    jTi = inverse(truth.poses[j]) @ truth.poses[i]
    there = transform_to_camera(inverse(jTi), points)
    expected = there[:, :2] / there[:, 2:] * [rig.fx, rig.fy] + [rig.cx, rig.cy]
    return np.asarray(second - expected)


def depth_at(depth: FloatArray, xy: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Depth (n,) at sub-pixel points (n, 2), and whether the surface is smooth there.

    On a plane the inverse depth is linear in the pixel: bilinear interpolation is exact.
    """
    low = np.clip(np.floor(xy).astype(np.int64), 0, np.array(depth.shape)[::-1] - 2)
    part = xy - low
    around = 1.0 / np.stack([_at(depth, low, c, r) for r in (0, 1) for c in (0, 1)])
    weights = np.stack(
        [
            (1.0 - part[:, 0]) * (1.0 - part[:, 1]),
            part[:, 0] * (1.0 - part[:, 1]),
            (1.0 - part[:, 0]) * part[:, 1],
            part[:, 0] * part[:, 1],
        ]
    )
    flat = around.max(axis=0) <= (1.0 + _FLAT) * around.min(axis=0)
    return 1.0 / (weights * around).sum(axis=0), flat


def _at(depth: FloatArray, low: IntArray, column: int, row: int) -> FloatArray:
    return np.asarray(depth[low[:, 1] + row, low[:, 0] + column])


def _columns(what: str) -> tuple[str, ...]:
    return (what, "sigma of one coordinate (MAD), px", "median, px", "beyond 3 px, %", "number")


def _row(name: str, spread: Spread) -> tuple[Cell, ...]:
    return (name, spread.sigma, spread.bias, spread.gross, spread.count)
