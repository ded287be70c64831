"""A lens or mirror calibrated as an ordinary camera, that looks straight up or down."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fgslam.cameras.lenses import RawCamera, checked_camera
from fgslam.cameras.omni.camera import inside, unit_rays
from fgslam.cameras.omni.mirrors import AHEAD_IS_UP
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError

AROUND = ("omni", "equidistant", "fov", "ds", "eucm", "ocam")
"""Models of cameras that may see a half space and more."""


@dataclass(frozen=True)
class LensCamera:
    """A camera of :mod:`fgslam.cameras.lenses` whose axis is the robot's vertical one.

    Mei's unified model with its distortion, for one, which need not be radial.

    Attributes:
        width, height: of the picture, pixels.
        lens: name of its model; one of :data:`AROUND`.
        matrix: (9,) intrinsics row by row.
        distortion: parameters of the lens.
        ring: inner and outer radius around the principal point that show the surroundings, pixels.
        up: whether the picture's middle looks up; else down, as of a mirror above the camera.
        ahead, clockwise: as of :class:`fgslam.cameras.omni.mirrors.MirrorFrame`.

    Raises:
        CalibrationError: the lens is none of these, or the radii do not rise from 0 or more.
    """

    width: int
    height: int
    lens: str
    matrix: tuple[float, ...]
    distortion: tuple[float, ...]
    ring: tuple[float, float]
    up: bool = False
    ahead: float = AHEAD_IS_UP
    clockwise: bool = True
    _raw: RawCamera = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.lens not in AROUND:
            raise CalibrationError(
                f"camera: a {self.lens} lens does not see all around; known: {', '.join(AROUND)}"
            )
        if not 0.0 <= self.ring[0] < self.ring[1] < np.inf:
            raise CalibrationError(
                f"camera: ring_px is {self.ring[0]:g} to {self.ring[1]:g}; radii must rise from 0 "
                "or more"
            )
        matrix = np.array(self.matrix).reshape(3, 3)
        distortion = np.array(self.distortion)
        size = (self.width, self.height)
        raw = RawCamera(*size, matrix, distortion, np.eye(4), model=self.lens)
        object.__setattr__(self, "_raw", checked_camera(raw))

    @classmethod
    def of(
        cls,
        raw: RawCamera,
        ring: tuple[float, float] | None,
        up: bool,
        ahead: float = AHEAD_IS_UP,
        clockwise: bool = True,
    ) -> LensCamera:
        """The camera of a calibration; without a ring the largest circle within the picture."""
        column, row = raw.matrix[:2, 2].tolist()
        circle = min(column, row, raw.width - 1 - column, raw.height - 1 - row)
        numbers = (tuple(raw.matrix.ravel().tolist()), tuple(raw.distortion.tolist()))
        ring = ring or (0.0, circle)
        return cls(raw.width, raw.height, raw.model, *numbers, ring, up, ahead, clockwise)

    @property
    def centre(self) -> tuple[float, float]:
        """Principal point, column and row in pixels."""
        return self.matrix[2], self.matrix[5]

    def rays(self, pixels: FloatArray) -> FloatArray:
        """(n, 3) unit rays; see :class:`fgslam.cameras.omni.camera.OmniCamera`."""
        seen = self._raw.unproject(self._within(np.asarray(pixels, np.float64)))
        angle = np.arctan2(seen[:, 1], seen[:, 0]) - self.ahead
        height = np.arctan2(seen[:, 2], np.hypot(seen[:, 0], seen[:, 1]))
        return unit_rays(angle if self.clockwise else -angle, height if self.up else -height)

    def pixels(self, rays: FloatArray) -> FloatArray:
        """(n, 2) pixels; see :class:`fgslam.cameras.omni.camera.OmniCamera`."""
        rays = np.asarray(rays, np.float64)
        bearing = np.arctan2(rays[:, 1], rays[:, 0])
        angle = (bearing if self.clockwise else -bearing) + self.ahead
        level, along = np.hypot(rays[:, 0], rays[:, 1]), rays[:, 2] if self.up else -rays[:, 2]
        own = np.column_stack([level * np.cos(angle), level * np.sin(angle), along])
        return self._within(self._raw.project(own))

    def _within(self, pixels: FloatArray) -> FloatArray:
        """The pixels, NaN outside the picture and the ring."""
        radius = np.hypot(*(pixels - self._raw.matrix[:2, 2]).T)
        seen = (radius >= self.ring[0]) & (radius <= self.ring[1])
        return np.where(seen[:, None], inside(pixels, self.width, self.height), np.nan)
