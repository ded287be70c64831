"""Points with an appearance: ideal features, so that a front-end runs on a world without images."""

from __future__ import annotations

import numpy as np

from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray
from fgslam.core.sensors import CameraRig
from fgslam.core.types import Features

_BORDER_PX = 5.0
_NEAREST_M = 0.2


def visible(rig: CameraRig, points: FloatArray) -> BoolArray:
    """Which points (n, 3) in the camera's frame are in front and inside the reference image."""
    front = points[:, 2] > _NEAREST_M
    measured = rig.predict(np.where(front[:, None], points, 1.0))
    low = _BORDER_PX
    high = np.array([rig.width, rig.height]) - 1 - _BORDER_PX
    inside = ((measured[:, :2] > low) & (measured[:, :2] < high)).all(axis=1)
    return np.asarray(front & inside)


class FeatureWorld:
    """Points with an appearance, as ideal SIFT features of the rig's images.

    Each point has its own descriptor, orientation and physical size; coordinates carry
    independent normal noise.
    """

    def __init__(
        self,
        points: FloatArray,
        rng: np.random.Generator,
        rig: CameraRig,
        descriptors: ByteArray | None = None,
    ) -> None:
        """Draws the looks of points (n, 3) of the world, metres.

        Uniform descriptors are told apart, but fall into a few dozen words of places; others (n,
        128) may be given.
        """
        count = len(points)
        self.points = points
        self._rig = rig
        self._rng = rng
        if descriptors is None:
            descriptors = rng.integers(0, 120, (count, 128)).astype(np.uint8)
        self.descriptors = descriptors
        self._orientation = rng.uniform(0.0, 2.0 * np.pi, count)
        self._size = rng.uniform(4.0, 12.0, count)

    def features(
        self, wTc: FloatArray, sigma_px: float = 0.0, hidden: IntArray | None = None
    ) -> tuple[Features, ...]:
        """Features of right, left[, top] image; the ``hidden`` points are not there."""
        local = g.transform_to_camera(wTc, self.points)
        shown = visible(self._rig, local)
        if hidden is not None:
            shown[hidden] = False
        which = np.flatnonzero(shown)
        column, row, disparity = self._rig.predict(local[which]).T
        places = [(column, row), (column + disparity, row)]
        if self._rig.vertical_baseline is not None:
            ratio = self._rig.vertical_baseline / self._rig.baseline
            places.append((column, row + ratio * disparity))
        return tuple(self._image(np.column_stack(at), which, local, sigma_px) for at in places)

    def _image(
        self, xy: FloatArray, which: IntArray, local: FloatArray, sigma_px: float
    ) -> Features:
        return Features(
            xy=xy + sigma_px * self._rng.standard_normal(xy.shape),
            scale=self._size[which] / local[which, 2],
            orientation=self._orientation[which],
            descriptors=self.descriptors[which],
        )
