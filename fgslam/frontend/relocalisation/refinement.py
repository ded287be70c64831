"""A proposed pose refined: agreeing matches, guided re-matching around it, least squares."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fgslam.floor import Floor
from fgslam.frontend.relocalisation.known_map import KnownMap
from fgslam.frontend.relocalisation.least_squares import refine
from fgslam.frontend.relocalisation.proposals import Evidence
from fgslam.frontend.relocalisation.residuals import (
    Pairs,
    SeenPoints,
    residuals,
    squared_distances,
)
from fgslam.frontend.relocalisation.tentative import gated
from fgslam.settings.relocalisation import RelocalisationSettings
from fgslam.types import BoolArray, ByteArray, CameraRig, FloatArray, IntArray, StereoFeatures

_ROUNDS = 4  # of choosing matches and solving; the choice rests after two or three
_STEPS = 6
_KERNEL_WIDTH = 2.0  # as the tracker's
_BEYOND = 1.5  # times the farthest feature: no landmark farther away matches one
_VOTES = 4  # of one piece of the map
_SEVERAL = 4  # landmarks expected in a piece, so that one should be seen


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
        witnesses: what the matches weigh: of one piece of the map at most four count, for a thing
            that stands elsewhere, too, would match as a whole.
        covered: share of the map's pieces expected in view of which something is seen.
    """

    wTc: FloatArray
    covariance: FloatArray
    features: IntArray
    landmarks: IntArray
    residual_px: float
    misfit: float
    proposed: int
    expected: IntArray
    witnesses: int
    covered: float

    def __len__(self) -> int:
        return len(self.features)

    def unshared(self, other: Refined, positions: FloatArray, side: float) -> int:
        """Witnesses for this pose among the matches that the other does not have."""
        count = int(max(self.landmarks.max(), other.landmarks.max())) + 1
        own = self.features * count + self.landmarks
        rest = ~np.isin(own, other.features * count + other.landmarks)
        return witnesses(positions[self.landmarks[rest]], side)


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

    def refine(self, wTc: FloatArray, covariance: FloatArray) -> Refined | None:
        """The pose at rest with its matches; None where they do not fix it."""
        tentative = self.evidence.tentative
        least = 2 if self.floor.rigid_dof == 3 else 3
        chosen = tentative.features[:0], tentative.landmarks[:0]
        for guided in (False, True):
            candidates = self._around(wTc) if guided else self._proposed()
            for _ in range(_ROUNDS):
                before = chosen
                chosen = self._choose(wTc, covariance, candidates)
                if len(chosen[0]) < least:
                    return None
                wTc, covariance = self._solve(wTc, chosen)
                if not np.isfinite(covariance).all():
                    return None
                if np.array_equal(before[0], chosen[0]) and np.array_equal(before[1], chosen[1]):
                    break
        return self._finish(wTc, covariance, chosen)

    def _choose(
        self,
        wTc: FloatArray,
        covariance: FloatArray,
        candidates: tuple[IntArray, IntArray, FloatArray],
    ) -> tuple[IntArray, IntArray]:
        """One-to-one matches (features, landmarks) that agree with the pose."""
        i, j, cost = candidates
        pairs = Pairs.of(self.seen, i, self.known.landmarks, j)
        squared = squared_distances(residuals(self.rig, wTc, pairs), covariance)
        near = squared <= self.settings.gate_sigmas**2
        cost = cost if self.settings.descriptors else squared
        return _one_to_one(i[near], j[near], cost[near])

    def _proposed(self) -> tuple[IntArray, IntArray, FloatArray]:
        """The tentative matches: features, landmarks, distances."""
        tentative = self.evidence.tentative
        return tentative.features, tentative.landmarks, tentative.distances

    def _around(self, wTc: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
        """Pairs of features and landmarks in view that look alike, with their distances."""
        farthest = _BEYOND * float(np.abs(self.features.position[:, 2]).max())
        rows, _ = self.known.in_view(self.rig, wTc, farthest)
        views, _ = self.known.views_of(rows)
        if self.settings.descriptors:
            distance = _distances(self.features.descriptors, self.known.views.descriptors[views])
        else:
            distance = np.zeros((len(self.features), len(views)))
        i, column = np.nonzero(distance <= self.settings.max_distance)
        cost, v = distance[i, column], views[column]
        looks = (self.known.views, self.known.owners)
        keep = gated(self.features, (i, v), self.known.landmarks, looks, self.floor, self.settings)
        found = i[keep], self.known.owners[v[keep]], cost[keep]
        first = self._proposed()
        return (
            np.concatenate([found[0], first[0]]),
            np.concatenate([found[1], first[1]]),
            np.concatenate([found[2], first[2]]),
        )

    def _solve(
        self, wTc: FloatArray, chosen: tuple[IntArray, IntArray]
    ) -> tuple[FloatArray, FloatArray]:
        """Least squares; landmarks of one piece of the map err together and share their say."""
        pairs = Pairs.of(self.seen, chosen[0], self.known.landmarks, chosen[1])
        others = crowd(pairs.points, self.settings.piece_m) - 1
        drift = others[:, None, None] * self.settings.map_sigma_m**2 * np.eye(3)
        pairs = replace(pairs, point_covariances=pairs.point_covariances + drift)
        rows = np.zeros(len(pairs), np.int64)
        poses, covariances = refine(
            self.rig, self.floor, wTc[None], pairs, rows, _STEPS, _KERNEL_WIDTH
        )
        return poses[0], covariances[0]

    def _finish(
        self, wTc: FloatArray, covariance: FloatArray, chosen: tuple[IntArray, IntArray]
    ) -> Refined:
        pairs = Pairs.of(self.seen, chosen[0], self.known.landmarks, chosen[1])
        found = residuals(self.rig, wTc, pairs)
        image = found.residual[pairs.seen.in_image][:, :2]
        rms = float(np.sqrt(np.mean(np.sum(image**2, axis=1)))) if len(image) else float("nan")
        sizes = float(self.features.scale.min()), float(self.features.scale.max())
        expected = self.known.recognisable(self.rig, wTc, self._view_angle, sizes)
        tentative = np.unique(self.evidence.tentative.features)
        proposed = int(np.isin(tentative, chosen[0]).sum())
        positions, side = self.known.landmarks.positions, self.settings.piece_m
        return Refined(
            wTc=wTc,
            covariance=covariance,
            features=chosen[0],
            landmarks=chosen[1],
            residual_px=rms,
            misfit=float(np.mean(squared_distances(found))) / 3.0,
            proposed=proposed,
            expected=expected,
            witnesses=witnesses(positions[chosen[1]], side),
            covered=covered(positions[expected], np.isin(expected, chosen[1]), side),
        )

    @property
    def _view_angle(self) -> float:
        return float(np.deg2rad(self.settings.view_deg))


def pieces(positions: FloatArray, side: float) -> IntArray:
    """Number (n,) of the cube that each of the positions (n, 3) lies in, from 0."""
    cubes = np.floor(positions / side).astype(np.int64)
    return np.asarray(np.unique(cubes, axis=0, return_inverse=True)[1].ravel())


def witnesses(positions: FloatArray, side: float) -> int:
    """How many of the positions (n, 3) count where each cube has at most four votes."""
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


def crowd(positions: FloatArray, side: float) -> IntArray:
    """How many of the positions (n, 3) lie in the same cube as each."""
    of = pieces(positions, side)
    return np.asarray(np.bincount(of)[of])


def _distances(a: ByteArray, b: ByteArray) -> FloatArray:
    """Euclidean distances (n, m) of descriptors; exact sums in float32 (below 2^24)."""
    x, y = a.astype(np.float32), b.astype(np.float32)
    squared = np.einsum("ij,ij->i", x, x)[:, None] + np.einsum("ij,ij->i", y, y)
    return np.asarray(np.sqrt((squared - 2.0 * (x @ y.T)).astype(np.float64)))


def _one_to_one(i: IntArray, j: IntArray, cost: FloatArray) -> tuple[IntArray, IntArray]:
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
