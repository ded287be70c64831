"""The whole problem as a .g2o file, for other solvers: poses, landmarks and their measurements.

Tags are those of g2o's slam3d types (https://github.com/RainerKuemmerle/g2o/wiki/File-Format).
Information matrices are written in g2o's own error, which differs from ours in two ways:

* order: translation first, then rotation; ours is rotation first;
* rotation: the vector part of the unit quaternion, half of our rotation vector to first order, so
  that its information is four times ours and the mixed terms are twice ours.

Both errors live at the measured pose (``measured^-1 * predicted``), so that nothing else changes.
GTSAM's ``readG2o`` reorders as well, but takes the rotation for a rotation vector: there the
rotational information arrives four times too large.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import OutputError
from fgslam.core.files import write_text
from fgslam.core.geometry import congruence
from fgslam.core.trajectories import pose_rows

SUFFIX = ".g2o"
EXACT_SIGMA = 1e-6
"""Standard deviation (m, rad) in place of zero: a file of information cannot say `exact`."""

_OFFSET_ID = 0  # of the sensor in the pose's frame: the identity, poses are the camera's own
_UPPER3, _UPPER6 = np.triu_indices(3), np.triu_indices(6)
# From our tangent [rotation vector, translation] to g2o's [translation, quaternion's vector].
_OURS_OF_G2O = np.block([[np.zeros((3, 3)), 2.0 * np.eye(3)], [np.eye(3), np.zeros((3, 3))]])


@dataclass(frozen=True, slots=True, eq=False)
class PoseLandmarkGraph:
    """Poses, landmarks and what was measured between them; rows name poses and landmarks.

    Attributes:
        poses: (n, 4, 4) ``wTc``; the first one is held fixed.
        landmarks: (m, 3) world, metres.
        motion_from, motion_to: (k,) rows of the poses that an odometry edge joins.
        motions: (k, 4, 4) measured pose of the second in the frame of the first.
        motion_covariances: (k, 6, 6) in the tangent space at the second, [rotation, translation].
        seen_from, seen: (l,) rows of pose and landmark of an observation.
        points: (l, 3) where it was seen, in the camera's frame, metres.
        point_covariances: (l, 3, 3) metres squared.
    """

    poses: FloatArray
    landmarks: FloatArray
    motion_from: IntArray
    motion_to: IntArray
    motions: FloatArray
    motion_covariances: FloatArray
    seen_from: IntArray
    seen: IntArray
    points: FloatArray
    point_covariances: FloatArray


def require_graph_suffix(path: Path) -> None:
    """Raises OutputError unless the file's name ends in .g2o."""
    if path.suffix.lower() != SUFFIX:
        raise OutputError(
            f"cannot write {path}: unknown graph format '{path.suffix}'; use {SUFFIX}"
        )


def write_g2o(path: Path, graph: PoseLandmarkGraph, remarks: Sequence[str] = ()) -> None:
    """Writes a graph atomically; the same graph gives the same bytes.

    Vertices are numbered from 0: the poses in their order, then the landmarks in theirs.

    Args:
        path: the .g2o file.
        graph: what to write.
        remarks: put into comment lines in front.

    Raises:
        OutputError: another ending, a number that is not finite, or writing failed.
    """
    require_graph_suffix(path)
    _require_finite(path, graph)
    blocks = [
        *(f"# {remark}\n" for remark in remarks),
        f"PARAMS_SE3OFFSET {_OFFSET_ID} 0 0 0 0 0 0 1\n",
        *_vertices(graph),
        *_motions(graph),
        *_observations(graph),
    ]
    write_text(path, "".join(blocks))


def g2o_information(covariances: FloatArray) -> FloatArray:
    """Information (k, 6, 6) in g2o's error from covariances (k, 6, 6) in our tangent space."""
    return congruence(
        np.broadcast_to(_OURS_OF_G2O.T, covariances.shape), information_of(covariances)
    )


def information_of(covariances: FloatArray) -> FloatArray:
    """Inverses (k, d, d) of covariances, no direction being known better than EXACT_SIGMA."""
    variances, directions = np.linalg.eigh(covariances)
    inverse = 1.0 / np.maximum(variances, EXACT_SIGMA**2)
    return congruence(directions * np.sqrt(inverse)[:, None, :], np.eye(covariances.shape[-1]))


def _vertices(graph: PoseLandmarkGraph) -> Iterator[str]:
    numbers = np.arange(len(graph.poses))
    yield _lines("VERTEX_SE3:QUAT %d" + 7 * " %.12g", numbers[:, None], pose_rows(graph.poses))
    if len(graph.poses):
        yield "FIX 0\n"
    landmarks = len(graph.poses) + np.arange(len(graph.landmarks))
    yield _lines("VERTEX_TRACKXYZ %d" + 3 * " %.12g", landmarks[:, None], graph.landmarks)


def _motions(graph: PoseLandmarkGraph) -> Iterator[str]:
    upper = g2o_information(graph.motion_covariances)[:, _UPPER6[0], _UPPER6[1]]
    ends = np.column_stack([graph.motion_from, graph.motion_to])
    row_format = "EDGE_SE3:QUAT %d %d" + 7 * " %.12g" + 21 * " %.9g"
    yield _lines(row_format, ends, np.column_stack([pose_rows(graph.motions), upper]))


def _observations(graph: PoseLandmarkGraph) -> Iterator[str]:
    upper = information_of(graph.point_covariances)[:, _UPPER3[0], _UPPER3[1]]
    ends = np.column_stack([graph.seen_from, len(graph.poses) + graph.seen])
    row_format = f"EDGE_SE3_TRACKXYZ %d %d {_OFFSET_ID}" + 3 * " %.12g" + 6 * " %.9g"
    yield _lines(row_format, ends, np.column_stack([graph.points, upper]))


def _lines(row_format: str, numbers: IntArray, values: FloatArray) -> str:
    buffer = io.StringIO()
    # Adding zero turns -0 into 0.
    np.savetxt(buffer, np.column_stack([numbers, values + 0.0]), fmt=row_format)
    return buffer.getvalue()


def _require_finite(path: Path, graph: PoseLandmarkGraph) -> None:
    for name in ("poses", "landmarks", "motions", "motion_covariances", "points"):
        array = getattr(graph, name)
        bad = ~np.isfinite(array).all(axis=tuple(range(1, array.ndim)))
        if bad.any():
            raise OutputError(
                f"cannot write {path}: {name} {int(np.argmax(bad))} is not finite; the estimator "
                "diverged or the log is damaged, run the experiment again"
            )
