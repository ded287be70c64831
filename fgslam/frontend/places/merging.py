"""Two maps of one place become one: what both hold is fused, the rest stands side by side.

No evidence counts twice: maps know the frames that are in them (docs/derivations/places.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.spatial import cKDTree

from fgslam.core.arrays import BoolArray, FloatArray, IntArray, Rows
from fgslam.core.errors import MapError
from fgslam.core.geometry import (
    congruence,
    inverse_spd3,
    point_pose_jacobian,
    se3_exp,
    so3_log,
    transform_to_world,
)
from fgslam.core.saved_map import SavedMap
from fgslam.core.types import LandmarkAppearances, LandmarkMap, LandmarkPatches, Trajectory
from fgslam.frontend.features.matching import AppearanceIndex
from fgslam.frontend.tracking.ego_motion import align_in_space

# ------------------------------------------------------------------------------------------
# Lays one map onto another by what their landmarks look like and where they are

_NEIGHBOURS = 6  # views asked for: enough to pass over a place's own and reach the next
_HYPOTHESES = 400  # rigid triples that are scored
_MAX_DISTANCE = 250.0  # of descriptors, whose norm is 512
_RATIO = 0.8  # nearest place's distance over the next one's, at most
_SAME_PLACE_M = 0.3  # landmarks this near to one another are one place
_SIZE_RATIO = 1.6  # of two landmarks' physical sizes, at most
_SLACK_M = 0.03  # by how much maps are deformed, per axis: their covariances do not know it
_GATE_SIGMAS = 3.4  # largest normalised distance of two observations of a landmark
_SAMPLES = 60_000  # triples of matches drawn
_MIN_PAIRS = 20  # fewer landmarks in common are no overlap
_ELSEWHERE_M = 0.5  # alignments farther apart than this, or turned by more, are different ones
_ELSEWHERE_DEG = 15.0
_AMBIGUOUS_SHARE = 0.5  # of the best alignment's matches: the second-best must have fewer
_OVERLAP_SHARE = 0.15  # of the landmarks among the other map's, least share that is found there:
# one poster in common does not make two places one
_COMPETING = 8  # hypotheses elsewhere that are refined: the best ones
_LEAST_SPREAD_M = 0.3  # smaller triangles turn the map by more than least squares corrects
_ROUNDS = 8  # of least squares and choosing again
AT_ONCE = 8192  # pairs of views compared together; their bytes stay in the cache
_AMONG_M = 0.5  # a landmark this near to one of the other map's lies among them


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The second map's place in the first one.

    Attributes:
        aTb: (4, 4) takes points from the second map's world to the first one's.
        covariance: (6, 6) in the tangent space at it, [rotation, translation].
        pairs: (k, 2) rows of the same landmark in both maps, each at most once.
        residual_m: root mean square distance of the pairs.
        residual_sigmas: the same, normalised per number: 1 as the covariances say.
        candidates: tentative matches; ``agreeing`` of them agree with the alignment.
        second: those that agree with the second-best alignment elsewhere.
        among: trusted landmarks of the second map that lie among the first one's; ``found`` of
            them are in pairs.
    """

    aTb: FloatArray
    covariance: FloatArray
    pairs: IntArray
    residual_m: float
    residual_sigmas: float
    candidates: int
    agreeing: int
    second: int
    among: int
    found: int


def align_maps(a: SavedMap, b: SavedMap, rng: np.random.Generator, names: str) -> Alignment:
    """Where ``b`` lies in ``a``.

    Args:
        a: the map whose world it shall be.
        b: the other one.
        rng: draws the samples.
        names: of both maps, for messages.

    Raises:
        MapError: they do not overlap, or there are several ways to lay them onto each other.
    """
    tentative = tentative_pairs(a, b)
    n = len(tentative)
    if n < _MIN_PAIRS:
        raise MapError(
            f"{names}: only {n} landmarks look alike, {_MIN_PAIRS} are needed; the maps do "
            "not overlap"
        )
    problem = _Points.of(a, b, tentative, _SLACK_M)
    poses = _hypotheses(problem, rng)
    counts = np.array([int(problem.within(aTb, _GATE_SIGMAS).sum()) for aTb in poses])
    if not len(counts) or counts.max() < _MIN_PAIRS // 2:
        most = int(counts.max()) if len(counts) else 0
        raise MapError(
            f"{names}: {n} landmarks look alike, but at most {most} of them lie alike; the maps "
            "do not overlap, or too little"
        )
    best, _ = _refined(problem, poses[int(np.argmax(counts))], _GATE_SIGMAS)
    agreeing = int(problem.within(best, _GATE_SIGMAS).sum())
    second = _second(problem, best, poses[np.argsort(-counts, kind="stable")])
    if second >= _AMBIGUOUS_SHARE * agreeing:
        raise MapError(
            f"{names}: ambiguous: {agreeing} landmarks agree with one alignment, {second} with "
            "another one; drive through the place that both share once more"
        )
    return _completed(a, b, best, (n, agreeing, second), names)


