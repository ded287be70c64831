"""Colour moments of patches and segments: eq. 1 of Goedemé et al., with centred bands.

Printed, C_PQ = (int PQ)(int 1) / (int P)(int Q) with P and Q "centralised around their means"
divides zero by zero, for a centralised band integrates to zero. Without centralising it is
Mindru's D02, mean(PQ) / (mean P mean Q) = 1 + cov(P, Q) / (mean P mean Q): a gain of either band
cancels, an offset does not.
"""

from __future__ import annotations

from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray, Image, IntArray

_MEAN_FLOOR = 8.0
"""Grey values; means below it count as it, so that the noise of dark patches is no colour."""

PATCH_SIGMAS = 6.0  # half side of the square of a feature, in SIFT scales: as its descriptor's

Float32Image: TypeAlias = npt.NDArray[np.float32]

PAIRS = ((0, 2), (0, 1), (1, 2))
"""R and B, R and G, G and B: the order of the paper and of all colour descriptors here."""


def moment_images(image: Image) -> list[Float32Image]:
    """Bands of an image (h, w, 3) and products of their :data:`PAIRS`: 6 float32 images (h, w).

    Products of two bytes are exact.
    """
    bands: list[Float32Image] = [band.astype(np.float32) for band in cv2.split(image)]
    return [*bands, *(bands[p] * bands[q] for p, q in PAIRS)]


def colour_from_means(means: FloatArray) -> FloatArray:
    """(n, 3) C_RB, C_RG, C_GB of the means (n, 6) of :func:`moment_images` over n areas."""
    first = means[:, [p for p, _ in PAIRS]]
    second = means[:, [q for _, q in PAIRS]]
    # The covariance is floored with its means: dark areas tend to 1, as grey ones are.
    covariance = means[:, 3:6] - first * second
    floored = np.maximum(first, _MEAN_FLOOR) * np.maximum(second, _MEAN_FLOOR)
    return np.asarray(1.0 + covariance / floored)


class PatchColours:
    """Colour moments over any upright rectangles of one image, by summed-area tables."""

    def __init__(self, image: Image) -> None:
        """Sums up an image (h, w, 3)."""
        self._shape = image.shape[:2]
        self._tables = [cv2.integral(part, sdepth=cv2.CV_64F) for part in moment_images(image)]

    def around(self, pixels: FloatArray, scale_px: FloatArray) -> FloatArray:
        """(n, 3) over squares around pixels (n, 2), as wide as scales (n,) ask for."""
        half = np.maximum(PATCH_SIGMAS * scale_px, 1.0)[:, None]
        low = np.floor(pixels - half + 0.5).astype(np.int64)
        high = np.floor(pixels + half + 0.5).astype(np.int64) + 1
        limit = np.array([self._shape[1], self._shape[0]])
        return self.boxes(np.clip(low, 0, limit - 1), np.clip(high, 1, limit))

    def boxes(self, low: IntArray, high: IntArray) -> FloatArray:
        """(n, 3) over rectangles from (column, row) ``low`` (n, 2) to ``high``, exclusive."""
        (x0, y0), (x1, y1) = low.T, high.T
        area = ((x1 - x0) * (y1 - y0)).astype(np.float64)
        sums = [t[y1, x1] - t[y0, x1] - t[y1, x0] + t[y0, x0] for t in self._tables]
        return colour_from_means(np.column_stack(sums) / area[:, None])
