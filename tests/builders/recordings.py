"""A small trinocular recording on disk, drawn from textured boards by exact homographies.

Real enough for the whole pipeline (SIFT finds over a hundred features in each image), made in a
fraction of a second, with the exact path as truth and an odometry that drifts.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from fgslam.cameras.lenses import RawCamera
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.geometry import BODY_FORWARD_LEFT_UP_FROM_CAMERA, se3_exp

WIDTH, HEIGHT = 160, 120
FOCAL = 130.0
BASELINE = 0.10
PERIOD_S = 0.25
_CELL_M = 0.01
Boards: TypeAlias = Sequence[tuple[float, float, float, float, float]]
"""x and y of the centre, depth, width, height: metres in the first camera's frame."""
_BOARDS: Boards = (
    (0.0, 0.0, 4.0, 9.0, 7.0),
    (-0.9, 0.3, 2.8, 1.1, 1.4),
    (0.8, -0.4, 2.2, 0.9, 1.0),
    (0.1, 0.6, 1.8, 0.7, 0.5),
)


_WIDE = (180.0, 600, 480)
"""Focal length and size of the plane that lenses look at: 118 x 106 degrees."""


def write_recording(root: Path, frames: int = 12, top: bool = True, seed: int = 0) -> Path:
    """An image folder (docs/datasets/images.md) of ``frames`` frames, truth and odometry."""
    rng = np.random.default_rng(seed)
    textures = [_texture(rng, width, height) for *_, width, height in _BOARDS]
    poses = camera_path(frames)
    offsets = {"right": (0.0, 0.0), "left": (-BASELINE, 0.0)} | (
        {"top": (0.0, -BASELINE)} if top else {}
    )
    for name, (x, y) in offsets.items():
        (root / name).mkdir(parents=True)
        for k, wTc in enumerate(poses):
            centre = wTc[:3, 3] + wTc[:3, :3] @ np.array([x, y, 0.0])
            image = _render(textures, wTc[:3, :3], centre, rng)
            assert cv2.imwrite(str(root / name / f"{k:06d}.png"), image)
    stamps = np.asarray(100.0 + PERIOD_S * np.arange(frames), np.float64)
    times = "".join(f"{k:06d} {t:.6f}\n" for k, t in enumerate(stamps))
    (root / "times.txt").write_text(times, encoding="utf-8")
    write_calibration(root)
    write_tum(root / "gt_right_cam.txt", stamps, poses)
    write_tum(root / "odometry.txt", stamps, _drifting_body_poses(poses, rng))
    return root


def views(
    cameras: Sequence[RawCamera],
    frames: int = 12,
    seed: int = 0,
    boards: Boards = _BOARDS,
    plane: tuple[float, int, int] = _WIDE,
) -> Iterator[tuple[Image, ...]]:
    """What cameras with lenses see of the same boards, or of others, frame by frame.

    The first one's body moves as :func:`camera_path`; ``bTc`` of each is its place in it. Lenses
    look at a ``plane``: focal length, width and height, pixels.
    """
    rng = np.random.default_rng(seed)
    textures = [_texture(rng, width, height) for *_, width, height in boards]
    maps = [_map_of(camera, plane) for camera in cameras]
    for wTb in camera_path(frames):
        seen = []
        for camera, (columns, rows) in zip(cameras, maps, strict=True):
            wTc = wTb @ camera.bTc
            wide = _render(textures, wTc[:3, :3], wTc[:3, 3], rng, plane, boards)
            seen.append(np.asarray(cv2.remap(wide, columns, rows, cv2.INTER_LINEAR), np.uint8))
        yield tuple(seen)


