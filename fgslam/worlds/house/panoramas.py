"""Rendered panorama sets with truth, like the recorded ones: for maps of places and their links."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, Image
from fgslam.worlds.buildings.house_plan import room_at
from fgslam.worlds.house.world import OmniWorld

# A place's surroundings are taken at these elevations for judging what two places share, degrees.
_ELEVATIONS_DEG = (-25.0, -12.0, 0.0, 10.0)
_DIRECTIONS = 90


@dataclass(frozen=True, slots=True, eq=False)
class PanoramaSet:
    """Images of one world and where they were taken.

    Attributes:
        images: n of (h, w, 3).
        poses: (n, 3) planar poses in the house.
        rooms: n names of rooms.
        shared: (n, n) fraction of the scene around i that j sees, too; 1 on the diagonal.
    """

    images: tuple[Image, ...]
    poses: FloatArray
    rooms: tuple[str, ...]
    shared: FloatArray


def render_panoramas(world: OmniWorld, poses: FloatArray) -> PanoramaSet:
    """Images from planar poses (n, 3), as target images are taken, with truth."""
    images = tuple(world.picture(pose, 1000 + k) for k, pose in enumerate(poses))
    found = (room_at(float(x), float(y)) for x, y, _ in poses)
    rooms = tuple(room.name if room else "outside" for room in found)
    return PanoramaSet(images, np.array(poses), rooms, shared_views(world, poses))


def shared_views(world: OmniWorld, poses: FloatArray) -> FloatArray:
    """(n, n) fraction of the surroundings of pose i that is seen from pose j, too."""
    points = [_surroundings(world, pose) for pose in poses]
    out = np.empty((len(poses), len(poses)))
    for i, around in enumerate(points):
        for j, pose in enumerate(poses):
            out[i, j] = 1.0 if i == j else _free(world, pose, around).mean()
    return out


def _surroundings(world: OmniWorld, pose: FloatArray) -> FloatArray:
    """(m, 3) points on what stands around a pose."""
    turn = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    bearing, elevation = np.meshgrid(turn, np.deg2rad(_ELEVATIONS_DEG))
    level = np.cos(elevation)
    rays = np.stack([level * np.cos(bearing), level * np.sin(bearing), np.sin(elevation)], axis=-1)
    rays = rays.reshape(-1, 3)
    origin = np.array([pose[0], pose[1], world.settings.camera_height_m])
    patch, distance = world.model.layer.caster.cast(origin, rays.astype(np.float32))
    hit = patch >= 0
    return np.asarray(origin + rays[hit] * distance[hit, None])


def _free(world: OmniWorld, pose: FloatArray, points: FloatArray) -> BoolArray:
    """(m,) whether points show from another pose."""
    return world.seen(pose, points)[1]
