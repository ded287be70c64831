"""The pose of a frame in a map without a prior: propose, refine, compare, accept or refuse."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray, Rows
from fgslam.core.geometry import inverse_spd3, point_pose_jacobian, so3_exp
from fgslam.core.sensors import CameraRig
from fgslam.core.types import (
    Floor,
    LandmarkAppearances,
    LandmarkMap,
    Relocalisation,
    RelocalisationStatus,
    StereoFeatures,
)
from fgslam.frontend.places.known_map import MAX_DISTANCE, KnownMap, Tentative, gated, specific
from fgslam.frontend.settings import RelocalisationSettings
from fgslam.frontend.tracking.ego_motion import align, rigid, rounded, sample_size

# ------------------------------------------------------------------------------------------
# Residuals of many matches at many poses, and Gauss-Newton on all poses at once

_BEHIND_M = 0.1
_LOG_TWO_PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True, slots=True, eq=False)
class SeenPoints(Rows):
    """Features as they are compared with landmarks.

    Attributes:
        in_image: (n,) True where compared in the image, False where in space.
        value: (n, 3) (column, row, disparity), or (X, Y, Z) in the camera's frame.
        covariance: (n, 3, 3) of it.
        position: (n, 3) in the camera's frame, metres.
        position_covariance: (n, 3, 3).
    """

    in_image: BoolArray
    value: FloatArray
    covariance: FloatArray
    position: FloatArray
    position_covariance: FloatArray

    @staticmethod
    def of(features: StereoFeatures, rig: CameraRig, view_sigma_px: float = 0.0) -> SeenPoints:
        """The features of a frame, or of a submap in its last camera's frame.

        ``view_sigma_px`` is added to the noise of columns and rows: a corner seen from elsewhere is
        found elsewhere. It is so by the same in all images of the rig: disparities keep theirs.
        """
        column, row, disparity = features.measurement.T
        inside = (column >= -0.5) & (column <= rig.width - 0.5)
        inside &= (row >= -0.5) & (row <= rig.height - 0.5)
        inside &= (disparity > 0.0) & (features.position[:, 2] > _BEHIND_M)
        pick = inside[:, None, None]
        return SeenPoints(
            in_image=inside,
            value=np.where(inside[:, None], features.measurement, features.position),
            covariance=np.where(
                pick,
                features.measurement_covariance + view_sigma_px**2 * np.diag([1.0, 1.0, 0.0]),
                features.position_covariance,
            ),
            position=features.position,
            position_covariance=features.position_covariance,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Pairs(Rows):
    """Features matched with landmarks, row by row.

    Attributes:
        seen: the features, k rows.
        points: (k, 3) the landmarks, world.
        point_covariances: (k, 3, 3).
    """

    seen: SeenPoints
    points: FloatArray
    point_covariances: FloatArray

    @staticmethod
    def of(seen: SeenPoints, features: IntArray, landmarks: LandmarkMap, rows: IntArray) -> Pairs:
        """Features (k,) by index with landmarks (k,) by row of the map."""
        return Pairs(seen.select(features), landmarks.positions[rows], landmarks.covariances[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Measured less predicted, for m matches: one row each.

    Attributes:
        valid: (m,) False where a landmark to be seen in the image lies behind the camera.
        residual: (m, 3).
        by_pose: (m, 3, 6) derivative of the *prediction* by the pose's tangent vector.
        covariance: (m, 3, 3) of the measurement and of the landmark as seen from the pose.
    """

    valid: BoolArray
    residual: FloatArray
    by_pose: FloatArray
    covariance: FloatArray


def residuals(
    rig: CameraRig,
    poses: FloatArray,
    pairs: Pairs,
    pose_rows: IntArray | None = None,
) -> Residuals:
    """Residuals of all pairs at one pose (4, 4), or of each pair at its own.

    Args:
        rig: the cameras.
        poses: (4, 4), or (h, 4, 4) with ``pose_rows`` (k,) naming each pair's.
        pairs: k matches.
        pose_rows: None for a single pose.
    """
    wTc = poses if pose_rows is None else poses[pose_rows]
    wRc = np.broadcast_to(wTc[..., :3, :3], (len(pairs), 3, 3))
    offset = pairs.points - wTc[..., :3, 3]
    points = np.einsum("kji,kj->ki", wRc, offset)
    seen = pairs.seen
    ahead = points[:, 2] > _BEHIND_M
    valid = ahead | ~seen.in_image
    safe = np.where(ahead[:, None], points, [0.0, 0.0, 1.0])
    pick = seen.in_image[:, None]
    predicted = np.where(pick, rig.predict(safe), points)
    jacobian = np.where(pick[:, :, None], rig.jacobian(safe), np.eye(3))
    to_value = jacobian @ np.swapaxes(wRc, 1, 2)
    covariance = to_value @ pairs.point_covariances @ np.swapaxes(to_value, 1, 2)
    return Residuals(
        valid=valid,
        residual=seen.value - predicted,
        by_pose=jacobian @ point_pose_jacobian(points),
        covariance=covariance + seen.covariance,
    )


