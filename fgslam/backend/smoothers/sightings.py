"""Landmark observations of a whole graph in arrays: whitened residuals and their derivatives.

A rig's stereo factors are linearised all at once (:mod:`fgslam.factors.stacked`); any other factor
of a pose and a landmark (of range and bearing) by GTSAM. Either way they are those of the factors'
own cost.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import gtsam
import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.sensors import CameraRig
from fgslam.factors.graphs import is_pose
from fgslam.factors.landmark import FROM_MEASUREMENT
from fgslam.factors.noise import plain
from fgslam.factors.stacked import LinearRows, linearised, residuals


class Sightings(Protocol):
    """Observations of one kind."""

    @property
    def rows(self) -> IntArray:
        """Of their factors in the graph that they come from (k,)."""
        ...

    @property
    def poses(self) -> IntArray:
        """Rows (k,) of their poses."""
        ...

    @property
    def points(self) -> IntArray:
        """Rows (k,) of their landmarks."""
        ...

    def of_points(self, kept: BoolArray) -> Sightings:
        """Those of some landmarks, a mask (m,), which are counted anew."""
        ...

    def residuals(self, poses: FloatArray, points: FloatArray) -> FloatArray:
        """Whitened residuals (k, 3) at all poses (n, 4, 4) and points (m, 3)."""
        ...

    def look(self, poses: FloatArray, points: FloatArray) -> LinearRows:
        """The same, with derivatives."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class StereoSightings:
    """Those of one rig, on :class:`Sightings`.

    Attributes:
        rows, poses, points: see there.
        measured: (k, 3) column, row, disparity, pixels.
        roots: (k, 3, 3) square roots of their informations.
        rig: the cameras; their images' size is not known.
    """

    rows: IntArray
    poses: IntArray
    points: IntArray
    measured: FloatArray
    roots: FloatArray
    rig: CameraRig

    @staticmethod
    def of(factors: list[Any], rows: IntArray, poses: IntArray, points: IntArray) -> Sightings:
        """Of stereo factors, with or without kernels."""
        left, right, row = np.array([factor.measured().vector() for factor in factors]).T
        roots = np.empty((len(factors), 3, 3))
        for root, factor in zip(roots, factors, strict=True):
            model = factor.noiseModel()
            bare: Any = model.noise() if isinstance(model, gtsam.noiseModel.Robust) else model
            root[:] = bare.R()
        k = factors[0].calibration()
        rig = CameraRig(0, 0, k.fx(), k.fy(), k.px(), k.py(), k.baseline(), None, np.eye(4))
        measured = np.column_stack([right, row, left - right])
        return StereoSightings(rows, poses, points, measured, roots @ FROM_MEASUREMENT, rig)

    def of_points(self, kept: BoolArray) -> Sightings:
        """See :class:`Sightings`."""
        own, number = kept[self.points], np.cumsum(kept) - 1
        return StereoSightings(
            self.rows[own],
            self.poses[own],
            number[self.points[own]],
            self.measured[own],
            self.roots[own],
            self.rig,
        )

    def residuals(self, poses: FloatArray, points: FloatArray) -> FloatArray:
        """See :class:`Sightings`."""
        own, seen = poses[self.poses], points[self.points]
        return residuals(self.rig, own, seen, self.measured, self.roots)

    def look(self, poses: FloatArray, points: FloatArray) -> LinearRows:
        """See :class:`Sightings`."""
        own, seen = poses[self.poses], points[self.points]
        return linearised(self.rig, own, seen, self.measured, self.roots)


@dataclass(frozen=True, slots=True, eq=False)
class FactorSightings:
    """Those that GTSAM linearises, on :class:`Sightings`.

    Attributes:
        rows, poses, points: see there.
        graph: the factors without kernels.
        keys: rows of the variables among poses and points, by GTSAM's keys.
    """

    rows: IntArray
    poses: IntArray
    points: IntArray
    graph: Any
    keys: dict[int, int]

    @staticmethod
    def of(factors: list[Any], rows: IntArray, poses: IntArray, points: IntArray) -> Sightings:
        """Of factors with one pose and one landmark each and three numbers."""
        graph = gtsam.NonlinearFactorGraph()
        keys: dict[int, int] = {}
        for factor, pose, point in zip(factors, poses.tolist(), points.tolist(), strict=True):
            graph.add(plain(factor))
            keys.update(zip(factor.keys(), (pose, point), strict=True))
        return FactorSightings(rows, poses, points, graph, keys)

    def of_points(self, kept: BoolArray) -> Sightings:
        """See :class:`Sightings`."""
        own, number = np.flatnonzero(kept[self.points]), np.cumsum(kept) - 1
        factors = [self.graph.at(row) for row in own.tolist()]
        points = number[self.points[own]]
        return FactorSightings.of(factors, self.rows[own], self.poses[own], points)

    def residuals(self, poses: FloatArray, points: FloatArray) -> FloatArray:
        """See :class:`Sightings`."""
        return self.look(poses, points).residual

    def look(self, poses: FloatArray, points: FloatArray) -> LinearRows:
        """See :class:`Sightings`."""
        linear = self.graph.linearize(values_of(self.keys, poses, points))
        row, column, value = linear.sparseJacobian_()
        row, column = row.astype(np.int64) - 1, column.astype(np.int64) - 1
        border = 3 * sum(not is_pose(key) for key in self.keys)  # landmarks come first
        last = border + 6 * sum(is_pose(key) for key in self.keys)
        k = len(self.rows)
        out = LinearRows(np.zeros((k, 3)), np.zeros((k, 3, 6)), np.zeros((k, 3, 3)))
        of_point, of_pose, right = (
            column < border,
            (column >= border) & (column < last),
            column == last,
        )
        out.residual.ravel()[row[right]] = -value[right]
        out.by_pose.reshape(-1, 6)[row[of_pose], (column[of_pose] - border) % 6] = value[of_pose]
        out.by_point.reshape(-1, 3)[row[of_point], column[of_point] % 3] = value[of_point]
        return out


def values_of(keys: dict[int, int], poses: FloatArray, points: FloatArray) -> Any:
    """GTSAM values of variables, given by their rows among poses (n, 4, 4) and points (m, 3)."""
    values = gtsam.Values()
    for key, row in keys.items():
        values.insert(key, gtsam.Pose3(poses[row]) if is_pose(key) else points[row])
    return values
