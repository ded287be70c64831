"""Colour moments of patches and segments: eq. 1 of Goedemé et al., with centred bands.

Printed, C_PQ = (int PQ)(int 1) / (int P)(int Q) with P and Q "centralised around their means"
divides zero by zero, for a centralised band integrates to zero. Two readings make sense:

* ``ratio``: without centralising, mean(PQ) / (mean P mean Q) = 1 + cov(P, Q) / (mean P mean Q).
  Mindru's D02: a gain of either band cancels, an offset does not;
* ``correlation``: centralised and divided by the deviations, Pearson's: both cancel.
"""

from __future__ import annotations

from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.frontend.features.settings import ColourMomentSettings

_MEAN_FLOOR = 8.0
"""Grey values; means (and deviations) below it count as it, so that the noise of dark patches is no
colour."""

PATCH_SIGMAS = 6.0  # half side of the square of a feature, in SIFT scales: as its descriptor's

Float32Image: TypeAlias = npt.NDArray[np.float32]

PAIRS = ((0, 2), (0, 1), (1, 2))
"""R and B, R and G, G and B: the order of the paper and of all colour descriptors here."""


def moment_images(image: Image, with_squares: bool) -> list[Float32Image]:
    """Bands of an image (h, w, 3), products of their :data:`PAIRS`, on demand their squares.

    Returns:
        6 or 9 float32 images (h, w); products of two bytes are exact.
    """
    bands: list[Float32Image] = [band.astype(np.float32) for band in cv2.split(image)]
    products = [bands[p] * bands[q] for p, q in PAIRS]
    squares = [band * band for band in bands] if with_squares else []
    return [*bands, *products, *squares]


def colour_from_means(means: FloatArray, settings: ColourMomentSettings) -> FloatArray:
    """(n, 3) C_RB, C_RG, C_GB of the means (n, 6 or 9) of :func:`moment_images` over n areas."""
    first = means[:, [p for p, _ in PAIRS]]
    second = means[:, [q for _, q in PAIRS]]
    if settings.form == "ratio":
        floor = _MEAN_FLOOR
        # The covariance is floored with its means: dark areas tend to 1, as grey ones are.
        covariance = means[:, 3:6] - first * second
        return np.asarray(1.0 + covariance / (np.maximum(first, floor) * np.maximum(second, floor)))
    variances = np.maximum(means[:, 6:9] - means[:, :3] ** 2, _MEAN_FLOOR**2)
    deviations = np.sqrt(variances)
    scale = deviations[:, [p for p, _ in PAIRS]] * deviations[:, [q for _, q in PAIRS]]
    return np.asarray((means[:, 3:6] - first * second) / scale)


class PatchColours:
    """Colour moments over any upright rectangles of one image, by summed-area tables."""

    def __init__(self, image: Image, settings: ColourMomentSettings) -> None:
        """Sums up an image (h, w, 3)."""
        self._settings = settings
        self._shape = image.shape[:2]
        parts = moment_images(image, settings.form == "correlation")
        self._tables = [cv2.integral(part, sdepth=cv2.CV_64F) for part in parts]

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
        return colour_from_means(np.column_stack(sums) / area[:, None], self._settings)
