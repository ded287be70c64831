"""Tentative correspondences of two omnidirectional images (Goedemé et al. III-A).

SIFT features: the nearest descriptor, clearly nearer than the second, mutually; then the colour
filter of eq. 1. Column segments: the nearest of the whitened vectors, likewise.

Both images are taken on one plane. What no motion on it explains is left out *before* the nearest
are sought, so it does not compete either: elevations of opposite sign, and
apparent sizes that disagree with the elevations. A thing at height z and distance r has size ~ 1/r
and sin(elevation) = z/r, so s_a / s_b = sin(e_a) / sin(e_b).
"""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.cameras.omni import OmniCamera, measure
from fgslam.core.arrays import ByteArray, FloatArray, Image, IntArray
from fgslam.core.homing import (
    BearingMatches,
    ColumnSegments,
    FeatureKind,
    OmniFeatures,
    UprightFeatures,
)
from fgslam.frontend.features.colour_sift import up_in_image
from fgslam.frontend.features.column_segments import whitened
from fgslam.frontend.features.settings import OmniMatchingSettings

_MAX_COLUMN_DISTANCE = 4.4  # Mahalanobis, of 11 elements; 4.4 is exceeded by 5 % if normal
_COLUMN_RATIO = 0.7  # column segments: nearest over second nearest distance below this
_MAX_SCALE_RATIO = 2.0  # factor between the ratio of scales and that of the sines of the elevations
_HORIZON_MARGIN_DEG = 3.0  # elevations nearer to the horizon may have either sign

Float32Array = npt.NDArray[np.float32]


_ROUNDING = 1e-6
"""Of squared distances of unit vectors in float32, some times over."""


def match_features(
    a: OmniFeatures,
    b: OmniFeatures,
    settings: OmniMatchingSettings,
    squared: Float32Array | None = None,
) -> BearingMatches:
    """Matches of both kinds: SIFT first, then column segments; each ascending in ``index_a``.

    Args:
        a: features of the present image.
        b: of the target image.
        settings: thresholds.
        squared: distances of their SIFT features as of :func:`planar_distances`, where they are
            known; they are not changed.
    """
    sift = match_sift(a.sift, b.sift, settings, squared)
    return sift.join(match_columns(a.columns, b.columns, settings))


# --------------------------------------------------------------------------------------------
# SIFT


def match_sift(
    a: UprightFeatures,
    b: UprightFeatures,
    settings: OmniMatchingSettings,
    squared: Float32Array | None = None,
) -> BearingMatches:
    """Mutual nearest descriptors that are distinct, planar and of one colour."""
    if not len(a) or not len(b):
        return sift_matches(a, b, np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))
    i, j, ratio = _mutual_nearest(planar_distances(a, b, settings) if squared is None else squared)
    colour = np.linalg.norm(a.colour[i] - b.colour[j], axis=1)
    keep = (ratio < settings.ratio) & (colour < settings.max_colour_distance)
    return sift_matches(a, b, i[keep], j[keep], 1.0 - ratio[keep])


def planar_distances(
    a: UprightFeatures, b: UprightFeatures, settings: OmniMatchingSettings
) -> Float32Array:
    """(n, m) squared distances of descriptors, infinite where no motion on the plane explains."""
    squared = _squared_distances(a.descriptors, b.descriptors, settings.root)
    if settings.planar_gates:
        _forbid_impossible(squared, a, b)
    return squared


def _squared_distances(a: ByteArray, b: ByteArray, root: bool) -> Float32Array:
    x, y = _comparable(a, root), _comparable(b, root)
    norms = np.einsum("ij,ij->i", y, y)
    squared = x @ y.T
    squared *= -2.0
    squared += norms
    squared += np.einsum("ij,ij->i", x, x)[:, None]
    return np.asarray(squared, np.float32)


def _comparable(descriptors: ByteArray, root: bool) -> Float32Array:
    values = descriptors.astype(np.float32)
    if not root:
        return values
    total = np.maximum(values.sum(axis=1, keepdims=True), 1.0)
    return np.asarray(np.sqrt(values / total), np.float32)


