"""Two maps of one place become one: what both hold is fused, the rest stands side by side.

No evidence counts twice: maps know the frames that are in them (docs/derivations/map_alignment.md).
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.estimates import LandmarkMap, Trajectory
from fgslam.core.features import LandmarkAppearances, LandmarkPatches
from fgslam.core.geometry import congruence, inverse_spd3, point_pose_jacobian, transform_to_world
from fgslam.core.saved_map import SavedMap
from fgslam.frontend.places.map_alignment import Alignment

_MEDIAN_OF_CHI_SQUARE_3 = 2.366
_SINCE_A_START_S = 1e8  # three years: below, a time stamp may count from any recording's start
_SHARES = 21  # weightings tried by covariance intersection: from all of a to all of b

Counts = TypeVar("Counts", IntArray, BoolArray)


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
    names = np.empty(len(b), np.int64)
    names[yours], names[rest] = a.landmarks.ids[mine], first + np.arange(len(rest))
    return SavedMap(
        rig=a.rig,
        landmarks=_landmarks(a, b, moved, alignment, names, alone),
        appearances=_appearances(a, b, alignment.aTb, names),
        hits=_counted(count, a.hits, b.hits, alignment.pairs, rest),
        misses=_counted(count, a.misses, b.misses, alignment.pairs, rest),
        permanent=_counted(np.logical_or, a.permanent, b.permanent, alignment.pairs, rest),
        colour=np.concatenate([a.colour, b.colour[rest]]),
        trajectory=_trajectory(a.trajectory, b.trajectory, alignment.aTb),
        about={"drives": [*a.about.get("drives", ()), *b.about.get("drives", ())]},
        evidence=np.union1d(a.evidence, b.evidence),
        patches=_patches(a, b, alignment.pairs, rest),
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
    alignment takes it out of the differences, and a second visit says nothing about it. The share
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
