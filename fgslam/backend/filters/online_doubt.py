"""Consider covariance: what a rig's calibration adds to poses and landmarks, frame by frame.

The Schmidt-Kalman filter's cross terms (Schmidt 1966), as derivatives: how the newest pose and each
landmark of the map follow the terms that all cameras share, and the field that no term follows,
neither of which is estimated. A frame costs what it sees. Estimates stay as they are. Final
covariances of a whole graph have the same from the graph
(:mod:`fgslam.backend.smoothers.rig_doubt`).
docs/derivations/measurement_noise.md.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from fgslam.backend.filters.error_columns import ErrorColumns
from fgslam.core.arrays import FloatArray, IntArray, Rows
from fgslam.core.estimates import LandmarkMap, Prediction
from fgslam.core.floor import Floor
from fgslam.core.geometry import (
    adjoint,
    inverse,
    projection_jacobian,
    skew,
    triangulate,
)
from fgslam.core.measurements import Increment, Observations
from fgslam.core.rig_correction import (
    EXPECTED_PX,
    SHARED,
    RigCorrection,
    shared_displacements,
    shared_information,
)
from fgslam.core.rig_field import field_displacements, field_modes
from fgslam.core.sensors import CameraRig, pixel_model, rig_map, vertical_to_horizontal
from fgslam.core.store import Kept

_LEAST_MATCHES = 6  # of a frame; with fewer, its pose follows the one before
_LEAST_DISPARITY_PX = 0.5  # farther points are known no better than their noise
_LEAST_INFORMATION = 1e-9  # of the mean, in directions that the matches leave open
_NONE = np.zeros((6, 6))


class RigTerms:
    """The terms in SHARED of a rig that calibrates itself, then the modes of its field: unknown.

    Of a rig that is exact, or that is taken as stated, none is unknown.
    """

    deviations: Kept[FloatArray | None]
    _applied: Kept[FloatArray]
    _field_px: Kept[float]

    def __init__(self, sensor: CameraRig) -> None:
        """Those of a rig that is not exact."""
        self.rig = None if sensor.exact else sensor
        self.count = len(SHARED) + (0 if self.rig is None else field_modes(self.rig))
        """How many there are, q."""
        self.deviations = None
        """(q, q) lower root of their covariance; None: they are known."""
        self._applied = np.empty(0)
        self._field_px = 0.0

    @property
    def covariance(self) -> FloatArray | None:
        """(q, q) of the terms; None: they are known."""
        return None if self.deviations is None else self.deviations @ self.deviations.T

    def update(self, increment: Increment) -> None:
        """Takes in the correction that a frame's measurements contain, and the field's size."""
        known = increment.settled_rig
        self._hear(increment.rig_correction, 0.0 if known is None else known.field_px)

    def shifts(self, measured: FloatArray) -> FloatArray:
        """(k, 3, q) by which a unit of each displaces measurements (k, 3); zero where known."""
        if self.rig is None or self.deviations is None:
            return np.zeros((len(measured), 3, self.count))
        pixels = pixels_of(self.rig, measured)
        of_pixels = [shared_displacements(self.rig, pixels), field_displacements(self.rig, pixels)]
        return fused(self.rig, np.concatenate(of_pixels, axis=2))

    def _hear(self, correction: FloatArray | None, field_px: float) -> None:
        """Both change seldom."""
        if self.rig is None or correction is None:
            return
        if np.array_equal(correction, self._applied) and field_px == self._field_px:
            return
        self._applied, self._field_px = correction, field_px
        none = RigCorrection.none(self.rig)
        shared = shared_covariance(dataclasses.replace(none, values=correction))
        self.deviations = field_px * np.eye(self.count)
        self.deviations[: len(SHARED), : len(SHARED)] = np.linalg.cholesky(shared)


class OnlineDoubt(ErrorColumns):
    """Derivatives of the newest pose and of the landmarks by what is unknown of the rig.

    Of a rig that is exact, or that is taken as stated, nothing is added.
    """

    _terms: Kept[RigTerms]
    _wTc: Kept[FloatArray | None]

    def __init__(self, sensor: CameraRig, floor: Floor) -> None:
        """The first pose is known, the map empty.

        Args:
            sensor: that measures.
            floor: a hard one leaves the pose these directions alone.
        """
        # By landmark: derivative in world axes, information given the poses.
        self._terms = RigTerms(sensor)
        super().__init__(self._terms.count, information=np.empty((0, 3, 3)))
        self._floor = floor
        self._wTc = None

    @property
    def present(self) -> bool:
        """Whether any term is unknown."""
        return self._terms.deviations is not None

    def observe(self, increment: Increment, wTc: FloatArray) -> None:
        """Takes in a frame: its accepted measurements and its pose as estimated."""
        self._terms.update(increment)
        rig = self._terms.rig
        if rig is None or not self.present:
            return
        if self._wTc is not None:
            self._gain = adjoint(inverse(inverse(self._wTc) @ wTc)) @ self._gain
        kept = increment.observations.select(~increment.rejected)
        near = kept.measurement[:, 2] > _LEAST_DISPARITY_PX
        seen = _Linearised.of(rig, self._terms, kept.select(near), wTc)
        rows, known = self._rows(seen.ids)
        if self._wTc is not None and known.sum() >= _LEAST_MATCHES:
            basis = self._floor.basis(wTc) if self._floor.rigid_dof < 6 else np.eye(6)
            self._gain = seen.select(known).pose_gain(*self._at(rows[known]), basis)
        self._update(seen.select(known), rows[known])
        self._add(seen.select(~known))
        self.forget(increment.pruned_ids)
        self._wTc = wTc

    def of_pose(self) -> FloatArray:
        """(6, 6) what the terms add to the newest pose's covariance; zero where they are known."""
        if self._terms.deviations is None:
            return _NONE  # one for all frames: a smoother keeps that of each
        root = self._gain @ self._terms.deviations
        return np.asarray(root @ root.T)

    def pose(self, newest: Prediction) -> Prediction:
        """The newest pose with what the terms add to its covariance."""
        if not self.present:
            return newest
        return Prediction(newest.wTc, newest.covariance + self.of_pose())

    def landmarks(self, known: LandmarkMap) -> LandmarkMap:
        """Landmarks with what the terms add to their covariances."""
        covariance = self._terms.covariance
        if covariance is None or self._held:
            return known
        gain = self._of("gain", known.ids)
        more = gain @ covariance @ np.swapaxes(gain, 1, 2)
        return dataclasses.replace(known, covariances=known.covariances + more)

    def joint(self, ids: IntArray, covariance: FloatArray) -> FloatArray:
        """A joint covariance (6 + 3k, 6 + 3k) of newest pose and landmarks with what it adds."""
        terms = self._terms.covariance
        if terms is None:
            return covariance
        gain = np.concatenate([self._gain, self._of_map(ids).reshape(-1, self._terms.count)])
        return np.asarray(covariance + gain @ terms @ gain.T)

    # ----------------------------------------------------------------------------------------

    def _at(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        return self._map["gain"][rows], self._map["information"][rows]

    def _update(self, seen: _Linearised, rows: IntArray) -> None:
        gain, information = self._at(rows)
        pull, added = seen.landmark_information()
        information = information + added
        off = seen.off(self._gain) - seen.by_point @ gain
        self._map["gain"][rows] = gain + np.linalg.solve(information, pull @ off)
        self._map["information"][rows] = information

    def _add(self, seen: _Linearised) -> None:
        """Landmarks where their first measurement has them; identities ascend."""
        if len(seen.ids):
            gain = np.linalg.solve(seen.by_point, seen.off(self._gain))
            information = seen.landmark_information()[1]
            self._append({"ids": seen.ids, "gain": gain, "information": information})


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class _Linearised(Rows):
    """Measurements (k) of a frame, linearised where they have their points."""

    ids: IntArray
    shift: FloatArray
    by_pose: FloatArray
    by_point: FloatArray
    covariance: FloatArray

    @staticmethod
    def of(rig: CameraRig, terms: RigTerms, seen: Observations, wTc: FloatArray) -> _Linearised:
        points = triangulate(rig, seen.measurement)
        projection = projection_jacobian(rig, points)
        by_pose = np.concatenate([projection @ skew(points), -projection], axis=2)
        by_point = projection @ wTc[:3, :3].T
        shift = terms.shifts(seen.measurement)
        return _Linearised(seen.ids, shift, by_pose, by_point, seen.covariance)

    def off(self, pose_gain: FloatArray) -> FloatArray:
        """(k, 3, q) what of the measurements' shifts the pose does not follow."""
        return np.asarray(self.shift - self.by_pose @ pose_gain)

    def landmark_information(self) -> tuple[FloatArray, FloatArray]:
        """What residuals pull landmarks by (k, 3, 3), and their information (k, 3, 3)."""
        pull = np.swapaxes(self.by_point, 1, 2) @ np.linalg.inv(self.covariance)
        return pull, pull @ self.by_point

    def pose_gain(self, gain: FloatArray, information: FloatArray, basis: FloatArray) -> FloatArray:
        """(6, q) derivative of the pose that fits landmarks of these derivatives best.

        ``basis`` (6, d) spans the directions that the pose has.
        """
        turned = np.swapaxes(self.by_point, 1, 2)
        expected = self.covariance + self.by_point @ np.linalg.solve(information, turned)
        by_pose = self.by_pose @ basis
        pull = np.swapaxes(by_pose, 1, 2) @ np.linalg.inv(expected)
        normal, freedom = (pull @ by_pose).sum(axis=0), basis.shape[1]
        normal += _LEAST_INFORMATION * np.trace(normal) / freedom * np.eye(freedom)
        off = self.shift - self.by_point @ gain
        return np.asarray(basis @ np.linalg.solve(normal, (pull @ off).sum(axis=0)))


def pixels_of(rig: CameraRig, measured: FloatArray) -> FloatArray:
    """(k, cameras, 2) where a point of these measurements (k, 3) is seen."""
    model = pixel_model(rig.cameras, vertical_to_horizontal(rig))
    return np.asarray((measured @ model.T).reshape(-1, rig.cameras, 2))


def fused(rig: CameraRig, of_pixels: FloatArray) -> FloatArray:
    """(k, 3, n) of measurements, by displacements of their pixels (k, 2 * cameras, n)."""
    return np.asarray(rig_map(rig) @ of_pixels)


def shared_covariance(correction: RigCorrection) -> FloatArray:
    """(q, q) covariance of what nothing estimates; (0, 0) of an exact rig."""
    if correction.rig.exact:
        return np.empty((0, 0))
    # EXPECTED_PX is of one coordinate between two images: as much of a pixel in each of them.
    off_px = max(EXPECTED_PX, correction.rms_px() / np.sqrt(2.0))
    return np.asarray(np.linalg.inv(shared_information(correction.rig, off_px)))
