"""The landmark database: identity, appearance and bookkeeping (Se et al. 4 and 6.1).

Geometry (positions and covariances) belongs to the estimator; the two are joined by landmark ids.
Each entry is [s, o, m, n, l] with a descriptor; the scale is kept as the physical size
``s * Z``, because the image scale is inversely proportional to the depth (3.1; design E-S7).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.geometry import (
    congruence,
    point_pose_jacobian,
    project,
    projection_jacobian,
    rotate_covariances,
    transform_to_camera,
)
from fgslam.settings.frontend import DatabaseSettings
from fgslam.types import (
    BoolArray,
    ByteArray,
    CameraRig,
    FloatArray,
    IntArray,
    LandmarkMap,
    Prediction,
    StateArrays,
    StereoFeatures,
)

_NEAREST_DEPTH_M = 0.1
_COLUMNS = (
    "ids",
    "size",
    "orientation",
    "descriptors",
    "hits",
    "misses",
    "missed",
    "seen",
    "colour",
)


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
            matched (else each frame would start them anew) but are not missed.
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


class LandmarkDatabase:
    """Landmarks' appearance and counts: hits n, misses m, consecutive misses l."""

    def __init__(self, rig: CameraRig, settings: DatabaseSettings, max_disparity_px: float) -> None:
        """Starts empty (4.2); landmarks of more than ``max_disparity_px`` are not expected."""
        self._rig = rig
        self._settings = settings
        self._max_disparity = max_disparity_px
        self._next_id = 0
        self._frame = 0
        self.ids: IntArray = np.empty(0, np.int64)
        self.size: FloatArray = np.empty(0)
        self.orientation: FloatArray = np.empty(0)
        self.descriptors: ByteArray = np.empty((0, 128), np.uint8)
        self.hits: IntArray = np.empty(0, np.int64)
        self.misses: IntArray = np.empty(0, np.int64)
        self.missed: IntArray = np.empty(0, np.int64)
        self.seen: IntArray = np.empty(0, np.int64)
        self.colour: ByteArray = np.empty(0, np.uint8)

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def valid(self) -> BoolArray:
        """(n,) landmarks seen often enough to be trusted (6.1)."""
        return self.hits >= self._settings.valid_hits

    def expected(self, landmarks: LandmarkMap, wTc: FloatArray) -> ExpectedLandmarks:
        """Landmarks of the map that should or may be in view from ``wTc`` (4.4)."""
        points = transform_to_camera(wTc, landmarks.positions)
        in_view, certain, measurement = self._in_view(points)
        rows = np.flatnonzero(in_view)
        ids = landmarks.ids[rows]
        own = self.rows(ids)
        return ExpectedLandmarks(
            ids=ids,
            rows=rows,
            measurement=measurement[rows],
            scale=self.size[own] / points[rows, 2],
            orientation=self.orientation[own],
            descriptors=self.descriptors[own],
            certain=certain[rows],
        )

    def rows(self, ids: IntArray) -> IntArray:
        """Rows of landmarks that are in the database; ids ascending in it."""
        return np.searchsorted(self.ids, ids)

    def new_ids(self, count: int) -> IntArray:
        """The identities that the next ``count`` landmarks will get."""
        return np.arange(self._next_id, self._next_id + count)

    def record_hits(self, ids: IntArray, features: StereoFeatures, which: IntArray) -> None:
        """Type III: a match resets l and refreshes the appearance."""
        rows = self.rows(ids)
        self.missed[rows] = 0
        self.seen[rows] = self._frame
        self.hits[rows] += 1
        self.size[rows] = features.scale[which] * features.position[which, 2]
        self.orientation[rows] = features.orientation[which]
        self.descriptors[rows] = features.descriptors[which]

    def record_misses(self, ids: IntArray) -> None:
        """Type II: expected in view and not matched."""
        rows = self.rows(ids)
        self.missed[rows] += 1
        self.misses[rows] += 1

    def add(self, features: StereoFeatures, which: IntArray, colour: ByteArray) -> IntArray:
        """Type IV: starts a track for each chosen feature (4.2); returns their identities."""
        ids = self.new_ids(len(which))
        self._next_id += len(which)
        zeros = np.zeros(len(which), np.int64)
        self._extend(
            ids=ids,
            size=features.scale[which] * features.position[which, 2],
            orientation=features.orientation[which],
            descriptors=features.descriptors[which],
            hits=zeros + 1,
            misses=zeros,
            missed=zeros,
            seen=zeros + self._frame,
            colour=colour,
        )
        return ids

    def prune(self) -> IntArray:
        """Ends a frame: drops landmarks missed N times in a row (4.3); returns their identities.

        On request also those that were never confirmed and not seen for long, in view or not.
        """
        gone = self.missed >= self._settings.prune_after_misses
        forget_after = self._settings.forget_unconfirmed_after
        if forget_after is not None:
            gone |= ~self.valid & (self._frame >= self.seen + forget_after)
        self._frame += 1
        if not gone.any():
            return np.empty(0, np.int64)
        pruned = self.ids[gone]
        for name in _COLUMNS:
            setattr(self, name, getattr(self, name)[~gone])
        return pruned

    def state(self) -> StateArrays:
        """All entries, as arrays; a snapshot."""
        out: StateArrays = {name: getattr(self, name).copy() for name in _COLUMNS}
        out["next_id"] = np.array(self._next_id)
        out["frame"] = np.array(self._frame)
        return out

    def restore(self, state: StateArrays) -> None:
        """Continues from :meth:`state`."""
        for name in _COLUMNS:
            setattr(self, name, state[name].copy())
        self._next_id = int(state["next_id"])
        self._frame = int(state["frame"])

    def _extend(self, **columns: FloatArray | IntArray | ByteArray) -> None:
        for name, values in columns.items():
            setattr(self, name, np.concatenate([getattr(self, name), values]))

    def _in_view(self, points: FloatArray) -> tuple[BoolArray, BoolArray, FloatArray]:
        """Which points may be in view, which are well inside it, and where they project to."""
        depth = points[:, 2]
        front = depth > _NEAREST_DEPTH_M
        points = np.where(front[:, None], points, 1.0)
        measurement = project(self._rig, points)
        if self._settings.field_of_view == "cone":
            tangent = np.tan(np.deg2rad(self._settings.cone_deg))
            possible = certain = (np.abs(points[:, :2]) < tangent * points[:, 2:]).all(axis=1)
        else:
            possible = self._in_images(measurement, -self._settings.border_px)
            certain = self._in_images(measurement, self._settings.border_px)
        possible = possible & front & (measurement[:, 2] <= self._max_disparity)
        return possible, certain, measurement

    def _in_images(self, measurement: FloatArray, border: float) -> BoolArray:
        """Whether a landmark falls inside all images of the rig, the border left out."""
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