# --------------------------------------------------------------------------------------------
# By appearance


def tentative_pairs(a: SavedMap, b: SavedMap) -> IntArray:
    """Rows (k, 2) of confirmed landmarks that look alike and like no other place; b's ascending."""
    mine, yours = _trusted_views(a), _trusted_views(b)
    if not len(mine) or not len(yours):
        return np.empty((0, 2), np.int64)
    index = AppearanceIndex(a.appearances.descriptors[mine])
    found = index.query(b.appearances.descriptors[yours], _NEIGHBOURS)
    known = found.rows >= 0
    views = mine[np.where(known, found.rows, 0)]
    owners = a.landmarks.rows(a.appearances.ids[views].ravel()).reshape(views.shape)
    places = a.landmarks.positions[owners]
    other = known & (np.linalg.norm(places - places[:, :1], axis=2) > _SAME_PLACE_M)
    next_place = np.where(other, found.distances, np.inf).min(axis=1)
    near = found.distances[:, 0]
    size = np.log(a.appearances.size[views[:, 0]] / b.appearances.size[yours])
    keep = known[:, 0] & (near <= _MAX_DISTANCE) & (near <= _RATIO * next_place)
    keep &= np.abs(size) <= np.log(_SIZE_RATIO)
    rows = b.landmarks.rows(b.appearances.ids[yours[keep]])
    return _nearest_of_each(rows, owners[keep, 0], near[keep])


def _trusted_views(saved: SavedMap) -> IntArray:
    """Indices of the views of landmarks that were seen again after their first frames."""
    trusted = saved.landmarks.ids[saved.permanent | (saved.hits >= 3)]
    return np.flatnonzero(np.isin(saved.appearances.ids, trusted))


def _nearest_of_each(rows: IntArray, owners: IntArray, distances: FloatArray) -> IntArray:
    """One pair (owner, row) for each row: that of the nearest view."""
    order = np.lexsort((owners, distances, rows))
    first = order[np.unique(rows[order], return_index=True)[1]]
    return np.column_stack([owners[first], rows[first]])


# --------------------------------------------------------------------------------------------
# By geometry


