"""Landmark observations of a whole graph in arrays: whitened residuals and their derivatives.

A rig's stereo factors are linearised all at once (:mod:`fgslam.factors.landmark`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.sensors import CameraRig
from fgslam.factors.graphs import is_pose
from fgslam.factors.landmark import FROM_MEASUREMENT, LinearRows, linearised, residuals


@dataclass(frozen=True, slots=True, eq=False)
class StereoSightings:
    """Observations of one rig.

    Attributes:
        rows: of their factors in the graph that they come from (k,).
        poses: rows (k,) of their poses.
        points: rows (k,) of their landmarks.
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
    def of(
        factors: list[Any], rows: IntArray, poses: IntArray, points: IntArray
    ) -> StereoSightings:
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

    def of_points(self, kept: BoolArray) -> StereoSightings:
        """Those of some landmarks, a mask (m,), whose rows are renumbered."""
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
        """Whitened residuals (k, 3) at all poses (n, 4, 4) and points (m, 3)."""
        own, seen = poses[self.poses], points[self.points]
        return residuals(self.rig, own, seen, self.measured, self.roots)

    def look(self, poses: FloatArray, points: FloatArray) -> LinearRows:
        """The same, with derivatives."""
        own, seen = poses[self.poses], points[self.points]
        return linearised(self.rig, own, seen, self.measured, self.roots)


def values_of(keys: dict[int, int], poses: FloatArray, points: FloatArray) -> Any:
    """GTSAM values of variables, given by their rows among poses (n, 4, 4) and points (m, 3)."""
    values = gtsam.Values()
    for key, row in keys.items():
        values.insert(key, gtsam.Pose3(poses[row]) if is_pose(key) else points[row])
    return values
