"""Colour 8-bit images from what cameras and image libraries give."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import Image
from fgslam.core.errors import FrameError
from fgslam.frontend.features.grey import as_array


def colour_image(image: npt.ArrayLike, size: tuple[int, int], name: str = "image") -> Image:
    """The image in colour, (height, width, 3) uint8 in red, green, blue, contiguous.

    A grey image gets three equal channels: its features are found, their colours tell nothing.

    Args:
        image: (height, width) grey, or (height, width, 3) RGB; uint8; any memory layout. Not
            changed, and not copied where it is colour and contiguous already.
        size: width and height of the camera's images.
        name: of the image in messages.

    Raises:
        FrameError: another type, shape or size.
    """
    array = as_array(image, name)
    wanted = (size[1], size[0])
    if array.dtype != np.uint8:
        raise FrameError(
            f"{name} is of type {array.dtype}; give uint8 (a float image in 0 to 1: "
            "(255 * image).astype(numpy.uint8))"
        )
    if array.shape not in (wanted, (*wanted, 3)):
        raise FrameError(
            f"{name} has shape {array.shape}, but the camera's images are {wanted} in grey or "
            f"{(*wanted, 3)} in red, green, blue; scale it, or take the calibration for its size"
        )
    if array.ndim == 2:
        array = np.repeat(array[:, :, None], 3, axis=2)
    return np.ascontiguousarray(array)
