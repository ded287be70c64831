"""What every omnidirectional camera model offers.

Camera axes are the robot's: x forward, y left, z up. A ray's *bearing* is ``atan2(y, x)``, its
*elevation* ``atan2(z, hypot(x, y))``: radians, counter-clockwise and up positive. Pixels are
(column, row), the centre of the top-left one is (0, 0).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import CalibrationError, FrameError
from fgslam.core.planar import wrap


class OmniCamera(Protocol):
    """A calibrated camera that sees (nearly) all around. Immutable."""

    @property
    def width(self) -> int:
        """Of the image, in pixels."""
        ...

    @property
    def height(self) -> int:
        """Of the image, in pixels."""
        ...

    def rays(self, pixels: FloatArray) -> FloatArray:
        """(n, 3) unit vectors along which pixels (n, 2) look; NaN outside the field of view."""
        ...

    def pixels(self, rays: FloatArray) -> FloatArray:
        """(n, 2) pixels of rays (n, 3) of any length; NaN where the camera does not see them."""
        ...


def require_own_image(camera: OmniCamera, image: Image) -> None:
    """Raises FrameError unless an image is (height, width, 3) uint8 of the camera's size."""
    wanted = (camera.height, camera.width, 3)
    if image.shape != wanted or image.dtype != np.uint8:
        raise FrameError(
            f"an image is {image.dtype} {image.shape}, but the camera's are uint8 {wanted} "
            "(rows, columns, R G B); take the calibration of this camera at this size"
        )


# --------------------------------------------------------------------------------------------
# Pixels to bearings and elevations with their covariance


_STEP_PX = 0.05  # of the central difference: its error is a millionth of the derivative


def unit_rays(bearing: FloatArray, elevation: FloatArray) -> FloatArray:
    """(n, 3) rays of bearings and elevations (n,), radians; the inverse of :func:`angles_of`."""
    level = np.cos(elevation)
    return np.column_stack([level * np.cos(bearing), level * np.sin(bearing), np.sin(elevation)])


def angles_of(rays: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bearings and elevations (n,) of rays (n, 3), radians."""
    bearing = np.arctan2(rays[:, 1], rays[:, 0])
    elevation = np.arctan2(rays[:, 2], np.hypot(rays[:, 0], rays[:, 1]))
    return bearing, elevation


def measure(
    camera: OmniCamera, pixels: FloatArray, sigma_px: float | FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """What pixels measure, to first order in their noise.

    Args:
        camera: that took the image.
        pixels: (n, 2).
        sigma_px: standard deviation of each coordinate in pixels, one number or (n,).

    Returns:
        Bearing (n,) and elevation (n,) in radians, and covariance (n, 2, 2) of both; NaN outside
        the field of view. At its very border the derivative is one-sided.
    """
    pixels = np.asarray(pixels, dtype=np.float64)
    n = len(pixels)
    offsets = _STEP_PX * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]], dtype=np.float64)
    bearing, elevation = angles_of(camera.rays((offsets[:, None] + pixels[None]).reshape(-1, 2)))
    bearings, elevations = bearing.reshape(5, n), elevation.reshape(5, n)
    jacobian = np.empty((n, 2, 2))
    for axis in range(2):
        plus, minus = 1 + 2 * axis, 2 + 2 * axis
        jacobian[:, 0, axis] = _slope(bearings[[plus, 0, minus]])
        jacobian[:, 1, axis] = _slope(elevations[[plus, 0, minus]])
    variance = np.broadcast_to(np.square(sigma_px), (n,))
    covariance = (jacobian @ jacobian.transpose(0, 2, 1)) * variance[:, None, None]
    return bearings[0], elevations[0], covariance


def _slope(values: FloatArray) -> FloatArray:
    """(n,) derivative from (3, n) angles after, at and before; one-sided where one is NaN."""
    after, before = wrap(values[0] - values[1]), wrap(values[1] - values[2])
    both = 0.5 * (after + before)
    return np.asarray(
        np.where(np.isfinite(both), both, np.where(np.isfinite(after), after, before)) / _STEP_PX
    )


# --------------------------------------------------------------------------------------------
# Whether pixels lie in a picture, and whether a picture has a sensible size


def require_size(what: str, width: int, height: int) -> None:
    """Raises CalibrationError for a picture without two rows and columns; ``what`` names it."""
    if width < 2 or height < 2:
        raise CalibrationError(f"{what}: a picture of {width}x{height} pixels; give at least 2x2")


def inside(pixels: FloatArray, width: int, height: int) -> FloatArray:
    """Pixels (n, 2), NaN where they lie outside the picture.

    A pixel reaches half a pixel around its centre, so the picture reaches from -0.5 to size - 0.5.
    """
    c, r = pixels[:, 0], pixels[:, 1]
    outside = (c < -0.5) | (c > width - 0.5) | (r < -0.5) | (r > height - 0.5)
    return np.where(outside[:, None], np.nan, pixels)


# --------------------------------------------------------------------------------------------
# Where each pixel of one camera's image lies in another's, both at one viewpoint


Float32 = npt.NDArray[np.float32]

OUTSIDE = -1e4
"""Coordinate of pixels that the source does not see: outside any image, so that it stays black."""


def unwrap_maps(source: OmniCamera, target: OmniCamera) -> tuple[Float32, Float32]:
    """Columns and rows (target.height, target.width) in the source's image, for a remap."""
    columns, rows = np.meshgrid(np.arange(target.width), np.arange(target.height))
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    rays = target.rays(pixels)
    seen = np.isfinite(rays[:, 0])
    found = np.full((len(pixels), 2), np.nan)
    found[seen] = source.pixels(rays[seen])
    found = np.where(np.isfinite(found), found, OUTSIDE)
    maps = found.reshape(target.height, target.width, 2).astype(np.float32)
    return np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])
