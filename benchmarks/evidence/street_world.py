"""A street of textured house fronts, cars, trees and signs, driven along by a stereo rig.

Rendered at twice the size and averaged, so that images are sharp without aliasing; poses, rig and
depths are exact. World axes are a camera's: x right, y down, z along the street.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial.transform import Rotation

from fgslam.core.arrays import FloatArray
from fgslam.core.correction import camera_displacements
from fgslam.core.geometry import pose
from fgslam.core.sensors import CameraRig
from fgslam.worlds.patches import Patch, RayCaster, Surface, Thing, rectangle, stack
from fgslam.worlds.renderer import Layer, LightMaps, Renderer, pinhole_view
from fgslam.worlds.textures import GreyBank

Float32 = npt.NDArray[np.float32]

RIG = CameraRig(613, 185, 353.5456, 353.5456, 300.69365, 91.3052, 0.53715, None, np.eye(4))
"""As KITTI's, at half the size."""
FRAMES = 56

_SMOOTH = ((1.0, 9.0), (2.5, 10.0), (7.0, 12.0), (20.0, 14.0), (60.0, 14.0))
"""Sigma in texels and amplitude in grey levels of the noise that textures are made of."""
_PAINTED = {"facade": (90, 8, 150, 32.0), "road": (30, 4, 60, 20.0)}
"""Rectangles of a texture: how many, smallest and largest side in texels, sigma of their level."""
_ROAD_CONTRAST = 0.45
_LEAVES, _LEAF_TEXELS, _LEAF_LEVELS = 400, (4, 30), 40.0
_ABOVE_ROAD_M = 1.65
_LENGTH_M = FRAMES * 1.3 + 130.0
_STEP_M = 1.2  # at 10 Hz 43 km/h
_SCALE = 2  # of the rendered image over the one that is made of it


class Street:
    """The street of one seed, and the drive along it."""

    def __init__(self, seed: int) -> None:
        """Builds textures, surfaces and poses. Raises MissingDependencyError without Open3D."""
        rng = np.random.default_rng([seed, 77])
        self._bank = GreyBank(_textures(rng))
        surfaces = stack([Thing("street", tuple(_patches(rng)))])
        count = len(surfaces)
        two = np.full(count, 2)
        light = np.repeat(rng.uniform(0.75, 1.1, count), 4).astype(np.float32)
        maps = LightMaps(light, 4 * np.arange(count), two, two)
        self._scene = Layer(surfaces, RayCaster(surfaces), maps, self._bank)
        self.poses = _drive(np.random.default_rng([seed, 78]))
        """(n, 4, 4) of the right camera, the reference."""

    def images(self, correction: FloatArray, frames: int = FRAMES) -> Float32:
        """(n, 2, h, w) grey levels in right and left image, neither noisy nor rounded.

        Args:
            correction: (p,) by which the rig differs from RIG, terms as in
                :func:`fgslam.core.correction.term_names`.
            frames: how many, from the first one.
        """
        cameras = [self._camera(number, correction) for number in range(RIG.cameras)]
        return np.array(
            [
                [self._image(camera, wTc @ cTk) for camera, cTk in cameras]
                for wTc in self.poses[:frames]
            ]
        )

    def _camera(self, number: int, correction: FloatArray) -> tuple[Renderer, FloatArray]:
        """A camera whose pixels look where those of the displaced rig do; its pose (4, 4)."""
        size = (_SCALE * RIG.height, _SCALE * RIG.width)
        middle = (_SCALE * RIG.cx + 0.5, _SCALE * RIG.cy + 0.5)
        view = pinhole_view(size, _SCALE * RIG.fx, *middle)
        pixels = (view.exact[:, :2] - 0.5) / _SCALE
        exact = pixels
        for _ in range(3):
            exact = pixels - camera_displacements(RIG, number, exact) @ correction
        columns, rows = (_SCALE * exact + 0.5).astype(np.float32).T
        direction = np.stack([columns, rows, np.ones_like(rows)])
        rays = dataclasses.replace(view.rays, direction=direction)
        cTk = pose(np.eye(3), np.array([-number * RIG.baseline, 0.0, 0.0]))
        return Renderer(dataclasses.replace(view, rays=rays), self._bank), cTk

    def _image(self, camera: Renderer, wTc: FloatArray) -> Float32:
        large = camera.image(self._scene, wTc)[..., 0]
        small = cv2.resize(large, (RIG.width, RIG.height), interpolation=cv2.INTER_AREA)
        return np.asarray(small, np.float32)


