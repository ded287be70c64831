"""What a lens model leaves of each image's displacement beside the terms of a rig's correction.

A random field over each image: smooth, as large in columns as in rows, and without what the terms
of :data:`fgslam.core.rig_correction.TERMS` follow. Its modes are those of Karhunen and Loeve, on a
grid. docs/derivations/measurement_noise.md.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.rig_correction import TERMS, camera_displacements
from fgslam.core.sensors import CameraRig

_LENGTH = 0.25  # of the image's width: deviation of the Gaussian kernel by which places are alike
_ACROSS = 13  # nodes along the longer side: three within a length
_HELD = 0.95  # share of the variance that the modes kept have


class _Modes(NamedTuple):
    """A field whose coordinates have variance one before the terms are taken out.

    Attributes:
        across, down: columns and rows of the nodes.
        values: (nodes, 2, modes) displacements, row by row of the grid.
    """

    across: FloatArray
    down: FloatArray
    values: FloatArray


def field_modes(rig: CameraRig) -> int:
    """Number of modes of all images."""
    return int(rig.cameras * _modes(rig).values.shape[2])


def field_displacements(rig: CameraRig, pixels: FloatArray) -> FloatArray:
    """Displacements (k, 2 * cameras, modes) of pixels (k, cameras, 2) by a unit of each mode.

    Independent units, each of variance one, are a field of one pixel a coordinate (root mean
    square), less what the terms follow. Images have fields of their own.
    """
    out = np.zeros((len(pixels), 2 * rig.cameras, field_modes(rig)))
    modes = _modes(rig)
    count = modes.values.shape[2]
    for camera in range(rig.cameras):
        rows = slice(2 * camera, 2 * camera + 2)
        out[:, rows, camera * count : (camera + 1) * count] = _between(modes, pixels[:, camera])
    return out


def _between(modes: _Modes, pixels: FloatArray) -> FloatArray:
    """(k, 2, modes) at pixels (k, 2), bilinear between nodes; outside as at the border."""
    column, right = _steps(modes.across, pixels[:, 0])
    row, low = _steps(modes.down, pixels[:, 1])
    out = np.zeros((len(pixels), *modes.values.shape[1:]))
    for below, share_row in ((0, 1.0 - low), (1, low)):
        for beside, share_column in ((0, 1.0 - right), (1, right)):
            node = (row + below) * len(modes.across) + column + beside
            out += (share_row * share_column)[:, None, None] * modes.values[node]
    return out


def _steps(nodes: FloatArray, where: FloatArray) -> tuple[IntArray, FloatArray]:
    """Nodes (k,) before places (k,), and the share of the way to the next."""
    steps = np.clip((where - nodes[0]) / (nodes[1] - nodes[0]), 0.0, len(nodes) - 1.0)
    first = np.minimum(steps.astype(np.int64), len(nodes) - 2)
    return first, steps - first


@lru_cache(maxsize=8)
def _modes(rig: CameraRig) -> _Modes:
    across, down = (_nodes(rig, size) for size in (rig.width, rig.height))
    places = np.stack([axis.ravel() for axis in np.meshgrid(across, down)], axis=1)
    apart = ((places[:, None] - places) ** 2).sum(axis=2)
    alike = np.kron(np.exp(-0.5 * apart / (_LENGTH * rig.width) ** 2), np.eye(2))
    unit = camera_displacements(rig, 1, places)[..., : len(TERMS)]
    terms = np.linalg.qr(unit.reshape(len(alike), -1))[0]
    rest = np.eye(len(alike)) - terms @ terms.T
    variances, axes = np.linalg.eigh(rest @ alike @ rest)
    shares = np.cumsum(variances[::-1]) / variances.sum()
    kept = slice(-1 - int(np.searchsorted(shares, _HELD)), None)
    values = axes[:, kept] * np.sqrt(variances[kept])
    return _Modes(across, down, values.reshape(len(places), 2, -1))


def _nodes(rig: CameraRig, size: int) -> FloatArray:
    """Along an axis of the image, about as far apart along both."""
    share = (size - 1) / (max(rig.width, rig.height) - 1)
    return np.linspace(0.0, size - 1.0, max(2, 1 + round((_ACROSS - 1) * share)))
