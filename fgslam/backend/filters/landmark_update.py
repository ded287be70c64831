"""Kalman filters of single landmarks, 3x3 each (Se, Lowe and Little 2001, Sections 4.1 and 6.4).

A matched landmark s with covariance S is updated by what a frame measures of it; the covariance of
the frame's pose is added to that of the measurement. One that was expected and not seen is grown
(type II); one that is new begins with its first observation (type IV).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from fgslam.backend.filters.filtered import placed
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import congruence, inverse_spd3, point_pose_jacobian, transform_to_camera
from fgslam.core.sensors import CameraRig, Observations

UpdateKind: TypeAlias = Literal["pixel", "world", "running_mean", "half"]


class Landmarks(NamedTuple):
    """Matched landmarks: positions (k, 3), covariances (k, 3, 3), innovation squared, summed.

    And the gains (k, 3, m) of the Kalman filters that updated them.
    """

    positions: FloatArray
    covariances: FloatArray
    nis: float = 0.0
    gain: FloatArray | None = None


def kalman_update(
    known: Landmarks, jacobian: FloatArray, innovation: FloatArray, noise: FloatArray
) -> Landmarks:
    """The Kalman filter (6.4): K = S H^T (H S H^T + R)^-1, s + K v, (I - K H) S.

    The new covariance is in Joseph's form, (I - K H) S (I - K H)^T + K R K^T.

    Args:
        known: s and S.
        jacobian: H (k, m, 3) of the measurement by the landmark.
        innovation: v (k, m), measured less expected.
        noise: R (k, m, m).
    """
    before, inverse = known.covariances, inverse_spd3 if noise.shape[1] == 3 else np.linalg.inv
    precision = inverse(congruence(jacobian, before) + noise)
    gain = before @ np.swapaxes(jacobian, 1, 2) @ precision
    keep = np.eye(before.shape[1]) - gain @ jacobian
    return Landmarks(
        known.positions + np.einsum("kij,kj->ki", gain, innovation),
        congruence(keep, before) + congruence(gain, noise),
        float(np.einsum("ki,kij,kj->", innovation, precision, innovation)),
        gain,
    )


def average(
    known: Landmarks, positions: FloatArray, noise: FloatArray, weight: FloatArray
) -> Landmarks:
    """Averaging (4.1): (1 - w) s + w s', (1 - w)^2 S + w^2 S', with weights w (k, 1)."""
    innovation = positions - known.positions
    precision = inverse_spd3(known.covariances + noise)
    squared = (weight**2)[:, :, None]
    kept = ((1.0 - weight) ** 2)[:, :, None]
    return Landmarks(
        known.positions + weight * innovation,
        kept * known.covariances + squared * noise,
        float(np.einsum("ki,kij,kj->", innovation, precision, innovation)),
    )


def average_weight(kind: UpdateKind, counts: FloatArray) -> FloatArray:
    """(k, 1) of a sighting: one over their number, which was ``counts`` (k,) before; or a half."""
    if kind == "half":
        return np.full((len(counts), 1), 0.5)
    return np.asarray(1.0 / (counts[:, None] + 1.0))


@dataclass(frozen=True, slots=True, eq=False)
class FrameUpdate:
    """The updates by one frame.

    Attributes:
        rig: the cameras.
        wTc: (4, 4) pose of the frame.
        pose_covariance: (6, 6) of it, which landmarks take over; None: it counts as exact.
    """

    rig: CameraRig
    wTc: FloatArray
    pose_covariance: FloatArray | None

    def update(
        self, kind: UpdateKind, known: Landmarks, counts: FloatArray, observed: Observations
    ) -> Landmarks:
        """Matched landmarks after the frame; ``counts`` (k,) frames saw each before it."""
        if kind == "pixel":
            return self.update_by_pixels(known, observed)
        if kind == "world":
            return self.update_by_positions(known, observed)
        return self.update_average(known, observed, kind, counts)

    def update_by_pixels(self, known: Landmarks, observed: Observations) -> Landmarks:
        """Measured are (column, row, disparity), linearised at the landmark; R + J P J^T."""
        points = transform_to_camera(self.wTc, known.positions)
        jacobian = self.rig.jacobian(points)
        noise = observed.covariance
        if self.pose_covariance is not None:
            by_pose = jacobian @ point_pose_jacobian(points)
            noise = noise + congruence(by_pose, self.pose_covariance)
        innovation = observed.measurement - self.rig.predict(points)
        return kalman_update(known, jacobian @ self.wTc[:3, :3].T, innovation, noise)

    def update_by_positions(self, known: Landmarks, observed: Observations) -> Landmarks:
        """Measured is the position, as in the paper: H = I."""
        positions, noise = self.place(observed)
        identity = np.broadcast_to(np.eye(3), noise.shape)
        return kalman_update(known, identity, positions - known.positions, noise)

    def update_average(
        self, known: Landmarks, observed: Observations, kind: UpdateKind, counts: FloatArray
    ) -> Landmarks:
        """The running mean of all sightings, or half old and half new."""
        return average(known, *self.place(observed), average_weight(kind, counts))

    def place(self, observed: Observations) -> tuple[FloatArray, FloatArray]:
        """World positions (k, 3) of single observations, and covariances (k, 3, 3)."""
        measurement, noise = observed.measurement, observed.covariance
        return placed(self.rig, self.wTc, measurement, noise, self.pose_covariance)
