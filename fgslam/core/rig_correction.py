"""What a stated calibration leaves uncorrected, as displacements of a rig's pixels.

A rectified pair is as good as its calibration. What remains is smooth over each image: the second
camera is turned, its focal length, principal point and lens differ a little from those stated, and
the lens of all cameras bends what it should not. To first order in each, the terms of
:data:`TERMS` (Brown 1971 for the lens). Derived in docs/derivations/self_calibration.md.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import Brief, FloatArray
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.measurements import Increment, Observations
from fgslam.core.sensors import CameraRig, measurement_map, vertical_to_horizontal

TERMS = (
    "column",  # principal point
    "row",
    "yaw",  # rotation, radians
    "pitch",
    "roll",
    "focal",  # relative
    "decentring_x",  # of the lens
    "decentring_y",
    "radial",
)
"""Of each camera beside the reference, in units of the focal length."""

COMMON_TERMS = ("radial_of_all",)
"""What all cameras share; a common focal length is not among them: a straight drive hides it."""

EXPECTED_PX = 1.0
"""Displacement that a calibration is taken to leave, root mean square over the image: what the
matcher's epipolar gate (``StereoSettings.epipolar_px``) admits; a worse rig matches nothing."""

_GRID = 7  # points along each axis of the image at which the prior is stated


def term_names(rig: CameraRig) -> tuple[str, ...]:
    """Names of a correction's values, as ``left.yaw``: those of each camera, then the common."""
    cameras = ("left", "top")[: rig.cameras - 1]
    return tuple(f"{camera}.{term}" for camera in cameras for term in TERMS) + COMMON_TERMS


def displacements(rig: CameraRig, pixels: FloatArray) -> FloatArray:
    """Displacements (k, 2 * cameras, p) of pixels by a unit of each term, pixels.

    Args:
        rig: as calibrated.
        pixels: (k, cameras, 2) raw (column, row) in right, left[, top].
    """
    focal = np.array([rig.fx, rig.fy])
    count = len(TERMS)
    out = np.zeros((len(pixels), rig.cameras, 2, count * (rig.cameras - 1) + 1))
    rays = (pixels - [rig.cx, rig.cy]) / focal
    squared = (rays**2).sum(axis=2, keepdims=True)
    out[..., -1] = focal * rays * squared
    for camera in range(1, rig.cameras):
        at = slice(count * (camera - 1), count * camera)
        out[:, camera, :, at] = focal[:, None] * _terms(rays[:, camera], squared[:, camera])
    return out.reshape(len(pixels), 2 * rig.cameras, out.shape[3])


def _terms(rays: FloatArray, squared: FloatArray) -> FloatArray:
    """Displacements (k, 2, 9) of normalised image points (k, 2) in the order of TERMS."""
    x, y = rays.T
    r2 = squared[:, 0]
    zero, one = np.zeros_like(x), np.ones_like(x)
    columns = (one, zero, 1.0 + x * x, x * y, -y, x, r2 + 2.0 * x * x, 2.0 * x * y, x * r2)
    rows = (zero, one, x * y, 1.0 + y * y, x, y, 2.0 * x * y, r2 + 2.0 * y * y, y * r2)
    return np.stack([np.stack(columns, axis=1), np.stack(rows, axis=1)], axis=1)


def prior_information(rig: CameraRig, expected_px: float = EXPECTED_PX) -> FloatArray:
    """Information (p, p) of a calibration taken to leave ``expected_px`` over the image.

    As if a grid of displacements in every image had been measured as zero, with a noise for which
    the displacements predicted by the terms have this standard deviation in the mean.
    """
    column, row = np.meshgrid(*(np.linspace(0, n - 1, _GRID) for n in (rig.width, rig.height)))
    grid = np.stack([column.ravel(), row.ravel()], axis=1)
    unit = displacements(rig, np.repeat(grid[:, None], rig.cameras, axis=1))
    groups = [slice(c, c + len(TERMS)) for c in range(0, unit.shape[2] - 1, len(TERMS))]
    groups.append(slice(unit.shape[2] - 1, unit.shape[2]))
    out = np.zeros((unit.shape[2], unit.shape[2]))
    for k, group in enumerate(groups):
        rows = slice(2 * k + 2, 2 * k + 4) if k < rig.cameras - 1 else slice(None)
        jacobian = unit[:, rows, group].reshape(-1, group.stop - group.start)
        scale = jacobian.shape[1] / (len(jacobian) * expected_px**2)
        out[group, group] = scale * (jacobian.T @ jacobian)
    return out


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class RigCorrection(Brief):
    """Corrections of a rig against its calibration, with their uncertainty.

    Attributes:
        rig: as calibrated.
        values: (p,) in the order of :func:`term_names`; zero for an exact calibration.
        covariance: (p, p) of the above.
    """

    rig: CameraRig
    values: FloatArray
    covariance: FloatArray

    @staticmethod
    def none(rig: CameraRig) -> RigCorrection:
        """The calibration as stated, with the prior's covariance."""
        information = prior_information(rig)
        covariance = np.asarray(np.linalg.inv(information), np.float64)
        return RigCorrection(rig, np.zeros(len(information)), covariance)

    def at(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Displacements (k, 2 * cameras) that are taken off pixels, and sigmas of each."""
        unit = displacements(self.rig, pixels[:, : self.rig.cameras])
        variance = np.einsum("kap,pq,kaq->ka", unit, self.covariance, unit)
        return unit @ self.values, np.sqrt(variance)

    def centre_px(self) -> tuple[float, float]:
        """Disparity offset of a point in the middle of both images, pixels, and its sigma."""
        rig = self.rig
        middle = np.broadcast_to([rig.cx, rig.cy], (1, rig.cameras, 2))
        moved, sigma = self.at(middle)
        return float(moved[0, 2]), float(sigma[0, 2])

    def significance(self) -> float:
        """Chi-square, of ``len(values)`` degrees of freedom, that the calibration is exact."""
        return float(self.values @ np.linalg.solve(self.covariance, self.values))

    def corrected(self, observed: Observations) -> Observations:
        """The observations as an exact rig had measured them; their raw pixels stay."""
        rig, pixels = self.rig, observed.pixels[:, : self.rig.cameras]
        moved = displacements(rig, pixels) @ self.values
        fuse = measurement_map("fused", rig.cameras, vertical_to_horizontal(rig))
        return dataclasses.replace(observed, measurement=observed.measurement - moved @ fuse.T)

    def corrected_increment(self, increment: Increment) -> Increment:
        """A frame's increment with corrected observations, those of its loops included."""
        loops = tuple(
            dataclasses.replace(loop, observations=self.corrected(loop.observations))
            for loop in increment.loops
        )
        observed = self.corrected(increment.observations)
        return dataclasses.replace(increment, observations=observed, loops=loops)

    def corrected_log(self, log: MeasurementLog) -> MeasurementLog:
        """A log in which every frame is corrected."""
        frames = [self.corrected_increment(increment) for increment in log]
        return MeasurementLog(log.rig, log.motion_model, frames)