def squared_distances(found: Residuals, pose_covariance: FloatArray | None = None) -> FloatArray:
    """Mahalanobis distances squared (m,); infinite where invalid.

    ``pose_covariance`` (6, 6) or (m, 6, 6) is that of the poses, where they are uncertain.
    """
    information, _ = _information(found, pose_covariance)
    squared = np.einsum("mi,mij,mj->m", found.residual, information, found.residual)
    return np.where(found.valid, squared, np.inf)


def log_likelihoods(found: Residuals, pose_covariance: FloatArray | None = None) -> FloatArray:
    """Log densities (m,) of the residuals as Gaussians; minus infinity where invalid."""
    information, log_determinant = _information(found, pose_covariance)
    squared = np.einsum("mi,mij,mj->m", found.residual, information, found.residual)
    logs = -0.5 * (squared + log_determinant + 3.0 * _LOG_TWO_PI)
    return np.where(found.valid, logs, -np.inf)


def _information(
    found: Residuals, pose_covariance: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Inverse covariances (m, 3, 3) and log determinants (m,) of the covariances."""
    covariance = found.covariance
    if pose_covariance is not None:
        spread = found.by_pose @ pose_covariance @ np.swapaxes(found.by_pose, 1, 2)
        covariance = covariance + 0.5 * (spread + np.swapaxes(spread, 1, 2))
    return inverse_spd3(covariance), np.linalg.slogdet(covariance)[1]


def log_uniform(
    rig: CameraRig, seen: SeenPoints, max_disparity_px: float, room: float
) -> FloatArray:
    """Log density (n,) of a feature that has nothing to do with its landmark.

    In the image uniform over its pixels and disparities; in space over ``room`` cubic metres.
    """
    image = -np.log(rig.width * rig.height * max_disparity_px)
    return np.asarray(np.where(seen.in_image, image, -np.log(room)))


_HOPELESS = 1e-12  # of the reduced Hessian's reciprocal condition


def refine(
    rig: CameraRig,
    floor: Floor,
    poses: FloatArray,
    pairs: Pairs,
    pose_rows: IntArray,
    iterations: int,
    kernel_width: float | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Poses (h, 4, 4) moved to fit their matches, and their covariances (h, 6, 6).

    Args:
        rig: the cameras.
        floor: which motions are allowed.
        poses: (h, 4, 4) where to start.
        pairs: matches of all poses.
        pose_rows: (k,) which pose each match belongs to.
        iterations: steps taken; all poses take the same number.
        kernel_width: of a Cauchy kernel on normalised residuals; None for plain least squares.

    A pose that its matches do not fix keeps its place and gets an infinite covariance.
    """
    for _ in range(iterations):
        hessians, gradients = _normal_equations(rig, poses, pairs, pose_rows, kernel_width)
        steps = np.einsum("hij,hj->hi", _inverses(floor, poses, hessians), gradients)
        steps[~np.isfinite(steps).all(axis=1)] = 0.0
        # No step turns by over half a radian or moves by over a metre: all is linear no more.
        turn = np.linalg.norm(steps[:, :3], axis=1) / 0.5
        way = np.linalg.norm(steps[:, 3:], axis=1) / 1.0
        steps = steps / np.maximum(1.0, np.maximum(turn, way))[:, None]
        moved = poses.copy()
        for k, step in enumerate(steps):  # turn and move apart: planar motion stays planar
            moved[k, :3, 3] += poses[k, :3, :3] @ step[3:]
            moved[k, :3, :3] = poses[k, :3, :3] @ so3_exp(step[:3])
        poses = moved
    hessians, _ = _normal_equations(rig, poses, pairs, pose_rows, None)
    return poses, _inverses(floor, poses, hessians)


def _normal_equations(
    rig: CameraRig,
    poses: FloatArray,
    pairs: Pairs,
    pose_rows: IntArray,
    kernel_width: float | None,
) -> tuple[FloatArray, FloatArray]:
    """Hessians (h, 6, 6) and steepest descents (h, 6)."""
    found = residuals(rig, poses, pairs, pose_rows)
    information = inverse_spd3(found.covariance)
    weight = found.valid.astype(np.float64)
    if kernel_width is not None:
        squared = np.einsum("mi,mij,mj->m", found.residual, information, found.residual)
        weight = weight / (1.0 + squared / kernel_width**2)
    weighted = np.swapaxes(found.by_pose, 1, 2) @ (weight[:, None, None] * information)
    hessian = (weighted @ found.by_pose).reshape(-1, 36)
    gradient = np.einsum("mij,mj->mi", weighted, found.residual)
    hessians = _summed(hessian, pose_rows, len(poses)).reshape(-1, 6, 6)
    return hessians, _summed(gradient, pose_rows, len(poses))


def _summed(values: FloatArray, rows: IntArray, count: int) -> FloatArray:
    """Sums (count, d) of the values (m, d) that belong to each row, added in their order."""
    d = values.shape[1]
    places = rows[:, None] * d + np.arange(d)
    sums = np.bincount(places.ravel(), values.ravel(), minlength=count * d)
    return np.asarray(sums.reshape(count, d), np.float64)


def _inverses(floor: Floor, poses: FloatArray, hessians: FloatArray) -> FloatArray:
    """Inverses (h, 6, 6) on the directions that the floor allows; infinite where undetermined."""
    bases = np.array([floor.basis(pose) for pose in poses]).reshape(len(poses), 6, -1)
    reduced = np.swapaxes(bases, 1, 2) @ hessians @ bases
    size = np.sqrt(np.maximum(np.diagonal(reduced, axis1=1, axis2=2), 1e-300))
    scaled = reduced / (size[:, :, None] * size[:, None, :])
    good = np.isfinite(scaled).all(axis=(1, 2))
    scaled[~good] = np.eye(bases.shape[2])
    values, vectors = np.linalg.eigh(scaled)
    good &= values[:, 0] > _HOPELESS
    inverted = (vectors / np.maximum(values, _HOPELESS)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    inverted /= size[:, :, None] * size[:, None, :]
    out = bases @ inverted @ np.swapaxes(bases, 1, 2)
    out[~good] = np.inf
    return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))


