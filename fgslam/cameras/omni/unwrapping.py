"""Where each pixel of one camera's image lies in another's, both at one viewpoint."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fgslam.cameras.omni.protocol import OmniCamera

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
