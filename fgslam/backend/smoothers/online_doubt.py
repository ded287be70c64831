"""What the doubt about a rig's calibration adds to the newest pose's covariance, frame by frame.

The Schmidt-Kalman filter's cross terms (Schmidt 1966), as derivatives: how the newest pose and each
landmark of the map follow the terms that all cameras share. A frame costs what it sees. Final
covariances have them from the whole graph (:mod:`.rig_doubt`).
docs/derivations/measurement_noise.md.
"""

from __future__ import annotations

import numpy as np

from fgslam.backend.smoothers.rig_doubt import shared_covariance, shared_shifts
from fgslam.core.arrays import BoolArray, FloatArray, GrowingColumns, IntArray
from fgslam.core.geometry import (
    adjoint,
    inverse,
    projection_jacobian,
    skew,
    triangulate,
)
from fgslam.core.measurements import Increment, Observations
from fgslam.core.rig_correction import SHARED, RigCorrection
from fgslam.core.sensors import CameraRig

_LEAST_MATCHES = 6  # of a frame; with fewer, its pose follows the one before
_LEAST_DISPARITY_PX = 0.5  # farther points are known no better than their noise
_LEAST_INFORMATION = 1e-9  # of the mean, in directions that the matches leave open


class OnlineDoubt:
    """Derivatives of the newest pose and of the landmarks by the terms in SHARED."""

    def __init__(self, rig: CameraRig) -> None:
        """The first pose is known, the map empty."""
        self._rig = rig
        self._wTc: FloatArray | None = None
        self._gain = np.zeros((6, len(SHARED)))
        # By landmark: identity, derivative in world axes, information given the poses.
        self._map = GrowingColumns(
            ids=np.empty(0, np.int64),
            gain=np.empty((0, 3, len(SHARED))),
            information=np.empty((0, 3, 3)),
        )

    def added(self, correction: RigCorrection) -> FloatArray:
        """(6, 6) to be added to the covariance of the newest pose, in its own frame."""
        covariance = shared_covariance(correction)
        return self._gain @ covariance @ self._gain.T

    def observe(self, increment: Increment, wTc: FloatArray) -> None:
        """Takes in a frame: its accepted measurements and its pose as estimated."""
        if self._wTc is not None:
            self._gain = adjoint(inverse(inverse(self._wTc) @ wTc)) @ self._gain
        seen = increment.observations.select(~increment.rejected)
        near = seen.measurement[:, 2] > _LEAST_DISPARITY_PX
        look = _Look(self._rig, seen.select(near), wTc)
        rows, known = self._rows(look.ids)
        if self._wTc is not None and known.sum() >= _LEAST_MATCHES:
            self._gain = look.select(known).pose_gain(*self._at(rows[known]))
        self._update(look.select(known), rows[known])
        self._add(look.select(~known))
        self._map.drop(np.isin(self._map["ids"], increment.pruned_ids))
        self._wTc = wTc

    def _rows(self, ids: IntArray) -> tuple[IntArray, BoolArray]:
        """(k,) rows of landmarks in the map, and which of them are there."""
        have = self._map["ids"]
        if not len(have):
            return np.zeros(len(ids), np.int64), np.zeros(len(ids), np.bool_)
        rows = np.minimum(np.searchsorted(have, ids), len(have) - 1)
        return rows, np.asarray(have[rows] == ids)

    def _at(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        return self._map["gain"][rows], self._map["information"][rows]

    def _update(self, look: _Look, rows: IntArray) -> None:
        gain, information = self._at(rows)
        pull, told = look.landmarks()
        information = information + told
        off = look.off(self._gain) - look.by_point @ gain
        self._map["gain"][rows] = gain + np.linalg.solve(information, pull @ off)
        self._map["information"][rows] = information

    def _add(self, look: _Look) -> None:
        """Landmarks where their first measurement has them; identities ascend."""
        if not len(look.ids):
            return
        gain = np.linalg.solve(look.by_point, look.off(self._gain))
        new = {"ids": look.ids, "gain": gain, "information": look.landmarks()[1]}
        before = len(self._map)
        self._map.append(new)
        self._map.keep_ascending("ids", before)


class _Look:
    """Measurements (k) of a frame, linearised where they have their points."""

    def __init__(self, rig: CameraRig, seen: Observations, wTc: FloatArray) -> None:
        points = triangulate(rig, seen.measurement)
        projection = projection_jacobian(rig, points)
        self.ids = seen.ids
        self.shift = shared_shifts(rig, seen.measurement)
        self.by_pose = np.concatenate([projection @ skew(points), -projection], axis=2)
        self.by_point = projection @ wTc[:3, :3].T
        self.covariance = seen.covariance

    def select(self, rows: BoolArray) -> _Look:
        """Some of them."""
        out = object.__new__(_Look)
        for name, values in vars(self).items():
            setattr(out, name, values[rows])
        return out

    def off(self, pose_gain: FloatArray) -> FloatArray:
        """(k, 3, q) what of the measurements' shifts the pose does not follow."""
        return np.asarray(self.shift - self.by_pose @ pose_gain)

    def landmarks(self) -> tuple[FloatArray, FloatArray]:
        """What residuals pull landmarks by (k, 3, 3), and tell of them (k, 3, 3)."""
        pull = np.swapaxes(self.by_point, 1, 2) @ np.linalg.inv(self.covariance)
        return pull, pull @ self.by_point

    def pose_gain(self, gain: FloatArray, information: FloatArray) -> FloatArray:
        """(6, q) derivative of the pose that fits landmarks of these derivatives best."""
        turned = np.swapaxes(self.by_point, 1, 2)
        expected = self.covariance + self.by_point @ np.linalg.solve(information, turned)
        pull = np.swapaxes(self.by_pose, 1, 2) @ np.linalg.inv(expected)
        normal = (pull @ self.by_pose).sum(axis=0)
        normal += _LEAST_INFORMATION * np.trace(normal) / 6.0 * np.eye(6)
        return np.linalg.solve(normal, (pull @ (self.shift - self.by_point @ gain)).sum(axis=0))
