"""What a camera to the left of an image's own would see, by the disparity of each pixel."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, Image

_CRACK_PX = 3.0  # between two neighbours on one surface, in the original image
_LEAST_WEIGHT = 1e-3
_SMOOTH = (41, 41)  # what fills the parts that nothing is known of has no texture of this size


def seen_from_the_left(image: Image, shift: npt.NDArray[np.float32], known: BoolArray) -> Image:
    """The image (h, w, ...) with each known pixel further right by its ``shift`` (h, w).

    Nearer surfaces hide farther ones. What nobody sees is filled without texture.
    """
    source = _source_columns(shift, known)
    seen = np.isfinite(source)
    rows = np.repeat(np.arange(len(image), dtype=np.float32)[:, None], image.shape[1], axis=1)
    columns = np.where(seen, source, -1.0).astype(np.float32)
    moved = np.asarray(cv2.remap(image, columns, rows, cv2.INTER_LINEAR))
    there = seen if image.ndim == 2 else seen[:, :, None]
    weight = cv2.blur(seen.astype(np.float32), _SMOOTH)
    around = cv2.blur(np.where(there, moved, 0).astype(np.float32), _SMOOTH)
    weight = np.maximum(weight, _LEAST_WEIGHT).reshape(*weight.shape, *(1,) * (image.ndim - 2))
    return np.asarray(np.where(there, moved, around / weight), np.uint8)


def _source_columns(shift: npt.NDArray[np.float32], known: BoolArray) -> npt.NDArray[np.float32]:
    """Column (h, w) of the original at which each pixel of the view looks; NaN where none."""
    height, width = shift.shape
    rows, columns = np.nonzero(known)
    order = np.argsort(shift[rows, columns], kind="stable")  # the nearest last, which stays
    rows, columns = rows[order], columns[order]
    there = columns + shift[rows, columns]
    pixel = np.rint(there).astype(np.int64)
    inside = (pixel >= 0) & (pixel < width)
    source = np.full((height, width), np.nan, np.float32)
    source[rows[inside], pixel[inside]] = (columns + pixel - there)[inside]
    # A surface that is stretched leaves cracks of a pixel.
    before, after = source[:, :-2], source[:, 2:]
    crack = np.isnan(source[:, 1:-1]) & (np.abs(after - before) <= _CRACK_PX)
    source[:, 1:-1][crack] = 0.5 * (before + after)[crack]
    return source