def _map_of(
    camera: RawCamera, plane_at: tuple[float, int, int]
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Columns and rows of the wide plane at which each pixel of a camera looks."""
    focal, width, height = plane_at
    grid = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    rays = camera.unproject(np.column_stack([axis.ravel() for axis in grid]))
    plane = np.where(rays[:, 2:] > 0.1, rays[:, :2] / rays[:, 2:], np.nan)
    pixels = focal * plane + 0.5 * np.array([width - 1, height - 1])
    found = np.nan_to_num(pixels, nan=-1e4).reshape(camera.height, camera.width, 2)
    columns, rows = np.moveaxis(found.astype(np.float32), -1, 0).copy()
    return columns, rows


def write_calibration(root: Path, **changes: object) -> None:
    """``calib.json`` of the recording, some values changed; None leaves a key out."""
    values: dict[str, object] = {
        "width": WIDTH,
        "height": HEIGHT,
        "fx": FOCAL,
        "fy": FOCAL,
        "cx": (WIDTH - 1) / 2,
        "cy": (HEIGHT - 1) / 2,
        "baseline_m": BASELINE,
        "vertical_baseline_m": BASELINE,
    } | changes
    kept = {key: value for key, value in values.items() if value is not None}
    (root / "calib.json").write_text(json.dumps(kept), encoding="utf-8")


def write_tum(path: Path, stamps: FloatArray, poses: FloatArray) -> None:
    quaternions = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    np.savetxt(path, np.column_stack([stamps, poses[:, :3, 3], quaternions]), fmt="%.9f")


def camera_path(frames: int) -> FloatArray:
    """Poses (n, 4, 4) of the right camera: ahead in a gentle curve, 4 cm and 0.6 degrees a step."""
    step = se3_exp(np.array([0.0, np.radians(0.6), 0.0, 0.005, 0.0, 0.04]))
    poses = [np.eye(4)]
    for _ in range(frames - 1):
        poses.append(poses[-1] @ step)
    return np.array(poses)


def experiment(root: Path, **changes: object) -> dict[str, object]:
    """Values of a configuration that runs the recording; whole groups may be replaced.

    Without pictures and page, which take longer than the run.
    """
    return {
        "name": "boards",
        "dataset": {"kind": "image_folder", "path": str(root)},
        "frontend": {"matching": {"widen_sigmas": 3.0}},
        "output": {"pictures": False, "report": False, "checkpoint_seconds": 1000.0},
    } | changes


def _drifting_body_poses(poses: FloatArray, rng: np.random.Generator) -> FloatArray:
    bTc = BODY_FORWARD_LEFT_UP_FROM_CAMERA
    out = [np.eye(4)]
    for before, after in itertools.pairwise(poses):
        motion = bTc @ np.linalg.inv(before) @ after @ np.linalg.inv(bTc)
        noise = rng.standard_normal(6) * np.repeat([np.radians(0.1), 0.002], 3)
        out.append(out[-1] @ motion @ se3_exp(noise))
    return np.array(out)


def _texture(rng: np.random.Generator, width_m: float, height_m: float) -> npt.NDArray[np.float32]:
    """Blobs of several sizes, none below what the farthest view resolves."""
    shape = (round(height_m / _CELL_M), round(width_m / _CELL_M))
    total = np.zeros(shape)
    for sigma in (3.0, 6.0, 12.0, 25.0):
        layer = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), sigma)
        total += layer / layer.std()
    return np.asarray(np.clip(128.0 + 32.0 * total, 0.0, 255.0), np.float32)


def _render(
    textures: list[npt.NDArray[np.float32]],
    wRc: FloatArray,
    centre: FloatArray,
    rng: np.random.Generator,
    plane: tuple[float, int, int] = (FOCAL, WIDTH, HEIGHT),
    boards: Boards = _BOARDS,
) -> Image:
    """Boards painted from far to near; camera noise of one grey level."""
    focal, *size = plane
    camera = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])
    canvas = np.zeros(size[::-1], np.float32)
    for texture, (x, y, depth, width, height) in zip(textures, boards, strict=True):
        corner = np.array([x - width / 2, y - height / 2, depth]) - centre
        axes = np.diag([_CELL_M, _CELL_M, 0.0])
        axes[:, 2] = corner
        homography = camera @ wRc.T @ axes
        painted = cv2.warpPerspective(texture, homography, size, flags=cv2.INTER_LINEAR)
        cover = cv2.warpPerspective(np.ones_like(texture), homography, size)
        canvas = np.asarray(canvas * (1.0 - cover) + painted, canvas.dtype)
    noisy = canvas + rng.standard_normal(canvas.shape)
    return np.asarray(np.clip(np.round(noisy), 0, 255), np.uint8)
