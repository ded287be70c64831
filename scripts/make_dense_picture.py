"""Draws a run's dense map from above and from two sides, and its grid, as one picture.

    python -m scripts.make_dense_picture RUN [docs/images/dense_map.jpg]

The picture of docs/howto/dense_map.md is of the lab's drive, ``fgslam demo``.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from fgslam.core.arrays import FloatArray
from fgslam.core.open3d_library import load_open3d
from fgslam.report.surface import Surface
from fgslam.runs.dense import DenseMap
from fgslam.runs.export import dense_map
from scripts.make_tutorial_pictures import IMAGES, write_small

_SIZE = (480, 360)


def draw(found: DenseMap) -> Image.Image:
    """The surface from above, ahead and the left, and the grid."""
    surface, axes = found.surface, found.grid.wRg
    ends = np.percentile(surface.positions @ axes, (2.0, 98.0), axis=0)
    middle, half = axes @ ends.mean(axis=0), float(np.linalg.norm(ends[1] - ends[0]) / 2.0)
    ahead, left, up = axes.T
    # Where to look from, in halves of the map, and what is up in the picture.
    views = ((1.5 * up - 0.01 * ahead, ahead), (0.8 * up - ahead, up), (0.6 * up + left, up))
    shown = [_view(surface, middle + half * v, middle, upwards) for v, upwards in views]
    grid = ImageOps.contain(Image.fromarray(found.grid.cells), _SIZE, Image.Resampling.BOX)
    sheet = Image.new("RGB", (2 * _SIZE[0], 2 * _SIZE[1]), (205, 205, 205))
    for k, picture in enumerate([*shown, grid]):
        free = (_SIZE[0] - picture.width) // 2, (_SIZE[1] - picture.height) // 2
        sheet.paste(picture, (k % 2 * _SIZE[0] + free[0], k // 2 * _SIZE[1] + free[1]))
    return sheet


def _view(surface: Surface, eye: FloatArray, target: FloatArray, up: FloatArray) -> Image.Image:
    o3d, (width, height) = load_open3d(), _SIZE
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    row, column = np.indices((height, width))
    across, down = (column - width / 2) / width * 1.2, (row - height / 2) / width * 1.2
    rays = forward + across[..., None] * right + down[..., None] * np.cross(forward, right)
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    # Seen from behind, walls and ceilings are left out.
    corners = surface.positions[surface.triangles]
    outwards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    triangles = surface.triangles[((eye - corners[:, 0]) * outwards).sum(axis=1) > 0.0]
    scene.add_triangles(
        o3d.core.Tensor(surface.positions), o3d.core.Tensor(triangles.astype(np.uint32))
    )
    both = np.concatenate([np.broadcast_to(eye, rays.shape), rays], axis=-1).astype(np.float32)
    hit = scene.cast_rays(o3d.core.Tensor(both), nthreads=1)
    seen = np.isfinite(hit["t_hit"].numpy())
    corner = triangles[np.where(seen, hit["primitive_ids"].numpy(), 0)]
    u, v = np.moveaxis(hit["primitive_uvs"].numpy(), -1, 0)
    weights = np.stack([1.0 - u - v, u, v], axis=-1)[..., None]
    colours = (weights * surface.colours[corner]).sum(axis=-2)
    normals = (weights * surface.normals[corner]).sum(axis=-2)
    facing = -(normals * rays).sum(axis=-1) / np.linalg.norm(rays, axis=-1)
    shaded = colours * (0.6 + 0.4 * np.abs(facing))[..., None]
    shaded[~seen] = 255.0
    return Image.fromarray(shaded.clip(0.0, 255.0).astype(np.uint8))


if __name__ == "__main__":
    target = Path(sys.argv[2]) if len(sys.argv) > 2 else IMAGES / "dense_map.jpg"
    with tempfile.TemporaryDirectory() as folder:
        draw(dense_map(Path(sys.argv[1]))).save(Path(folder) / "sheet.png")
        write_small(Path(folder) / "sheet.png", target)
