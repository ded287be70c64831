"""The map as relocalisation knows it, and the tentative matches of a frame with it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.geometry import transform_to_camera, wrap
from fgslam.core.sensors import CameraRig
from fgslam.core.types import Floor, LandmarkAppearances, LandmarkMap, StereoFeatures
from fgslam.frontend.features.matching import AppearanceIndex, Neighbours

_NEAREST_M = 0.3
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
        landmarks: LandmarkMap,
        appearances: LandmarkAppearances,
        map_sigma_m: float = 0.0,
        index: AppearanceIndex | None = None,
    ) -> KnownMap:
        """Landmarks without a view, and views without a landmark, are left out.

        ``map_sigma_m`` is added to the landmarks' noise; ``index`` is one over these appearances.
        Positions and views are not copied where all are kept, and must not change.
        """
        owners, counts = _owners(landmarks.ids, appearances.ids)
        if (owners < 0).any():
            appearances, index = appearances.of(landmarks.ids), None
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
            AppearanceIndex(appearances.descriptors, appearances.words) if index is None else index,
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

        Only those at a depth of at most ``farthest`` (metres; one for all, or one for each).
        """
        rows = self._roughly_in_view(rig, wTc, farthest)
        points = transform_to_camera(wTc, self.landmarks.positions[rows])
        limit = farthest if isinstance(farthest, float) else farthest[rows]
        near = (points[:, 2] > _NEAREST_M) & (points[:, 2] <= limit)
        rows, points = rows[near], points[near]
        column, row, disparity = rig.predict(points).T
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

        Most landmarks of a large map are behind the camera, next to its view, or too far.
        """
        right, _, forward = wTc[:3, :3].T
        depth = forward @ self.axes - forward @ wTc[:3, 3]
        across = right @ self.axes - right @ wTc[:3, 3]
        near = depth <= farthest + _ROUNDING_M
        near &= depth > _NEAREST_M - _ROUNDING_M
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
        ray = self.landmarks.positions[rows] - wTc[:3, 3]
        distance = np.maximum((ray @ wTc[:3, :3])[:, 2], _NEAREST_M)
        ray = ray / np.maximum(np.linalg.norm(ray, axis=1), 1e-9)[:, None]
        views, at = self.views_of(rows)
        cosine = np.einsum("vi,vi->v", self.views.direction[views], ray[at])
        near = ~(cosine < np.cos(max_angle))  # so NaN is near
        scale = self.views.size[views] / distance[at]
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


MAX_DISTANCE = 400.0  # of descriptors, whose norm is 512
_RATIO = 0.85  # a gap: the next place is farther than its predecessor by this ratio
_MOST_PLACES = 3  # that may share a feature before it counts for nothing
_SAME_PLACE_M = 0.3  # landmarks this near to one another are one place
_SIZE_RATIO = 1.6  # of a feature's physical size to a landmark's, at most
_ORIENTATION_DEG = 30.0  # on a level floor, largest difference
_HEIGHT_M = 0.05  # on a level floor, largest difference beyond what the covariances allow
_GATE_SIGMAS = 3.0  # of sizes and heights; what their covariances allow


@dataclass(frozen=True, slots=True, eq=False)
class Tentative:
    """Matches by appearance, in the order of features, then of distance.

    Attributes:
        features: (k,) indices of features, ascending; a feature may have several candidates.
        landmarks: (k,) rows of the map.
        distances: (k,) of descriptors.
        places: (k,) number of different places among the feature's candidates.
    """

    features: IntArray
    landmarks: IntArray
    distances: FloatArray
    places: IntArray

    def __len__(self) -> int:
        return len(self.features)


def gated(
    features: StereoFeatures,
    pairs: tuple[IntArray, IntArray],
    landmarks: LandmarkMap,
    appearances: tuple[LandmarkAppearances, IntArray],
    floor: Floor,
) -> BoolArray:
    """Which pairs (feature, view) agree in size and, on a level floor, in height and orientation.

    Args:
        features: of the frame.
        pairs: (k,) indices of features and (k,) rows of stored views.
        landmarks: the map.
        appearances: stored views and the map's row of each view's landmark.
        floor: decides whether the camera is upright and at one height.
    """
    (i, v), (views, owners) = pairs, appearances
    depth = np.abs(features.position[i, 2])
    sigma = np.sqrt(features.position_covariance[i, 2, 2]) / np.maximum(depth, 1e-6)
    sizes = features.scale[i] * np.abs(features.position[i, 2])
    ratio = np.abs(np.log(sizes / np.maximum(views.size[v], 1e-9)))
    keep = ratio <= np.log(_SIZE_RATIO) + _GATE_SIGMAS * sigma
    if floor.rigid_dof != 3:
        return np.asarray(keep)
    turn = np.abs(wrap(features.orientation[i] - views.orientation[v]))
    keep &= turn <= np.deg2rad(_ORIENTATION_DEG)
    return np.asarray(keep & _heights_agree(features, i, landmarks, owners[v], floor))


def _heights_agree(
    features: StereoFeatures,
    i: IntArray,
    landmarks: LandmarkMap,
    rows: IntArray,
    floor: Floor,
) -> BoolArray:
    """Motion on a level floor leaves heights as they are."""
    down = floor.down
    difference = np.abs(features.position[i] @ down - landmarks.positions[rows] @ down)
    variance = np.einsum("i,kij,j->k", down, features.position_covariance[i], down)
    variance += np.einsum("i,kij,j->k", down, landmarks.covariances[rows], down)
    return np.asarray(difference <= _HEIGHT_M + _GATE_SIGMAS * np.sqrt(variance))


def specific(
    neighbours: Neighbours,
    keep: BoolArray,
    owners: IntArray,
    landmarks: LandmarkMap,
) -> Tentative:
    """Candidates of each feature, up to the first clear gap of distances between places.

    A feature that resembles a few places keeps them all, as repeated texture must; one that
    resembles many (no gap within three places) keeps none.

    Args:
        neighbours: (q, k) nearest views of each feature.
        keep: (q, k) of which passed the gates.
        owners: the map's row of each view's landmark.
        landmarks: the map.
    """
    found: list[tuple[int, int, int]] = []  # feature, landmark, places of the feature
    distances: list[float] = []
    limits = np.where(keep, neighbours.distances, np.inf)
    for i in np.flatnonzero((limits <= MAX_DISTANCE).any(axis=1)):
        order = np.flatnonzero(keep[i])
        own, far = owners[neighbours.rows[i, order]], limits[i, order]
        at = landmarks.positions[own]
        # A candidate's place is the first candidate that lies so near.
        near = np.linalg.norm(at[:, None] - at[None], axis=2) <= _SAME_PLACE_M
        end, count = _gap(np.argmax(near, axis=1), far)
        first: dict[int, int] = {}  # the first view of each landmark
        for k in np.flatnonzero(far[:end] <= MAX_DISTANCE).tolist():
            first.setdefault(int(own[k]), k)
        for k in sorted(first.values(), key=lambda k: (far[k], own[k])):
            found.append((int(i), int(own[k]), count))
            distances.append(float(far[k]))
    table = np.array(found, np.int64).reshape(-1, 3)
    return Tentative(table[:, 0], table[:, 1], np.array(distances), table[:, 2])


def _gap(place: IntArray, far: FloatArray) -> tuple[int, int]:
    """Number of leading candidates before the first gap, and of their places; 0 without a gap."""
    seen: list[int] = []
    for k, p in enumerate(place):
        if p in seen:
            continue
        # Of a place the first view counts.
        if seen and max(far[:k][place[:k] == p][0] for p in seen) <= _RATIO * far[k]:
            return k, len(seen)
        if len(seen) == _MOST_PLACES:
            return 0, 0
        seen.append(int(p))
    return len(place), len(seen)
