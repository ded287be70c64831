"""Landmarks of worlds without appearance: where they are, and the identities that they get.

They lie on the surfaces of a room or of corridors, with the side they are seen from. Identities are
as the landmark database makes them: given in the order of first sight, kept through misses, dropped
after too many in a row, and new when the point is seen again (Se et al. 4.3).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.worlds.buildings.lab import build_lab
from fgslam.worlds.rendering.patches import stack
from fgslam.worlds.settings import MeasurementWorldSettings
from fgslam.worlds.simulated.drives import CORRIDOR_WIDTH_M

_BARE = frozenset({"floor", "ceiling"})
"""Things of the lab with few features; they get this share of what their area would earn."""
_BARE_SHARE = 0.05
_STREAM = 21  # of random numbers, apart from the rendered lab's
_HEIGHTS_M = (0.1, 2.6)
_RELIEF_M = 0.15  # how far things stand out from a corridor's wall
_ON_WALL_M = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkWorld:
    """Points that can be seen.

    Attributes:
        points: (n, 3) metres, room frame.
        normals: (n, 3) unit, towards the side they are seen from.
        strength: (n,) in [0, 1): the stronger are found first where there are too many.
        boxes: (k, 2, 2) least and greatest x, y of the convex parts of the place.
        inside: (n, k) which points lie in which part: what shares a part sees each other.
    """

    points: FloatArray
    normals: FloatArray
    strength: FloatArray
    boxes: FloatArray
    inside: BoolArray

    def __len__(self) -> int:
        return len(self.points)

    def in_sight(self, position: FloatArray) -> IntArray:
        """Points with nothing between them and a camera position (3,), ascending."""
        here = _inside(position[None], self.boxes)[0]
        return np.flatnonzero(self.inside[:, here].any(axis=1))


def build_world(settings: MeasurementWorldSettings, corners: FloatArray | None) -> LandmarkWorld:
    """The landmarks of a place, from its own seed.

    Args:
        settings: how many, and where. The furniture is that of the rendered lab's ``room_seed``.
        corners: (k, 2) centre line of the corridors, metres; None for the room.
    """
    rng = np.random.default_rng([settings.world_seed, _STREAM])
    if corners is None:
        points, normals = _lab_points(settings, rng)
        boxes = np.array([[points[:, :2].min(axis=0) - 1.0, points[:, :2].max(axis=0) + 1.0]])
    else:
        way = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
        count = int(np.ceil(settings.landmarks * way / 100.0))
        boxes = _corridor_boxes(corners)
        points, normals = _corridor_points(boxes, count, rng)
    strength = rng.uniform(size=len(points))
    return LandmarkWorld(points, normals, strength, boxes, _inside(points, boxes))


def _inside(points: FloatArray, boxes: FloatArray) -> BoolArray:
    """(n, k) which points lie in which box, walls included."""
    xy = points[:, None, :2]
    return np.asarray(
        ((xy >= boxes[:, 0] - _ON_WALL_M) & (xy <= boxes[:, 1] + _ON_WALL_M)).all(axis=2)
    )


def _lab_points(
    settings: MeasurementWorldSettings, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Spread over walls, furniture and what hangs on the walls, by area."""
    count = settings.landmarks
    things = build_lab(np.random.default_rng([settings.world_seed, 2]), visit=1)
    patches = stack(things)
    area = np.linalg.norm(np.cross(patches.edge_u, patches.edge_v), axis=1)
    bare = np.array([thing.name in _BARE for thing in things])
    area[bare[patches.thing]] *= _BARE_SHARE
    which = rng.choice(len(patches), size=count, p=area / area.sum())
    u, v = rng.uniform(size=(2, count, 1))
    points = patches.corner[which] + u * patches.edge_u[which] + v * patches.edge_v[which]
    return points, patches.normal[which]


def _corridor_boxes(corners: FloatArray) -> FloatArray:
    """(k, 2, 2) one rectangle for each leg, the squares at its ends included."""
    half = CORRIDOR_WIDTH_M / 2
    pairs = [np.array([a, b]) for a, b in itertools.pairwise(corners)]
    return np.array([[p.min(axis=0) - half, p.max(axis=0) + half] for p in pairs])


