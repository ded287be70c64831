"""Which landmarks of the map are in view of a pose, and where (Se et al. 3.1 and 4.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray, Rows
from fgslam.core.estimates import Prediction
from fgslam.core.geometry import (
    congruence,
    point_pose_jacobian,
    project,
    projection_jacobian,
    rotate_covariances,
    transform_to_camera,
)
from fgslam.core.sensors import CameraRig
from fgslam.frontend.tracking.settings import DatabaseSettings

Wanted: TypeAlias = Callable[[IntArray, FloatArray], BoolArray]
"""Of rows (k,) of the map and their depths: which (k,) to consider at all."""
_CONE_DEG = 30.0  # half angle of the cone in which the paper expects landmarks (4.4)
_NEAREST_DEPTH_M = 0.1
_SLACK_PX = 1e-6  # of the rough test before the exact one; far above rounding


@dataclass(frozen=True, slots=True, eq=False)
class ExpectedLandmarks:
    """Landmarks expected in view, with their predicted characteristics (Se et al. 3.1).

    Attributes:
        ids: (v,) landmark identities, ascending.
        rows: (v,) their rows in the estimator's map.
        measurement: (v, 3) predicted (column, row, disparity).
        scale: (v,) predicted scale, pixels.
        orientation: (v,) radians.
        descriptors: (v, 128).
        certain: (v,) well inside the view, so that no match is a miss; those at its border may be
            matched (else each frame would start them anew) but are not missed, nor are those seen
            from a direction from which they were never matched (6.3).
    """

    ids: IntArray
    rows: IntArray
    measurement: FloatArray
    scale: FloatArray
    orientation: FloatArray
    descriptors: ByteArray
    certain: BoolArray

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True, eq=False)
class InView(Rows):
    """Points that may be in view.

    Attributes:
        rows: (v,) which of the points, ascending.
        points: (v, 3) in the camera's frame, metres.
        measurement: (v, 3) predicted (column, row, disparity).
        certain: (v,) well inside the view.
    """

    rows: IntArray
    points: FloatArray
    measurement: FloatArray
    certain: BoolArray


class FieldOfView:
    """Common field of view of the cameras, by the settings."""

    def __init__(self, rig: CameraRig, settings: DatabaseSettings, max_disparity_px: float) -> None:
        """Points of more than ``max_disparity_px`` are outside."""
        self._rig = rig
        self._border = settings.border_px
        self._cone = settings.field_of_view == "cone"
        self._tangent = np.tan(np.deg2rad(_CONE_DEG))
        self._max_disparity = max_disparity_px

    def select(
        self,
        wTc: FloatArray,
        positions: FloatArray,
        wanted: Wanted | None = None,
    ) -> InView:
        """The points (n, 3) of the world that may be in view from ``wTc``.

        Args:
            wTc: (4, 4) pose.
            positions: (n, 3) points.
            wanted: asked about those roughly in view.
        """
        points = transform_to_camera(wTc, positions)
        rows = self._roughly(points)
        if wanted is not None:
            rows = rows[wanted(rows, points[rows, 2])]
        points = points[rows]
        measurement = project(self._rig, points)
        if self._cone:
            possible = certain = self._in_cone(points)
        else:
            possible = self._in_images(measurement, -self._border)
            certain = self._in_images(measurement, self._border)
        keep = possible & (measurement[:, 2] <= self._max_disparity)
        return InView(rows, points, measurement, certain).select(keep)

    def _roughly(self, points: FloatArray) -> IntArray:
        """Rows (k,) of all points (n, 3) in view and few others: no division, few points a test.

        The reference image with its border, widened by a hair, as planes through the camera.
        """
        rows = np.flatnonzero(points[:, 2] > _NEAREST_DEPTH_M)
        rig, reach = self._rig, self._border + _SLACK_PX
        if self._cone:
            return rows
        for axis, (focal, centre, size) in enumerate(
            ((rig.fx, rig.cx, rig.width), (rig.fy, rig.cy, rig.height))
        ):
            along, depth = focal * points[rows, axis], points[rows, 2]
            inside = along >= (-reach - centre) * depth
            inside &= along <= (size - 1 + reach - centre) * depth
            rows = rows[inside]
        return rows

    def _in_cone(self, points: FloatArray) -> BoolArray:
        return np.asarray((np.abs(points[:, :2]) < self._tangent * points[:, 2:]).all(axis=1))

    def _in_images(self, measurement: FloatArray, border: float) -> BoolArray:
        """True if a landmark projects into all images of the rig, the border excluded."""
        rig = self._rig
        column, row, disparity = measurement.T
        vertical = (
            0.0
            if rig.vertical_baseline is None
            else disparity * (rig.fy * rig.vertical_baseline) / (rig.fx * rig.baseline)
        )
        inside = (column >= border) & (column + disparity <= rig.width - 1 - border)
        inside &= (row >= border) & (row + vertical <= rig.height - 1 - border)
        return np.asarray(inside)


def predicted_covariance(
    rig: CameraRig, prediction: Prediction, positions: FloatArray, covariances: FloatArray
) -> FloatArray:
    """Covariance (v, 3, 3) of predicted (column, row, disparity), without measurement noise.

    Args:
        rig: the cameras.
        prediction: pose and its covariance.
        positions: (v, 3) landmarks in the world, in front of the camera.
        covariances: (v, 3, 3) theirs.
    """
    points = transform_to_camera(prediction.wTc, positions)
    by_pose = point_pose_jacobian(points)
    weighted = (by_pose.reshape(-1, 6) @ prediction.covariance).reshape(by_pose.shape)
    in_camera = rotate_covariances(prediction.wTc[:3, :3].T, covariances)
    in_camera += weighted @ np.swapaxes(by_pose, 1, 2)
    return congruence(projection_jacobian(rig, points), in_camera)


def directions_to(wTc: FloatArray, points: FloatArray) -> FloatArray:
    """View vectors (v, 3): unit, world, from the camera to points (v, 3) of its own frame."""
    turned = points @ wTc[:3, :3].T
    return np.asarray(turned / np.linalg.norm(turned, axis=1, keepdims=True))
