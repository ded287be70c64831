"""Kernels that cut patches out of an image, and add up what aligning them needs.

With the grey values f of a patch, their slopes f_x and f_y, and the weights w of its pixels (x, y),
counted from the middle::

    b = (1, f, f_x, f_y, f_x x, f_x y, f_y x, f_y y)    by light (2), a move (2), a deformation (4)
    G = sum w b b^T                                     the patch's gram matrix
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from fgslam.core.arrays import Float32, FloatArray
from fgslam.core.kernels import Kernel, invert

TERMS = 8
FLAT = 1e-3  # keeps patches without any contrast solvable


def sample(grey: Any, scale: int, place: Any, linear: Any, size: int, out: Any) -> None:
    """Grey values (size^2,) of a patch around a place, deformed; on straight lines between pixels.

    Beyond the border they are those of the border.
    """
    height, width, reach = grey.shape[0], grey.shape[1], 0.5 * (size - 1)
    far_x = reach * (abs(linear[0, 0]) + abs(linear[0, 1]))
    far_y = reach * (abs(linear[1, 0]) + abs(linear[1, 1]))
    inside = scale * (place[0] - far_x) >= 0.0 and scale * (place[0] + far_x) < width - 1
    inside &= scale * (place[1] - far_y) >= 0.0 and scale * (place[1] + far_y) < height - 1
    step_u, step_v = scale * linear[0, 0], scale * linear[1, 0]
    for row in range(size):
        first_u = scale * (place[0] + linear[0, 1] * (row - reach))
        first_v = scale * (place[1] + linear[1, 1] * (row - reach))
        for column in range(size):
            u = first_u + step_u * (column - reach)
            v = first_v + step_v * (column - reach)
            if not inside:
                u = min(u, width - 1.0) if u > 0.0 else 0.0  # what is no number, too
                v = min(v, height - 1.0) if v > 0.0 else 0.0
            left, top = np.uintp(u), np.uintp(v)
            right, below = left + np.uintp(1), top + np.uintp(1)
            if not inside:
                right, below = min(right, np.uintp(width - 1)), min(below, np.uintp(height - 1))
            x, y = u - left, v - top
            above, under = grey[top], grey[below]
            upper = (1.0 - x) * above[left] + x * above[right]
            lower = (1.0 - x) * under[left] + x * under[right]
            out[row * size + column] = (1.0 - y) * upper + y * lower


def weighted_terms(cut: Any, n: int, size: int, weight: Any, out: Any) -> None:
    """Vectors w b (m, 8) of the pixels of patch n; ``cut`` has a rim of one pixel."""
    wide, reach = size + 2, 0.5 * (size - 1)
    for row in range(size):
        for column in range(size):
            k, at = row * size + column, (row + 1) * wide + column + 1
            half, x, y = 0.5 * weight[k], column - reach, row - reach
            across = half * cut[n, at + 1] - half * cut[n, at - 1]
            down = half * cut[n, at + wide] - half * cut[n, at - wide]
            out[k, 0], out[k, 1] = weight[k], weight[k] * cut[n, at]
            out[k, 2], out[k, 3] = across, down
            out[k, 4], out[k, 5], out[k, 6], out[k, 7] = across * x, across * y, down * x, down * y


def _cut(grey: Any, scale: int, places: Any, linear: Any, size: int, cut: Any) -> None:
    for n in range(len(places)):
        sample(grey, scale, places[n], linear, size, cut[n])


def _add_up(cut: Any, size: int, weight: Any, prior: Any, gram: Any, inverse: Any, b: Any) -> None:
    for n in range(len(cut)):
        gram[n] = 0.0
        weighted_terms(cut, n, size, weight, b)
        for k in range(len(weight)):
            share = 1.0 / weight[k]
            for i in range(TERMS):
                factor = share * b[k, i]
                for j in range(i, TERMS):
                    gram[n, i, j] += factor * b[k, j]
        for i in range(TERMS):
            for j in range(TERMS):
                gram[n, i, j] = inverse[n, i, j] = gram[n, min(i, j), max(i, j)]
            inverse[n, i, i] += prior[i]
        invert(inverse[n], TERMS)


# ------------------------------------------------------------------------------------------
# The same in NumPy


def offsets(size: int) -> tuple[FloatArray, FloatArray]:
    """(m,) columns and rows of a patch's pixels from its middle."""
    y, x = np.indices((size, size)).reshape(2, -1) - 0.5 * (size - 1)
    return x, y


def remapped(grey: Float32, columns: FloatArray, rows: FloatArray) -> Float32:
    """Grey values (n, m) between pixels; n below 32767."""
    if not columns.size:  # OpenCV refuses empty maps
        return np.empty(columns.shape, np.float32)
    at = columns.astype(np.float32), rows.astype(np.float32)
    seen = cv2.remap(grey, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(seen, np.float32)


def every_term(cut: Float32, size: int) -> FloatArray:
    """(n, 8, m) b of all pixels of all patches."""
    wide = cut.reshape(-1, size + 2, size + 2).astype(np.float64)
    middle, (x, y) = slice(1, -1), offsets(size)
    across = (0.5 * (wide[:, middle, 2:] - wide[:, middle, :-2])).reshape(len(cut), size**2)
    down = (0.5 * (wide[:, 2:, middle] - wide[:, :-2, middle])).reshape(len(cut), size**2)
    first = wide[:, middle, middle].reshape(len(cut), size**2)
    parts = (np.ones_like(first), first, across, down)
    return np.stack([*parts, across * x, across * y, down * x, down * y], axis=1)


def _cut_numpy(
    grey: Float32, scale: int, places: FloatArray, _: FloatArray, size: int, cut: Float32
) -> None:
    x, y = offsets(size)
    cut[:] = remapped(grey, scale * (places[:, :1] + x), scale * (places[:, 1:] + y))


def _add_up_numpy(
    cut: Float32,
    size: int,
    weight: FloatArray,
    prior: FloatArray,
    gram: FloatArray,
    inverse: FloatArray,
    _: FloatArray,
) -> None:
    b = every_term(cut, size)
    gram[:] = (weight * b) @ b.transpose(0, 2, 1)
    inverse[:] = np.linalg.inv(gram + np.diag(prior))


cut_patches = Kernel(_cut, _cut_numpy, "f4[:,::1] i8 f8[:,::1] f8[:,::1] i8 f4[:,::1]", sample)
"""(grey, scale, places (n, 2), no deformation (2, 2), size, cut): grey values ``cut`` (n, size^2)
around places of an image with ``scale`` values of ``grey`` along a pixel."""
add_up = Kernel(
    *(_add_up, _add_up_numpy, "f4[:,::1] i8 f8[::1] f8[::1] f8[:,:,::1] f8[:,:,::1] f8[:,::1]"),
    *(weighted_terms, invert),
)
"""(cut (n, (size + 2)^2), size, weight (m,), prior (8,), gram (n, 8, 8), inverse, room (m, 8)): G,
and its inverse with the prior added on the diagonal."""
