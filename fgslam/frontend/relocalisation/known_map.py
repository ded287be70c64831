"""The map as relocalisation knows it: landmarks, their views, and the index over them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.frontend.relocalisation.appearance_index import AppearanceIndex
from fgslam.geometry import project, transform_to_camera
from fgslam.map_types import LandmarkAppearances
from fgslam.types import BoolArray, CameraRig, FloatArray, IntArray, LandmarkMap

_NEAREST_DEPTH_M = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class KnownMap:
    """Landmarks that have a look, and their views.

    Attributes:
        landmarks: n of them.
        views: v stored views, ascending by landmark.
        owners: (v,) row of each view's landmark.
        index: over the views; its owners are their rows.
    """

    landmarks: LandmarkMap
    views: LandmarkAppearances
    owners: IntArray
    index: AppearanceIndex

    @staticmethod
    def of(
        landmarks: LandmarkMap, appearances: LandmarkAppearances, map_sigma_m: float = 0.0
    ) -> KnownMap:
        """Landmarks without a view, and views without a landmark, are left out.

        ``map_sigma_m`` is added to the landmarks' noise.
        """
        seen = np.isin(landmarks.ids, appearances.ids)
        kept = LandmarkMap(
            landmarks.ids[seen],
            landmarks.positions[seen],
            landmarks.covariances[seen] + map_sigma_m**2 * np.eye(3),
        )
        views = appearances.of(kept.ids)
        index = AppearanceIndex()
        index.add(np.arange(len(views)), views.descriptors)
        return KnownMap(kept, views, kept.rows(views.ids), index)

    def in_view(self, rig: CameraRig, wTc: FloatArray) -> tuple[IntArray, FloatArray]:
        """Rows (m,) of landmarks in all images from ``wTc``, and their points in the camera."""
        points = transform_to_camera(wTc, self.landmarks.positions)
        rows = np.flatnonzero(points[:, 2] > _NEAREST_DEPTH_M)
        points = points[rows]
        column, row, disparity = project(rig, points).T
        vertical = 0.0
        if rig.vertical_baseline is not None:
            vertical = disparity * (rig.fy * rig.vertical_baseline) / (rig.fx * rig.baseline)
        inside = (column >= 0.0) & (column + disparity <= rig.width - 1.0)
        inside &= (row >= 0.0) & (row + vertical <= rig.height - 1.0)
        return rows[inside], points[inside]

    def recognisable(
        self, wTc: FloatArray, rows: IntArray, max_angle: float, scales: tuple[float, float]
    ) -> BoolArray:
        """Which of the landmarks (m,) in front of ``wTc`` have a view near to that from there.

        Near is a direction within ``max_angle`` (radians) of the stored one (unknown ones are
        near), and a predicted scale within ``scales`` (pixels), which the frame's features have.
        """
        sight = self.landmarks.positions[rows] - wTc[:3, 3]
        depth = np.maximum(sight @ wTc[:3, 2], _NEAREST_DEPTH_M)
        sight = sight / np.maximum(np.linalg.norm(sight, axis=1), 1e-9)[:, None]
        place = np.full(len(self.landmarks), -1)
        place[rows] = np.arange(len(rows))
        views = np.flatnonzero(place[self.owners] >= 0)
        at = place[self.owners[views]]
        cosine = np.einsum("vi,vi->v", self.views.direction[views], sight[at])
        near = ~(cosine < np.cos(max_angle))  # so NaN is near
        scale = self.views.size[views] / depth[at]
        near &= (scale >= scales[0]) & (scale <= scales[1])
        out = np.zeros(len(rows), np.bool_)
        out[at[near]] = True
        return out
