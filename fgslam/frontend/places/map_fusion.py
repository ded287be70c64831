"""Two maps of one place become one: what both hold is fused, the rest stands side by side."""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import LandmarkMap, Trajectory
from fgslam.core.features import LandmarkAppearances
from fgslam.core.geometry import congruence, inverse_spd3, point_pose_jacobian, transform_to_world
from fgslam.core.saved_map import SavedMap
from fgslam.frontend.places.map_alignment import Alignment


def merge_maps(a: SavedMap, b: SavedMap, alignment: Alignment) -> SavedMap:
    """Map ``a`` with ``b`` in its world.

    Landmarks in both keep a's identity; position and covariance are the two weighted by their
    covariances, the alignment's uncertainty part of b's. Hits and misses add up, permanent is what
    either holds so, and all views are kept. Others of b get identities after a's last. The
    trajectory is both drives, where b's came later, else a's alone; a session is not kept, since
    no run had this map.
    """
    moved = _moved(b, alignment)
    mine, yours = alignment.pairs[:, 0], alignment.pairs[:, 1]
    rest = np.setdiff1d(np.arange(len(b)), yours)
    first = int(a.landmarks.ids[-1]) + 1 if len(a) else 0
    names = np.empty(len(b), np.int64)
    names[yours], names[rest] = a.landmarks.ids[mine], first + np.arange(len(rest))
    return SavedMap(
        rig=a.rig,
        landmarks=_landmarks(a, moved, alignment.pairs, names, rest),
        appearances=_appearances(a, b, alignment.aTb, names),
        hits=_added(a.hits, b.hits, alignment.pairs, rest),
        misses=_added(a.misses, b.misses, alignment.pairs, rest),
        permanent=_added(a.permanent.astype(int), b.permanent.astype(int), alignment.pairs, rest)
        > 0,
        colour=np.concatenate([a.colour, b.colour[rest]]),
        trajectory=_trajectory(a.trajectory, b.trajectory, alignment.aTb),
        about={"drives": [*a.about.get("drives", ()), *b.about.get("drives", ())]},
        session={},
    )


def _moved(b: SavedMap, alignment: Alignment) -> LandmarkMap:
    """Landmarks of b in a's world, as uncertain as they and the alignment are together."""
    aTb, positions = alignment.aTb, b.landmarks.positions
    by_alignment = -aTb[:3, :3] @ point_pose_jacobian(positions)
    covariances = congruence(aTb[:3, :3], b.landmarks.covariances)
    covariances = covariances + congruence(by_alignment, alignment.covariance)
    return LandmarkMap(b.landmarks.ids, transform_to_world(aTb, positions), covariances)


def _landmarks(
    a: SavedMap, moved: LandmarkMap, pairs: IntArray, names: IntArray, rest: IntArray
) -> LandmarkMap:
    mine, yours = pairs[:, 0], pairs[:, 1]
    positions, covariances = a.landmarks.positions.copy(), a.landmarks.covariances.copy()
    own, other = inverse_spd3(covariances[mine]), inverse_spd3(moved.covariances[yours])
    covariances[mine] = inverse_spd3(own + other)
    weighted = np.einsum("kij,kj->ki", own, positions[mine])
    weighted = weighted + np.einsum("kij,kj->ki", other, moved.positions[yours])
    positions[mine] = np.einsum("kij,kj->ki", covariances[mine], weighted)
    return LandmarkMap(
        np.concatenate([a.landmarks.ids, names[rest]]),
        np.concatenate([positions, moved.positions[rest]]),
        np.concatenate([covariances, moved.covariances[rest]]),
    )


def _added(a: IntArray, b: IntArray, pairs: IntArray, rest: IntArray) -> IntArray:
    """Counts of a, with b's of the same landmark, then those of b alone."""
    out = a.copy()
    out[pairs[:, 0]] += b[pairs[:, 1]]
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
