"""Noise of measurements along a graph's solved poses.

On the way, tracks are judged along the poses as tracked, whose own errors lean all of them: by four
times the stated noise, where a quarter of a frame's matches finds its pose, by up to half as much
again as their noise does. Solved poses lean none; but what leans all tracks of a real recording
alike goes into them, too, and is then missed. docs/derivations/measurement_noise.md.
"""

from __future__ import annotations

import numpy as np

from fgslam.backend.open_tracks import ENDED_AFTER, LEAST_SIGHTINGS, LONGEST, Tracks, tracks_of
from fgslam.backend.persistence import STATED, Fitted
from fgslam.backend.smoothers.whole_graph import State, WholeGraph
from fgslam.core.arrays import BoolArray, IntArray
from fgslam.factors.graphs import number


def power_ratio(graph: WholeGraph, state: State) -> float:
    """By how much tracks lean at a solution, over what the graph takes them to: a variance.

    Tracks are as :class:`~fgslam.backend.persistence.Persistence` judges them.
    """
    if graph.seen is None:
        return 1.0
    frame_of = np.array([number(key) for key in graph.pose_keys])
    order, tracks = _in_tracks(graph.seen.points, frame_of[graph.seen.poses], graph.weights > 0.0)
    if not len(order):
        return 1.0
    look = graph.seen.look(state.poses, state.points)
    fitted = Fitted.of(tracks, look.residual[order], look.by_point[order])
    if fitted is None:
        return 1.0
    sums = STATED[1] + fitted.powers()[1]
    return float(sums[0] / sums[1])


def _in_tracks(points: IntArray, frames: IntArray, counts: BoolArray) -> tuple[IntArray, Tracks]:
    """Rows (n,) of the sightings (k,) that count, by landmark and frame, and their tracks."""
    order = np.flatnonzero(counts)
    order = order[np.lexsort((frames[order], points[order]))]
    begins = np.ones(len(order), np.bool_)
    begins[1:] = (np.diff(points[order]) != 0) | (np.diff(frames[order]) > ENDED_AFTER)
    first = np.flatnonzero(begins)
    since = np.arange(len(order)) - np.repeat(first, np.diff(np.append(first, len(order))))
    first = np.flatnonzero(since % LONGEST == 0)
    sightings = np.diff(np.append(first, len(order)))
    long = sightings >= LEAST_SIGHTINGS
    return order[np.repeat(long, sightings)], tracks_of(sightings[long])
