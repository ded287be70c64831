"""Sensors that measure landmarks: rigs of two or three cameras, range-bearing sensors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from fgslam.core.arrays import FloatArray
from fgslam.core.brief import Brief


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class CameraRig(Brief):
    """Two or three rectified pinhole cameras with equal intrinsics; the right one is the reference.

    The left camera sits ``baseline`` metres along the reference camera's -x axis, the top camera
    (if any) ``vertical_baseline`` metres along its -y axis (Se et al. 2.2). Hence a point at depth
    Z has disparities ``d = c_left - c_right = fx * baseline / Z`` and
    ``r_top - r_right = fy * vertical_baseline / Z``, both positive.

    Attributes:
        width, height: image size in pixels.
        fx, fy, cx, cy: intrinsics in pixels.
        baseline: horizontal baseline in metres.
        vertical_baseline: vertical baseline in metres, or None for a two-camera rig.
        bTc: (4, 4) pose of the reference camera in the robot's body frame (the lever arm).
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    baseline: float
    vertical_baseline: float | None
    bTc: FloatArray

    @property
    def cameras(self) -> int:
        """Number of cameras, 2 or 3."""
        return 2 if self.vertical_baseline is None else 3


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class RangeBearingSensor(Brief):
    """Measures (azimuth, elevation, range) of landmarks: radians, metres; axes as a camera's.

    ``azimuth = atan2(x, z)`` is positive to the right, ``elevation = atan2(-y, hypot(x, z))`` up.

    Attributes:
        max_range_m: farthest landmark seen.
        bTc: (4, 4) pose of the sensor in the robot's body frame.
    """

    max_range_m: float
    bTc: FloatArray


Sensor: TypeAlias = CameraRig | RangeBearingSensor
"""What measures landmarks; each by three numbers."""
