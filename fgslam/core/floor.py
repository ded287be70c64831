"""The floor that a wheeled robot keeps to: which camera motions it allows (Se et al. 5).

Shared by the front-end's least squares, the filters and the graphs, so that all of them mean the
same by "on the floor".
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import congruence, pose, so3_exp
from fgslam.core.sensors import CameraRig, vertical_of

DegreesOfFreedom: TypeAlias = Literal[3, 5, 6]


@dataclass(frozen=True, eq=False)
class Floor:
    """A horizontal floor under the camera.

    Attributes:
        dof: 6 no floor; 5 the camera's height is fixed (the paper's); 3 pitch and roll, too.
        down: (3,) unit vector of the world's vertical.
        hard: whether the floor is exact; soft, each frame may leave it by the deviations below.
        height_sigma_m: soft: standard deviation of the camera's height, metres.
        tilt_sigma_rad: soft: standard deviation of pitch and of roll, radians.
    """

    dof: DegreesOfFreedom
    down: FloatArray
    hard: bool = True
    height_sigma_m: float = 0.0
    tilt_sigma_rad: float = 0.0

    @staticmethod
    def under(rig: CameraRig, dof: DegreesOfFreedom) -> Floor:
        """The exact floor that is level with the robot's body in the first camera frame.

        Where nothing is known of how the camera is mounted, it is taken as level.
        """
        return Floor(dof, -vertical_of(rig.bTc))

    @property
    def rigid_dof(self) -> DegreesOfFreedom:
        """Degrees of freedom that remain exactly: 6 where the floor is soft."""
        return self.dof if self.hard else 6

    @cached_property
    def horizontal(self) -> FloatArray:
        """(3, 2) orthonormal horizontal directions of the world."""
        return np.asarray(np.linalg.svd(self.down[None, :])[2][1:].T)

    def constrain(self, wTc: FloatArray) -> FloatArray:
        """The nearest pose that the floor allows, as if it were hard."""
        if self.dof == 6:
            return wTc
        translation = wTc[:3, 3] - self.down * (self.down @ wTc[:3, 3])
        rotation = wTc[:3, :3]
        if self.dof == 3:
            rotation = self._turn_about_vertical(rotation)
        return pose(rotation, translation)

    def basis(self, wTc: FloatArray) -> FloatArray:
        """Columns (6, dof) span the tangent directions at ``wTc`` that the floor allows."""
        if self.dof == 6:
            return np.eye(6)
        cRw = wTc[:3, :3].T
        rotations = np.eye(3) if self.dof == 5 else (cRw @ self.down)[:, None]
        out = np.zeros((6, rotations.shape[1] + 2))
        out[:3, : rotations.shape[1]] = rotations
        out[3:, rotations.shape[1] :] = cRw @ self.horizontal
        return out

    def allowed_part(self, wTc: FloatArray, covariance: FloatArray) -> FloatArray:
        """A covariance (6, 6) without the directions that a hard floor excludes."""
        if self.rigid_dof == 6:
            return covariance
        basis = self.basis(wTc)
        return congruence(basis @ basis.T, covariance)

    def _turn_about_vertical(self, rotation: FloatArray) -> FloatArray:
        """The rotation about the vertical that is nearest to ``rotation``."""
        n = self.down
        sine = n @ np.array(
            [
                rotation[2, 1] - rotation[1, 2],
                rotation[0, 2] - rotation[2, 0],
                rotation[1, 0] - rotation[0, 1],
            ]
        )
        cosine = np.trace(rotation) - n @ rotation @ n
        return so3_exp(n * np.arctan2(sine, cosine))
