"""Scenes as flat patches, and what a ray meets in them.

Patches are parallelograms with one texture each, so that shading is exact. Seen from its front a
patch has ``edge_u`` to the right and ``edge_v`` downwards, like an image. Rays are cast with
Open3D's Embree back-end (CPU).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, Float32, FloatArray, IntArray
from fgslam.core.open3d_library import load_open3d


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """What covers a patch.

    Attributes:
        texture: name in the texture library.
        tile_m: size in metres that one copy of the texture covers; None: the patch holds one.
        glow: fraction of the light that the surface emits by itself (lamps, screens).
    """

    texture: str
    tile_m: float | None = None
    glow: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Patch:
    """A parallelogram: corner (3,), edge_u (3,), edge_v (3,) in metres, and its surface."""

    corner: FloatArray
    edge_u: FloatArray
    edge_v: FloatArray
    surface: Surface


@dataclass(frozen=True, slots=True, eq=False)
class Thing:
    """A named object of the scene; object identities of the ground truth are indices of these."""

    name: str
    patches: tuple[Patch, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PatchArrays:
    """Patches of a scene, stacked.

    Attributes:
        corner, edge_u, edge_v: (n, 3) metres.
        normal: (n, 3) unit, towards the front.
        dual_u, dual_v: (n, 3) so that ``dual_u @ (X - corner)`` is X's fraction along edge_u.
        thing: (n,) index of the object.
        surfaces: n surfaces.
    """

    corner: FloatArray
    edge_u: FloatArray
    edge_v: FloatArray
    normal: FloatArray
    dual_u: FloatArray
    dual_v: FloatArray
    thing: IntArray
    surfaces: tuple[Surface, ...]

    def __len__(self) -> int:
        return len(self.thing)


def stack(things: Iterable[Thing], first_thing: int = 0) -> PatchArrays:
    """All patches of the things, numbered from ``first_thing`` in their order."""
    things = tuple(things)
    patches = [patch for thing in things for patch in thing.patches]
    corner = np.array([p.corner for p in patches], dtype=np.float64)
    u = np.array([p.edge_u for p in patches], dtype=np.float64)
    v = np.array([p.edge_v for p in patches], dtype=np.float64)
    normal = np.cross(v, u)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    dual_u, dual_v = np.cross(v, normal), np.cross(normal, u)
    dual_u /= np.sum(dual_u * u, axis=1, keepdims=True)
    dual_v /= np.sum(dual_v * v, axis=1, keepdims=True)
    thing = np.repeat(np.arange(len(things)) + first_thing, [len(t.patches) for t in things])
    surfaces = tuple(p.surface for p in patches)
    return PatchArrays(corner, u, v, normal, dual_u, dual_v, thing.astype(np.int64), surfaces)


def rectangle(
    corner: Iterable[float], edge_u: Iterable[float], edge_v: Iterable[float], surface: Surface
) -> Patch:
    """One patch from its upper left corner, as seen from the front."""
    return Patch(
        np.array(tuple(corner), dtype=np.float64),
        np.array(tuple(edge_u), dtype=np.float64),
        np.array(tuple(edge_v), dtype=np.float64),
        surface,
    )


def box(
    low: tuple[float, float, float],
    high: tuple[float, float, float],
    surface: Surface,
    front: Surface | None = None,
    top: Surface | None = None,
) -> list[Patch]:
    """Six faces of an upright box, its front towards -y.

    Args:
        low: least x, y, z, metres.
        high: greatest x, y, z.
        surface: of all faces but those named.
        front: of the face towards -y.
        top: of the upper face.
    """
    (x0, y0, z0), (x1, y1, z1) = low, high
    w, d, h = x1 - x0, y1 - y0, z1 - z0
    return [
        rectangle((x0, y0, z1), (w, 0, 0), (0, 0, -h), front or surface),
        rectangle((x1, y1, z1), (-w, 0, 0), (0, 0, -h), surface),
        rectangle((x1, y0, z1), (0, d, 0), (0, 0, -h), surface),
        rectangle((x0, y1, z1), (0, -d, 0), (0, 0, -h), surface),
        rectangle((x0, y1, z1), (w, 0, 0), (0, -d, 0), top or surface),
        rectangle((x0, y0, z0), (w, 0, 0), (0, d, 0), surface),
    ]


def prism(
    bottom: tuple[float, float, float],
    top: tuple[float, float, float],
    radius: float,
    surface: Surface,
    sides: int = 8,
) -> list[Patch]:
    """The mantle of a round bar between two points: legs, poles, limbs."""
    base, tip = np.array(bottom, dtype=np.float64), np.array(top, dtype=np.float64)
    axis = tip - base
    unit = axis / np.linalg.norm(axis)
    helper = np.array([1.0, 0.0, 0.0]) if abs(unit[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = np.cross(unit, helper)
    first /= np.linalg.norm(first)
    second = np.cross(unit, first)
    angle = 2.0 * np.pi * np.arange(sides + 1) / sides
    ring = radius * (np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second)
    return [Patch(tip + ring[i], ring[i + 1] - ring[i], -axis, surface) for i in range(sides)]


def placed(patches: Iterable[Patch], x: float, y: float, z: float, yaw_deg: float) -> list[Patch]:
    """The patches turned counter-clockwise about the vertical and then moved."""
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    shift = np.array([x, y, z])
    return [
        Patch(rotation @ p.corner + shift, rotation @ p.edge_u, rotation @ p.edge_v, p.surface)
        for p in patches
    ]


# --------------------------------------------------------------------------------------------
# Casting rays

Int32 = npt.NDArray[np.int32]


class RayCaster:
    """First patch hit by each ray. Safe to share between threads."""

    def __init__(self, patches: PatchArrays) -> None:
        """Raises MissingDependencyError where Open3D cannot be loaded."""
        self._o3d = load_open3d()
        corner, u, v = patches.corner, patches.edge_u, patches.edge_v
        vertices = np.stack([corner, corner + u, corner + u + v, corner + v], axis=1)
        base = 4 * np.arange(len(patches))[:, None, None]
        triangles = base + np.array([[0, 1, 2], [0, 2, 3]])
        self._scene = self._o3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(
            self._tensor(vertices.reshape(-1, 3).astype(np.float32)),
            self._tensor(triangles.reshape(-1, 3).astype(np.uint32)),
        )

    def cast(self, origin: FloatArray, directions: Float32) -> tuple[Int32, Float32]:
        """First hits of rays from one point.

        Args:
            origin: (3,) metres.
            directions: (n, 3), of any length.

        Returns:
            Patch index (n,), -1 where nothing is hit, and the hit's distance (n,) in units of
            the direction's length (infinite where nothing is hit).
        """
        rays = np.empty((len(directions), 6), dtype=np.float32)
        rays[:, :3] = origin
        rays[:, 3:] = directions
        answer = self._scene.cast_rays(self._tensor(rays), nthreads=1)
        triangle = answer["primitive_ids"].numpy()
        patch = (triangle >> np.uint32(1)).astype(np.int32)
        patch[triangle == np.uint32(0xFFFFFFFF)] = -1
        return patch, answer["t_hit"].numpy()

    def blocked(self, origins: FloatArray, directions: FloatArray, reach: float) -> BoolArray:
        """(n,) whether something lies between an origin and ``origin + reach * direction``."""
        rays = np.hstack([origins, directions]).astype(np.float32)
        answer = self._scene.test_occlusions(self._tensor(rays), tnear=0.0, tfar=reach, nthreads=1)
        return np.asarray(answer.numpy(), dtype=np.bool_)

    def distance(self, points: FloatArray) -> FloatArray:
        """(n,) distance in metres from points (n, 3) to the nearest surface."""
        query = self._tensor(points.astype(np.float32))
        return np.asarray(self._scene.compute_distance(query).numpy(), dtype=np.float64)

    def _tensor(self, array: npt.NDArray[np.generic]) -> object:
        return self._o3d.core.Tensor(np.ascontiguousarray(array))
