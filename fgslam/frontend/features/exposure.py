"""What an image's exposure leaves of its contrast: the measure that detection is relative to.

A contrast threshold in grey levels is one for well exposed images. The same scene at a tenth of the
light has a tenth of every contrast, and of the camera's noise what does not come with the light.
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import Image, IntArray

_GREY_LEVELS = 256
_TAILS = (0.01, 0.99)  # a lamp and its reflection are not what an image is exposed for
_FULL_RANGE = 170.0
"""Grey levels between the tails of a well exposed image: two thirds of the scale."""

_LAPLACIAN = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_ANSWERS = 8 * 255 + 1  # different sizes that its answers can have
_LAPLACIAN_GAIN = 6.0  # deviation of its answer to white noise of deviation one
_MEDIAN_OF_NORMAL = 0.6745  # median of a standard normal variable's absolute value
_ROUNDING = 12.0**-0.5  # deviation of what rounding to grey levels adds


def contrast_share(image: Image) -> float:
    """Contrast of a grey image (height, width) against a well exposed one's, in [0, 1].

    The grey levels that all but the darkest and the brightest hundredth of the pixels lie in. An
    image that fills two thirds of the scale has the share 1, one of half the light half of it.
    """
    low, high = np.searchsorted(_up_to(image, _GREY_LEVELS), np.array(_TAILS) * image.size)
    return float(min(1.0, (high - low) / _FULL_RANGE))


def noise_sigma(image: Image) -> float:
    """Deviation of a grey image's noise, grey levels; at least that of rounding.

    From the answers to the difference of two Laplacians, which is blind to edges that are straight
    (Immerkaer 1996); by their median instead of their mean, so that texture counts little.
    """
    answers = np.abs(cv2.filter2D(image, cv2.CV_16S, _LAPLACIAN))[1:-1, 1:-1]
    if answers.size == 0:
        return _ROUNDING
    counts = _up_to(answers.astype(np.uint16), _ANSWERS)
    ranks = np.array([(answers.size - 1) // 2, answers.size // 2])
    median = float(np.searchsorted(counts, ranks, side="right").mean())
    return max(median / (_MEDIAN_OF_NORMAL * _LAPLACIAN_GAIN), _ROUNDING)


def _up_to(values: Image | npt.NDArray[np.uint16], levels: int) -> IntArray:
    """(levels,) how many values are at most 0, 1 and so on: exact, and without sorting."""
    counts = cv2.calcHist([values], [0], None, (levels,), (0, levels))
    return np.cumsum(counts, dtype=np.int64)
