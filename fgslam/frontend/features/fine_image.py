"""An image with the values halfway between its pixels, to be sampled at fractions of them.

A straight line between two pixels loses fine contrast, most of it halfway, and shifts it by up to
a twentieth of a pixel in between; OpenCV's cubic kernel keeps the contrast and shifts all else by
as much. Lagrange's polynomial through six pixels is exact to the fifth degree (Deslauriers and
Dubuc 1989, Symmetric iterative interpolation processes), and between its values a line does.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import Image

Float32 = npt.NDArray[np.float32]

PER_PIXEL = 2
"""Values of a fine image along a pixel of its image."""

_HALFWAY = np.array([3.0, -25.0, 150.0, 150.0, -25.0, 3.0]) / 256.0
_HERE = np.ones(1)
_BEFORE = 2  # of the six pixels: those before the one that the place lies behind


@dataclass(eq=False)
class FineImage:
    """A grey image (h, w) uint8, and its values halfway between its pixels, found when needed."""

    image: Image

    @cached_property
    def grey(self) -> Float32:
        """(2 h - 1, 2 w - 1): the pixel (column, row) of the image is at (2 column, 2 row)."""
        height, width = self.image.shape
        values = self.image.astype(np.float32)  # not rounded: a dark image has few grey values
        out = np.empty((PER_PIXEL * height - 1, PER_PIXEL * width - 1), np.float32)
        out[::2, ::2] = values
        out[::2, 1::2] = _filtered(values, across=True, down=False)[:, :-1]
        out[1::2, ::2] = _filtered(values, across=False, down=True)[:-1]
        out[1::2, 1::2] = _filtered(values, across=True, down=True)[:-1, :-1]
        return out


def _filtered(values: Float32, *, across: bool, down: bool) -> Float32:
    """Values (h, w) half a pixel to the right, below, or both."""
    anchor = (_BEFORE if across else 0, _BEFORE if down else 0)
    along, below = (_HALFWAY if one else _HERE for one in (across, down))
    found = cv2.sepFilter2D(
        values, cv2.CV_32F, along, below, anchor=anchor, borderType=cv2.BORDER_REPLICATE
    )
    return np.asarray(found, np.float32)
