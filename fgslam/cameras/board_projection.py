"""Pixels of a board's points and their derivatives, for every lens that can be calibrated.

The models are those of :mod:`fgslam.cameras.lenses`, whose tests hold them against other libraries;
here they come with analytic derivatives and stay finite where a ray is not seen, so that a least
squares fit can pass through such values.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from fgslam.cameras.trees import intrinsic_matrix
from fgslam.core.arrays import FloatArray

PARAMETERS = {
    "radtan": ("k1", "k2", "p1", "p2", "k3"),
    "equidistant": ("k1", "k2", "k3", "k4"),
    "omni": ("xi", "k1", "k2", "p1", "p2"),
}
"""Parameters of the lenses that can be calibrated; names as of the lenses."""
INTRINSICS = ("fx", "fy", "cx", "cy")
TURN = 6  # numbers of a pose: rotation vector and translation
_TINY = 1e-9  # least distance to the axis, and depth over distance, that are divided by

Plane = tuple[FloatArray, FloatArray, FloatArray]
"""Of points: the model's plane (n, 2), its derivatives (n, 2, 3) by the point and (n, 2, k) by the
lens's parameters."""


def projected(
    model: str, points: FloatArray, turn: FloatArray, intrinsics: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) and derivatives (2n, 6 + p) by the board's pose (6,) and the intrinsics (p,).

    Args:
        model: one of :data:`PARAMETERS`.
        points: (n, 3) in the board's axes.
        turn: rotation vector and translation that take them to the camera's axes.
        intrinsics: fx, fy, cx, cy and the model's parameters.
    """
    if model == "radtan":
        matrix = intrinsic_matrix(*intrinsics[:4])
        pixels, by = cv2.projectPoints(points, turn[:3], turn[3:], matrix, intrinsics[4:])
        by = by[:, : TURN + len(intrinsics)]
        return np.asarray(pixels, np.float64).reshape(-1, 2), np.asarray(by, np.float64)
    rotation, by_vector = cv2.Rodrigues(turn[:3])
    plane, by_point, by_lens = _PLANES[model](intrinsics[4:], points @ rotation.T + turn[3:])
    point_by_vector = np.einsum("kij,nj->nik", by_vector.reshape(3, 3, 3), points)
    focal = intrinsics[:2]
    by = np.zeros((len(points), 2, TURN + len(intrinsics)))
    by[:, :, :3] = by_point @ point_by_vector * focal[:, None]
    by[:, :, 3:TURN] = by_point * focal[:, None]
    by[:, [0, 1], [6, 7]] = plane
    by[:, [0, 1], [8, 9]] = 1.0
    by[:, :, 10:] = by_lens * focal[:, None]
    return plane * focal + intrinsics[2:4], by.reshape(2 * len(points), -1)


def _equidistant(parameters: FloatArray, points: FloatArray) -> Plane:
    x, y, z = points.T
    across = np.maximum(np.hypot(x, y), _TINY)
    angle = np.arctan2(across, z)
    powers = angle[:, None] ** np.arange(1, 2 * len(parameters) + 2, 2)
    terms = np.concatenate([[1.0], parameters])
    radius = powers @ terms
    slope = (powers / angle[:, None]) @ (terms * np.arange(1, 2 * len(parameters) + 2, 2))
    unit = points[:, :2] / across[:, None]
    flat = np.column_stack([unit, np.zeros(len(points))])  # derivative of the distance to the axis
    squared = across**2 + z**2
    by_angle = np.column_stack([unit * z[:, None], -across]) / squared[:, None]
    by_radius = slope[:, None] * by_angle
    scale = radius / across
    by_scale = (by_radius - scale[:, None] * flat) / across[:, None]
    by_point = points[:, :2, None] * by_scale[:, None]
    by_point[:, [0, 1], [0, 1]] += scale[:, None]
    return points[:, :2] * scale[:, None], by_point, unit[:, :, None] * powers[:, None, 1:]


def _omni(parameters: FloatArray, points: FloatArray) -> Plane:
    xi, distortion = parameters[0], parameters[1:]
    length = np.maximum(np.linalg.norm(points, axis=1), _TINY)
    below = np.maximum(points[:, 2] + xi * length, _TINY * length)
    straight = points[:, :2] / below[:, None]
    by_below = xi * points / length[:, None] + np.array([0.0, 0.0, 1.0])
    by_point = -straight[:, :, None] * (by_below / below[:, None])[:, None]
    by_point[:, [0, 1], [0, 1]] += 1.0 / below[:, None]
    by_xi = -straight * (length / below)[:, None]
    plane, bent, by_distortion = _brown(distortion, straight)
    by_lens = np.concatenate([bent @ by_xi[:, :, None], by_distortion], axis=2)
    return plane, bent @ by_point, by_lens


def _brown(parameters: FloatArray, plane: FloatArray) -> Plane:
    """The plane with k1, k2, p1, p2; derivatives (n, 2, 2) by the plane and (n, 2, 4) by them."""
    k1, k2, p1, p2 = parameters
    x, y = plane.T
    r2, xy = x * x + y * y, x * y
    radial, slope = 1.0 + r2 * (k1 + r2 * k2), 2.0 * k1 + 4.0 * k2 * r2
    shown = np.column_stack(
        [
            x * radial + 2.0 * p1 * xy + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * xy,
        ]
    )
    mixed = slope * xy + 2.0 * (p1 * x + p2 * y)
    bent = np.empty((len(plane), 2, 2))
    bent[:, 0, 0] = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
    bent[:, 1, 1] = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
    bent[:, 0, 1] = bent[:, 1, 0] = mixed
    own = np.stack([plane * r2[:, None], plane * (r2**2)[:, None]], axis=2)
    tangential = np.stack(
        [
            np.column_stack([2.0 * xy, r2 + 2.0 * y * y]),
            np.column_stack([r2 + 2.0 * x * x, 2.0 * xy]),
        ],
        axis=2,
    )
    return shown, bent, np.concatenate([own, tangential], axis=2)


_PLANES: dict[str, Callable[[FloatArray, FloatArray], Plane]] = {
    "equidistant": _equidistant,
    "omni": _omni,
}