# ------------------------------------------------------------------------------------------
# Poses proposed from tentative matches by random samples (RANSAC, Fischler and Bolles 1981)

_AT_ONCE = 40_000  # residuals computed together; a few megabytes


@dataclass(frozen=True, slots=True, eq=False)
class Proposals(Rows):
    """Poses (h, 4, 4), covariances (h, 6, 6) and scores (h,), best first."""

    poses: FloatArray
    covariances: FloatArray
    scores: FloatArray

    def join(self, other: Proposals) -> Proposals:
        """Both, best first."""
        joined = Rows.join(self, other)
        return joined.select(np.argsort(-joined.scores, kind="stable"))

    @staticmethod
    def none() -> Proposals:
        """No pose at all."""
        return Proposals(np.empty((0, 4, 4)), np.empty((0, 6, 6)), np.empty(0))


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """The matches that poses are judged by.

    Attributes:
        rig: the cameras.
        tentative: k matches, in the order of features.
        pairs: their geometry.
        log_chance: (k,) log density of a match that is a mistake.
    """

    rig: CameraRig
    tentative: Tentative
    pairs: Pairs
    log_chance: FloatArray

    def scores(self, poses: FloatArray, covariances: FloatArray) -> FloatArray:
        """Log-likelihood ratios (h,): each feature's best candidate against chance, if better.

        The poses' own uncertainty widens the expected residuals and thereby thins their density:
        a vague pose gains little from many matches.
        """
        out = np.empty(len(poses))
        of_feature = np.flatnonzero(np.diff(self.tentative.features, prepend=-1))
        step = max(1, _AT_ONCE // max(1, len(self.pairs)))
        for start in range(0, len(poses), step):
            some = poses[start : start + step]
            h, k = len(some), len(self.pairs)
            rows, match = np.repeat(np.arange(h), k), np.tile(np.arange(k), h)
            found = residuals(self.rig, some, self.pairs.select(match), rows)
            logs = log_likelihoods(found, covariances[start : start + step][rows])
            gain = logs.reshape(h, k) - self.log_chance
            best = np.maximum.reduceat(gain, of_feature, axis=1)
            out[start : start + step] = np.maximum(best, 0.0).sum(axis=1)
        return out

    def agreeing(self, wTc: FloatArray, covariance: FloatArray) -> BoolArray:
        """Matches (k,) that are likelier right than chance at a pose with its covariance."""
        found = residuals(self.rig, wTc, self.pairs)
        return np.asarray(log_likelihoods(found, covariance) > self.log_chance)


def apart(poses: FloatArray, wTc: FloatArray, metres: float, radians: float) -> BoolArray:
    """Which poses (h, 4, 4) are elsewhere: farther than ``metres`` or turned by ``radians``."""
    way = np.linalg.norm(poses[:, :3, 3] - wTc[:3, 3], axis=1)
    cosine = 0.5 * (np.einsum("hij,ij->h", poses[:, :3, :3], wTc[:3, :3]) - 1.0)
    return np.asarray((way > metres) | (cosine < np.cos(radians)))


def distinct(found: Proposals, count: int, metres: float, radians: float) -> Proposals:
    """The best of each neighbourhood, at most ``count``."""
    chosen: list[int] = []
    free = np.ones(len(found), np.bool_)
    while free.any() and len(chosen) < count:
        best = int(np.argmax(free))
        chosen.append(best)
        free &= apart(found.poses, found.poses[best], metres, radians)
        free[best] = False
    return found.select(np.array(chosen, np.int64))


_HYPOTHESES = 64  # poses scored at a time, from the rigid samples
_SAMPLES = 4096  # minimal samples drawn at a time; most fail the rigidity test
_ROUNDS = 6  # times that samples are drawn at most
_CONFIDENCE = 0.999  # that one sample was free of mistakes, at which the search ends
_SAMPLED_STEPS = 3  # Newton steps of a sample: from the closed form to the image's metric


def propose_by_samples(evidence: Evidence, floor: Floor, rng: np.random.Generator) -> Proposals:
    """Poses, best first; none where too few matches make a sample.

    Rounds of samples are drawn until one of them was free of mistakes with the wanted confidence,
    judged by the matches that agree with the best pose so far.
    """
    size, found, drawn = sample_size(floor), Proposals.none(), 0
    if len(np.unique(evidence.tentative.features)) < size:
        return found
    weight = 1.0 / evidence.tentative.places  # a feature's say is shared by its places
    odds = weight / weight.sum()
    pairs = evidence.pairs
    noise = pairs.seen.position_covariance + rounded(pairs.point_covariances)
    for _ in range(_ROUNDS):
        samples = _draw(evidence, odds, size, rng)
        here, there = pairs.seen.position[samples], pairs.points[samples]
        rigid_ones = samples[rigid(here, there, noise[samples], floor)]
        used = rigid_ones[:_HYPOTHESES]
        share = 1.0 if len(rigid_ones) <= len(used) else len(used) / len(rigid_ones)
        drawn += int(len(samples) * share)
        if len(used):
            found = found.join(_poses(evidence, used, floor))
        if len(found) and drawn >= _needed(evidence, found, odds, size):
            break
    return found


def _draw(evidence: Evidence, odds: FloatArray, size: int, rng: np.random.Generator) -> IntArray:
    """Samples (c, size) of matches without a feature or landmark twice."""
    edges = np.cumsum(odds)
    drawn = np.searchsorted(edges, rng.random((_SAMPLES, size)) * edges[-1], side="right")
    drawn = np.minimum(drawn, len(odds) - 1)
    keep = np.ones(_SAMPLES, np.bool_)
    for a in range(size):
        for b in range(a):
            for column in (evidence.tentative.features, evidence.tentative.landmarks):
                keep &= column[drawn[:, a]] != column[drawn[:, b]]
    return np.asarray(drawn[keep])


def _poses(evidence: Evidence, samples: IntArray, floor: Floor) -> Proposals:
    pairs = evidence.pairs
    poses = align(pairs.seen.position[samples], pairs.points[samples], floor)
    rows = np.repeat(np.arange(len(samples)), samples.shape[1])
    sampled: Pairs = pairs.select(samples.ravel())
    poses, covariances = refine(evidence.rig, floor, poses, sampled, rows, _SAMPLED_STEPS)
    good = np.isfinite(covariances).all(axis=(1, 2)) & np.isfinite(poses).all(axis=(1, 2))
    poses, covariances = poses[good], covariances[good]
    scores = evidence.scores(poses, covariances)
    order = np.argsort(-scores, kind="stable")
    return Proposals(poses[order], covariances[order], scores[order])


def _needed(evidence: Evidence, found: Proposals, odds: FloatArray, size: int) -> float:
    """Samples after which one was clean, if the best pose's matches are all that are right."""
    agreeing = evidence.agreeing(found.poses[0], found.covariances[0])
    chance = float(odds[agreeing].sum()) ** size
    if chance <= 0.0:
        return np.inf
    if chance >= 1.0:
        return 1.0
    return float(np.log(1.0 - _CONFIDENCE) / np.log1p(-chance))


# ------------------------------------------------------------------------------------------
# A proposed pose refined: agreeing matches, guided re-matching around it, least squares

PIECE_M = 0.5  # landmarks in a cube of this side drift together and may be one object, moved as one
_INLIER_SIGMAS = 4.0  # largest normalised residual (three numbers) of an inlier
_VIEW_RAD = float(np.deg2rad(20.0))  # a landmark is expected to be seen this near to a stored view
_CHOICES = 4  # of choosing matches and solving; the choice rests after two or three
_STEPS = 6
_KERNEL_WIDTH = 2.0  # as the tracker's
_BEYOND = 1.5  # times the farthest feature: no landmark farther away matches one
_VOTES = 4  # of one piece of the map
_SEVERAL = 4  # landmarks expected in a piece, so that one should be seen
_CELL_RAD = np.deg2rad(8.0)  # side of a direction: half a metre at 3.6 m
_TWO = 2  # features in a direction, so that one should be known


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """A pose with all that agrees with it.

    Attributes:
        wTc: (4, 4).
        covariance: (6, 6).
        features: (k,) indices.
        landmarks: (k,) rows of the map, unique.
        residual_px: root mean square of the image residuals.
        misfit: mean squared normalised residual over its three numbers; 1 where as modelled.
        proposed: how many of the frame's tentatively matched features agree.
        expected: (m,) rows of landmarks that the pose should see.
        independent: independent inliers: at most four count of one piece of the map, since an
            object that stands elsewhere, too, matches as a whole.
        covered: share of the map's pieces expected in view of which something is seen.
        explained: share of the directions in which the frame sees things in which one agrees.
    """

    wTc: FloatArray
    covariance: FloatArray
    features: IntArray
    landmarks: IntArray
    residual_px: float
    misfit: float
    proposed: int
    expected: IntArray
    independent: int
    covered: float
    explained: float

    def __len__(self) -> int:
        return len(self.features)

    def unshared(self, other: Refined, positions: FloatArray, side: float) -> int:
        """Independent inliers of this pose among the matches that the other does not have."""
        count = int(max(self.landmarks.max(), other.landmarks.max())) + 1
        own = self.features * count + self.landmarks
        rest = ~np.isin(own, other.features * count + other.landmarks)
        return independent_inliers(positions[self.landmarks[rest]], side)

    def explains_more_than(self, other: Refined) -> int:
        """Features that have a landmark at this pose, and none at the other."""
        return int((~np.isin(self.features, other.features)).sum())


Matches = tuple[IntArray, IntArray]
"""Features (k,) by index and landmarks (k,) by row of the map."""
Candidates = tuple[IntArray, IntArray, FloatArray]
"""Such pairs, and their distances (k,)."""


def _no_matches() -> Matches:
    return np.empty(0, np.int64), np.empty(0, np.int64)


@dataclass(slots=True, eq=False)
class _Search:
    """One pose on its way: what it may match, and what it does.

    ``rests`` once the choice is that of the round before, ``lost`` once it does not fix the pose.
    """

    wTc: FloatArray
    covariance: FloatArray
    chosen: Matches = field(default_factory=_no_matches)
    candidates: Candidates = field(default_factory=lambda: (*_no_matches(), np.empty(0)))
    rests: bool = False
    lost: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Refiner:
    """What refinement needs besides the pose."""

    rig: CameraRig
    floor: Floor
    known: KnownMap
    features: StereoFeatures
    seen: SeenPoints
    evidence: Evidence
    settings: RelocalisationSettings

    def refine(self, proposals: Proposals) -> list[Refined]:
        """The poses at rest with their matches, in order; without those that these do not fix.

        They do not know of each other, but are solved together: many small systems cost no more
        than one.
        """
        searches = [
            _Search(wTc, covariance)
            for wTc, covariance in zip(proposals.poses, proposals.covariances, strict=True)
        ]
        tentative = self.evidence.tentative
        proposed = tentative.features, tentative.landmarks, tentative.distances
        for guided in (False, True):
            for one in searches:
                one.candidates = self._around(one.wTc, proposed) if guided else proposed
            searches = self._rested(searches)
        return [self._finish(one.wTc, one.covariance, one.chosen) for one in searches]

    def _rested(self, searches: list[_Search]) -> list[_Search]:
        """The searches whose choice of matches has come to rest, or was made often enough."""
        least = 2 if self.floor.rigid_dof == 3 else 3
        moving = searches
        for _ in range(_CHOICES):
            for one in moving:
                i, j, cost = one.candidates
                pairs = Pairs.of(self.seen, i, self.known.landmarks, j)
                off = squared_distances(residuals(self.rig, one.wTc, pairs), one.covariance)
                near = off <= _INLIER_SIGMAS**2
                before, one.chosen = one.chosen, _one_to_one(i[near], j[near], cost[near])
                one.rests = all(map(np.array_equal, before, one.chosen))
                one.lost = len(one.chosen[0]) < least
            moving = [one for one in moving if not one.lost]
            self._solve(moving)
            moving = [one for one in moving if not one.lost and not one.rests]
        return [one for one in searches if not one.lost]

    def _around(self, wTc: FloatArray, proposed: Candidates) -> Candidates:
        """Pairs of features and landmarks in view that look alike, then those proposed."""
        farthest = _BEYOND * float(np.abs(self.features.position[:, 2]).max())
        rows, _ = self.known.in_view(self.rig, wTc, farthest)
        views, _ = self.known.views_of(rows)
        distance = _distances(self.features.descriptors, self.known.views.descriptors[views])
        i, column = np.nonzero(distance <= MAX_DISTANCE)
        cost, v = distance[i, column], views[column]
        stored = (self.known.views, self.known.owners)
        keep = gated(self.features, (i, v), self.known.landmarks, stored, self.floor)
        found = i[keep], self.known.owners[v[keep]], cost[keep]
        i, j, cost = (np.concatenate(both) for both in zip(found, proposed, strict=True))
        return i, j, cost

    def _solve(self, searches: list[_Search]) -> None:
        """Least squares; landmarks of one piece of the map err together and share their weight."""
        if not searches:
            return
        features, landmarks = (np.concatenate([one.chosen[k] for one in searches]) for k in (0, 1))
        pairs = Pairs.of(self.seen, features, self.known.landmarks, landmarks)
        counts = [len(one.chosen[0]) for one in searches]
        rows = np.repeat(np.arange(len(searches)), counts)
        sides = np.split(pairs.points, np.cumsum(counts)[:-1])
        others = np.concatenate([crowd(points, PIECE_M) for points in sides]) - 1
        drift = others[:, None, None] * self.settings.map_sigma_m**2 * np.eye(3)
        pairs = replace(pairs, point_covariances=pairs.point_covariances + drift)
        start = np.array([one.wTc for one in searches])
        solved = refine(self.rig, self.floor, start, pairs, rows, _STEPS, _KERNEL_WIDTH)
        for one, wTc, covariance in zip(searches, *solved, strict=True):
            one.wTc, one.covariance = wTc, covariance
            one.lost = not bool(np.isfinite(covariance).all())

    def _finish(self, wTc: FloatArray, covariance: FloatArray, chosen: Matches) -> Refined:
        pairs = Pairs.of(self.seen, chosen[0], self.known.landmarks, chosen[1])
        found = residuals(self.rig, wTc, pairs)
        image = found.residual[pairs.seen.in_image][:, :2]
        rms = float(np.sqrt(np.mean(np.sum(image**2, axis=1)))) if len(image) else float("nan")
        sizes = float(self.features.scale.min()), float(self.features.scale.max())
        expected = self.known.recognisable(self.rig, wTc, _VIEW_RAD, sizes)
        tentative = np.unique(self.evidence.tentative.features)
        proposed = int(np.isin(tentative, chosen[0]).sum())
        positions, side = self.known.landmarks.positions, PIECE_M
        return Refined(
            wTc=wTc,
            covariance=covariance,
            features=chosen[0],
            landmarks=chosen[1],
            residual_px=rms,
            misfit=float(np.mean(squared_distances(found))) / 3.0,
            proposed=proposed,
            expected=expected,
            independent=independent_inliers(positions[chosen[1]], side),
            covered=covered(positions[expected], np.isin(expected, chosen[1]), side),
            explained=explained(self.features.position, chosen[0]),
        )


def pieces(positions: FloatArray, side: float) -> IntArray:
    """Number (n,) of the cube that each of the positions (n, 3) lies in, from 0."""
    cubes = np.floor(positions / side).astype(np.int64)
    return np.asarray(np.unique(cubes, axis=0, return_inverse=True)[1].ravel())


def independent_inliers(positions: FloatArray, side: float) -> int:
    """Number of the positions (n, 3), of which at most four count in each cube."""
    return (
        int(np.minimum(np.bincount(pieces(positions, side)), _VOTES).sum()) if len(positions) else 0
    )


def covered(positions: FloatArray, seen: BoolArray, side: float) -> float:
    """Share of the cubes with several positions (n, 3) in which one at least is seen; 1 of none."""
    if not len(positions):
        return 1.0
    of = pieces(positions, side)
    several = np.bincount(of) >= _SEVERAL
    if not several.any():
        return 1.0
    return float(np.mean(np.bincount(of, weights=seen)[several] > 0.0))


def explained(points: FloatArray, agreeing: IntArray) -> float:
    """Share of the directions with two points (n, 3) of the frame in which one agrees; 1 of none.

    Args:
        points: all features' positions in the camera's frame.
        agreeing: (k,) rows of those that have a landmark at the pose.
    """
    across = np.arctan2(points[:, 0], points[:, 2])
    down = np.arctan2(points[:, 1], np.hypot(points[:, 0], points[:, 2]))
    cells = np.floor(np.column_stack([across, down]) / _CELL_RAD).astype(np.int64)
    of = np.unique(cells, axis=0, return_inverse=True)[1].ravel()
    known = np.bincount(of[agreeing], minlength=int(of.max(initial=-1)) + 1) > 0
    several = np.bincount(of) >= _TWO
    return float(np.mean(known[several])) if several.any() else 1.0


def crowd(positions: FloatArray, side: float) -> IntArray:
    """How many of the positions (n, 3) lie in the same cube as each."""
    of = pieces(positions, side)
    return np.asarray(np.bincount(of)[of])


def _distances(a: ByteArray, b: ByteArray) -> FloatArray:
    """Euclidean distances (n, m) of descriptors; exact sums in float32 (below 2^24)."""
    x, y = a.astype(np.float32), b.astype(np.float32)
    squared = np.einsum("ij,ij->i", x, x)[:, None] + np.einsum("ij,ij->i", y, y)
    return np.asarray(np.sqrt((squared - 2.0 * (x @ y.T)).astype(np.float64)))


def _one_to_one(i: IntArray, j: IntArray, cost: FloatArray) -> Matches:
    """The pairs that are each other's cheapest; ascending in the first."""
    best_i = np.zeros(len(i), np.bool_)
    best_i[np.unique(i[(order := np.lexsort((j, cost, i)))], return_index=True)[1]] = True
    first = np.zeros(len(i), np.bool_)
    first[order] = best_i
    best_j = np.zeros(len(i), np.bool_)
    best_j[np.unique(j[(order := np.lexsort((i, cost, j)))], return_index=True)[1]] = True
    second = np.zeros(len(i), np.bool_)
    second[order] = best_j
    keep = np.flatnonzero(first & second)
    keep = keep[np.argsort(i[keep], kind="stable")]
    return i[keep], j[keep]


_NEIGHBOURS = 12  # stored views asked of the index for each feature
_REFINED = 4  # distinct best poses that are refined and compared
_ELSEWHERE_M = 0.5  # poses farther apart than this are different places
_ELSEWHERE_RAD = float(np.deg2rad(15.0))  # and so are poses turned by more than this
VIEW_SIGMA_PX = 0.3  # added to a feature's noise: from elsewhere it is found elsewhere
_MAX_DISPARITY_PX = 40.0  # of mistakes, spread evenly; the scores hardly depend on it


class Relocaliser:
    """Finds frames in a map that it has learnt."""

    def __init__(self, rig: CameraRig, floor: Floor, settings: RelocalisationSettings) -> None:
        """Knows no map yet; ``floor`` states which camera motions the map's robot makes."""
        self._rig = rig
        self._floor = floor
        self._settings = settings
        none = np.empty(0, np.int64)
        self._known = KnownMap.of(
            LandmarkMap(none, np.empty((0, 3)), np.empty((0, 3, 3))),
            LandmarkAppearances(
                none, np.empty((0, 128), np.uint8), np.empty(0), np.empty(0), np.empty((0, 3))
            ),
        )

    def __len__(self) -> int:
        """Landmarks known."""
        return len(self._known.landmarks)

    def learn(self, landmarks: LandmarkMap, appearances: LandmarkAppearances) -> None:
        """Replaces the map; landmarks without a stored view cannot be recognised: left out.

        Its arrays are not copied, and must not change until the next map is learnt. The very
        appearances of the last map keep their index: who is lost asks in every frame.
        """
        known = self._known
        index = known.index if known.views is appearances else None
        self._known = KnownMap.of(landmarks, appearances, self._settings.map_sigma_m, index)

    def locate(self, features: StereoFeatures, rng: np.random.Generator) -> Relocalisation:
        """The frame's pose, or why none is accepted.

        Args:
            features: of one frame, or of a short submap in its last camera's frame; positions
                outside the image count by their own covariances, and ``scale`` times the depth in
                that frame must be the feature's physical size.
            rng: draws the samples.
        """
        tentative = self.tentative(features)
        seen = SeenPoints.of(features, self._rig, VIEW_SIGMA_PX)
        landmarks = self._known.landmarks
        pairs = Pairs.of(seen, tentative.features, landmarks, tentative.landmarks)
        chance = log_uniform(self._rig, pairs.seen, _MAX_DISPARITY_PX, self._known.room)
        evidence = Evidence(self._rig, tentative, pairs, chance)
        proposals = propose_by_samples(evidence, self._floor, rng)
        refined = self._refine(features, seen, evidence, proposals)
        return accept(tentative, refined, landmarks, self._settings)

    def tentative(self, features: StereoFeatures) -> Tentative:
        """Matches of the features with landmarks anywhere in the map."""
        known = self._known
        views = (known.views, known.owners)
        found = known.index.query(features.descriptors, _NEIGHBOURS)
        i, k = np.nonzero(found.rows >= 0)
        pairs = (i, found.rows[i, k])
        keep = np.zeros(found.rows.shape, np.bool_)
        keep[i, k] = gated(features, pairs, known.landmarks, views, self._floor)
        return specific(found, keep, known.owners, known.landmarks)

    def _refine(
        self,
        features: StereoFeatures,
        seen: SeenPoints,
        evidence: Evidence,
        proposals: Proposals,
    ) -> list[Refined]:
        """The best distinct poses refined, that with most independent inliers first."""
        limits = _ELSEWHERE_M, _ELSEWHERE_RAD
        refiner = Refiner(
            self._rig, self._floor, self._known, features, seen, evidence, self._settings
        )
        out = refiner.refine(distinct(proposals, _REFINED, *limits))
        out.sort(key=lambda found: (-found.independent, -len(found)))
        first: list[Refined] = []
        for candidate in out:
            if all(apart(candidate.wTc[None], other.wTc, *limits)[0] for other in first):
                first.append(candidate)
        return first


LEAST_INLIERS = 8
"""Fewer independent inliers are no pose; at most four count of one piece of the map, which may be
one object."""
ENOUGH_INLIERS = 36  # independent inliers that only another hypothesis can call in question
MAX_MISFIT = 1.2  # mean squared normalised residual of fewer inliers; 1 where as modelled
_LEAST_AGREEMENT = 0.57  # of frame and map, with fewer inliers
_LEAST_COVERED = 0.5  # share of the pieces in view, or of the directions, in which something agrees
_AMBIGUOUS_SHARE = 0.5  # of the best pose's independent inliers that another one has, too
_AMBIGUOUS_OWN = 0.2  # features that only the other explains, for each that only the best explains


def accept(
    tentative: Tentative,
    refined: list[Refined],
    landmarks: LandmarkMap,
    settings: RelocalisationSettings,
) -> Relocalisation:
    """The best of the refined poses, and whether it is accepted.

    Args:
        tentative: the frame's matches by appearance.
        refined: poses of different places, that with most independent inliers first.
        landmarks: the map.
        settings: what it takes.
    """
    matched = len(np.unique(tentative.features))
    if matched < LEAST_INLIERS:
        return _nothing(
            RelocalisationStatus.TOO_FEW_MATCHES,
            len(tentative),
            f"only {matched} features look like a landmark; {LEAST_INLIERS} are needed",
        )
    if not refined:
        return _nothing(
            RelocalisationStatus.TOO_FEW_INLIERS,
            len(tentative),
            f"{matched} features match, no two agree",
        )
    best = refined[0]
    competing = [
        (other.unshared(best, landmarks.positions, PIECE_M), other)
        for other in refined[1:]
        if _competes(other, best)
    ]
    votes, second = max(competing, key=lambda pair: pair[0], default=(0, None))
    status, why = _status(best, votes, matched, settings)
    return Relocalisation(
        status=status,
        wTc=best.wTc,
        covariance=best.covariance,
        features=best.features,
        ids=landmarks.ids[best.landmarks],
        candidates=len(tentative),
        expected=len(best.expected),
        residual_px=best.residual_px,
        second=0 if second is None else len(second),
        why=why,
    )


def _status(
    best: Refined, competing: int, matched: int, settings: RelocalisationSettings
) -> tuple[RelocalisationStatus, str]:
    """Status of the best pose and the reason.

    ``competing`` is the number of independent inliers of the strongest competing hypothesis that
    the best one does not share.
    """
    n = len(best)
    sigma_m = float(np.sqrt(np.trace(best.covariance[3:, 3:])))
    sigma_deg = float(np.rad2deg(np.sqrt(np.trace(best.covariance[:3, :3]))))
    found = (
        f"{n} matches agree ({best.proposed} of {matched} tentative), {best.independent} "
        f"independent inliers, elsewhere {competing}; {len(best.expected)} landmarks expected, "
        f"{best.covered:.0%} of their places seen; known in {best.explained:.0%} of the "
        f"directions; misfit {best.misfit:.2f}; sigma {sigma_m:.3f} m {sigma_deg:.2f} deg"
    )
    if best.independent < LEAST_INLIERS:
        needed = f"{LEAST_INLIERS} independent inliers are needed"
        return RelocalisationStatus.TOO_FEW_INLIERS, f"{found}; {needed}"
    if competing >= _AMBIGUOUS_SHARE * best.independent:
        return (
            RelocalisationStatus.AMBIGUOUS,
            f"{found}; another place explains the frame nearly as well",
        )
    if _contradicted(best, matched):
        return (
            RelocalisationStatus.CONTRADICTED,
            f"{found}; too few for how they fit, or for what does not agree with them",
        )
    if sigma_m > settings.max_sigma_m or sigma_deg > settings.max_sigma_deg:
        return RelocalisationStatus.INACCURATE, f"{found}; too uncertain"
    return RelocalisationStatus.FOUND, found


def _contradicted(pose: Refined, matched: int) -> bool:
    """True if the pose has few inliers that fit badly, or whose surroundings do not fit.

    Accidental inliers fill their gates; correct ones lie in the middle. Where the robot is
    somewhere else, most tentative matches are outliers and most landmarks expected in view are not
    seen. An object that was carried off brings inliers alone; but its former surroundings are not
    seen, and its present ones are unmapped.
    """
    if pose.independent >= ENOUGH_INLIERS:
        return False
    agreement = (2.0 * pose.proposed / max(matched, 1) + pose.covered) / 3.0
    surroundings_unmapped = max(pose.covered, pose.explained) < _LEAST_COVERED
    misfits = pose.misfit > MAX_MISFIT
    return misfits or agreement < _LEAST_AGREEMENT or surroundings_unmapped


def _competes(other: Refined, best: Refined) -> bool:
    """True if another pose may be the right one.

    Not if landmarks expected there are not seen. Nor if it explains less than half of the best
    one's features and hardly any other: the right pose would also explain what stands next to the
    objects that both places have. (Under perceptual aliasing the other place explains more than
    half, even where a third of its landmarks are missing.)
    """
    refuted = other.misfit > MAX_MISFIT or other.covered < _LEAST_COVERED
    if refuted and other.independent < ENOUGH_INLIERS:
        return False
    lost, own = best.explains_more_than(other), other.explains_more_than(best)
    return 2 * lost <= len(best) or own >= _AMBIGUOUS_OWN * lost


def _nothing(status: RelocalisationStatus, candidates: int, why: str) -> Relocalisation:
    none = np.empty(0, np.int64)
    return Relocalisation(
        status=status,
        wTc=np.eye(4),
        covariance=np.full((6, 6), np.nan),
        features=none,
        ids=none,
        candidates=candidates,
        expected=0,
        residual_px=float("nan"),
        second=0,
        why=why,
    )