def _forbid_impossible(squared: Float32Array, a: UprightFeatures, b: UprightFeatures) -> None:
    """Sets distances of candidates to infinity that no planar motion explains."""
    margin = np.deg2rad(_HORIZON_MARGIN_DEG)
    side_a, side_b = _side(a.elevation, margin), _side(b.elevation, margin)
    apart = _height_in_sizes(a, margin)[:, None] - _height_in_sizes(b, margin)
    impossible = np.abs(apart, out=apart) > np.float32(np.log(_MAX_SCALE_RATIO))
    # Near the horizon in both views the elevations tell nothing about the sizes.
    impossible &= (side_a != 0)[:, None] | (side_b != 0)
    impossible |= side_a[:, None] * side_b < 0
    np.putmask(squared, impossible, np.inf)


def _side(elevation: FloatArray, margin: float) -> npt.NDArray[np.int8]:
    return np.where(np.abs(elevation) > margin, np.sign(elevation), 0.0).astype(np.int8)


def _height_in_sizes(features: UprightFeatures, margin: float) -> Float32Array:
    """(n,) log of |sin(elevation)| over the apparent size, the same from everywhere."""
    height = np.maximum(np.abs(np.sin(features.elevation)), np.sin(max(margin, 1e-3)))
    return np.log(height / features.scale).astype(np.float32)


def _mutual_nearest(squared: Float32Array) -> tuple[IntArray, IntArray, FloatArray]:
    """Rows, columns, and nearest over second nearest distance of mutual nearest pairs.

    A candidate without any competing candidate has ratio 0.
    """
    every = np.arange(len(squared))
    j = squared.argmin(axis=1)
    mutual = squared.argmin(axis=0)[j] == every
    best = squared[every, j].astype(np.float64)
    squared[every, j] = np.inf
    second = squared.min(axis=1).astype(np.float64)
    squared[every, j] = best
    keep = mutual & np.isfinite(best)
    # Equal descriptors differ by rounding; two equal ones in a row compete all the same.
    best, second = (np.maximum(d[keep], 0.0) + _ROUNDING for d in (best, second))
    return every[keep], j[keep], np.minimum(np.sqrt(best / second), 1.0)


def sift_matches(
    a: UprightFeatures, b: UprightFeatures, i: IntArray, j: IntArray, quality: FloatArray
) -> BearingMatches:
    """Features i (k,) of one view with features j of the other."""
    variances = [
        c[k, axis, axis] for c, k in ((a.covariance, i), (b.covariance, j)) for axis in (0, 1)
    ]
    return BearingMatches(
        kind=np.full(len(i), int(FeatureKind.SIFT), np.int64),
        index_a=i,
        index_b=j,
        bearing_a=a.bearing[i],
        elevation_a=a.elevation[i],
        bearing_b=b.bearing[j],
        elevation_b=b.elevation[j],
        sigma=np.sqrt(np.column_stack(variances)),
        quality=quality,
    )


# --------------------------------------------------------------------------------------------
# Column segments


def match_columns(
    a: ColumnSegments, b: ColumnSegments, settings: OmniMatchingSettings
) -> BearingMatches:
    """Mutual nearest whitened vectors that are distinct."""
    none = np.zeros(0, np.int64)
    if len(a) < 2 or len(b) < 2:
        return _column_matches(a, b, none, none, np.zeros(0))
    i, j, distance, ratio = nearest_segments(whitened(a.descriptors), whitened(b.descriptors))
    keep = (ratio < _COLUMN_RATIO) & (distance < _MAX_COLUMN_DISTANCE)
    return _column_matches(a, b, i[keep], j[keep], 1.0 - ratio[keep])


def nearest_segments(
    a: FloatArray, b: FloatArray
) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    """Mutual nearest of vectors (n, k) and (m, k), n and m at least 2.

    Returns:
        Indices (k,) into ``a``, ascending, and into ``b``, the distance, and its ratio to that of
        the second nearest in ``b``.
    """
    # In as many dimensions as segments have elements a product of matrices outruns any tree. It
    # finds who is near; how near, down to no distance at all, is then taken from the vectors.
    squared = np.einsum("ij,ij->i", b, b) - 2.0 * (a @ b.T)
    i = np.arange(len(a))
    j = squared.argmin(axis=1)
    back = (squared + np.einsum("ij,ij->i", a, a)[:, None]).argmin(axis=0)
    squared[i, j] = np.inf
    other = squared.argmin(axis=1)
    i = np.flatnonzero(back[j] == i)
    best, second = (np.linalg.norm(a[i] - b[k[i]], axis=1) for k in (j, other))
    # A second one just as near, be it at no distance at all, competes in full.
    ratio = np.ones(len(i))
    np.divide(best, second, out=ratio, where=second > best)
    return i, j[i], best, ratio


