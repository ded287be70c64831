"""How straight and upright vertical edges are in an unwrapped picture: a check of a calibration.

In a cylinder view (:class:`fgslam.cameras.omni.Cylinder`) of a level camera the image of
an upright edge is a part of a column, wherever it is. A wrong centre leans and bends them; so does
a tilted camera, by the tilt times the sine of their bearing from its axis. A wrong profile of the
mirror alone leaves them upright: that is for :mod:`fgslam.cameras.rings`.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray, Image

Float32 = npt.NDArray[np.float32]

_BLUR_PX = 1.5
_LEAST_SLOPE = 1.5  # grey levels a pixel; 2 grey levels of noise leave 0.16 after the blur
_MAX_LEAN = 0.2  # columns a row: steeper than 79 degrees


@dataclass(frozen=True, slots=True, eq=False)
class UprightEdges:
    """Long edges near the vertical, one row each.

    Attributes:
        column, row: (n,) middle, pixels.
        length: (n,) rows.
        lean: (n,) angle of the fitted line from the vertical, radians, clockwise positive.
        bow: (n,) root mean square distance of the edge's points from its line, pixels.
    """

    column: FloatArray
    row: FloatArray
    length: FloatArray
    lean: FloatArray
    bow: FloatArray

    def __len__(self) -> int:
        return len(self.column)


def upright_edges(image: Image, min_length: int) -> UprightEdges:
    """Finds edges within 11 degrees of the vertical, at least ``min_length`` rows long.

    Args:
        image: (height, width) or (height, width, 3), unwrapped.
        min_length: rows.
    """
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), _BLUR_PX)
    slope = np.asarray(cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=1, scale=0.5), np.float32)
    found = []
    for sign in (np.float32(1.0), np.float32(-1.0)):
        found += [
            _line(chain) for chain in _chains(np.asarray(sign * slope)) if len(chain) >= min_length
        ]
    kept = np.array([f for f in found if abs(np.tan(f[3])) <= _MAX_LEAN]).reshape(-1, 5)
    kept = kept[np.argsort(kept[:, 0], kind="stable")]
    return UprightEdges(*kept.T)


def _chains(slope: Float32) -> list[FloatArray]:
    """Edges (k, 2) of row and column: maxima along rows, linked downward row by row."""
    place, strong = _row_maxima(slope)
    growing: dict[int, list[tuple[int, float]]] = {}
    chains: list[list[tuple[int, float]]] = []
    for row in range(slope.shape[0]):
        grown: dict[int, list[tuple[int, float]]] = {}
        for column in np.flatnonzero(strong[row]).tolist():
            above = next((c for c in (column, column - 1, column + 1) if c in growing), None)
            if above is None:
                chain: list[tuple[int, float]] = []
                chains.append(chain)
            else:
                chain = growing.pop(above)
            chain.append((row, float(place[row, column])))
            grown[column] = chain
        growing = grown
    return [np.array(chain) for chain in chains]


def _row_maxima(slope: Float32) -> tuple[Float32, npt.NDArray[np.bool_]]:
    """Fractional column (h, w) by a parabola, and where there is a maximum at all."""
    before, top, after = slope[:, :-2], slope[:, 1:-1], slope[:, 2:]
    strong = np.zeros(slope.shape, np.bool_)
    strong[:, 1:-1] = (top > before) & (top >= after) & (top >= _LEAST_SLOPE)
    place = np.tile(np.arange(slope.shape[1], dtype=np.float32), (slope.shape[0], 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        shift = 0.5 * (before - after) / (before - 2.0 * top + after)
    place[:, 1:-1] += np.where(strong[:, 1:-1], shift, 0.0)
    return place, strong


def _line(chain: FloatArray) -> tuple[float, float, float, float, float]:
    """Column and row of the middle, rows, lean and bow of a chain (k, 2)."""
    row, column = chain[:, 0], chain[:, 1]
    middle = row.mean()
    slope, offset = np.polyfit(row - middle, column, 1)
    away = (column - offset - slope * (row - middle)) * np.cos(np.arctan(slope))
    bow = float(np.sqrt(np.mean(away**2)))
    return float(offset), float(middle), float(len(chain)), float(-np.arctan(slope)), bow
