"""How likely a tentative match is right, and what a hypothesis that it agrees with gains by it.

A match much better than its runner-up is nearly always right, one barely better hardly ever.
Counting both alike wastes what matching knows; so a hypothesis is supported by likelihoods
(Tordoff and Murray 2005): with probability p of being right, a normalised epipolar residual r has
density (1 - p) u + p N(r), u being what wrong matches have.
"""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.homing import BearingMatches, FeatureKind

_LOGIT = {FeatureKind.SIFT: (-3.0, 10.5), FeatureKind.COLUMN: (-2.3, 3.5)}
"""Logit of p as a line over quality: offset and slope, by kind.

Measured on the 22 pairs of ``omni_home`` that were answered rightly, 8,555 SIFT matches and 876
column matches in bins of quality: SIFT 0.1 at 0.05, 0.4 at 0.22, 0.7 at 0.35, 0.9 at 0.6; columns
0.2 at 0.22, 0.3 at 0.4, 0.5 at 0.6.
"""
_LEAST, _MOST = 0.02, 0.95
_SCATTER = 1.2  # of right matches' residuals over their stated noise, measured on the same pairs
COMMON_CHANCE = 0.05
"""That a wrong match agrees with a hypothesis, while searching; an answer's own is measured."""
_SHARES = np.array([1.0, 0.5, 0.25, 0.1])
"""Scenes differ in how many of their matches survive; p is taken times each of these, evenly."""


def right_probability(matches: BearingMatches) -> FloatArray:
    """(n,) probability that a match is right, before any geometry."""
    p = np.empty(len(matches))
    for kind, (offset, slope) in _LOGIT.items():
        of_kind = matches.kind == int(kind)
        p[of_kind] = 1.0 / (1.0 + np.exp(-offset - slope * matches.quality[of_kind]))
    return np.clip(p, _LEAST, _MOST)


def gain(residuals: FloatArray, sigmas: float, chance: float) -> FloatArray:
    """N(r) / u: how much denser right residuals are than wrong ones; any shape.

    ``chance`` is the probability that a wrong match keeps within ``sigmas``.
    """
    density = np.exp(-0.5 * (residuals / _SCATTER) ** 2) / (_SCATTER * np.sqrt(2.0 * np.pi))
    return np.asarray(density * (2.0 * sigmas / chance))


def log_likelihood_ratio(gains: FloatArray, probability: FloatArray) -> float:
    """Log of how much better a hypothesis explains the matches than chance does.

    Args:
        gains: (n,) as from :func:`gain`, zero for matches that contradict it.
        probability: (n,) of being right.

    If all matches are wrong the ratio's expectation is 1; by Markov's inequality it exceeds x with
    probability 1 / x at most.
    """
    shares = _SHARES[:, None] * probability
    logs = np.sum(np.log1p(shares * (gains - 1.0)), axis=1)
    return float(np.logaddexp.reduce(logs) - np.log(len(_SHARES)))
