"""The bearing log: all that a homing estimator consumes, replayable without images.

A file of :mod:`fgslam.core.store`, like the measurement log.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Literal

import numpy as np

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray, Rows
from fgslam.core.errors import MeasurementLogError
from fgslam.core.geometry import wrap
from fgslam.core.store import FileKind, require_ascending, require_covariances, require_finite

# ------------------------------------------------------------------------------------------
# Values of visual homing: features, matches, homing vectors, tracks (Goedemé et al. 2005)


def among(ids: IntArray, others: IntArray) -> BoolArray:
    """(n,) which identities are among others, both ascending.

    With every image some dozens are looked up; what sorts them first takes ten times as long.
    """
    if not len(others):
        return np.zeros(len(ids), np.bool_)
    places = others.searchsorted(ids)
    return np.asarray(others[np.minimum(places, len(others) - 1, out=places)] == ids)


def common_rows(ids: IntArray, others: IntArray) -> tuple[IntArray, IntArray]:
    """(k,) rows of identities (n,) and of others (m,), both ascending, that name the same."""
    if not len(others):
        return np.empty(0, np.int64), np.empty(0, np.int64)
    places = others.searchsorted(ids)
    np.minimum(places, len(others) - 1, out=places)
    mine = np.flatnonzero(others[places] == ids)
    return mine, places[mine]


# --------------------------------------------------------------------------------------------
# Features of one image, and matches between two


class FeatureKind(int, Enum):
    """Which front-end found a feature; stored as a number."""

    SIFT = 0
    COLUMN = 1


@dataclass(frozen=True, slots=True, eq=False)
class UprightFeatures(Rows):
    """Rotation-reduced colour SIFT features of one image (III-A, 1).

    Attributes:
        pixels: (n, 2) in the image that was given, column and row.
        bearing, elevation: (n,) radians.
        covariance: (n, 2, 2) of (bearing, elevation).
        scale: (n,) SIFT scale in radians of elevation (pixels over pixels a radian).
        descriptors: (n, 128) uint8.
        colour: (n, 3) C_RB, C_RG, C_GB over the patch (eq. 1, with centred bands).
    """

    pixels: FloatArray
    bearing: FloatArray
    elevation: FloatArray
    covariance: FloatArray
    scale: FloatArray
    descriptors: ByteArray
    colour: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class ColumnSegments(Rows):
    """Invariant column segments of one image (III-A, 2).

    Attributes:
        bearing: (n,) radians of the segment's column.
        sigma_bearing: (n,) radians.
        tangents: (n, 2) tangent of the elevation at the segment's lower and upper end.
        sigma_tangents: (n, 2).
        descriptors: (n, 11) g, C_RB, C_RG, C_GB, DCT-II coefficients 1 to 7; not whitened.
    """

    bearing: FloatArray
    sigma_bearing: FloatArray
    tangents: FloatArray
    sigma_tangents: FloatArray
    descriptors: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class OmniFeatures:
    """All that is kept of a path image: features, no pixels of it."""

    sift: UprightFeatures
    columns: ColumnSegments


@dataclass(frozen=True, slots=True, eq=False)
class BearingMatches(Rows):
    """Tentative or accepted correspondences of two views; ``a`` is the present, ``b`` the target.

    Attributes:
        kind: (n,) :class:`FeatureKind` values.
        index_a, index_b: (n,) rows of the feature in its view's list of that kind.
        bearing_a, elevation_a, bearing_b, elevation_b: (n,) radians.
        sigma: (n, 4) standard deviations in that order, radians.
        quality: (n,) in [0, 1], 1 for the most distinctive: 1 - (nearest over second nearest).
    """

    kind: IntArray
    index_a: IntArray
    index_b: IntArray
    bearing_a: FloatArray
    elevation_a: FloatArray
    bearing_b: FloatArray
    elevation_b: FloatArray
    sigma: FloatArray
    quality: FloatArray


# --------------------------------------------------------------------------------------------
# The initialisation step's answer (section III)


@dataclass(frozen=True, slots=True, eq=False)
class TwoViewVector:
    """(R, theta, psi) with R = 1: where the target lies and how it is turned (III-B).

    It is true where a :class:`Refusal` is false, so that ``if answer:`` distinguishes them.

    Attributes:
        direction: theta, of the target as seen from the present pose, radians.
        rotation: psi, heading of the target minus the present one, radians.
        covariance: (2, 2) of (direction, rotation).
        inliers: (n,) of the matches that were given.
        competing_support: inliers of the best *different* solution; 0 for none.
        wrong_probability: probability that a different solution is the better one, 0.5 at most;
            0.5, too, where the camera is neither level nor clearly tilted.
    """

    direction: float
    rotation: float
    covariance: FloatArray
    inliers: BoolArray
    competing_support: int
    wrong_probability: float = 0.0

    @property
    def support(self) -> int:
        """Number of inliers."""
        return int(np.count_nonzero(self.inliers))

    def __bool__(self) -> Literal[True]:
        return True


class RefusalReason(str, Enum):
    """Why no homing vector is given; the value is written into files."""

    TOO_DARK = "too_dark"
    NO_FEATURES = "no_features"
    TOO_FEW_MATCHES = "too_few_matches"
    TOO_FEW_INLIERS = "too_few_inliers"
    AMBIGUOUS = "ambiguous"
    UNCERTAIN = "uncertain"
    AT_TARGET = "at_target"
    # Of a homing under way
    LOST = "lost"
    NO_PROGRESS = "no_progress"


@dataclass(frozen=True, slots=True)
class Refusal:
    """No homing vector, and why; ``details`` is one clear clause with the numbers. It is false.

    ``AT_TARGET`` is an answer of its own: both views are from one place, ``rotation`` holds
    the turn (radians); it is None for all other reasons.
    """

    reason: RefusalReason
    details: str
    rotation: float | None = None

    def __bool__(self) -> Literal[False]:
        return False


@dataclass(frozen=True, slots=True, eq=False)
class LocalMap(Rows):
    """Features triangulated from start and target, polar around the start (III-C, fig. 4).

    Attributes:
        ids: (n,) identities, ascending.
        bearing, distance: (n,) delta_{i,0} in radians and d_{i,0} in legs (eq. 3).
        covariance: (n, 2, 2) of (distance, bearing).
    """

    ids: IntArray
    bearing: FloatArray
    distance: FloatArray
    covariance: FloatArray

    def points(self) -> FloatArray:
        """(n, 2) positions in the start frame, legs."""
        return np.column_stack(
            [self.distance * np.cos(self.bearing), self.distance * np.sin(self.bearing)]
        )


@dataclass(frozen=True, slots=True, eq=False)
class HomingStart:
    """What a homing estimator is made with: the two views' measurements and first guesses.

    Attributes:
        time: of the start image, seconds.
        vector: as estimated from the two views.
        local_map: the features that are tracked from now on; row i belongs to match i.
        matches: (n) the same features as seen from start (a) and target (b).
    """

    time: float
    vector: TwoViewVector
    local_map: LocalMap
    matches: BearingMatches


# --------------------------------------------------------------------------------------------
# The update step (section IV)


@dataclass(frozen=True, slots=True, eq=False)
class TrackedBearings(Rows):
    """Bearings of the tracked features in one image on the way (eq. 6); an absent one is lost.

    Attributes:
        time: seconds.
        ids: (m,) of the local map, ascending.
        bearing: (m,) radians from the present heading.
        sigma_bearing: (m,).
        elevation: (m,) radians, NaN where it is not known.
        sigma_elevation: (m,), NaN likewise.
    """

    SHARED = frozenset({"time"})

    time: float
    ids: IntArray
    bearing: FloatArray
    sigma_bearing: FloatArray
    elevation: FloatArray
    sigma_elevation: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class HomeVector:
    """The steering vector: the target relative to the *present* pose.

    Attributes:
        distance: in legs; 1 at the start, so it is the fraction of the way that is left.
        direction: of the target from the present heading, radians.
        rotation: heading of the target minus the present one, radians.
        covariance: (3, 3) of (distance, direction, rotation).
    """

    distance: float
    direction: float
    rotation: float
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class HomingEstimate:
    """State of a homing estimator, in the start frame.

    Attributes:
        time: seconds.
        robot, target: (3,) planar poses; a target whose distance is not estimated lies at 1.
        covariance: (6, 6) joint of (robot, target); NaN where an estimator has none.
        ids: (n,) features still in the map, ascending.
        landmarks: (n, 2); landmark_covariances: (n, 2, 2), NaN where an estimator has none.
    """

    time: float
    robot: FloatArray
    target: FloatArray
    covariance: FloatArray
    ids: IntArray
    landmarks: FloatArray
    landmark_covariances: FloatArray

    def home(self) -> HomeVector:
        """The steering vector with its first-order covariance."""
        x, y, heading = (self.target - self.robot).tolist()
        c, s = math.cos(self.robot[2]), math.sin(self.robot[2])
        jacobian = home_vector_jacobian(self.robot, self.target)
        covariance = jacobian @ self.covariance @ jacobian.T
        turn = float(wrap(np.array(heading)))
        direction = math.atan2(c * y - s * x, c * x + s * y)
        return HomeVector(math.hypot(x, y), direction, turn, covariance)


def home_vector_jacobian(robot: FloatArray, target: FloatArray) -> FloatArray:
    """(3, 6) derivative of (distance, direction, rotation) by (robot, target), each (3,).

    At the target itself the direction has no derivative; its row is then infinite, not an error.
    """
    x, y = (target[:2] - robot[:2]).tolist()
    distance = math.hypot(x, y)
    c, s = (x / distance, y / distance) if distance > 0.0 else (math.nan, math.nan)
    far = distance or math.inf
    return np.array(
        [
            [-c, -s, 0.0, c, s, 0.0],
            [s / far, -c / far, -1.0, -s / far, c / far, 0.0],
            [0.0, 0.0, -1.0, 0.0, 0.0, 1.0],
        ]
    )


@dataclass(frozen=True, slots=True, eq=False)
class HomingTruth:
    """Truth of a simulated homing, in the start frame and in *metres*.

    Attributes:
        target: (3,) planar pose.
        robots: (k, 3) planar pose at each tracked image.
        landmarks: (n, 2) of the local map's rows; NaN where a match was wrong.
    """

    target: FloatArray
    robots: FloatArray
    landmarks: FloatArray

    @property
    def leg_m(self) -> float:
        """Distance from start to target, metres: the unit of estimates."""
        return float(np.hypot(*self.target[:2]))


@dataclass(slots=True, eq=False)
class BearingLog:
    """One homing.

    Attributes:
        start: what the estimator was made with.
        images: what it was given, time increasing.
        truth: of a simulated homing; its robots are those of the images.
        provenance: where all this comes from; plain JSON values.
    """

    start: HomingStart
    images: list[TrackedBearings] = field(default_factory=list)
    truth: HomingTruth | None = None
    provenance: dict[str, Any] = field(default_factory=dict)

    def save(self, path: Path) -> None:
        """Writes the log, whole or not at all. Raises OutputError when it cannot be written."""
        LOG.save(path, self)

    @staticmethod
    def load(path: Path) -> BearingLog:
        """Reads a log. Raises MeasurementLogError for a missing, truncated or foreign file."""
        return LOG.load(path)


def _require_measured(log: BearingLog) -> None:
    """Raises ValueError for what no homing measures: a log may be made by anyone."""
    start, vector = log.start, log.start.vector
    require_finite("vector", np.array([vector.direction, vector.rotation]))
    require_covariances("vector", vector.covariance[None], definite=False)
    require_finite("local map", start.local_map.bearing)
    times = np.array([start.time, *(image.time for image in log.images)])
    require_finite("times of the images", times)
    require_ascending("times of the images", times)
    for k, image in enumerate(log.images):
        if len(np.unique(image.ids)) < len(image.ids):
            raise ValueError(f"image {k} shows a feature twice")
        if len({len(array) for array in (image.ids, image.bearing, image.sigma_bearing)}) > 1:
            raise ValueError(f"image {k}: its arrays differ in length")
        require_finite(f"bearings of image {k}", image.bearing)
        if not ((image.sigma_bearing > 0.0) & np.isfinite(image.sigma_bearing)).all():
            raise ValueError(f"image {k}: a deviation of a bearing is no positive number")


LOG = FileKind(
    BearingLog,
    "fgslam bearing log",
    version=2,
    error=MeasurementLogError,
    give="give a run folder's bearings.npz",
    again="run again",
    check=_require_measured,
)
