"""The map as relocalisation knows it: landmarks, their views, and the index over them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import LandmarkMap
from fgslam.core.features import LandmarkAppearances
from fgslam.core.geometry import project, transform_to_camera
from fgslam.core.sensors import CameraRig
from fgslam.frontend.places.relocalisation.appearance_index import AppearanceIndex

_NEAREST_DEPTH_M = 0.3
_ROUNDING_M = 1e-6  # of depths computed in two ways, with thousands of kilometres to spare


@dataclass(frozen=True, slots=True, eq=False)
class KnownMap:
    """Landmarks that have a look, and their views.

    Attributes:
        landmarks: n of them.
        views: v stored views, ascending by landmark.
        owners: (v,) row of each view's landmark.
        starts: (n + 1,) first view of each landmark, and the end.
        largest: (n,) size of each landmark's largest view.
        axes: (3, n) the landmarks' positions, coordinate by coordinate.
        index: over the views, by their rows.
    """

    landmarks: LandmarkMap
    views: LandmarkAppearances
    owners: IntArray
    starts: IntArray
    largest: FloatArray
    axes: FloatArray
    index: AppearanceIndex

    @staticmethod
    def of(
        landmarks: LandmarkMap, appearances: LandmarkAppearances, map_sigma_m: float = 0.0
    ) -> KnownMap:
        """Landmarks without a view, and views without a landmark, are left out.

        ``map_sigma_m`` is added to the landmarks' noise. Positions and views are not copied where
        all are kept, and must not change.
        """
        owners, counts = _owners(landmarks.ids, appearances.ids)
        if (owners < 0).any():
            appearances = appearances.of(landmarks.ids)
        if (counts == 0).any():
            landmarks = landmarks.select(counts > 0)
            owners, counts = _owners(landmarks.ids, appearances.ids)
        owners = owners[owners >= 0]
        starts = np.concatenate([[0], np.cumsum(counts)])
        return KnownMap(
            LandmarkMap(
                landmarks.ids,
                landmarks.positions,
                landmarks.covariances + map_sigma_m**2 * np.eye(3),
            ),
            appearances,
            owners,
            starts,
            np.maximum.reduceat(appearances.size, starts[:-1]) if len(owners) else np.empty(0),
            np.ascontiguousarray(landmarks.positions.T),
            AppearanceIndex(appearances.descriptors, appearances.words),
        )

    @property
    def room(self) -> float:
        """Volume of the box around the landmarks, no side below a metre, cubic metres."""
        extent = np.ptp(self.axes, axis=1) if len(self.landmarks) else np.ones(3)
        return float(np.prod(np.maximum(extent, 1.0)))

    def views_of(self, rows: IntArray) -> tuple[IntArray, IntArray]:
        """Views of landmarks (m,), landmark by landmark; and to which of the m each belongs."""
        counts = self.starts[rows + 1] - self.starts[rows]
        at = np.repeat(np.arange(len(rows)), counts)
        skipped = self.starts[rows] - (np.cumsum(counts) - counts)
        return np.arange(len(at)) + skipped[at], at

    def in_view(
        self, rig: CameraRig, wTc: FloatArray, farthest: float | FloatArray = np.inf
    ) -> tuple[IntArray, FloatArray]:
        """Rows (m,) of landmarks in all images from ``wTc``, and their points in the camera.

        Only those no deeper than ``farthest`` (metres; one for all, or one for each).
        """
        rows = self._roughly_in_view(rig, wTc, farthest)
        points = transform_to_camera(wTc, self.landmarks.positions[rows])
        limit = farthest if isinstance(farthest, float) else farthest[rows]
        near = (points[:, 2] > _NEAREST_DEPTH_M) & (points[:, 2] <= limit)
        rows, points = rows[near], points[near]
        column, row, disparity = project(rig, points).T
        vertical = 0.0
        if rig.vertical_baseline is not None:
            vertical = disparity * (rig.fy * rig.vertical_baseline) / (rig.fx * rig.baseline)
        inside = (column >= 0.0) & (column + disparity <= rig.width - 1.0)
        inside &= (row >= 0.0) & (row + vertical <= rig.height - 1.0)
        return rows[inside], points[inside]

    def _roughly_in_view(
        self, rig: CameraRig, wTc: FloatArray, farthest: float | FloatArray
    ) -> IntArray:
        """Rows of those and few others: by depth and the image's left and right, a hair wider.

        Most landmarks of a large map are behind the camera, beside its view, or too far.
        """
        right, _, forward = wTc[:3, :3].T
        depth = forward @ self.axes - forward @ wTc[:3, 3]
        across = right @ self.axes - right @ wTc[:3, 3]
        near = (depth > _NEAREST_DEPTH_M - _ROUNDING_M) & (depth <= farthest + _ROUNDING_M)
        near &= across >= -rig.cx / rig.fx * depth - _ROUNDING_M
        near &= across <= (rig.width - 1.0 - rig.cx) / rig.fx * depth + _ROUNDING_M
        return np.flatnonzero(near)

    def recognisable(
        self, rig: CameraRig, wTc: FloatArray, max_angle: float, scales: tuple[float, float]
    ) -> IntArray:
        """Rows (m,) of landmarks in view from ``wTc`` that have a view near to that from there.

        Near is a direction within ``max_angle`` (radians) of the stored one (unknown ones are
        near), and a predicted scale within ``scales`` (pixels), which the frame's features have.
        """
        rows, _ = self.in_view(rig, wTc, self.largest / scales[0] + _ROUNDING_M)
        sight = self.landmarks.positions[rows] - wTc[:3, 3]
        depth = np.maximum(sight @ wTc[:3, 2], _NEAREST_DEPTH_M)
        sight = sight / np.maximum(np.linalg.norm(sight, axis=1), 1e-9)[:, None]
        views, at = self.views_of(rows)
        cosine = np.einsum("vi,vi->v", self.views.direction[views], sight[at])
        near = ~(cosine < np.cos(max_angle))  # so NaN is near
        scale = self.views.size[views] / depth[at]
        near &= (scale >= scales[0]) & (scale <= scales[1])
        out = np.zeros(len(rows), np.bool_)
        out[at[near]] = True
        return np.asarray(rows[out])


def _owners(ids: IntArray, viewed: IntArray) -> tuple[IntArray, IntArray]:
    """The row (v,) of each view's landmark, -1 where there is none; views (n,) of each landmark."""
    first = np.flatnonzero(np.diff(viewed, prepend=-1))
    counts = np.diff(first, append=len(viewed))
    if np.array_equal(viewed[first], ids):  # as nearly always, and ten times as fast
        return np.repeat(np.arange(len(ids)), counts), counts
    row = np.searchsorted(ids, viewed)
    known = row < len(ids)
    known[known] = ids[row[known]] == viewed[known]
    return np.where(known, row, -1), np.bincount(row[known], minlength=len(ids))
