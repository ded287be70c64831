"""Scenes as flat patches: parallelograms with one texture each, so that shading is exact.

Seen from its front a patch has ``edge_u`` to the right and ``edge_v`` downwards, like an image.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """What covers a patch.

    Attributes:
        texture: name in the texture library.
        tile_m: size in metres that one copy of the texture covers; None stretches it once.
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