def _drive(rng: np.random.Generator) -> FloatArray:
    """(n, 4, 4) poses: speed and heading wave slowly, the car rocks by a third of a degree."""
    k = np.arange(FRAMES)
    speed = _STEP_M + 0.08 * np.sin(k / 9 + rng.uniform(0, 6))
    turns = rng.uniform(-1, 1) * 0.002 * np.sin(k / rng.uniform(8, 20) + rng.uniform(0, 6))
    yaw = np.cumsum(turns)
    waves = [ndimage.gaussian_filter1d(rng.normal(size=FRAMES), 2) for _ in range(3)]
    pitch, roll, bounce = (w * size for w, size in zip(waves, (0.006, 0.006, 0.03), strict=True))
    steps = speed[:, None] * np.column_stack([np.sin(yaw), np.zeros(FRAMES), np.cos(yaw)])
    out = np.tile(np.eye(4), (FRAMES, 1, 1))
    out[:, :3, :3] = Rotation.from_euler("yxz", np.column_stack([yaw, pitch, roll])).as_matrix()
    out[1:, :3, 3] = np.cumsum(steps[:-1], axis=0)
    out[:, 1, 3] += bounce
    return out


# --------------------------------------------------------------------------------------------
# Textures


def _textures(rng: np.random.Generator) -> dict[str, Float32]:
    out = {f"facade{i}": _texture(rng, 1024, "facade") for i in range(5)}
    out |= {f"road{i}": _texture(rng, 1024, "road") for i in range(2)}
    out |= {f"leaf{i}": _texture(rng, 512, "leaf") for i in range(3)}
    sky = 205.0 + 0.25 * (_texture(rng, 1024, "road") - 125.0)
    return out | {"sky": np.clip(sky, 0.0, 255.0).astype(np.float32)}


def _texture(rng: np.random.Generator, side: int, kind: str) -> Float32:
    """(side, side) noise of many sizes, rectangles or discs painted over it."""
    out = np.zeros((side, side))
    for sigma, amplitude in _SMOOTH:
        smooth = ndimage.gaussian_filter(rng.normal(size=(side, side)), sigma, mode="wrap")
        out += amplitude * smooth / smooth.std()
    if kind == "road":
        out *= _ROAD_CONTRAST
    if kind == "leaf":
        for _ in range(_LEAVES):
            column, row = (int(v) for v in rng.integers(0, side, 2))
            radius, level = int(rng.integers(*_LEAF_TEXELS)), float(rng.normal(0, _LEAF_LEVELS))
            cv2.circle(out, (column, row), radius, level, -1)
    else:
        count, least, most, sigma = _PAINTED[kind]
        for _ in range(count):
            width, height = rng.integers(least, most, 2)
            column, row = rng.integers(0, side, 2)
            out[row : row + height, column : column + width] += rng.normal(0, sigma)
    return np.clip(125.0 + out + rng.normal(0, 12), 3.0, 250.0).astype(np.float32)


# --------------------------------------------------------------------------------------------
# Surfaces


