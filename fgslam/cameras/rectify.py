"""Rectification: one orientation and one view for all cameras, so that rows agree.

The view is perspective. Its x axis lies along the baseline, its z axis as near to the mean of the
optical axes as that allows; of three cameras in an L the image plane holds both baselines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.cameras.lenses import Calibration, RawCamera, View, pixel_grid
from fgslam.core.arrays import Brief, Float32, FloatArray, Image
from fgslam.core.correction import camera_displacements
from fgslam.core.geometry import pose
from fgslam.core.sensors import CameraRig

MapArray: TypeAlias = npt.NDArray[np.float32]

_OUTSIDE = -1e4  # coordinate that is outside of any image, so that it stays black
# A perspective view magnifies its rim by 1 / cos^2: at 60 degrees off the axis by 4.
_WIDEST_DEG = 120.0
# The middle of the view keeps at least this share of the raw image's resolution.
_LEAST_RESOLUTION = 0.9
_BORDER_STEPS = 200


@dataclass(frozen=True, eq=False, repr=False)
class Rectifier(Brief):
    """Remaps raw images to rectified ones; maps are computed once.

    Attributes:
        rig: the rectified rig, reference = right camera.
        maps: per camera (right, left[, top]) the columns and rows (h, w) to sample, float32.
        order: per camera, which of the images given as (right, left[, top]) is its own; another
            order than 0, 1, 2 where what the calibration calls left is on the right.
        size: width and height of the raw images, pixels; None: those of the rig.
        shown: per camera, what of its raw image may be used (h, w), nonzero where it may; None:
            all of it. Empty: all of every image.
        correction: (p,) displacements of the rectified images
            (:mod:`fgslam.core.correction`) that the maps undo; None: none.
        calibration: of the raw cameras, with this view, without the correction; None where the
            images are rectified as they are stored.

    Without maps the images are rectified as they are.
    """

    rig: CameraRig
    maps: tuple[tuple[MapArray, MapArray], ...]
    order: tuple[int, ...] = (0, 1, 2)
    size: tuple[int, int] | None = None
    shown: tuple[Image | None, ...] = ()
    correction: FloatArray | None = None
    calibration: Calibration | None = field(default=None, repr=False)

    def rectify(self, camera: int, image: Image) -> Image:
        """Rectified image (h, w) of camera 0 (right), 1 (left) or 2 (top), bilinear."""
        if not self.maps:
            return image
        columns, rows = self.maps[camera]
        return np.asarray(cv2.remap(image, columns, rows, cv2.INTER_LINEAR), np.uint8)

    def images(self, raw: Sequence[Image]) -> tuple[Image, ...]:
        """Rectified (right, left[, top]) of raw images given in that order."""
        return tuple(self.image(k, raw) for k in range(self.rig.cameras))

    def image(self, camera: int, raw: Sequence[Image]) -> Image:
        """One of these."""
        return self.rectify(camera, raw[self.order[camera]])

    def raw_pixels(self, camera: int, pixels: FloatArray) -> FloatArray:
        """Where rectified pixels (n, 2) of a camera lie in its raw image (n, 2), bilinear."""
        columns, rows = (column.astype(np.float32)[:, None] for column in pixels.T)
        found = [cv2.remap(m, columns, rows, cv2.INTER_LINEAR)[:, 0] for m in self.maps[camera]]
        return np.column_stack(found).astype(np.float64)

    @cached_property
    def raw_size(self) -> tuple[int, int]:
        """Width and height of the images that it takes."""
        return self.size or (self.rig.width, self.rig.height)

    @cached_property
    def overlap(self) -> float:
        """Share of the rectified image that all cameras show something of, at infinity."""
        return float(np.logical_and.reduce(self.masks).mean())

    @cached_property
    def masks(self) -> tuple[npt.NDArray[np.bool_], ...]:
        """Per camera, which pixels (h, w) of its rectified image show something to be used."""
        return tuple(self._mask(camera) for camera in range(self.rig.cameras))

    def _mask(self, camera: int) -> npt.NDArray[np.bool_]:
        width, height = self.raw_size
        shown = self.shown[camera] if self.shown else None
        if not self.maps:
            whole = np.ones((height, width), np.bool_)
            return whole if shown is None else shown > 0
        columns, rows = self.maps[camera]
        # A pixel reaches half a pixel around its centre.
        seen = (columns >= -0.5) & (columns <= width - 0.5)
        seen &= (rows >= -0.5) & (rows <= height - 0.5)
        if shown is None:
            return np.asarray(seen)
        # Black beyond the image, and half of white and black is none.
        found = cv2.remap(
            np.where(shown > 0, 255, 0).astype(np.uint8), columns, rows, cv2.INTER_LINEAR
        )
        return np.asarray(seen & (found == 255))

    @cached_property
    def margins(self) -> tuple[Float32, ...]:
        """Per camera, how far each pixel (h, w) is from what shows nothing; empty: all are full."""
        if all(mask.all() for mask in self.masks):
            return ()
        # The picture's own border is none: features reach over it as in any image.
        return tuple(
            np.asarray(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5), np.float32)
            if not mask.all()
            else np.full(mask.shape, np.inf, np.float32)
            for mask in self.masks
        )


def orientation(positions: Sequence[FloatArray], axes: FloatArray) -> FloatArray:
    """Rotation (3, 3) from the body's axes to the view's.

    Args:
        positions: of right, left[, top] camera (3,) in the body.
        axes: (n, 3) optical axes in the body.
    """
    right, left, *top = positions
    x = (right - left) / np.linalg.norm(right - left)
    z = axes.mean(axis=0)
    if top:
        z = np.cross(x, right - top[0])
    y = np.cross(z, x)
    y = y / np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)])


def chosen_view(
    cameras: Sequence[RawCamera],
    rotations: Sequence[FloatArray],
    size: tuple[int, int],
    fov_deg: float | None = None,
) -> View:
    """The largest view that all cameras fill, as far as a perspective view reaches.

    Args:
        cameras: as calibrated.
        rotations: (3, 3) of each, from raw to the view's axes.
        size: width and height of the view in pixels.
        fov_deg: wanted horizontal angle of view; what is black then stays so. None: no border is
            black, at most 120 degrees, and the middle keeps nine tenths of the resolution.
    """
    limit = np.tan(np.radians(0.5 * (fov_deg or _WIDEST_DEG)))
    low, high = np.full(2, -limit), np.full(2, limit)
    if fov_deg is None:
        for camera, rotation in zip(cameras, rotations, strict=True):
            inner = _inner(camera, rotation)
            low, high = np.maximum(low, inner[0]), np.minimum(high, inner[1])
        natural = _LEAST_RESOLUTION * float(np.mean([camera.focal_px for camera in cameras]))
        # Where no rectangle is seen by all, borders are black.
        focal = max(*(np.array(size) / (high - low)), natural) if (high > low).all() else natural
    else:
        focal = size[0] / (high[0] - low[0])
    middle = 0.5 * (low + high)
    column, row = (0.5 * (np.array(size) - 1.0) - focal * middle).tolist()
    matrix = np.array([[focal, 0.0, column], [0.0, focal, row], [0.0, 0.0, 1.0]])
    return View(matrix, size, tuple(rotations))


def _inner(camera: RawCamera, rotation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest (x, y) of the plane at z = 1 that the camera sees all over."""
    width, height = camera.width - 1.0, camera.height - 1.0
    along, start = np.linspace(0.0, 1.0, _BORDER_STEPS), np.zeros(_BORDER_STEPS)
    down, across = along * height, along * width
    sides = ((start, down), (start + width, down), (across, start), (across, start + height))
    low, high = np.full(2, -np.inf), np.full(2, np.inf)
    # Which axis of the view the raw columns run along, and which way: it may be turned by 90
    # degrees. Places of borders do not tell: a principal point may lie at one.
    of_columns = int(np.argmax(np.abs(rotation[:2, 0])))
    for number, (columns, rows) in enumerate(sides):
        raw_axis, far = divmod(number, 2)
        axis = of_columns if raw_axis == 0 else 1 - of_columns
        rays = camera.unproject(np.column_stack([columns, rows])) @ rotation.T
        rays = rays[rays[:, 2] > 0.0]  # NaN is not
        found = rays[:, axis] / rays[:, 2]
        if not len(found):
            continue
        if (rotation[axis, raw_axis] > 0.0) == bool(far):
            high[axis] = min(high[axis], found.min())
        else:
            low[axis] = max(low[axis], found.max())
    return low, high


