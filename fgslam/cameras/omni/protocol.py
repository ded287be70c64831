"""What every omnidirectional camera model offers.

Camera axes are the robot's: x forward, y left, z up. A ray's *bearing* is ``atan2(y, x)``, its
*elevation* ``atan2(z, hypot(x, y))``: radians, counter-clockwise and up positive. Pixels are
(column, row), the centre of the top-left one is (0, 0).
"""

from __future__ import annotations

from typing import Protocol

from fgslam.core.arrays import FloatArray


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
