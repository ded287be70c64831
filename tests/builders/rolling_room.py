"""Colour and depth of a hand-held camera in a room, each row of its own moment: exact truth."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation

from fgslam.core.arrays import FloatArray, Image

WIDTH, HEIGHT, FOCAL = 320, 240, 260.0
HALF_M = np.array([1.7, 1.1, 1.4])  # of the room, right, down, ahead
DEPTH_SIGMA = 1.425e-3  # of a depth of 1 m, growing with its square
_A_METRE = 90.0  # texels
_FPS = 15.0


@dataclass(frozen=True)
class Hand:
    """How a hand moves: turns (degrees) and shifts (metres) that swing, by a seed."""

    seed: int
    turn_deg: float = 14.0
    shift_m: float = 0.12

    def at(self, times: FloatArray) -> tuple[Rotation, FloatArray]:
        """Orientations and positions (n, 3) at times (n,), seconds."""
        rng = np.random.default_rng(self.seed)
        hertz, phase = rng.uniform(0.5, 1.0, (2, 3)), rng.uniform(0.0, 2.0 * np.pi, (2, 3))
        swing = np.sin(2.0 * np.pi * hertz * times[:, None, None] + phase)
        axes = np.array([0.7, 1.0, 0.5])
        turns = np.deg2rad(self.turn_deg) * axes * swing[:, 0]
        return Rotation.from_rotvec(turns), self.shift_m * swing[:, 1]


def _texture(seed: int) -> FloatArray:
    noise = np.random.default_rng(seed).normal(size=(400, 400))
    fine, coarse = (ndimage.gaussian_filter(noise, s, mode="wrap") for s in (2.0, 6.0))
    return np.asarray(np.clip(128.0 + 30.0 * (fine / fine.std() + coarse / coarse.std()), 0, 255))


WALLS = [_texture(seed) for seed in range(6)]


def seen(hand: Hand, stamp: float, readout_s: float) -> tuple[Image, FloatArray]:
    """(h, w) grey and depth, the middle row of which is of the moment ``stamp``."""
    columns, rows = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    row_turns, row_places = hand.at(stamp + readout_s * (np.arange(HEIGHT) / HEIGHT - 0.5))
    rays = np.stack(
        [(columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL, np.ones(rows.shape)], axis=2
    )
    along = np.einsum("rij,rcj->rci", row_turns.as_matrix(), rays)
    with np.errstate(divide="ignore"):
        far = (np.sign(along) * HALF_M - row_places[:, None]) / along
    axis, depth = far.argmin(axis=2), far.min(axis=2)
    points = row_places[:, None] + depth[:, :, None] * along
    grey = np.empty(rows.shape)
    for wall, texture in enumerate(WALLS):
        on = (axis == wall // 2) & (
            (np.take_along_axis(along, axis[..., None], 2)[..., 0] > 0) == wall % 2
        )
        places = np.delete(points[on], wall // 2, axis=1).T * _A_METRE
        grey[on] = ndimage.map_coordinates(texture, places, order=1, mode="grid-wrap")
    return np.asarray(np.round(grey), np.uint8), depth


def recording(
    root: Path, hand: Hand, readout_s: float, frames: int = 16, off: FloatArray | None = None
) -> Path:
    """TUM's layout, with exact truth, noise in depth, and a calibration ``off`` by SHARED (7,)."""
    column, row, focal, *decentring, radial, baseline = np.zeros(7) if off is None else off
    rng, times = np.random.default_rng(hand.seed), 10.0 + np.arange(frames) / _FPS
    for folder in ("rgb", "depth"):
        (root / folder).mkdir(parents=True)
    names = [f"{t:.6f}.png" for t in times]
    for name, t in zip(names, times, strict=True):
        grey, depth = seen(hand, t, readout_s)
        noisy = (1.0 + baseline) * (depth + DEPTH_SIGMA * depth**2 * rng.normal(size=depth.shape))
        cv2.imwrite(str(root / "rgb" / name), grey)
        cv2.imwrite(str(root / "depth" / name), np.round(5000.0 * noisy).astype(np.uint16))
    for folder in ("rgb", "depth"):
        listed = "".join(f"{t:.6f} {folder}/{n}\n" for t, n in zip(times, names, strict=True))
        (root / f"{folder}.txt").write_text(listed, encoding="utf-8")
    turns, places = hand.at(times)
    rows = np.column_stack([times, places, turns.as_quat()])
    np.savetxt(root / "groundtruth.txt", rows, fmt="%.9f")
    matrix = np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])
    matrix += FOCAL * np.array([focal, focal, column, row])
    fx, fy, cx, cy = matrix.tolist()
    camera = {
        "image_width": WIDTH,
        "image_height": HEIGHT,
        "camera_matrix": {"rows": 3, "cols": 3, "data": [fx, 0, cx, 0, fy, cy, 0, 0, 1]},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [radial, 0, *decentring, 0]},
    }
    (root / "camera.yaml").write_text(json.dumps(camera), encoding="utf-8")
    return root
