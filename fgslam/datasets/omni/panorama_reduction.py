"""Panoramas made smaller by averaging, without moving anything in them.

Plain resizing keeps the picture's *borders* in place; a panorama's first and last columns (and
rows) must keep their *centres*, or bearings would be off by half a pixel at the seam.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy import sparse

from fgslam.core.arrays import FloatArray, Image

Float32 = npt.NDArray[np.float32]


class PanoramaReduction:
    """Averages pictures (height, width, 3) of one size to a smaller one, around the seam."""

    def __init__(self, before: tuple[int, int], after: tuple[int, int]) -> None:
        """Sizes are (width, height); ``after`` must not be larger."""
        self._across = _averaging(before[0], after[0], periodic=True)
        self._down = _averaging(before[1], after[1], periodic=False)

    def __call__(self, image: Image) -> Image:
        """The smaller picture, rounded."""
        height, width, bands = image.shape
        rows = self._down @ image.reshape(height, -1).astype(np.float32)
        columns = rows.reshape(-1, width, bands).transpose(1, 0, 2).reshape(width, -1)
        out = (self._across @ columns).reshape(-1, rows.shape[0], bands).transpose(1, 0, 2)
        return np.ascontiguousarray(out + np.float32(0.5)).astype(np.uint8)


def _averaging(before: int, after: int, periodic: bool) -> sparse.csr_array:
    """(after, before) weights: each new pixel is the mean over the old ones that it covers."""
    step = (before - 1) / (after - 1)
    centres = np.arange(after) * step
    reach = int(np.ceil(0.5 * step + 0.5))
    old = np.rint(centres).astype(np.int64)[:, None] + np.arange(-reach, reach + 1)
    weights: FloatArray = np.clip(
        np.minimum(centres[:, None] + 0.5 * step, old + 0.5)
        - np.maximum(centres[:, None] - 0.5 * step, old - 0.5),
        0.0,
        None,
    )
    if periodic:
        # The first and the last column look the same way.
        old = np.mod(old, before - 1)
    else:
        weights = np.where((old >= 0) & (old < before), weights, 0.0)
        old = np.clip(old, 0, before - 1)
    weights /= weights.sum(axis=1, keepdims=True)
    new = np.repeat(np.arange(after), old.shape[1])
    entries = (weights.ravel().astype(np.float32), (new, old.ravel()))
    return sparse.csr_array(entries, shape=(after, before))
