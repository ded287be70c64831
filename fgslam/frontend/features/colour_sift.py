"""Rotation-reduced colour SIFT of one omnidirectional image (Goedemé et al. III-A1).

A robot on a plane turns about the vertical alone, so features need no rotation of their own: every
descriptor is taken along the direction in which the elevation grows at that pixel. In an unwrapped
view that is up the image, in a raw mirror image it is along the radius. Key points that
differ only by the orientation OpenCV gave them are one.
"""

from __future__ import annotations

from collections.abc import Sequence as Many

import cv2
import numpy as np
from scipy.spatial import cKDTree

from fgslam.cameras.omni import OmniCamera, measure
from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, Image, IntArray
from fgslam.core.homing import UprightFeatures
from fgslam.core.planar import wrap
from fgslam.frontend.features.colour_moments import PatchColours
from fgslam.frontend.features.settings import UprightSiftSettings

SIGMA_PX = 1.2  # of a feature's position, pixels of its view (docs/derivations/omni_features.md)
SIGMA_SCALES = 0.27  # scales of a feature, added in quadrature to its position's sigma
MAX_FEATURES = 3000  # the strongest
MIN_ELEVATION_DEG, MAX_ELEVATION_DEG = -60.0, 60.0
"""Below: the floor at our feet, the tripod; above: the ceiling overhead."""
_BASE_SIGMA_PX = 1.6  # Gaussian of the first level, doubled image
_EDGE_THRESHOLD = 10.0  # ratio of principal curvatures above which edges go
_OCTAVE_LAYERS = 3  # levels an octave; 3 in Lowe
_STEP = 1e-3
"""Radians of elevation over which directions in the image are taken."""

_RIM_PX = 6
"""So near to where the picture ends, its end is what would be found."""

_SEAM_PX = 6.0
"""Copies of one feature lie no further apart."""

_SAME_SIZE = 0.15
"""Difference of the logarithms of scales below which two features at one place are one."""

_MARGIN_PART = 16
"""A panorama is continued over its seam by its width over this."""


def wrapping_period(camera: OmniCamera) -> int | None:
    """Columns after which a panorama repeats itself; None for any other kind of image.

    A panorama has equal steps of bearing along a row, at one elevation, and closes to a circle: its
    last column shows what the first does (period ``width - 1``), or the next one would.
    """
    columns = np.arange(camera.width, dtype=np.float64)
    middle = np.full(camera.width, (camera.height - 1) / 2.0)
    rays = camera.rays(np.column_stack([columns, middle]))
    if not np.all(np.isfinite(rays)):
        return None
    steps = wrap(np.diff(np.arctan2(rays[:, 1], rays[:, 0])))
    period = round(2.0 * np.pi / max(float(np.abs(steps).mean()), 1e-9))
    even = np.ptp(steps) < 1e-6 and np.ptp(rays[:, 2]) < 1e-6
    return period if even and period in (camera.width - 1, camera.width) else None


def up_in_image(camera: OmniCamera, pixels: FloatArray) -> FloatArray:
    """(n, 2) movement in the image, pixels a radian, as the elevation at pixels (n, 2) grows.

    NaN where the camera does not see; one-sided at the edge of its field of view.
    """
    rays = camera.rays(pixels)
    level = np.hypot(rays[:, 0], rays[:, 1])
    with np.errstate(invalid="ignore", divide="ignore"):
        outward = rays[:, :2] / level[:, None]
    up = np.column_stack([-rays[:, 2:] * outward, level])
    moved = [camera.pixels(rays + sign * _STEP * up) for sign in (1.0, -1.0)]
    offsets = [(moved[0] - pixels) / _STEP, (pixels - moved[1]) / _STEP]
    offsets = [np.where(np.abs(o) * _STEP > camera.width / 2, 0.0, o) for o in offsets]
    known = [np.all(np.isfinite(o), axis=1, keepdims=True) for o in offsets]
    both = 0.5 * (offsets[0] + offsets[1])
    one = np.where(known[0], offsets[0], offsets[1])
    return np.asarray(np.where(known[0] & known[1], both, one))


def inner_part(seen: BoolArray, rim_px: int) -> ByteArray:
    """255 where all pixels within ``rim_px`` are seen, else 0; OpenCV's kind of mask."""
    mask = np.asarray(255 * seen, np.uint8)
    if not rim_px:
        return mask
    box = np.ones((2 * rim_px + 1, 2 * rim_px + 1), np.uint8)
    return np.asarray(cv2.erode(mask, box), np.uint8)