@dataclass(frozen=True, slots=True, eq=False)
class _Points(Rows):
    """Matched landmarks: positions (n, 3) and covariances (n, 3, 3) in both maps' worlds."""

    a: FloatArray
    b: FloatArray
    a_covariance: FloatArray
    b_covariance: FloatArray

    @staticmethod
    def of(a: SavedMap, b: SavedMap, pairs: IntArray, slack_m: float) -> _Points:
        slack = slack_m**2 * np.eye(3)
        mine, yours = pairs[:, 0], pairs[:, 1]
        return _Points(
            a.landmarks.positions[mine],
            b.landmarks.positions[yours],
            a.landmarks.covariances[mine] + slack,
            b.landmarks.covariances[yours],
        )

    def residuals(self, aTb: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Differences (n, 3) in a's world, and the inverse of their covariances (n, 3, 3)."""
        both = self.a_covariance + congruence(aTb[:3, :3], self.b_covariance)
        return self.a - transform_to_world(aTb, self.b), inverse_spd3(both)

    def squared(self, aTb: FloatArray) -> FloatArray:
        """(n,) normalised distances, squared."""
        residual, weight = self.residuals(aTb)
        return np.asarray(np.einsum("ni,nij,nj->n", residual, weight, residual))

    def within(self, aTb: FloatArray, gate: float) -> BoolArray:
        """(n,) which agree with an alignment."""
        return np.asarray(self.squared(aTb) <= gate**2)


def _hypotheses(problem: _Points, rng: np.random.Generator) -> FloatArray:
    """Alignments (h, 4, 4) from triples whose sides are as long in both maps."""
    triples = rng.integers(0, len(problem.a), (_SAMPLES, 3))
    mine, yours = problem.a[triples], problem.b[triples]
    variance = np.trace(problem.a_covariance + problem.b_covariance, axis1=1, axis2=2) / 3.0
    keep = np.ones(len(triples), np.bool_)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        own = np.linalg.norm(mine[:, i] - mine[:, j], axis=1)
        other = np.linalg.norm(yours[:, i] - yours[:, j], axis=1)
        sigma = np.sqrt(variance[triples[:, i]] + variance[triples[:, j]])
        keep &= np.abs(own - other) <= _GATE_SIGMAS * sigma
    area = np.linalg.norm(np.cross(mine[:, 1] - mine[:, 0], mine[:, 2] - mine[:, 0]), axis=1)
    chosen = np.flatnonzero(keep & (area >= _LEAST_SPREAD_M**2))[:_HYPOTHESES]
    return align_in_space(yours[chosen], mine[chosen])


def _refined(problem: _Points, aTb: FloatArray, gate: float) -> tuple[FloatArray, FloatArray]:
    """Weighted least squares over what agrees, chosen again until it stays; with covariance."""
    before = np.zeros(len(problem.a), np.bool_)
    information = np.eye(6)
    for _ in range(_ROUNDS):
        keep = problem.within(aTb, gate)
        if np.array_equal(keep, before) or keep.sum() < 3:
            break
        before, chosen = keep, problem.select(keep)
        residual, weight = chosen.residuals(aTb)
        jacobian = -aTb[:3, :3] @ point_pose_jacobian(chosen.b)
        weighted = np.swapaxes(jacobian, 1, 2) @ weight
        information = (weighted @ jacobian).sum(axis=0)
        step = np.linalg.solve(information, np.einsum("nij,nj->i", weighted, residual))
        aTb = aTb @ se3_exp(step)
    return aTb, np.asarray(np.linalg.inv(information))


def _second(problem: _Points, best: FloatArray, poses: FloatArray) -> int:
    """Matches that agree with the best alignment elsewhere; ``poses`` with the best ones first."""
    centre, most = problem.b.mean(axis=0), 0
    for pose in poses[_differ(poses, best, centre)][:_COMPETING]:
        # What merely starts elsewhere comes to the best one itself.
        competing, _ = _refined(problem, pose, _GATE_SIGMAS)
        if _differ(competing[None], best, centre)[0]:
            most = max(most, int(problem.within(competing, _GATE_SIGMAS).sum()))
    return most


def _differ(poses: FloatArray, best: FloatArray, centre: FloatArray) -> BoolArray:
    """Which alignments put the second map's centre, or its heading, elsewhere than the best."""
    here = transform_to_world(best, centre[None])[0]
    shift = poses[:, :3, :3] @ centre + poses[:, :3, 3] - here
    turns = np.array([np.linalg.norm(so3_log(best[:3, :3].T @ pose[:3, :3])) for pose in poses])
    far = np.linalg.norm(shift, axis=1) > _ELSEWHERE_M
    return np.asarray(far | (turns > np.deg2rad(_ELSEWHERE_DEG)))


# --------------------------------------------------------------------------------------------
# All landmarks, and the decision


def _completed(
    a: SavedMap,
    b: SavedMap,
    aTb: FloatArray,
    matches: tuple[int, int, int],
    names: str,
) -> Alignment:
    """The alignment over all landmarks that it brings together; refused where most stay alone."""
    for _ in range(2):
        pairs = _same(a, b, aTb)
        problem = _Points.of(a, b, pairs, _SLACK_M)
        aTb, covariance = _refined(problem, aTb, _GATE_SIGMAS)
    pairs = _same(a, b, aTb)
    problem = _Points.of(a, b, pairs, _SLACK_M)
    trusted = b.permanent | (b.hits >= 3)
    tree = cKDTree(a.landmarks.positions[a.permanent | (a.hits >= 3)])
    near, _ = tree.query(transform_to_world(aTb, b.landmarks.positions))
    among = trusted & (near <= _AMONG_M)
    found = among & np.isin(np.arange(len(b)), pairs[:, 1])
    counts = (int(among.sum()), int(found.sum()))
    if len(pairs) < _MIN_PAIRS or counts[1] < _OVERLAP_SHARE * counts[0]:
        raise MapError(
            f"{names}: {len(pairs)} landmarks agree with the best alignment, but of {counts[0]} "
            f"that then lie among the other map's only {counts[1]} are found there; the maps do "
            "not overlap"
        )
    offsets = problem.a - transform_to_world(aTb, problem.b)
    return Alignment(
        aTb=aTb,
        covariance=covariance,
        pairs=pairs,
        residual_m=float(np.sqrt(np.mean((offsets**2).sum(axis=1)))),
        residual_sigmas=float(np.sqrt(problem.squared(aTb).mean() / 3.0)),
        candidates=matches[0],
        agreeing=matches[1],
        second=matches[2],
        among=counts[0],
        found=counts[1],
    )


def _same(a: SavedMap, b: SavedMap, aTb: FloatArray) -> IntArray:
    """Rows (k, 2) of landmarks that lie in the same place and look alike, each in one pair."""
    points = transform_to_world(aTb, b.landmarks.positions)
    reach = _GATE_SIGMAS * np.sqrt(
        _SLACK_M**2 + np.trace(b.landmarks.covariances, axis1=1, axis2=2)
    )
    near = cKDTree(a.landmarks.positions).query_ball_point(points, np.minimum(reach, _AMONG_M))
    counts = np.array([len(rows) for rows in near])
    yours = np.repeat(np.arange(len(b)), counts)
    mine = np.concatenate([np.empty(0, np.int64), *(np.sort(rows) for rows in near)]).astype(int)
    pairs = np.column_stack([mine, yours])
    keep = _Points.of(a, b, pairs, _SLACK_M).within(aTb, _GATE_SIGMAS)
    pairs = pairs[keep]
    distance = _descriptor_distances(a, b, pairs)
    keep = distance <= _MAX_DISTANCE
    return _one_to_one(pairs[keep], distance[keep])


def _descriptor_distances(a: SavedMap, b: SavedMap, pairs: IntArray) -> FloatArray:
    """(k,) between the nearest views of each pair; infinite where one has no view."""
    mine, yours = _view_lists(a)[pairs[:, 0]], _view_lists(b)[pairs[:, 1]]
    others = np.diff(yours, axis=1)[:, 0]
    counts = np.diff(mine, axis=1)[:, 0] * others
    pair = np.repeat(np.arange(len(pairs)), counts)
    own, other = np.divmod(
        np.arange(len(pair)) - (np.cumsum(counts) - counts)[pair], np.maximum(others, 1)[pair]
    )
    own, other = mine[pair, 0] + own, yours[pair, 0] + other
    out = np.full(len(pairs), np.inf)
    for start in range(0, len(pair), AT_ONCE):
        part = slice(start, start + AT_ONCE)
        difference = a.appearances.descriptors[own[part]].astype(np.int32)
        difference -= b.appearances.descriptors[other[part]]
        squared = np.einsum("ij,ij->i", difference, difference)
        np.minimum.at(out, pair[part], np.sqrt(squared))
    return out


def _view_lists(saved: SavedMap) -> IntArray:
    """(n, 2) first view of each landmark, and the one after its last."""
    ids, views = saved.landmarks.ids, saved.appearances.ids
    return np.column_stack([np.searchsorted(views, ids, s) for s in ("left", "right")])


def _one_to_one(pairs: IntArray, distances: FloatArray) -> IntArray:
    """The nearest pairs first, each landmark once; by the first map's rows."""
    used: tuple[set[int], set[int]] = (set(), set())
    kept = []
    for k in np.lexsort((pairs[:, 1], pairs[:, 0], distances)).tolist():
        i, j = pairs[k].tolist()
        if i not in used[0] and j not in used[1]:
            used[0].add(i)
            used[1].add(j)
            kept.append(k)
    chosen = pairs[kept] if kept else np.empty((0, 2), np.int64)
    return chosen[np.argsort(chosen[:, 0], kind="stable")]


_MEDIAN_OF_CHI_SQUARE_3 = 2.366
_SINCE_A_START_S = 1e8  # three years: below, a time stamp may count from any recording's start
_SHARES = 21  # weightings tried by covariance intersection: from all of a to all of b

Counts = TypeVar("Counts", IntArray, FloatArray, BoolArray)


def merge_maps(a: SavedMap, b: SavedMap, alignment: Alignment) -> SavedMap:
    """Map ``a`` with ``b`` in its world.

    Landmarks in both keep a's identity. Of maps without a frame in common, position and covariance
    are the two weighted by their own parts of the covariances, the alignment's uncertainty part of
    b's, and hits and misses add up. Maps that share frames or moments are fused without counting
    anything twice (covariance intersection, Julier and Uhlmann 1997), with the larger counts. A
    ``b`` without a frame that a lacks leaves ``a`` as it is.

    Permanent is what either holds so, and all views are kept. Others of b get identities after a's
    last. The trajectory is both drives, where b's came later, else a's alone.
    """
    if adds_nothing(b, a):
        return a
    alone = shared_frames(a, b) == 0 and not shared_moments(a, b)
    moved = _moved(b, alignment)
    count = np.add if alone else np.maximum
    mine, yours = alignment.pairs[:, 0], alignment.pairs[:, 1]
    rest = np.setdiff1d(np.arange(len(b)), yours)
    first = int(a.landmarks.ids[-1]) + 1 if len(a) else 0
    grey = a.colours is None and b.colours is None
    names = np.empty(len(b), np.int64)
    names[yours], names[rest] = a.landmarks.ids[mine], first + np.arange(len(rest))
    return SavedMap(
        rig=a.rig,
        landmarks=_landmarks(a, b, moved, alignment, names, alone),
        appearances=_appearances(a, b, alignment.aTb, names),
        hits=_counted(count, a.hits, b.hits, alignment.pairs, rest),
        misses=_counted(count, a.misses, b.misses, alignment.pairs, rest),
        farthest=_counted(np.maximum, a.farthest, b.farthest, alignment.pairs, rest),
        permanent=_counted(np.logical_or, a.permanent, b.permanent, alignment.pairs, rest),
        colour=np.concatenate([a.colour, b.colour[rest]]),
        trajectory=_trajectory(a.trajectory, b.trajectory, alignment.aTb),
        about={"drives": [*a.about.get("drives", ()), *b.about.get("drives", ())]},
        evidence=np.union1d(a.evidence, b.evidence),
        patches=_patches(a, b, alignment.pairs, rest),
        colours=None if grey else np.concatenate([a.shown, b.shown[rest]]),
    )


def shared_frames(a: SavedMap, b: SavedMap) -> int:
    """How many frames are in both maps."""
    return len(np.intersect1d(a.evidence, b.evidence))


def shared_moments(a: SavedMap, b: SavedMap) -> int:
    """How many poses both maps have of one moment by the world's clock.

    One recording whose images were read in two ways (another calibration, compression or size) has
    no frame in common with itself, and shows the same all the same.
    """
    ours, theirs = a.trajectory.timestamps, b.trajectory.timestamps
    common = np.intersect1d(ours, theirs)
    return int(np.count_nonzero(common > _SINCE_A_START_S))


def adds_nothing(b: SavedMap, a: SavedMap) -> bool:
    """Whether every frame of ``b`` is in ``a`` already."""
    return shared_frames(a, b) == len(b.evidence)


def _patches(a: SavedMap, b: SavedMap, pairs: IntArray, rest: IntArray) -> LandmarkPatches | None:
    """Those of a, or where it has none of the same landmark of b, then those of b alone."""
    if a.patches is None and b.patches is None:
        return None
    ours, theirs = (one.patches or LandmarkPatches.none(len(one)) for one in (a, b))
    mine, yours = pairs[ours.distances[pairs[:, 0]] == 0.0].T
    grey, distances = ours.grey.copy(), ours.distances.copy()
    grey[mine], distances[mine] = theirs.grey[yours], theirs.distances[yours]
    return LandmarkPatches(grey, distances).join(theirs.select(rest))


def _moved(b: SavedMap, alignment: Alignment) -> LandmarkMap:
    """Landmarks of b in a's world, as uncertain as they and the alignment are together."""
    aTb, positions = alignment.aTb, b.landmarks.positions
    by_alignment = -aTb[:3, :3] @ point_pose_jacobian(positions)
    covariances = congruence(aTb[:3, :3], b.landmarks.covariances)
    covariances = covariances + congruence(by_alignment, alignment.covariance)
    return LandmarkMap(b.landmarks.ids, transform_to_world(aTb, positions), covariances)


def _landmarks(
    a: SavedMap,
    b: SavedMap,
    moved: LandmarkMap,
    alignment: Alignment,
    names: IntArray,
    alone: bool,
) -> LandmarkMap:
    """Fused landmarks, then those of b alone; ``alone``: no frame is in both maps."""
    mine, yours = alignment.pairs[:, 0], alignment.pairs[:, 1]
    rest = np.setdiff1d(np.arange(len(b)), yours)
    positions, covariances = a.landmarks.positions.copy(), a.landmarks.covariances.copy()
    ours, theirs = covariances[mine], moved.covariances[yours]
    offset = moved.positions[yours] - positions[mine]
    if alone:
        before = congruence(alignment.aTb[:3, :3], b.landmarks.covariances[yours])
        own = own_share(offset, ours + before)
        ours, theirs = own * ours, theirs - (1.0 - own) * before
        fused, weight = _independent(ours, theirs)
        fused = fused + (1.0 / own - 1.0) * ours if own > 0.0 else covariances[mine]
    else:
        fused, weight = _intersected(ours, theirs)
    positions[mine] += np.einsum("kij,kj->ki", weight, offset)
    covariances[mine] = fused
    return LandmarkMap(
        np.concatenate([a.landmarks.ids, names[rest]]),
        np.concatenate([positions, moved.positions[rest]]),
        np.concatenate([covariances, moved.covariances[rest]]),
    )


def own_share(offset: FloatArray, covariance: FloatArray) -> float:
    """Share of two maps' covariances by which their landmarks differ, 0 to 1.

    What a drive drifted is in the covariances of all its landmarks, but moves neighbours alike: the
    alignment takes it out of the differences, and a second visit measures nothing of it. The share
    is the median normalised distance (k,) over its expectation, chi-square in three dimensions.
    """
    if not len(offset):
        return 1.0
    squared = np.einsum("ki,kij,kj->k", offset, inverse_spd3(covariance), offset)
    return float(min(np.median(squared) / _MEDIAN_OF_CHI_SQUARE_3, 1.0))


def _independent(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Covariance (k, 3, 3) of the weighted mean of independent errors, and the weight of b's."""
    information = inverse_spd3(b)
    fused = inverse_spd3(inverse_spd3(a) + information)
    return fused, fused @ information


def _intersected(a: FloatArray, b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The same of errors whose correlation is not known: the weighting of least determinant.

    A pair of one and the same covariance keeps it.
    """
    share = np.linspace(0.0, 1.0, _SHARES)[:, None, None, None]
    own, other = (1.0 - share) * inverse_spd3(a), share * inverse_spd3(b)
    best = np.argmax(np.linalg.det(own + other), axis=0)
    rows = np.arange(len(a))
    fused = inverse_spd3((own + other)[best, rows])
    return fused, fused @ other[best, rows]


def _counted(count: np.ufunc, a: Counts, b: Counts, pairs: IntArray, rest: IntArray) -> Counts:
    """Numbers of a, with b's of the same landmark, then those of b alone."""
    out = a.copy()
    out[pairs[:, 0]] = count(a[pairs[:, 0]], b[pairs[:, 1]])
    return np.concatenate([out, b[rest]])


def _appearances(a: SavedMap, b: SavedMap, aTb: FloatArray, names: IntArray) -> LandmarkAppearances:
    """All views; of one landmark a's come first, which counts as seen longer ago."""
    mine, yours = a.appearances, b.appearances
    ids = np.concatenate([mine.ids, names[b.landmarks.rows(yours.ids)]])
    order = np.argsort(ids, kind="stable")

    def both(own: FloatArray, other: FloatArray) -> FloatArray:
        return np.concatenate([own, other])[order]

    return LandmarkAppearances(
        ids=ids[order],
        descriptors=np.concatenate([mine.descriptors, yours.descriptors])[order],
        size=both(mine.size, yours.size),
        orientation=both(mine.orientation, yours.orientation),
        direction=both(mine.direction, yours.direction @ aTb[:3, :3].T),
    )


def _trajectory(a: Trajectory, b: Trajectory, aTb: FloatArray) -> Trajectory:
    if not len(b) or (len(a) and b.timestamps[0] <= a.timestamps[-1]):
        return a
    stamps = np.concatenate([a.timestamps, b.timestamps])
    return Trajectory(stamps, np.concatenate([a.poses.reshape(-1, 4, 4), aTb @ b.poses]))
