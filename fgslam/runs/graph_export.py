"""A run as a graph for other solvers: its log's measurements around an estimator's final answer."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.estimates import Trajectory
from fgslam.core.geometry import triangulate, triangulation_covariance
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.measurements import Increment
from fgslam.core.trajectories import read_tum
from fgslam.report.graph_file import PoseLandmarkGraph, require_graph_suffix, write_g2o
from fgslam.report.point_cloud import read_ply

_HEADER = (
    "poses wTc of the reference camera; x right, y down, z forward; metres",
    "information: g2o's error (translation, vector part of the quaternion), metres and half angles",
    "left out: observations that the run rejected, constraints of a floor, closures of loops, "
    "odometry to frames located anew",
    "landmarks that the map no longer holds start where they were first seen",
)


def export_graph(path: Path, log_file: Path, folder: Path, remark: str = "") -> str:
    """Writes a log's measurements, started at an estimator's final poses and map, as .g2o.

    Stereo and range-bearing observations become points with their first-order covariance.

    Args:
        path: the file.
        log_file: the run's measurements.npz.
        folder: the estimator's, with final.tum and map.ply.
        remark: put into a comment.

    Returns:
        A line about what was written.

    Raises:
        FgslamError: another ending, or a file that is missing or damaged.
    """
    require_graph_suffix(path)  # now, not after seconds of reading
    log = MeasurementLog.load(log_file)
    trajectory = read_tum(folder / "final.tum")
    points = read_ply(folder / "map.ply")
    graph = build_graph(log, trajectory, points.ids, points.positions)
    write_g2o(path, graph, [*([remark] if remark else []), *_HEADER])
    left_out = sum(len(increment.observations) for increment in log) - len(graph.points)
    return (
        f"{path}: {len(graph.poses)} poses, {len(graph.landmarks)} landmarks, "
        f"{len(graph.motions)} odometry edges, {len(graph.points)} observations "
        f"({left_out} rejected ones left out)"
    )


def build_graph(
    log: MeasurementLog, trajectory: Trajectory, ids: IntArray, positions: FloatArray
) -> PoseLandmarkGraph:
    """The graph of a log: all that was measured and not rejected.

    Args:
        log: the measurements.
        trajectory: poses to start from; frames of the log that have none are left out.
        ids: (m,) landmarks of the map, ascending. Those never seen are left out; those seen and
            not in the map start where their first observation puts them.
        positions: (m, 3) world, metres.
    """
    row_of = {round(t, 9): row for row, t in enumerate(trajectory.timestamps.tolist())}
    rows = np.array([row_of.get(round(s.timestamp, 9), -1) for s in log], np.int64)
    kept = [_usable(increment) & (row >= 0) for increment, row in zip(log, rows, strict=True)]
    seen = [s.observations.select(keep) for s, keep in zip(log, kept, strict=True)]
    measurement = np.concatenate([np.empty((0, 3)), *(o.measurement for o in seen)])
    covariance = np.concatenate([np.empty((0, 3, 3)), *(o.covariance for o in seen)])
    seen_ids = np.concatenate([np.empty(0, np.int64), *(o.ids for o in seen)])
    used, first, landmark = np.unique(seen_ids, return_index=True, return_inverse=True)
    seen_from = np.repeat(rows, [len(o) for o in seen])
    points = triangulate(log.rig, measurement)
    start = _in_world(trajectory.poses[seen_from[first]], points[first])
    mapped = np.isin(used, ids)
    start[mapped] = positions[np.searchsorted(ids, used[mapped])]
    moved = [
        (rows[k - 1], rows[k], increment.odometry)
        for k, increment in enumerate(log)
        # A frame found anew after being carried off: its odometry does not know of that.
        if k
        and increment.odometry is not None
        and not increment.relocalised
        and min(rows[k - 1], rows[k]) >= 0
    ]
    return PoseLandmarkGraph(
        poses=trajectory.poses,
        landmarks=start,
        motion_from=np.array([a for a, _, _ in moved], np.int64),
        motion_to=np.array([b for _, b, _ in moved], np.int64),
        motions=np.array([o.motion for _, _, o in moved]).reshape(-1, 4, 4),
        motion_covariances=np.array([o.covariance for _, _, o in moved]).reshape(-1, 6, 6),
        seen_from=seen_from,
        seen=landmark.reshape(-1),
        points=points,
        point_covariances=triangulation_covariance(log.rig, measurement, covariance),
    )


def _usable(increment: Increment) -> BoolArray:
    """Observations (k,) that were not rejected and have a place."""
    # The third number is disparity or range: only a positive one is that of a point.
    return ~increment.rejected & (increment.observations.measurement[:, 2] > 0.0)


def _in_world(wTc: FloatArray, points: FloatArray) -> FloatArray:
    """Points (n, 3), each of its own camera (n, 4, 4)."""
    return np.asarray(np.einsum("nij,nj->ni", wTc[:, :3, :3], points) + wTc[:, :3, 3])