class UprightSift:
    """Finds upright colour SIFT features in the images of one camera."""

    def __init__(
        self,
        camera: OmniCamera,
        settings: UprightSiftSettings,
        seen: BoolArray | None = None,
    ) -> None:
        """Prepares detector, mask and the continuation over the seam.

        Args:
            camera: of the images, or of the view that they are unwrapped to.
            settings: of the detector.
            seen: (height, width) where an unwrapped view has a picture; None for everywhere.
        """
        self._camera = camera
        self._sift = cv2.SIFT.create(
            0,
            _OCTAVE_LAYERS,
            settings.contrast_threshold,
            _EDGE_THRESHOLD,
            _BASE_SIGMA_PX,
            cv2.CV_8U,
            True,
        )
        self._period = wrapping_period(camera)
        self._mask = self._seen_mask(seen)
        rows = np.flatnonzero(self._mask.any(axis=1))
        self._rows = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)

    def extract(self, image: Image) -> UprightFeatures:
        """Features of an image (height, width, 3), strongest first."""
        if self._rows[1] - self._rows[0] < 2:
            return empty_features()
        colour, mask, offset = self._working_image(image)
        grey = np.asarray(cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY), np.uint8)
        keypoints = self._sift.detect(grey, mask)
        table, octaves = _distinct(keypoints)
        strongest = np.argsort(-table[:, 3], kind="stable")
        pixels = table[:, :2] + offset
        keep = strongest[_once(pixels[strongest], table[strongest, 2], self._period)]
        keep = keep[:MAX_FEATURES]
        table, octaves = table[keep], octaves[keep]
        pixels = table[:, :2] + offset
        if self._period is not None:
            pixels = np.column_stack([pixels[:, 0] % self._period, pixels[:, 1]])
        up = up_in_image(self._camera, pixels)
        seen = np.all(np.isfinite(up), axis=1)
        table, octaves, pixels, up = table[seen], octaves[seen], pixels[seen], up[seen]
        if not len(table):
            return empty_features()
        scale_px = table[:, 2]
        sigma = np.hypot(SIGMA_PX, SIGMA_SCALES * scale_px)
        bearing, elevation, covariance = measure(self._camera, pixels, 1.0)
        return UprightFeatures(
            pixels=pixels,
            bearing=bearing,
            elevation=elevation,
            covariance=covariance * (sigma**2)[:, None, None],
            scale=scale_px / np.hypot(up[:, 0], up[:, 1]),
            descriptors=self._describe(grey, table, octaves, up),
            colour=PatchColours(colour).around(table[:, :2], scale_px),
        )

    def _seen_mask(self, given: BoolArray | None) -> ByteArray:
        camera = self._camera
        columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        rays = camera.rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64))
        low, high = np.sin(np.deg2rad([MIN_ELEVATION_DEG, MAX_ELEVATION_DEG]))
        with np.errstate(invalid="ignore"):
            seen = (rays[:, 2] >= low) & (rays[:, 2] <= high)
        seen = seen.reshape(camera.height, camera.width)
        if given is not None:
            seen = seen & given
        # A panorama goes on beyond the rows that are asked for; a mirror's image ends at its rim.
        whole = self._period is not None and given is None
        return inner_part(seen, 0 if whole else _RIM_PX)

    def _working_image(self, image: Image) -> tuple[Image, ByteArray | None, FloatArray]:
        """The rows in use, continued over the seam; the mask; what to add to get the image's."""
        first, last = self._rows
        if self._period is None:
            return image[first:last], self._mask[first:last], np.array([0.0, first])
        margin = max(self._period // _MARGIN_PART // 16, 1) * 16
        offset = np.array([-margin, first], dtype=np.float64)
        continued = (
            np.asarray(cv2.copyMakeBorder(part, 0, 0, margin, margin, cv2.BORDER_WRAP), np.uint8)
            for part in (image[first:last, : self._period], self._mask[first:last, : self._period])
        )
        colour, mask = continued
        return colour, mask, offset

    def _describe(
        self, grey: Image, table: FloatArray, octaves: IntArray, up: FloatArray
    ) -> ByteArray:
        angles = np.rad2deg(np.arctan2(up[:, 1], up[:, 0])) % 360.0
        keypoints = [
            cv2.KeyPoint(x, y, 2.0 * scale, angle, response, octave)
            for (x, y, scale, response), angle, octave in zip(
                table.tolist(), angles.tolist(), octaves.tolist(), strict=True
            )
        ]
        described, descriptors = self._sift.compute(grey, keypoints)
        if len(described) != len(keypoints):
            raise RuntimeError("OpenCV dropped key points that it had found itself")
        return np.asarray(descriptors, np.uint8)


def _distinct(keypoints: Many[cv2.KeyPoint]) -> tuple[FloatArray, IntArray]:
    """(n, 4) column, row, scale, response and (n,) packed octave, orientations merged."""
    rows = [(*kp.pt, 0.5 * kp.size, kp.response, kp.octave) for kp in keypoints]
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    # OpenCV puts the copies of a key point side by side, but does not promise it.
    _, first = np.unique(table[:, :3], axis=0, return_index=True)
    table = table[np.sort(first)]
    return table[:, :4], table[:, 4].astype(np.int64)


def _once(pixels: FloatArray, scale: FloatArray, period: int | None) -> BoolArray:
    """Which features (strongest first) to keep, so that none is there twice.

    OpenCV finds some extrema from two neighbouring levels, and a continued panorama shows what is
    near the seam on both sides, a fraction of its scale apart as the pyramid's phase differs. Two
    such copies would compete with each other in the ratio test.
    """
    keep = np.ones(len(pixels), np.bool_)
    places, box = pixels, None
    if period is not None:
        keep &= (pixels[:, 0] >= -_SEAM_PX) & (pixels[:, 0] < period + _SEAM_PX)
        places, box = np.column_stack([pixels[:, 0] % period, pixels[:, 1]]), [period, 0.0]
    rows = np.flatnonzero(keep)
    if not len(rows):
        return keep
    pairs = rows[cKDTree(places[rows], boxsize=box).query_pairs(_SEAM_PX, output_type="ndarray")]
    first, second = pairs.min(axis=1), pairs.max(axis=1)
    gap = np.abs(places[first] - places[second])
    if period is not None:
        gap[:, 0] = np.minimum(gap[:, 0], period - gap[:, 0])
    near = np.hypot(gap[:, 0], gap[:, 1]) < np.maximum(0.5, 0.25 * scale[first])
    alike = np.abs(np.log(scale[first] / scale[second])) < _SAME_SIZE
    keep[second[near & alike]] = False
    return keep


def empty_features() -> UprightFeatures:
    """No feature at all."""
    return UprightFeatures(
        pixels=np.empty((0, 2)),
        bearing=np.empty(0),
        elevation=np.empty(0),
        covariance=np.empty((0, 2, 2)),
        scale=np.empty(0),
        descriptors=np.empty((0, 128), np.uint8),
        colour=np.empty((0, 3)),
    )