def sampling_maps(
    camera: RawCamera, rotation: FloatArray, view: View, seen: FloatArray
) -> tuple[MapArray, MapArray]:
    """Columns and rows (h, w) of the raw image where each of the view's pixels is ``seen``."""
    width, height = view.size
    pixels = camera.project(view.rays(seen) @ rotation)
    pixels = np.where(np.isfinite(pixels), pixels, _OUTSIDE).clip(_OUTSIDE, -_OUTSIDE)
    found = pixels.reshape(height, width, 2).astype(np.float32)
    return np.ascontiguousarray(found[..., 0]), np.ascontiguousarray(found[..., 1])


def rectifier(
    cameras: Sequence[RawCamera],
    view: View,
    corrected: Callable[[CameraRig], FloatArray] | None = None,
) -> Rectifier:
    """What rectifies images of right, left[, top] camera into one view.

    Args:
        cameras: right, left[, top].
        view: the common image plane, with the turn of each of them.
        corrected: displacements (p,) of the rig's images, which are undone as well.
    """
    right = cameras[0]
    focal = np.diag(view.matrix)[:2]
    # The axes of the view in the body, by the reference camera.
    axes = right.bTc[:3, :3] @ view.rotations[0].T
    away = [axes.T @ (right.bTc[:3, 3] - camera.bTc[:3, 3]) for camera in cameras[1:]]
    above = float(away[1][1]) if len(away) > 1 else None
    fx, fy, cx, cy = (float(value) for value in (*focal, *view.matrix[:2, 2]))
    bTc = pose(axes, right.bTc[:3, 3])
    rig = CameraRig(*view.size, fx, fy, cx, cy, float(away[0][0]), above, bTc)
    correction = None if corrected is None else corrected(rig)
    maps = tuple(
        sampling_maps(camera, rotation, view, displaced_grid(rig, k, correction))
        for k, (camera, rotation) in enumerate(zip(cameras, view.rotations, strict=True))
    )
    return Rectifier(rig, maps, (0, 1, 2), right.size, correction=correction)


def displaced_grid(rig: CameraRig, camera: int, correction: FloatArray | None) -> FloatArray:
    """(n, 2) where a camera sees what an exact one has in each of its pixels, row by row."""
    exact = pixel_grid((rig.width, rig.height))
    if correction is None:
        return exact
    return np.asarray(exact + camera_displacements(rig, camera, exact) @ correction)


def rectifier_of(rig: CameraRig, correction: FloatArray) -> Rectifier:
    """What undoes displacements (p,) of the rig's images."""
    maps = []
    for camera in range(rig.cameras):
        seen = displaced_grid(rig, camera, correction)
        columns, rows = seen.T.reshape(2, rig.height, rig.width).astype(np.float32)
        maps.append((columns, rows))
    return Rectifier(rig, tuple(maps), correction=correction)
