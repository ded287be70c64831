"""Grey and colour 8-bit images from what cameras and image libraries give."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import Image
from fgslam.core.errors import FrameError

_CHANNELS = (1, 3, 4)


def grey_image(image: npt.ArrayLike, name: str = "image") -> Image:
    """The image in grey, (height, width) uint8, contiguous; the same input gives the same bytes.

    Colour is weighted as in ITU-R BT.601 (0.299 R + 0.587 G + 0.114 B). Of uint16 the upper eight
    bits are kept, whatever the image holds: stretching each image to its own contrast would change
    its features from frame to frame. Scale 10- and 12-bit images to 16 bits first.

    Args:
        image: (height, width) grey, or (height, width, 1, 3 or 4) grey, RGB or RGBA; uint8 or
            uint16; any memory layout. Not changed, and not copied where it is grey, uint8 and
            contiguous already.
        name: of the image in messages.

    Raises:
        FrameError: another type or shape.
    """
    array = _checked(as_array(image, name), name)
    if array.dtype == np.uint16:
        array = (array >> 8).astype(np.uint8)
    if array.ndim == 2:
        return np.ascontiguousarray(array, np.uint8)
    if array.shape[2] == 1:
        return np.ascontiguousarray(array[:, :, 0], np.uint8)
    code = cv2.COLOR_RGB2GRAY if array.shape[2] == 3 else cv2.COLOR_RGBA2GRAY
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(array), code), np.uint8)


def as_array(image: npt.ArrayLike, name: str) -> npt.NDArray[Any]:
    """The image as an array, of any type and shape. Raises FrameError where it has none."""
    if image is None:
        raise FrameError(f"{name} is missing (None); could its file be read?")
    if isinstance(image, str | bytes | Path):
        raise FrameError(f"{name} is a {type(image).__name__}; give its pixels as an array")
    try:
        return np.asarray(image)
    except (TypeError, ValueError):
        raise FrameError(f"{name} has rows of different lengths; give one array") from None


def _checked(array: npt.NDArray[Any], name: str) -> npt.NDArray[Any]:
    if array.dtype not in (np.uint8, np.uint16):
        raise FrameError(
            f"{name} is of type {array.dtype}; give uint8 or uint16 (a float image in 0 to 1: "
            "(255 * image).astype(numpy.uint8))"
        )
    grey = array.ndim == 2
    colour = array.ndim == 3 and array.shape[2] in _CHANNELS
    if not (grey or colour) or 0 in array.shape:
        raise FrameError(
            f"{name} has shape {array.shape}; give (height, width), or (height, width, 3) in red, "
            "green, blue"
        )
    return array


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
