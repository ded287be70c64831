"""Depth images of a drive as one coloured surface with its deviation, and as a grid to drive by.

A truncated signed distance on Open3D's blocks of voxels (Curless and Levoy 1996), weighed by the
inverse variance that the ray's depth has there; what a ray surely passes through is free from then
on, so that a person who has left is gone. docs/howto/dense_map.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy import ndimage
from scipy.spatial.transform import Rotation

from fgslam.core.arrays import BoolArray, ByteArray, Float32, FloatArray, Image, IntArray
from fgslam.core.files import write_bytes, write_text
from fgslam.core.geometry import inverse
from fgslam.core.open3d_library import load_open3d
from fgslam.report.formats import (
    AXES,
    ROS_FROM_CAMERA,
    Axes,
    as_records,
    require_suffix,
    write_points,
)

TRUNCATION_VOXELS = 4.0
KEPT_SIGMA_VOXELS = 2.0  # half of the truncation: what is off by two of them is not clipped
_LATTICE = 0.5  # voxels: no edge or corner is known better; 0.3 to 0.7 hardly matter (dense_map.md)
_GRAZING = np.float32(0.2)  # sine of the flattest angle at which the ground is known by its normal
_SIDE = 8  # voxels of a block
_VOXELS = _SIDE**3
_OFFSETS = np.stack(np.meshgrid(*(np.arange(_SIDE),) * 3, indexing="ij"), -1)[..., ::-1]
_OFFSETS = _OFFSETS.reshape(-1, 3).astype(np.float32)  # x runs fastest, as in Open3D's blocks
_ATTRIBUTES = {"tsdf": 1, "weight": 1, "color": 3, "shared": 1}
_AT_ONCE = 100  # blocks, whose temporary arrays stay in the processor's cache


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

    def __init__(self, matrix: FloatArray, voxel_m: float, range_m: float = np.inf) -> None:
        """Empty; ``matrix`` (3, 3) are the camera's intrinsics, ``range_m`` bounds the depth."""
        self._matrix, self.voxel_m, self._range_m = matrix, voxel_m, range_m
        self._truncation = np.float32(TRUNCATION_VOXELS * voxel_m)
        # Open3D's own map takes 0.1 ms for each block when it grows: it is filled at the end.
        self._rows: dict[tuple[int, ...], int] = {}  # of blocks
        self._blocks: npt.NDArray[np.int32] = np.empty((0, 3), np.int32)
        self._values = {name: np.empty((0, n), np.float32) for name, n in _ATTRIBUTES.items()}
        self._finder = self._grid(1)

    def _grid(self, blocks: int) -> Any:
        self._o3d, count = load_open3d(), len(_ATTRIBUTES)
        kinds, sizes = (self._o3d.core.float32,) * count, tuple((n,) for n in _ATTRIBUTES.values())
        device = self._o3d.core.Device("CPU:0")
        grid = self._o3d.t.geometry.VoxelBlockGrid
        return grid(tuple(_ATTRIBUTES), kinds, sizes, self.voxel_m, _SIDE, blocks, device)

    def add(self, frame: DepthFrame) -> Float32:
        """Integrates one depth image; (height, width) of it what is known well enough, else 0.

        The rest of it shows what is free.
        """
        sure = (frame.depth > 0.0) & (frame.depth < self._range_m)
        sure &= frame.sigma * frame.depth**2 < 2.0 * self._truncation
        sure_depth = np.where(sure, frame.depth, np.float32(0.0))
        if not sure_depth.any():
            return sure_depth
        tensor, cTw = self._o3d.core.Tensor, inverse(frame.wTc)
        seen = self._finder.compute_unique_block_coordinates(
            self._o3d.t.geometry.Image(tensor(sure_depth[:, :, None].copy())),
            tensor(self._matrix),
            tensor(cTw),
            1.0,
            float(sure_depth.max()) + 1.0,
            TRUNCATION_VOXELS,
        ).numpy()
        carved = np.flatnonzero(self._before(self._blocks, frame, cTw))
        at = [self._rows.setdefault(each, len(self._rows)) for each in map(tuple, seen.tolist())]
        self._blocks = np.concatenate([self._blocks, seen[np.array(at) >= len(self._blocks)]])
        for name, values in self._values.items():
            if len(values) < len(self._blocks) * _VOXELS:
                grown = np.zeros((2 * len(self._blocks) * _VOXELS, values.shape[1]), np.float32)
                grown[: len(values)] = values
                self._values[name] = grown
        sine = self._grazing(frame.depth)
        rows = np.union1d(carved, at)
        for part in np.array_split(rows, -(-len(rows) // _AT_ONCE)):
            self._integrate(part, frame, cTw, sine, sure)
        return sure_depth

    def _integrate(
        self, rows: IntArray, frame: DepthFrame, cTw: FloatArray, sine: Float32, sure: BoolArray
    ) -> None:
        """Weighted means of what voxels of some blocks are shown."""
        # In the camera's frame: a block's corner and its voxels' offsets.
        rotation = cTw[:3, :3].astype(np.float32) * np.float32(self.voxel_m)
        corners = self._blocks[rows] @ (_SIDE * rotation.T) + cTw[:3, 3].astype(np.float32)
        x, y, z = (
            np.add.outer(corner, offset).ravel()
            for corner, offset in zip(corners.T, rotation @ _OFFSETS.T, strict=True)
        )
        pixel = self._pixels(x, y, z, frame.depth.shape)
        use = np.flatnonzero(pixel >= 0)
        pixel, z = pixel[use], z[use]
        depth, sigma = frame.depth.ravel()[pixel], frame.sigma.ravel()[pixel]
        apart, known = (depth - z) * sine.ravel()[pixel], sure.ravel()[pixel]
        free = apart > self._truncation + 2.0 * sigma * depth**2
        near = np.flatnonzero(free | known & (apart >= -self._truncation))
        use, pixel, z, apart, free = use[near], pixel[near], z[near], apart[near], free[near]
        at = (rows[:, None] * _VOXELS + np.arange(_VOXELS)).ravel()[use]
        tsdf, total, colour, shared = self._values.values()
        # What a ray surely passes through is free from now on, whatever stood there before.
        before, weight = np.where(free, 0.0, total[at, 0]), 1.0 / (sigma[near] * z * z) ** 2
        total[at, 0] = before + weight
        share = weight / total[at, 0]
        tsdf[at, 0] += share * (np.minimum(apart / self._truncation, 1.0) - tsdf[at, 0])
        near = np.flatnonzero(~free)  # what is seen through has no colour
        at, pixel, share = at[near], pixel[near], share[near, None]
        shared[at] += share * (frame.shared.reshape(-1, 1)[pixel] - shared[at])
        colour[at] += share * (frame.image.reshape(frame.depth.size, -1)[pixel] - colour[at])

    def _grazing(self, depth: Float32) -> Float32:
        """Sine of the angle (height, width) at which each ray meets the ground.

        Of the slope from row to row, the lesser of both sides: at an edge one of them is a step.
        """
        _, fy, cy = self._matrix[1].astype(np.float32)
        near = np.where(depth > 0.0, 1.0 / np.maximum(depth, 1e-3), np.nan).astype(np.float32)
        steps = np.diff(near, axis=0, prepend=np.nan, append=np.nan)
        slope = np.minimum(steps[1:], steps[:-1]).clip(0.0)
        rows = np.arange(len(depth), dtype=np.float32)[:, None] - cy
        sine = near / np.hypot(fy * slope, near - rows * slope)
        return np.asarray(np.nan_to_num(np.maximum(sine, _GRAZING), nan=1.0), np.float32)

    def _pixels(self, x: Float32, y: Float32, z: Float32, shape: tuple[int, ...]) -> IntArray:
        """(n,) nearest pixels, counted row by row, of points in the camera's frame; -1 outside."""
        (fx, _, cx), (_, fy, cy) = self._matrix[:2].astype(np.float32)
        ahead = np.float32(1.0) / np.maximum(z, np.float32(1e-3))
        u, v = np.rint(fx * x * ahead + cx), np.rint(fy * y * ahead + cy)
        inside = (z > 0.0) & (u >= 0) & (v >= 0) & (u < shape[1]) & (v < shape[0])
        return np.where(inside, v * np.float32(shape[1]) + u, np.float32(-1.0)).astype(np.int32)

    def _before(
        self, blocks: npt.NDArray[np.int32], frame: DepthFrame, cTw: FloatArray
    ) -> BoolArray:
        """Whether the frame sees through each of blocks (n, 3)."""
        middles = (blocks + 0.5) * (_SIDE * self.voxel_m) @ cTw[:3, :3].T + cTw[:3, 3]
        x, y, z = middles.T.astype(np.float32)
        pixel = self._pixels(x, y, z, frame.depth.shape)
        depth = np.where(pixel >= 0, frame.depth.ravel()[pixel], 0.0)
        return np.asarray(depth > z + self._truncation)

    def surface(self, kept_sigma_m: float) -> Surface:
        """The surface where what the images measured deviates by at most so much along the rays."""
        if not (self._values["weight"] >= kept_sigma_m**-2).any():
            return Surface.empty()
        grid, count = self._grid(len(self._blocks)), len(self._blocks) * _VOXELS
        tensor = self._o3d.core.Tensor
        grid.hashmap().activate(tensor(self._blocks))
        rows = grid.hashmap().find(tensor(self._blocks))[0].numpy()
        for name, values in self._values.items():
            shown = grid.attribute(name).numpy().reshape(-1, _VOXELS, values.shape[1])
            shown[rows] = values[:count].reshape(-1, _VOXELS, values.shape[1])
        mesh = grid.extract_triangle_mesh(kept_sigma_m**-2)
        columns = [mesh.vertex[name].numpy() for name in ("positions", "normals", "colors")]
        # Open3D's order changes from call to call, and which of two equal vertices it takes.
        found, place = np.unique(np.nan_to_num(np.hstack(columns)), axis=0, return_inverse=True)
        vertices, normals, colours = found[:, :3], found[:, 3:6], found[:, 6:]
        triangles = place.ravel().astype(np.int32)[mesh.triangle.indices.numpy()]
        triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
        first = triangles.argmin(axis=1)[:, None]
        triangles = np.take_along_axis(triangles, (first + np.arange(3)) % 3, axis=1)
        nearest = np.rint(vertices / self.voxel_m).astype(np.int32)
        block = np.floor_divide(nearest, _SIDE)
        x, y, z = (nearest - _SIDE * block).T
        rows = grid.hashmap().find(tensor(np.ascontiguousarray(block)))[0].numpy()
        at = rows.astype(np.int64) * _VOXELS + x + _SIDE * (y + _SIDE * z)
        weight, shared = (grid.attribute(each).numpy().ravel()[at] for each in ("weight", "shared"))
        return Surface(
            np.ascontiguousarray(vertices),
            triangles[np.lexsort(triangles.T)],
            np.ascontiguousarray(normals),
            np.rint(255.0 * colours).clip(0, 255).astype(np.uint8),
            np.sqrt(1.0 / weight + np.float32(_LATTICE * self.voxel_m) ** 2),
            np.sqrt(shared),
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

    def save(
        self, path: Path, triangles: bool = False, axes: Axes = "camera", remark: str = ""
    ) -> None:
        """Writes vertices as `.ply` or `.pcd`; a `.ply` also with triangles. OutputError."""
        turn = np.float32(np.eye(3) if axes == "camera" else ROS_FROM_CAMERA)
        columns = {
            **dict(zip("xyz", turn @ self.positions.T, strict=True)),
            **dict(zip(("nx", "ny", "nz"), turn @ self.normals.T, strict=True)),
            **dict(zip(("red", "green", "blue"), self.colours.T, strict=True)),
            "sigma": self.sigmas,
            "voxel_sigma": self.voxel_sigmas,
        }
        elements = {"vertex": as_records(columns)}
        if triangles:
            corners = {"count": np.full(len(self.triangles), 3, np.uint8)}
            elements["face"] = as_records({**corners, "vertex_indices": self.triangles})
        comments = ["fgslam dense map 1", f"axes of the world: {AXES[axes]}, metres", remark]
        require_suffix(path, *(MESH if triangles else CLOUD))
        write_points(path, comments, **elements)


CLOUD = ("cloud", (".ply", ".pcd"))
MESH = ("mesh", (".ply",))
"""What a file is, and the formats that hold it."""

# --------------------------------------------------------------------------------------------
# A grid to drive by

FREE, OCCUPIED, UNKNOWN = 254, 0, 205
"""Grey values of Nav2's map server, as `trinary` reads them."""
_OBSTACLE_M = (0.1, 2.0)  # heights above the ground; the higher one is Nav2's
_POINTS = 2  # vertices and middles of triangles, from which on a cell is occupied
_CROSSINGS = 3  # by scans, from which on a cell is free
_NEAREST = 3  # obstacle of a column, counted from the camera: nearer ones may be wrong matches
_TILTS_DEG = (40.0, 30.0, 20.0, 20.0, 10.0, 10.0)  # of the floor's normals, ever nearer
_FEWEST, _NEAR_STEPS = 50, 2.0
_FLOOR_SHARE = 0.25  # of the level that has most
_SLOPE = 0.3  # of the ground, at most (Vosselman 2000)
_GROUND_CELLS = 4  # of the grid along a cell in which the ground's height is found
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)
_SQUARE = np.ones((3, 3), np.uint8)
_NONE_M = np.float32(1e9)  # out of any cell's way
_SPAN = 1 << 20  # of cells along y, as numbers of cells count them


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Cells of the floor, free, occupied or unknown, as Nav2 and move_base read them.

    Attributes:
        cells: (rows, columns) grey values, the row of the largest y first.
        resolution_m: side of a cell.
        origin: (x, y) of the corner of the last row's first cell, metres.
        wRg: (3, 3) from the grid's axes (x forward, y left, z up) to the map's (of cameras).
        ground: (rows, columns) height of the ground along z.
    """

    cells: ByteArray
    resolution_m: float
    origin: tuple[float, float]
    wRg: FloatArray
    ground: Float32

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


def find_up(surface: Surface, up: FloatArray, step_m: float) -> FloatArray:
    """Upward direction (3,) of the floor: of the lowest large level of the surface.

    Args:
        surface: of the drive.
        up: (3,) unit vector of the cameras' mean upward direction.
        step_m: between levels.
    """
    positions = surface.positions.astype(np.float64)
    for tilt_deg in _TILTS_DEG:
        level = positions[surface.normals @ up > np.cos(np.deg2rad(tilt_deg))]
        if len(level) < _FEWEST:
            return up
        heights = level @ up
        edges = np.arange(heights.min() - step_m, heights.max() + 2.0 * step_m, step_m)
        counts = np.histogram(heights, edges)[0]
        first = int(np.argmax(counts >= _FLOOR_SHARE * counts.max()))
        first += int(np.argmax(counts[first : first + 3]))  # the level's middle
        near = level[np.abs(heights - edges[first : first + 2].mean()) < _NEAR_STEPS * step_m]
        normal = np.linalg.svd(near - near.mean(axis=0), full_matrices=False)[2][2]
        up = normal * np.sign(normal @ up)
    return up


class Ground:
    """Height of the ground, which may slope and roll: the lowest level that a slope limit allows.

    Of each cell the mean of level vertices; where the cameras kept to one height above it, as on
    wheels, the ground below them too. What lies higher than the slope limit allows above
    any other cell stands on the ground (Vosselman 2000, slope-based filtering).
    """

    def __init__(
        self, points: FloatArray, upwards: FloatArray, cameras: FloatArray, cell_m: float
    ) -> None:
        """Finds it.

        Args:
            points: (n, 3) vertices, z up.
            upwards: (n,) of their normals.
            cameras: (k, 3) where the cameras were.
            cell_m: side of a cell.
        """
        self._cell_m = cell_m
        level = points[upwards > np.cos(np.deg2rad(_TILTS_DEG[0]))]
        seen = np.floor(level[:, :2] / cell_m).astype(np.int64)
        path = np.floor(cameras[:, :2] / cell_m).astype(np.int64)
        every = np.concatenate([path, seen])
        self._low = every.min(axis=0)
        cells = tuple((seen - self._low).T)
        total, count = np.zeros((2, *(every.max(axis=0) - self._low + 1)), np.float32)
        np.add.at(total, cells, level[:, 2])
        np.add.at(count, cells, 1.0)
        known = np.where(count > 0.0, total / np.maximum(count, 1.0), np.float32(np.nan))
        below = tuple((path - self._low).T)
        height = cameras[:, 2] - known[below]
        height = height[np.isfinite(height)]
        if len(height) and np.median(np.abs(height - np.median(height))) < _OBSTACLE_M[0]:
            known[below] = cameras[:, 2] - np.median(height)
        if np.isnan(known).all():
            known[:] = np.min(points[:, 2], initial=0.0)
        missing = np.isnan(known)
        # Closed: what lies below all its neighbours is a wrong match.
        most = cv2.dilate(np.where(missing, -_NONE_M, known), _SQUARE)
        ground = cv2.erode(np.where(most > -_NONE_M, most, _NONE_M), _SQUARE)
        rise = np.float32(_SLOPE * cell_m)
        for _ in range(max(ground.shape)):
            ways = cv2.erode(ground, _CROSS) + rise, cv2.erode(ground, _SQUARE) + 1.4142 * rise
            ground = np.minimum(ground, np.minimum(*ways))
        nearest = ndimage.distance_transform_edt(
            missing, return_distances=False, return_indices=True
        )
        self._heights = cv2.blur(ground[tuple(nearest)], (3, 3))

    def at(self, places: FloatArray) -> Float32:
        """Heights (...,) at places (..., 2), of the nearest cell."""
        cells = np.floor(places / self._cell_m).astype(np.int64) - self._low
        rows, columns = self._heights.shape
        x, y = cells[..., 0].clip(0, rows - 1), cells[..., 1].clip(0, columns - 1)
        return np.asarray(self._heights[x, y])


def make_grid(
    surface: Surface,
    scans: Sequence[tuple[npt.NDArray[Any], FloatArray]],
    rays: Float32,
    up: FloatArray,
    resolution_m: float,
) -> Grid:
    """Cells where the surface stands above the ground are occupied; free are those seen across.

    Args:
        surface: of the drive: what it has carved away was there for some time only.
        scans: some rows and columns of each depth image (r, c), 0 where there is none, and the
            camera's pose (4, 4).
        rays: (r, c, 3) of depth one.
        up: (3,) unit vector in the map.
        resolution_m: side of a cell.
    """
    wRg, heights = _level_axes(up), (max(_OBSTACLE_M[0], 2.0 * resolution_m), _OBSTACLE_M[1])
    poses = [wRg.T @ wTc[:3] for _, wTc in scans]
    vertices = surface.positions @ wRg
    ground = Ground(
        vertices,
        surface.normals @ up,
        np.array([gTc[:, 3] for gTc in poses]),
        _GROUND_CELLS * resolution_m,
    )
    points = np.concatenate([vertices, vertices[surface.triangles].mean(axis=1)])
    above = points[:, 2] - ground.at(points[:, :2])
    points = points[(above > heights[0]) & (above < heights[1])]
    occupied = _often(_numbers(np.floor(points[:, :2] / resolution_m)), _POINTS)
    crossed = [
        _crossed(np.float64(rays) * depth[..., None], gTc, ground, heights, resolution_m)
        for (depth, _), gTc in zip(scans, poses, strict=True)
    ]
    free = _often(np.concatenate(crossed), _CROSSINGS)
    everything = np.concatenate([np.zeros((1, 2), np.int64), free, occupied])
    low = everything.min(axis=0)
    cells = np.full(everything.max(axis=0) - low + 1, UNKNOWN, np.uint8)
    cells[tuple((free - low).T)] = FREE
    cells[tuple((occupied - low).T)] = OCCUPIED
    # Surfaces are known to a cell or so: what is next to an obstacle is not known to be free.
    near = cv2.dilate((cells == OCCUPIED).astype(np.uint8), _SQUARE) > 0
    cells[near & (cells == FREE)] = UNKNOWN
    places = (np.moveaxis(np.indices(cells.shape), 0, -1) + low + 0.5) * resolution_m
    cells, below = (np.ascontiguousarray(a.T[::-1]) for a in (cells, ground.at(places)))
    x, y = (low * resolution_m).tolist()
    return Grid(cells, resolution_m, (x, y), wRg, below)


def _numbers(cells: npt.NDArray[Any]) -> IntArray:
    """One number for each of cells (n, 2)."""
    x, y = cells.astype(np.int64).T
    return np.asarray(x * _SPAN + y + _SPAN // 2)


def _often(numbers: IntArray, times: int) -> IntArray:
    """Cells (n, 2) that are there so many times."""
    found, count = np.unique(numbers, return_counts=True)
    x, y = np.divmod(found[count >= times], _SPAN)
    return np.stack([x, y - _SPAN // 2], axis=1)


def _crossed(
    points: FloatArray,
    gTc: FloatArray,
    ground: Ground,
    heights: tuple[float, float],
    resolution_m: float,
) -> IntArray:
    """Numbers of cells that a scan sees across: of each column to the last ground before obstacles.

    Args:
        points: (r, c, 3) in the camera's frame, zero where there is none.
        gTc: (3, 4) pose of the camera in the grid's axes.
        ground: below all of it.
        heights: lowest and highest above it of an obstacle.
        resolution_m: side of a cell.
    """
    ahead = points @ gTc[:, :3].T
    height = ahead[..., 2] + gTc[2, 3] - ground.at(ahead[..., :2] + gTc[:2, 3])
    way = np.hypot(ahead[..., 0], ahead[..., 1])
    known = points[..., 2] > 0.0
    blocked = np.where(known & (height > heights[0]) & (height < heights[1]), way, np.inf)
    nth = min(_NEAREST, len(way)) - 1
    blocked = np.partition(blocked, nth, axis=0)[nth]
    floor = known & (np.abs(height) <= heights[0]) & (way < blocked)
    far = np.where(floor, way, np.where(way == blocked, way - resolution_m, 0.0))
    at = far.argmax(axis=0), np.arange(far.shape[1])
    unit = ahead[at][:, :2] / np.maximum(way[at], resolution_m)[:, None]
    along = np.minimum(np.arange(0.0, far.max(), 0.5 * resolution_m), far[at][:, None])
    places = gTc[:2, 3] + along[..., None] * unit[:, None]
    return np.unique(_numbers(np.floor(places.reshape(-1, 2) / resolution_m)))


def _level_axes(up: FloatArray) -> FloatArray:
    """(3, 3) from axes x forward, y left, z up to those of cameras, by the least turn."""
    turn = Rotation.align_vectors(up, ROS_FROM_CAMERA[2])[0]
    return np.asarray(turn.as_matrix() @ ROS_FROM_CAMERA.T)
