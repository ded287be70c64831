"""Depth images of a drive as one coloured surface with its deviation, and as a grid to drive by.

A truncated signed distance on Open3D's blocks of voxels (Curless and Levoy 1996), weighed by the
inverse variance that the ray's depth has there; so what stands in free space, seen through later,
is carved away. docs/howto/dense_map.md.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, ByteArray, Float32, FloatArray, Image, IntArray
from fgslam.core.errors import OutputError
from fgslam.core.files import write_bytes, write_text
from fgslam.core.geometry import inverse, skew
from fgslam.core.open3d_library import load_open3d
from fgslam.report.formats import AXES, ROS_FROM_CAMERA, Axes, pcd_bytes, ply_bytes

TRUNCATION_VOXELS = 4.0
KEPT_SIGMA_VOXELS = 1.5
_SIDE = 8  # voxels of a block
_OFFSETS = np.stack(np.meshgrid(*(np.arange(_SIDE),) * 3, indexing="ij"), -1)[..., ::-1]
_OFFSETS = _OFFSETS.reshape(-1, 3).astype(np.float32)  # x runs fastest, as in Open3D's blocks
_ATTRIBUTES = {"tsdf": 1, "weight": 1, "color": 3, "scatter": 1, "count": 1, "shared": 1}


@dataclass(frozen=True, slots=True, eq=False)
class DepthFrame:
    """One depth image.

    Attributes:
        depth: (height, width) Z in metres; 0 where there is none.
        sigma: (height, width) of the inverse depth, 1/m.
        image: (height, width[, 3]) uint8, grey or red, green, blue.
        wTc: (4, 4) of the camera.
        shared: (height, width) variance, m^2, of what all pixels have in common: pose, calibration.
    """

    depth: Float32
    sigma: Float32
    image: Image
    wTc: FloatArray
    shared: Float32


class Fusion:
    """The signed distance of the nearest surface, in voxels around all that was seen."""

    def __init__(self, matrix: FloatArray, voxel_m: float) -> None:
        """Empty; ``matrix`` (3, 3) are the camera's intrinsics."""
        self._o3d = load_open3d()
        o3c = self._o3d.core
        self._matrix, self.voxel_m = matrix, voxel_m
        self._truncation = np.float32(TRUNCATION_VOXELS * voxel_m)
        self._grid = self._o3d.t.geometry.VoxelBlockGrid(
            tuple(_ATTRIBUTES),
            (o3c.float32,) * len(_ATTRIBUTES),
            tuple((n,) for n in _ATTRIBUTES.values()),
            voxel_m,
            _SIDE,
            1000,
            o3c.Device("CPU:0"),
        )
        self._blocks = np.empty((0, 3), np.int32)

    def add(self, frame: DepthFrame) -> None:
        """Integrates one depth image; one without any depth changes nothing."""
        if not frame.depth.any():
            return
        tensor, cTw = self._o3d.core.Tensor, inverse(frame.wTc)
        seen = self._grid.compute_unique_block_coordinates(
            self._o3d.t.geometry.Image(tensor(frame.depth[:, :, None].copy())),
            tensor(self._matrix),
            tensor(cTw),
            1.0,
            float(frame.depth.max()) + 1.0,
            TRUNCATION_VOXELS,
        ).numpy()
        self._grid.hashmap().activate(tensor(seen))
        carved = self._blocks[self._before(frame, cTw)]
        self._blocks = np.unique(np.concatenate([self._blocks, seen]), axis=0)
        blocks = np.unique(np.concatenate([carved, seen]), axis=0)
        rows = self._rows(blocks)
        # In the camera's frame: a block's corner and its voxels' offsets.
        rotation = cTw[:3, :3].astype(np.float32) * np.float32(self.voxel_m)
        corners = blocks @ (_SIDE * rotation.T) + cTw[:3, 3].astype(np.float32)
        x, y, z = (corners[:, None] + _OFFSETS @ rotation.T).reshape(-1, 3).T
        pixel = self._pixels(x, y, z, frame.depth.shape)
        use = np.flatnonzero(pixel >= 0)
        pixel, z = pixel[use], z[use]
        depth = frame.depth.ravel()[pixel]
        apart = depth - z
        near = (depth > 0.0) & (apart >= -self._truncation)
        use, pixel, z, apart = use[near], pixel[near], z[near], apart[near]
        sigma = frame.sigma.ravel()[pixel] * z * z
        values = {
            "tsdf": np.minimum(apart / self._truncation, np.float32(1.0))[:, None],
            "color": frame.image.reshape(frame.depth.size, -1)[pixel].astype(np.float32),
            "shared": frame.shared.ravel()[pixel, None],
        }
        at = (rows[:, None] * _SIDE**3 + np.arange(_SIDE**3)).ravel()[use]
        self._take_in(at, (1.0 / (sigma * sigma))[:, None], values)

    def _take_in(self, at: IntArray, weight: Float32, values: dict[str, Float32]) -> None:
        """Weighted means (West 1979) of values at voxels (n,), each once."""
        arrays = {name: self._array(name) for name in _ATTRIBUTES}
        total = arrays["weight"][at] + weight
        share = weight / total
        for name, value in values.items():
            before = arrays[name][at]
            now = before + share * (value - before)
            arrays[name][at] = now
            if name == "tsdf":
                arrays["scatter"][at] += weight * (value - before) * (value - now)
        arrays["weight"][at] = total
        arrays["count"][at] += 1.0

    def _array(self, name: str) -> Float32:
        """(n, channels) of all voxels, to be written in place until blocks are added."""
        return np.asarray(self._grid.attribute(name).numpy().reshape(-1, _ATTRIBUTES[name]))

    def _rows(self, blocks: IntArray) -> IntArray:
        """(n,) where the attributes of blocks (n, 3) lie; -1 of those that are not there."""
        tensor = self._o3d.core.Tensor(np.ascontiguousarray(blocks, np.int32))
        rows, found = self._grid.hashmap().find(tensor)
        return np.where(found.numpy(), rows.numpy().astype(np.int64), -1)

    def _pixels(self, x: Float32, y: Float32, z: Float32, shape: tuple[int, ...]) -> IntArray:
        """(n,) nearest pixels, counted row by row, of points in the camera's frame; -1 outside."""
        (fx, _, cx), (_, fy, cy) = self._matrix[:2].astype(np.float32)
        ahead = np.maximum(z, np.float32(1e-3))
        u = np.rint(fx * x / ahead + cx).astype(np.int32)
        v = np.rint(fy * y / ahead + cy).astype(np.int32)
        inside = (z > 0.0) & (u >= 0) & (v >= 0) & (u < shape[1]) & (v < shape[0])
        return np.where(inside, v * shape[1] + u, -1)

    def _before(self, frame: DepthFrame, cTw: FloatArray) -> BoolArray:
        """(n,) blocks that the frame sees through."""
        side = _SIDE * self.voxel_m
        middles = (self._blocks + 0.5) * side @ cTw[:3, :3].T + cTw[:3, 3]
        x, y, z = middles.T.astype(np.float32)
        pixel = self._pixels(x, y, z, frame.depth.shape)
        depth = np.where(pixel >= 0, frame.depth.ravel()[pixel], 0.0)
        return np.asarray(depth > z + self._truncation)

    def surface(self, kept_sigma_m: float) -> Surface:
        """The surface where its deviation along the rays is at most so much."""
        weight, count = self._array("weight"), self._array("count")
        # Images that contradict each other more than they should know less than they state.
        spread = self._array("scatter") * self._truncation**2 / np.maximum(count - 1.0, 1.0)
        weight /= np.maximum(spread, 1.0)
        if not (weight >= kept_sigma_m**-2).any():
            return Surface.empty()
        mesh = self._grid.extract_triangle_mesh(kept_sigma_m**-2)
        columns = [mesh.vertex[name].numpy() for name in ("positions", "normals", "colors")]
        # Open3D's order changes from call to call, and which of two equal vertices it takes.
        rows, place = np.unique(np.nan_to_num(np.hstack(columns)), axis=0, return_inverse=True)
        vertices, normals, colours = rows[:, :3], rows[:, 3:6], rows[:, 6:]
        triangles = place.ravel().astype(np.int32)[mesh.triangle.indices.numpy()]
        triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
        first = triangles.argmin(axis=1)[:, None]
        triangles = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)
        nearest = np.rint(vertices / self.voxel_m).astype(np.int64)
        block = np.floor_divide(nearest, _SIDE)
        x, y, z = (nearest - _SIDE * block).T
        at = self._rows(block) * _SIDE**3 + x + _SIDE * (y + _SIDE * z)
        return Surface(
            np.ascontiguousarray(vertices),
            triangles[np.lexsort(triangles.T)],
            np.ascontiguousarray(normals),
            np.rint(255.0 * colours).clip(0, 255).astype(np.uint8),
            np.sqrt(1.0 / weight[at, 0]),
            np.sqrt(self._array("shared")[at, 0]),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Triangles with colours and deviations.

    Attributes:
        positions: (n, 3) world, metres.
        triangles: (m, 3) rows of the vertices, counter-clockwise as seen from outside.
        normals: (n, 3) unit vectors into the free space.
        colours: (n, 3) red, green, blue, uint8.
        voxel_sigmas: (n,) deviation along the rays of what the images measured, metres.
        shared_sigmas: (n,) of pose and calibration, which neighbours have in common, metres; NaN
            where the estimator reports none.
    """

    positions: Float32
    triangles: npt.NDArray[np.int32]
    normals: Float32
    colours: ByteArray
    voxel_sigmas: Float32
    shared_sigmas: Float32

    @staticmethod
    def empty() -> Surface:
        """Without any triangle."""
        rows, none = np.empty((0, 3), np.float32), np.empty(0, np.float32)
        return Surface(rows, rows.astype(np.int32), rows, rows.astype(np.uint8), none, none)

    @property
    def sigmas(self) -> Float32:
        """(n,) of both, metres."""
        return np.asarray(np.hypot(self.voxel_sigmas, self.shared_sigmas))

    def in_axes(self, axes: Axes) -> Surface:
        """The same, turned from the axes of cameras to those asked for."""
        if axes == "camera":
            return self
        turn = ROS_FROM_CAMERA.T.astype(np.float32)
        return replace(self, positions=self.positions @ turn, normals=self.normals @ turn)

    def save(
        self, path: Path, triangles: bool = False, axes: Axes = "camera", remark: str = ""
    ) -> None:
        """Writes vertices as `.ply` or `.pcd`; a `.ply` also with triangles. OutputError."""
        require_cloud_suffix(path, triangles)
        found = self.in_axes(axes)
        columns = {
            **dict(zip("xyz", found.positions.T, strict=True)),
            **dict(zip(("nx", "ny", "nz"), found.normals.T, strict=True)),
            **dict(zip(("red", "green", "blue"), found.colours.T, strict=True)),
            "sigma": found.sigmas,
            "voxel_sigma": found.voxel_sigmas,
        }
        comments = ["fgslam dense map 1", f"axes of the world: {AXES[axes]}, metres", remark]
        if path.suffix.lower() == ".pcd":
            red, green, blue = (columns.pop(name).astype(np.uint32) for name in _COLOURS)
            columns["rgb"] = (red << 16) | (green << 8) | blue
            columns = {re.sub("^n([xyz])$", r"normal_\1", n): c for n, c in columns.items()}
            write_bytes(path, pcd_bytes(comments, _as_records(columns)))
            return
        elements = {"vertex": _as_records(columns)}
        if triangles:
            corners = {"count": np.full(len(found.triangles), 3, np.uint8)}
            elements["face"] = _as_records({**corners, "vertex_indices": found.triangles})
        write_bytes(path, ply_bytes(comments, **elements))


_COLOURS = ("red", "green", "blue")


def require_cloud_suffix(path: Path, triangles: bool = False) -> None:
    """Raises OutputError unless the format can hold points, or triangles."""
    known = (".ply",) if triangles else (".ply", ".pcd")
    if path.suffix.lower() not in known:
        what = "mesh" if triangles else "cloud"
        raise OutputError(
            f"cannot write {path}: unknown {what} format '{path.suffix}'; use {' or '.join(known)}"
        )


def _as_records(columns: dict[str, npt.NDArray[Any]]) -> npt.NDArray[np.void]:
    """Rows of named columns (n,) or (n, k), packed, little-endian."""
    kinds = [(name, c.dtype.newbyteorder("<"), c.shape[1:]) for name, c in columns.items()]
    records = np.empty(len(next(iter(columns.values()))), np.dtype(kinds))
    for name, column in columns.items():
        records[name] = column
    return records


# --------------------------------------------------------------------------------------------
# A grid to drive by

FREE, OCCUPIED, UNKNOWN = 254, 0, 205
"""Grey values of Nav2's map server, as `trinary` reads them."""
_OBSTACLE_M = (0.1, 2.0)  # heights above the floor; the higher one is Nav2's
_POINTS = 2  # vertices and middles of triangles, from which on a cell is occupied
_CROSSINGS = 3  # by scans, from which on a cell is free
_NEAREST = 3  # obstacle of a column, counted from the camera: nearer ones may be wrong matches
_TILTS_DEG = (40.0, 30.0, 20.0, 20.0, 10.0, 10.0)  # of the floor's normals, ever nearer
_FEWEST, _NEAR_STEPS = 50, 2.0
_FLOOR_SHARE = 0.25  # of the level that has most


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Cells of the floor, free, occupied or unknown, as Nav2 and move_base read them.

    Attributes:
        cells: (rows, columns) grey values, the row of the largest y first.
        resolution_m: side of a cell.
        origin: (x, y) of the corner of the last row's first cell, metres.
        wRg: (3, 3) from the grid's axes (x forward, y left, z up) to the map's (of cameras).
        floor_m: height of the floor over the map's origin.
    """

    cells: ByteArray
    resolution_m: float
    origin: tuple[float, float]
    wRg: FloatArray
    floor_m: float

    @property
    def tilt_deg(self) -> float:
        """Angle between the grid and the level plane of the map's axes."""
        up = (ROS_FROM_CAMERA @ self.wRg)[2, 2]
        return float(np.degrees(np.arccos(np.clip(up, -1.0, 1.0))))

    def save(self, path: Path) -> None:
        """Writes `.yaml` and next to it the `.pgm` that it names. Raises OutputError."""
        image = path.with_suffix(".pgm")
        rows, columns = self.cells.shape
        write_bytes(image, f"P5\n{columns} {rows}\n255\n".encode() + self.cells.tobytes())
        x, y = self.origin
        write_text(
            path,
            f"image: {image.name}\nmode: trinary\nresolution: {self.resolution_m:.6g}\n"
            f"origin: [{x:.6g}, {y:.6g}, 0.0]\nnegate: 0\n"
            "occupied_thresh: 0.65\nfree_thresh: 0.196\n",
        )


def find_floor(
    surface: Surface, up: FloatArray, known: bool, step_m: float
) -> tuple[FloatArray, float]:
    """Direction up (3,) and height of the floor: the lowest large level of the surface.

    Args:
        surface: of the drive.
        up: (3,) unit vector of the cameras' mean upward direction, or of the body's.
        known: the body states it; else the level surfaces around it do.
        step_m: between levels.
    """
    positions = surface.positions.astype(np.float64)
    floor_m = float(np.min(positions @ up, initial=0.0))
    for tilt_deg in (20.0,) if known else _TILTS_DEG:
        level = positions[surface.normals @ up > np.cos(np.deg2rad(tilt_deg))]
        if len(level) < _FEWEST:
            return up, floor_m
        heights = level @ up
        edges = np.arange(heights.min() - step_m, heights.max() + 2.0 * step_m, step_m)
        counts = np.histogram(heights, edges)[0]
        first = int(np.argmax(counts >= _FLOOR_SHARE * counts.max()))
        first += int(np.argmax(counts[first : first + 3]))  # the level's middle
        near = np.abs(heights - edges[first : first + 2].mean()) < _NEAR_STEPS * step_m
        floor_m = float(np.median(heights[near]))
        if not known:
            normal = np.linalg.svd(level[near] - level[near].mean(axis=0), full_matrices=False)[2][
                2
            ]
            up = normal * np.sign(normal @ up)
            floor_m = float(np.median(level[near] @ up))
    return up, floor_m


def make_grid(
    surface: Surface,
    scans: Sequence[tuple[npt.NDArray[Any], FloatArray]],
    rays: Float32,
    up: FloatArray,
    floor_m: float,
    resolution_m: float,
) -> Grid:
    """Cells where the surface stands above the floor are occupied; free are those seen across.

    Args:
        surface: of the drive: what it has carved away was there for some time only.
        scans: some rows and columns of each depth image (r, c), 0 where there is none, and the
            camera's pose (4, 4).
        rays: (r, c, 3) of depth one.
        up: (3,) unit vector in the map.
        floor_m: height of the floor along it.
        resolution_m: side of a cell.
    """
    wRg, heights = _level_axes(up), (max(_OBSTACLE_M[0], 2.0 * resolution_m), _OBSTACLE_M[1])
    middles = surface.positions[surface.triangles].mean(axis=1)
    points = np.concatenate([surface.positions, middles]) @ wRg
    points = points[(points[:, 2] > floor_m + heights[0]) & (points[:, 2] < floor_m + heights[1])]
    occupied = _often(np.floor(points[:, :2] / resolution_m), _POINTS)
    crossed = [
        _crossed(
            np.float64(rays) * depth[..., None], wRg.T @ wTc[:3], floor_m, heights, resolution_m
        )
        for depth, wTc in scans
    ]
    free = _often(np.concatenate(crossed), _CROSSINGS)
    everything = np.concatenate([np.zeros((1, 2), np.int64), free, occupied])
    low = everything.min(axis=0)
    cells = np.full(everything.max(axis=0) - low + 1, UNKNOWN, np.uint8)
    cells[tuple((free - low).T)] = FREE
    cells[tuple((occupied - low).T)] = OCCUPIED
    # Surfaces are known to a cell or so: what is next to an obstacle is not known to be free.
    near = cv2.dilate((cells == OCCUPIED).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    cells[near & (cells == FREE)] = UNKNOWN
    x, y = (low * resolution_m).tolist()
    return Grid(np.ascontiguousarray(cells.T[::-1]), resolution_m, (x, y), wRg, floor_m)


def _often(cells: FloatArray, times: int) -> IntArray:
    """Those of cells (n, 2) that are there so many times."""
    found, count = np.unique(cells.astype(np.int64), axis=0, return_counts=True)
    return found[count >= times]


def _crossed(
    points: FloatArray,
    gTc: FloatArray,
    floor_m: float,
    heights: tuple[float, float],
    resolution_m: float,
) -> FloatArray:
    """Cells (n, 2) that a scan sees across: of each column to the farthest floor before obstacles.

    Args:
        points: (r, c, 3) in the camera's frame, zero where there is none.
        gTc: (3, 4) pose of the camera in the grid's axes.
        floor_m: height of the floor.
        heights: lowest and highest above it of an obstacle.
        resolution_m: side of a cell.
    """
    ahead = points @ gTc[:, :3].T
    height, way = ahead[..., 2] + gTc[2, 3] - floor_m, np.hypot(ahead[..., 0], ahead[..., 1])
    known = points[..., 2] > 0.0
    blocked = np.where(known & (height > heights[0]) & (height < heights[1]), way, np.inf)
    blocked = np.sort(blocked, axis=0)[min(_NEAREST, len(way)) - 1]
    floor = known & (np.abs(height) <= heights[0]) & (way < blocked)
    far = np.where(floor, way, np.where(way == blocked, way - resolution_m, 0.0))
    at = far.argmax(axis=0), np.arange(far.shape[1])
    unit = ahead[at][:, :2] / np.maximum(way[at], resolution_m)[:, None]
    along = np.minimum(np.arange(0.0, far.max(), 0.5 * resolution_m), far[at][:, None])
    places = gTc[:2, 3] + along[..., None] * unit[:, None]
    return np.unique(np.floor(places.reshape(-1, 2) / resolution_m), axis=0)


def _level_axes(up: FloatArray) -> FloatArray:
    """(3, 3) from axes x forward, y left, z up to those of cameras, by the least turn."""
    level = ROS_FROM_CAMERA.T
    axis, cosine = np.cross(level[:, 2], up), float(level[:, 2] @ up)
    turn = np.eye(3) + skew(axis) + skew(axis) @ skew(axis) / max(1.0 + cosine, 1e-9)
    return np.asarray(turn @ level)
