"""The factors of a whole graph that are no observations: GTSAM's, and a gyroscope's turns."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import gtsam
import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix

from fgslam.backend.smoothers.marginals import LinearSystem
from fgslam.backend.smoothers.sightings import values_of
from fgslam.backend.smoothers.turns import Turns
from fgslam.core.arrays import FloatArray
from fgslam.factors.graphs import is_pose


@dataclass(frozen=True, eq=False)
class OtherFactors:
    """Prior, odometry, floor, loops, what is known of single landmarks.

    Attributes:
        graph: GTSAM's, without empty slots.
        pose_keys, landmark_keys: of all variables, ascending.
        turns: odometry of a gyroscope; None where there is none.
    """

    graph: Any
    pose_keys: list[int]
    landmark_keys: list[int]
    turns: Turns | None = None

    def plus(self, factor: Any) -> OtherFactors:
        """With one more."""
        graph = self.graph.clone()
        graph.add(factor)
        return dataclasses.replace(self, graph=graph)

    def without(self, gone: set[int]) -> OtherFactors:
        """Without landmarks, by key, and what is said of them."""
        graph = gtsam.NonlinearFactorGraph()
        for row in range(self.graph.size()):
            if gone.isdisjoint(self.graph.at(row).keys()):
                graph.add(self.graph.at(row))
        left = [key for key in self.landmark_keys if key not in gone]
        return dataclasses.replace(self, graph=graph, landmark_keys=left)

    def cost(self, poses: FloatArray, points: FloatArray, bias: FloatArray) -> float:
        """Half the sum of squares at poses (n, 4, 4), points (m, 3) and biases (3q,)."""
        cost = float(self.graph.error(values_of(self._rows, poses, points)))
        return cost if self.turns is None else cost + self.turns.cost(poses, bias)

    def linear(self, poses: FloatArray, points: FloatArray, bias: FloatArray) -> LinearSystem:
        """Their normal equations there."""
        system = self._linear(poses, points)
        return system if self.turns is None else self.turns.joined(system, poses, bias)

    @cached_property
    def _rows(self) -> dict[int, int]:
        """Rows of the variables of GTSAM's factors, by key, ascending."""
        rows = {key: row for row, key in enumerate(self.landmark_keys)}
        rows |= {key: row for row, key in enumerate(self.pose_keys)}
        return {key: rows[key] for key in sorted(self.graph.keyVector())}

    def _linear(self, poses: FloatArray, points: FloatArray) -> LinearSystem:
        """Those of GTSAM."""
        n, m = len(self.pose_keys), len(self.landmark_keys)
        linear = self.graph.linearize(values_of(self._rows, poses, points))
        row, column, value = linear.sparseJacobian_()
        places = [
            3 * m + 6 * row + np.arange(6) if is_pose(key) else 3 * row + np.arange(3)
            for key, row in self._rows.items()
        ]
        # GTSAM counts from 1 and puts the right-hand side in the last column.
        place = np.concatenate([*places, [3 * m + 6 * n]])
        at = row.astype(np.int64) - 1, place[column.astype(np.int64) - 1]
        rows = int(row.max(initial=0))
        whole = csr_matrix((value, at), (rows, 3 * m + 6 * n + 1))
        jacobian, right = whole[:, :-1], whole[:, [-1]].toarray()[:, 0]
        information = (jacobian.T @ jacobian).tocsr()
        gradient = -(jacobian.T @ right)
        own, links = _apart(information[: 3 * m, : 3 * m])
        coupling = information[3 * m :, : 3 * m]
        return LinearSystem(
            np.array(self.pose_keys, np.int64),
            np.array(self.landmark_keys, np.int64),
            information[3 * m :, 3 * m :],
            coupling.tobsr((6, 3)) if n and m else bsr_matrix((6 * n, 3 * m), blocksize=(6, 3)),
            own,
            links,
            gradient[3 * m :],
            gradient[: 3 * m],
        )


def _apart(matrix: csr_matrix) -> tuple[FloatArray, csr_matrix]:
    """The (m, 3, 3) diagonal blocks of a sparse matrix (3m, 3m), and what is beside them."""
    entries = matrix.tocoo()
    own = np.zeros((matrix.shape[0] // 3, 3, 3))
    inside = entries.row // 3 == entries.col // 3
    row, column = entries.row[inside], entries.col[inside]
    own[row // 3, row % 3, column % 3] = entries.data[inside]
    beside = entries.data[~inside], (entries.row[~inside], entries.col[~inside])
    return own, csr_matrix(beside, matrix.shape)
