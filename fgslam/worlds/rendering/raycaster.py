"""Ray casting of patch scenes with Open3D's Embree back-end (CPU)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.worlds.rendering.open3d_library import load_open3d
from fgslam.worlds.rendering.patches import PatchArrays

Float32 = npt.NDArray[np.float32]
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
