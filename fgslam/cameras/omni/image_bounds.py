"""Whether pixels lie in a picture, and whether a picture has a sensible size."""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError


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
