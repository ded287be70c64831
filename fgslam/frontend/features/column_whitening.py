"""Distance of column segments: the measured spread of their descriptors between views of one thing.

Measured on ``omni_home`` (docs/derivations/omni_features.md, 4): matches of panoramas that see each
other, both ends of which lie within 0.7 degrees of where the true pose puts them; selected by the
covariance itself, from a diagonal guess in three rounds, without the 3 % furthest.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray

# fmt: off
_DEVIATIONS = np.array(
    [0.0704, 0.0021, 0.0017, 0.0035, 0.1387, 0.1322, 0.1365, 0.1114, 0.0875, 0.0736, 0.0633]
)
_CORRELATION_PERCENT = (
    (100,),
    (-5, 100),
    (-4, 83, 100),
    (-5, 66, 55, 100),
    (-14, 1, 0, 6, 100),
    (-2, -2, 2, -9, -2, 100),
    (-6, 0, -6, -2, -9, -9, 100),
    (0, -11, -5, -9, 8, 21, -27, 100),
    (-3, -1, -5, -3, 4, 3, 43, -25, 100),
    (-4, -1, 4, -11, 2, 9, 8, 18, 5, 100),
    (4, -5, -10, -12, -11, -3, 22, -11, 35, -2, 100),
)
# fmt: on


def _covariance() -> FloatArray:
    lower = np.zeros((len(_DEVIATIONS), len(_DEVIATIONS)))
    for i, row in enumerate(_CORRELATION_PERCENT):
        lower[i, : i + 1] = np.array(row) / 100.0
    correlation = lower + lower.T - np.eye(len(_DEVIATIONS))
    return np.asarray(correlation * np.outer(_DEVIATIONS, _DEVIATIONS))


COVARIANCE = _covariance()
"""(11, 11) of differences: arsinh(g - 1/2), C_RB, C_RG, C_GB, DCT-II coefficients 1 to 7."""

_WHITENING = np.linalg.cholesky(np.linalg.inv(COVARIANCE))


def whitened(descriptors: FloatArray) -> FloatArray:
    """(n, 11) vectors whose Euclidean distance is the Mahalanobis distance of descriptors (n, 11).

    The horizon's coordinate g is compared on a scale that is even within a segment's length of the
    segment and logarithmic beyond, where g's own error grows with it.
    """
    even = descriptors.copy()
    even[:, 0] = np.arcsinh(descriptors[:, 0] - 0.5)
    return np.asarray(even @ _WHITENING)