def _patches(rng: np.random.Generator) -> list[Patch]:
    road = Surface("road0", 5.0)
    sky = Surface("sky", 60.0)
    out = [
        rectangle((-60, _ABOVE_ROAD_M, -10), (120, 0, 0), (0, 0, _LENGTH_M + 60), road),
        rectangle((-90, -60, _LENGTH_M + 40), (180, 0, 0), (0, 65, 0), sky),
    ]
    for side in (-1, 1):
        out += _houses(rng, side)
        out += _kerb(rng, side)
    for _ in range(14):
        x, z, height = rng.uniform(-45, 45), _LENGTH_M + rng.uniform(-40, 35), rng.uniform(6, 25)
        out.append(_standing(x, z, (rng.uniform(5, 14), 0, 0), height, _facade(rng, (10, 20))))
    return out


def _facade(rng: np.random.Generator, tile_m: tuple[float, float] = (6, 9)) -> Surface:
    return Surface(f"facade{rng.integers(5)}", float(rng.uniform(*tile_m)))


def _standing(x: float, z: float, along: Iterable[float], height: float, surface: Surface) -> Patch:
    """An upright rectangle from the road up."""
    return rectangle((x, _ABOVE_ROAD_M - height, z), along, (0, height, 0), surface)


def _houses(rng: np.random.Generator, side: int) -> list[Patch]:
    """Fronts at 5.5 to 16 m beside the camera's path, some with a part that stands askew."""
    out, z = [], -5.0
    while z < _LENGTH_M:
        length, x = rng.uniform(4, 14), side * rng.uniform(5.5, 16)
        height = rng.uniform(2.5, 11)
        if rng.random() < 0.8:
            out.append(_standing(x, z, (0, 0, length), height, _facade(rng)))
            out.append(_standing(x, z, (side * 12, 0, 0), height, _facade(rng)))
            if rng.random() < 0.5:
                askew = (-side * 1.2, 0, length * 0.3)
                corner = (x, _ABOVE_ROAD_M - height * 0.7, z + length * 0.2)
                out.append(rectangle(corner, askew, (0, height * 0.7, 0), _facade(rng)))
        z += length + rng.uniform(0, 4)
    return out


def _kerb(rng: np.random.Generator, side: int) -> list[Patch]:
    """Cars, trees and signs at 3 to 6 m beside the camera's path."""
    out, z = [], 3.0
    while z < _LENGTH_M:
        kind, x = rng.random(), side * rng.uniform(2.9, 4.2)
        if kind < 0.45:
            out += _car(x, z, side, _facade(rng))
        elif kind < 0.75:
            out += _tree(rng, 1.4 * x, z)
        else:
            out.append(_standing(x - 0.05, z, (0.1, 0, 0), 2.6, Surface("leaf1", 0.5)))
            plate = Surface(f"facade{rng.integers(5)}", 1.5)
            corner = (x - 0.4, _ABOVE_ROAD_M - 2.8, z - 0.02)
            out.append(rectangle(corner, (0.8, 0, 0), (0, 0.8, 0), plate))
        z += rng.uniform(4, 10)
    return out


def _car(x: float, z: float, side: int, paint: Surface) -> list[Patch]:
    length, width, height = 4.2, 1.7, 1.4
    first = x if side > 0 else x - width
    return [
        _standing(first, z, (width, 0, 0), height, paint),
        _standing(first if side > 0 else first + width, z, (0, 0, length), height, paint),
        rectangle((first, _ABOVE_ROAD_M - height, z), (width, 0, 0), (0, 0, length), paint),
    ]


def _tree(rng: np.random.Generator, x: float, z: float) -> list[Patch]:
    """A trunk, and squares of leaves at all angles."""
    leaves = Surface(f"leaf{rng.integers(3)}", 1.5)
    out = [_standing(x - 0.12, z, (0.24, 0, 0), 3, Surface("facade1", 2.0))]
    for _ in range(25):
        corner = np.array([x, _ABOVE_ROAD_M - 3.6, z]) + rng.normal(0, 0.8, 3)
        turn = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
        edges = turn * rng.uniform(0.4, 1.0)
        out.append(rectangle(corner, edges[:, 0], edges[:, 1], leaves))
    return out