def _column_matches(
    a: ColumnSegments, b: ColumnSegments, i: IntArray, j: IntArray, quality: FloatArray
) -> BearingMatches:
    tangents_a, tangents_b, factor = consistent_tangents(a.tangents[i], b.tangents[j])
    sigma_a = factor * a.sigma_tangents[i].mean(axis=1) / (1.0 + tangents_a**2)
    sigma_b = factor * b.sigma_tangents[j].mean(axis=1) / (1.0 + tangents_b**2)
    return BearingMatches(
        kind=np.full(len(i), int(FeatureKind.COLUMN), np.int64),
        index_a=i,
        index_b=j,
        bearing_a=a.bearing[i],
        elevation_a=np.arctan(tangents_a),
        bearing_b=b.bearing[j],
        elevation_b=np.arctan(tangents_b),
        sigma=np.column_stack([a.sigma_bearing[i], sigma_a, b.sigma_bearing[j], sigma_b]),
        quality=quality,
    )


def consistent_tangents(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """One tangent of each view, their ratio the best estimate of e / d from both ends.

    The ends (low, high) of a segment are a vector that grows and shrinks with 1 / distance: a and b
    (n, 2) are parallel. With c the unit vector of their common direction, c.a / c.b is the ratio
    that both ends support most, also where one is at the horizon. The tangents that are returned
    are near the end that is further from the horizon, where something is to be seen.

    Returns:
        (n,) tangents in a and in b, and (n,) by what their standard deviation is that of an end.
    """
    along_a = np.hypot(a[:, 0], a[:, 1])
    along_b = np.hypot(b[:, 0], b[:, 1])
    common = a / along_a[:, None] + b / along_b[:, None]
    norm = np.hypot(common[:, 0], common[:, 1])
    common = common / np.maximum(norm, 1e-12)[:, None]
    end = _far_end(common)
    share = common[np.arange(len(a)), end]
    return (
        np.einsum("ij,ij->i", a, common) * share,
        np.einsum("ij,ij->i", b, common) * share,
        np.abs(share),
    )


def _far_end(tangents: FloatArray) -> IntArray:
    return np.asarray(np.argmax(np.abs(tangents), axis=1), np.int64)


# --------------------------------------------------------------------------------------------
# How likely a match is right, and what a hypothesis that it agrees with gains by it
#
# A match much better than its runner-up is nearly always right, one barely better hardly ever.
# Counting both alike wastes what matching knows; so a hypothesis is supported by likelihoods
# (Tordoff and Murray 2005): with probability p of being right, a normalised epipolar residual r has
# density (1 - p) u + p N(r), u being what wrong matches have.


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


# --------------------------------------------------------------------------------------------
# The baseline of all comparisons: SIFT as OpenCV has it


PLAIN_MATCHING = OmniMatchingSettings(
    ratio=0.8, root=False, max_colour_distance=1e9, planar_gates=False
)
"""Lowe's ratio test alone, for :func:`plain_sift`."""


_PLAIN_SIGMA_PX = 1.2  # of a feature's place


def plain_sift(camera: OmniCamera, image: Image) -> UprightFeatures:
    """OpenCV's SIFT with its own parameters, orientations and all, on an image (h, w, 3).

    Features that the camera does not see are left out. There is no colour: it is zero.
    """
    detector = cv2.SIFT.create(enable_precise_upscale=True)
    keypoints, descriptors = detector.detectAndCompute(
        cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None
    )
    if descriptors is None:
        descriptors = np.zeros((0, 128), np.float32)
    table = np.array([(*k.pt, 0.5 * k.size) for k in keypoints], np.float64).reshape(-1, 3)
    bearing, elevation, covariance = measure(camera, table[:, :2], _PLAIN_SIGMA_PX)
    up = np.linalg.norm(up_in_image(camera, table[:, :2]), axis=1)
    seen = np.isfinite(bearing) & np.isfinite(up)
    return UprightFeatures(
        pixels=table[seen, :2],
        bearing=bearing[seen],
        elevation=elevation[seen],
        covariance=covariance[seen],
        scale=table[seen, 2] / up[seen],
        descriptors=np.asarray(descriptors, np.uint8)[seen],
        colour=np.zeros((int(seen.sum()), 3)),
    )
