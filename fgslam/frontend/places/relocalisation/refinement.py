"""A proposed pose refined: agreeing matches, guided re-matching around it, least squares."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray
from fgslam.core.features import StereoFeatures
from fgslam.core.floor import Floor
from fgslam.core.sensors import CameraRig
from fgslam.frontend.places.relocalisation.known_map import MAX_DISTANCE, KnownMap, gated
from fgslam.frontend.places.relocalisation.proposals import Evidence, Proposals
from fgslam.frontend.places.relocalisation.residuals import (
    Pairs,
    SeenPoints,
    refine,
    residuals,
    squared_distances,
)
from fgslam.frontend.settings import RelocalisationSettings

PIECE_M = 0.5  # landmarks in a cube of this side drift together and may be one object, moved as one
_GATE_SIGMAS = 4.0  # largest normalised residual (three numbers) of an inlier
_VIEW_RAD = float(np.deg2rad(20.0))  # a landmark is expected to be seen this near to a stored view
_ROUNDS = 4  # of choosing matches and solving; the choice rests after two or three
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

    def explains_beside(self, other: Refined) -> int:
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
    """What refinement needs beside the pose."""

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
        for _ in range(_ROUNDS):
            for one in moving:
                i, j, cost = one.candidates
                pairs = Pairs.of(self.seen, i, self.known.landmarks, j)
                off = squared_distances(residuals(self.rig, one.wTc, pairs), one.covariance)
                near = off <= _GATE_SIGMAS**2
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
        looks = (self.known.views, self.known.owners)
        keep = gated(self.features, (i, v), self.known.landmarks, looks, self.floor)
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
