"""Distance of column segments: the measured spread of their descriptors between views of one thing.

Measured on ``omni_home`` (docs/derivations/omni_features.md, 4): matches of panoramas that see each
other, both ends of which lie within 0.7 degrees of where the true pose puts them; selected by the
covariance itself, from a diagonal guess in three rounds, without the 3 % furthest.
"""

from __future__ import annotations

import numpy as np

from fgslam.types import FloatArray

# fmt: off
_DEVIATIONS = np.array(
    [0.0635, 0.0024, 0.0020, 0.0038, 0.1256, 0.1280, 0.1283, 0.1051, 0.0787, 0.0692, 0.0641]
)
_CORRELATION_PERCENT = (
    (100,),
    (-9, 100),
    (-11, 90, 100),
    (-5, 73, 65, 100),
    (-9, -1, -1, 3, 100),
    (-6, 15, 19, 13, -27, 100),
    (-9, -4, -9, -4, 3, -20, 100),
    (-2, 8, 15, 8, 7, 19, -16, 100),
    (-7, -3, -9, -8, 15, -16, 32, -22, 100),
    (3, 6, 11, -7, 11, -1, 5, 16, 2, 100),
    (2, 1, -2, 1, 4, -17, 26, -14, 29, -3, 100),
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