def _corridor_points(
    boxes: FloatArray, count: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """On the walls, where no other leg opens."""
    corner, edge, normal = _sides(boxes)
    length = np.linalg.norm(edge, axis=1)
    # Openings take some; draw enough at once, keep the first ones.
    which = rng.choice(len(corner), size=2 * count, p=length / length.sum())
    xy = corner[which] + rng.uniform(size=(2 * count, 1)) * edge[which]
    relief = rng.uniform(0.0, _RELIEF_M, size=(2 * count, 1))
    opening = (xy[:, None] > boxes[:, 0] + _ON_WALL_M) & (xy[:, None] < boxes[:, 1] - _ON_WALL_M)
    wall = np.flatnonzero(~opening.all(axis=2).max(axis=1))[:count]
    heights = rng.uniform(*_HEIGHTS_M, size=2 * count)
    points = np.column_stack([xy + relief * normal[which], heights])[wall]
    return points, np.column_stack([normal[which], np.zeros(2 * count)])[wall]


def _sides(boxes: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Corner, edge and inward normal (4k, 2) of the boxes' sides."""
    (x0, y0), (x1, y1) = boxes[:, 0].T, boxes[:, 1].T
    zero, one = np.zeros(len(boxes)), np.ones(len(boxes))
    corner = np.array([[x0, y0], [x0, y1], [x0, y0], [x1, y0]])
    edge = np.array([[x1 - x0, zero], [x1 - x0, zero], [zero, y1 - y0], [zero, y1 - y0]])
    normal = np.array([[zero, one], [zero, -one], [one, zero], [-one, zero]])
    flat = [np.swapaxes(part, 1, 2).reshape(-1, 2) for part in (corner, edge, normal)]
    return flat[0], flat[1], flat[2]


# --------------------------------------------------------------------------------------------
# Identities


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """One frame's points by what they are to the database.

    Attributes:
        matched: (k,) points seen whose identity is known, by ascending identity (Type III).
        matched_ids: (k,) theirs.
        new: (m,) points seen for the first time, or again after they were dropped (Type IV).
        new_ids: (m,) the identities they got, ascending.
        missed_ids: identities expected in view and not seen, ascending (Type II).
        pruned_ids: identities dropped after this frame, ascending.
    """

    matched: IntArray
    matched_ids: IntArray
    new: IntArray
    new_ids: IntArray
    missed_ids: IntArray
    pruned_ids: IntArray

    @staticmethod
    def nothing() -> Sightings:
        """Of a frame in which the cameras saw nothing at all, and nothing was expected."""
        none = np.empty(0, np.int64)
        return Sightings(none, none, none, none, none, none)


class IdentityBook:
    """Who is known, missed and dropped, frame after frame."""

    def __init__(self, points: int, prune_after: int) -> None:
        """Knows none of the points; ``prune_after`` consecutive misses drop an identity."""
        self._prune_after = prune_after
        self._id = np.full(points, -1, np.int64)
        self._missed = np.zeros(points, np.int64)
        self._point_of_id: list[IntArray] = []
        self._count = 0

    def __len__(self) -> int:
        """Identities given so far."""
        return self._count

    @property
    def point_of_id(self) -> IntArray:
        """(n,) point behind each identity ever given."""
        return np.concatenate([np.empty(0, np.int64), *self._point_of_id])

    def known(self) -> BoolArray:
        """Which points have an identity now."""
        return np.asarray(self._id >= 0)

    def take(self, seen: BoolArray, expected: BoolArray) -> Sightings:
        """One frame.

        Args:
            seen: (points,) which were measured.
            expected: (points,) which should have been; those known and not seen are missed.
        """
        known = self._id >= 0
        matched = np.flatnonzero(seen & known)
        matched = matched[np.argsort(self._id[matched])]
        new = np.flatnonzero(seen & ~known)
        missed = expected & ~seen & known
        new_ids = self._count + np.arange(len(new))
        out = (matched, self._id[matched], new, new_ids, np.sort(self._id[missed]))
        self._missed[matched] = 0
        self._missed[missed] += 1
        self._id[new], self._missed[new] = new_ids, 0
        self._count += len(new)
        self._point_of_id.append(new)
        return Sightings(*out, pruned_ids=self._prune())

    def _prune(self) -> IntArray:
        gone = (self._id >= 0) & (self._missed >= self._prune_after)
        pruned = np.sort(self._id[gone])
        self._id[gone] = -1
        return pruned
