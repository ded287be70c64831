"""A square room with textured walls, seen in panoramas: exact truth for tests of tracking."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image as PictureFile
from scipy import ndimage

from fgslam.cameras.omni import Equirectangular
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.sensors import CameraRig

CAMERA = Equirectangular(601, 181, np.deg2rad(54.0), np.deg2rad(-54.0))
SMALL_CAMERA = {"kind": "equirectangular", "top_elevation_deg": 54, "bottom_elevation_deg": -54}
"""Keys of the camera of every second pixel."""
SMALL_CAMERA_FILE = "".join(f"{key}: {value}\n" for key, value in SMALL_CAMERA.items())
HALF = 3.0
"""Metres from the middle to each wall; walls have no end upwards or downwards."""

_A_METRE = 40.0  # texels


def _texture() -> FloatArray:
    """Smooth noise that continues itself in both directions."""
    noise = np.random.default_rng(11).normal(size=(400, int(8 * HALF * _A_METRE)))
    fine, coarse = (ndimage.gaussian_filter(noise, s, mode="wrap") for s in (2.5, 8.0))
    mixed = fine / fine.std() + coarse / coarse.std()
    return np.asarray(np.clip(128.0 + 30.0 * mixed, 0.0, 255.0), dtype=np.float64)


TEXTURE = _texture()


def hits(pose: FloatArray, rays: FloatArray) -> FloatArray:
    """(n, 3) where rays (n, 3) of the camera at a planar pose (3,) meet the walls."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    along = np.column_stack([c * rays[:, 0] - s * rays[:, 1], s * rays[:, 0] + c * rays[:, 1]])
    with np.errstate(divide="ignore"):
        far = (np.sign(along) * HALF - pose[:2]) / along
    distance = far.min(axis=1)
    return np.column_stack([pose[:2] + distance[:, None] * along, distance * rays[:, 2]])


def angles(pose: FloatArray, points: FloatArray) -> FloatArray:
    """(n, 2) bearing and elevation of points (n, 3) from a planar pose (3,)."""
    away = points[:, :2] - pose[:2]
    bearing = np.arctan2(away[:, 1], away[:, 0]) - pose[2]
    return np.column_stack([bearing, np.arctan2(points[:, 2], np.hypot(*away.T))])


def picture(pose: FloatArray) -> Image:
    """(h, w, 3) what the camera sees from a planar pose (3,)."""
    columns, rows = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    grey = greys(pose, CAMERA.rays(pixels)).reshape(CAMERA.height, CAMERA.width)
    return np.repeat(grey[:, :, None], 3, axis=2)


def stereo(pose: FloatArray, rig: CameraRig) -> tuple[Image, Image]:
    """(h, w) what a right and a left camera see that look ahead, the right one at the pose (3,)."""
    columns, rows = np.meshgrid(np.arange(rig.width), np.arange(rig.height))
    across, down = (columns.ravel() - rig.cx) / rig.fx, (rows.ravel() - rig.cy) / rig.fy
    rays = np.column_stack([np.ones(len(across)), -across, -down])
    beside = rig.baseline * np.array([-np.sin(pose[2]), np.cos(pose[2]), 0.0])
    right, left = (greys(at, rays).reshape(rows.shape) for at in (pose, pose + beside))
    return right, left


def greys(pose: FloatArray, rays: FloatArray) -> npt.NDArray[np.uint8]:
    """(n,) what is seen along rays (n, 3), x forward, y left, z up, from a planar pose (3,)."""
    points = hits(pose, rays)
    east_or_west = np.abs(points[:, 0]) > np.abs(points[:, 1])
    # Places along the walls, each wall with its own stretch of the texture.
    side = np.where(east_or_west, points[:, 1], points[:, 0])
    wall = np.where(east_or_west, np.where(points[:, 0] > 0, 0, 1), 2 + (points[:, 1] > 0))
    u = (side + HALF * (1 + 2 * wall)) * _A_METRE
    grey = ndimage.map_coordinates(
        TEXTURE, np.stack([points[:, 2] * _A_METRE, u]), order=1, mode="grid-wrap"
    )
    return np.asarray(np.round(grey), np.uint8)


def seen_at(metres: float, across: float = 0.4) -> Image:
    """(91, 301, 3) a panorama of every second pixel, on a straight way through the room."""
    return np.ascontiguousarray(picture(np.array([-2.0 + metres, across, 0.0]))[::2, ::2])


def folder_of(place: Path, metres: FloatArray, across: float = 0.4) -> Path:
    """The new folder ``place`` with a panorama from each of these places on the way."""
    place.mkdir()
    for k, one in enumerate(metres.tolist()):
        PictureFile.fromarray(seen_at(one, across)).save(place / f"view_{k}.png")
    return place
