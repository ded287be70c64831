"""Both kinds of features of one image: all that is kept of a path image (Goedemé III-A)."""

from __future__ import annotations

from collections.abc import Sequence as Many
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from fgslam.cameras.lenses import pixel_grid
from fgslam.cameras.omni import (
    Cylinder,
    Equirectangular,
    OmniCamera,
    measure,
    require_own_image,
    unit_rays,
    unwrap_maps,
)
from fgslam.core.arrays import BoolArray, ByteArray, Float32, FloatArray, Image, IntArray, Rows
from fgslam.core.bearings import ColumnSegments, OmniFeatures, UprightFeatures
from fgslam.core.errors import FrameError
from fgslam.core.geometry import wrap
from fgslam.frontend.settings import OmniFeatureSettings, UprightSiftSettings

# ------------------------------------------------------------------------------------------
# Colour moments of patches and segments: eq. 1 of Goedemé et al., with centred bands

_MEAN_FLOOR = 8.0
"""Grey values; means below it count as it, so that the noise of dark patches is no colour."""

PATCH_SIGMAS = 6.0  # half side of the square of a feature, in SIFT scales: as its descriptor's

PAIRS = ((0, 2), (0, 1), (1, 2))
"""R and B, R and G, G and B: the order of the paper and of all colour descriptors here."""


def moment_images(image: Image) -> list[Float32]:
    """Bands of an image (h, w, 3) and products of their :data:`PAIRS`: 6 float32 images (h, w).

    Products of two bytes are exact.
    """
    bands: list[Float32] = [band.astype(np.float32) for band in cv2.split(image)]
    return [*bands, *(bands[p] * bands[q] for p, q in PAIRS)]


def colour_from_means(means: FloatArray) -> FloatArray:
    """(n, 3) C_RB, C_RG, C_GB of the means (n, 6) of :func:`moment_images` over n areas."""
    first = means[:, [p for p, _ in PAIRS]]
    second = means[:, [q for _, q in PAIRS]]
    # The covariance is floored with its means: dark areas tend to 1, as grey ones are.
    covariance = means[:, 3:6] - first * second
    floored = np.maximum(first, _MEAN_FLOOR) * np.maximum(second, _MEAN_FLOOR)
    return np.asarray(1.0 + covariance / floored)


class PatchColours:
    """Colour moments over any upright rectangles of one image, by summed-area tables."""

    def __init__(self, image: Image) -> None:
        """Sums up an image (h, w, 3)."""
        self._shape = image.shape[:2]
        self._tables = [cv2.integral(part, sdepth=cv2.CV_64F) for part in moment_images(image)]

    def around(self, pixels: FloatArray, scale_px: FloatArray) -> FloatArray:
        """(n, 3) over squares around pixels (n, 2), as wide as scales (n,) ask for."""
        half = np.maximum(PATCH_SIGMAS * scale_px, 1.0)[:, None]
        low = np.floor(pixels - half + 0.5).astype(np.int64)
        high = np.floor(pixels + half + 0.5).astype(np.int64) + 1
        limit = np.array([self._shape[1], self._shape[0]])
        return self.boxes(np.clip(low, 0, limit - 1), np.clip(high, 1, limit))

    def boxes(self, low: IntArray, high: IntArray) -> FloatArray:
        """(n, 3) over rectangles from (column, row) ``low`` (n, 2) to ``high``, exclusive."""
        (x0, y0), (x1, y1) = low.T, high.T
        area = ((x1 - x0) * (y1 - y0)).astype(np.float64)
        sums = [t[y1, x1] - t[y0, x1] - t[y1, x0] + t[y0, x0] for t in self._tables]
        return colour_from_means(np.column_stack(sums) / area[:, None])


# ------------------------------------------------------------------------------------------
# Rotation-reduced colour SIFT of one omnidirectional image (Goedemé et al. III-A1)

SIGMA_PX = 1.2  # of a feature's position, pixels of its view (docs/derivations/omni.md)
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
        rays = camera.rays(pixel_grid((camera.width, camera.height)))
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


# ------------------------------------------------------------------------------------------
# Invariant column segments of one cylindrical view (Goedemé et al. III-A2)

_SIGMA_PX = 1.8  # of an end, and of a run of one column (docs/derivations/omni.md)
_SIGMA_RUN = 0.15  # part of a run's width added to the bearing's deviation
_RUN_STEP_PX = 1.5  # ends of one run shift less than this between columns
_MAX_RUN_DEG = 8.0
"""Wider runs (a table's edge, the joint of wall and ceiling) have no bearing of their own and are
dropped."""

_MIN_RUN_PX = 2  # neighbouring columns that must show a segment
_MIN_CONTRAST = 4.0  # least standard deviation of the luminance along it, grey values
_MIN_LENGTH_TANGENT = 0.05  # nor have segments that appear smaller, tangents of elevation
_MIN_LENGTH_PX = 8.0  # shorter segments have no profile to tell them by
_SMOOTHING_PX = 1.2  # Gaussian before the gradient is taken
PROFILE_SAMPLES = 32
COEFFICIENTS = 7
_MIN_GRADIENT = 4.0  # of the three bands together, grey values a pixel, at a segment's ends
_RIM_SIGMAS = 3.0
"""Of the smoothing: so far the end of the picture reaches into it."""


def dct_rows(samples: int = PROFILE_SAMPLES, count: int = COEFFICIENTS) -> FloatArray:
    """(count, samples) rows 1 to ``count`` of the orthonormal DCT-II."""
    k = np.arange(1, count + 1)[:, None]
    i = np.arange(samples)[None, :]
    return np.asarray(np.sqrt(2.0 / samples) * np.cos(np.pi * k * (2 * i + 1) / (2 * samples)))


@dataclass(frozen=True, slots=True, eq=False)
class _Raw(Rows):
    """Segments of single columns: column, row of upper and lower end (sub-pixel)."""

    column: IntArray
    top: FloatArray
    bottom: FloatArray


class ColumnSegmentFinder:
    """Finds invariant column segments in cylindrical views of one geometry."""

    def __init__(
        self,
        view: OmniCamera,
        seen: BoolArray | None = None,
    ) -> None:
        """Takes the view's camera: vertical columns, rows proportional to tan(elevation).

        ``seen`` (height, width) marks where the view has a picture; None for everywhere.
        """
        self._width, self._height = view.width, view.height
        self._period = wrapping_period(view) or view.width
        self._bearings, (self._tangent_0, self._tangent_step) = _axes(view)
        rim = int(np.ceil(_RIM_SIGMAS * _SMOOTHING_PX))
        self._blind = None if seen is None else inner_part(seen, rim)[:, : self._period] == 0
        self._dct = dct_rows() / np.sqrt(PROFILE_SAMPLES)

    def extract(self, image: Image) -> ColumnSegments:
        """Segments of a view (height, width, 3), ordered by column, then row."""
        image = image[:, : self._period]
        raw = self._segments(image)
        if not len(raw):
            return empty_segments()
        sums = _ColumnSums(image)
        means, contrast = sums.means(raw.column, raw.top, raw.bottom)
        keep = contrast >= _MIN_CONTRAST
        raw, means = raw.select(keep), means[keep]
        chosen, width = self._representatives(raw)
        return self._described(raw.select(chosen), means[chosen], width, sums)

    def _segments(self, image: Image) -> _Raw:
        """Between consecutive maxima of the colour gradient along each column."""
        gradient = self._gradient(image)
        before, middle, after = gradient[:-2], gradient[1:-1], gradient[2:]
        peak = (middle > before) & (middle >= after) & (middle > _MIN_GRADIENT**2)
        # Transposed, so that a column's maxima come one after the other.
        column, row = np.nonzero(np.ascontiguousarray(peak.T))
        at = row + _summit(before[row, column], middle[row, column], after[row, column]) + 1.0
        length = np.diff(at)
        shortest = max(
            _MIN_LENGTH_PX,
            _MIN_LENGTH_TANGENT / abs(self._tangent_step),
        )
        pair = (np.diff(column) == 0) & (length >= shortest)
        return _Raw(column[:-1][pair], at[:-1][pair], at[1:][pair])

    def _gradient(self, image: Image) -> Float32:
        """(h, w) squared colour gradient along the columns, grey values a pixel."""
        smooth = cv2.GaussianBlur(
            image.astype(np.float32),
            (0, 0),
            _SMOOTHING_PX,
            borderType=cv2.BORDER_REPLICATE,
        )
        slope = np.zeros_like(smooth)
        slope[1:-1] = 0.5 * (smooth[2:] - smooth[:-2])
        squared = np.einsum("rcb,rcb->rc", slope, slope)
        if self._blind is not None:
            squared[self._blind] = 0.0
        return np.asarray(squared, np.float32)

    def _representatives(self, raw: _Raw) -> tuple[IntArray, IntArray]:
        """Rows of the middle segment of every run that is kept, and the runs' widths in pixels.

        Segments of neighbouring columns whose ends nearly agree show one thing; a run may cross
        the seam.
        """
        labels = self._runs(raw)
        width = np.bincount(labels, minlength=labels.max(initial=-1) + 1)
        # By run and column, a run over the seam beginning at its true first column.
        shifted = self._shifted_columns(raw.column, labels)
        order = np.lexsort((shifted, labels))
        first = np.concatenate([[0], np.cumsum(width)[:-1]])
        middle = order[first + (width - 1) // 2] if len(width) else order
        widest = np.deg2rad(_MAX_RUN_DEG) / (2.0 * np.pi) * self._period
        keep = (width >= _MIN_RUN_PX) & (width <= max(widest, 1.0))
        middle, width = middle[keep], width[keep]
        sorting = np.argsort(middle)
        return middle[sorting], width[sorting]

    def _runs(self, raw: _Raw) -> IntArray:
        """(n,) number of the run that each segment belongs to."""
        n = len(raw)
        at = np.full((self._period, self._height + 4), -1, np.int64)
        top = np.floor(raw.top + 0.5).astype(np.int64)
        at[raw.column, top + 2] = np.arange(n)
        next_column = (raw.column + 1) % self._period
        sources, targets = [], []
        for shift in (-2, -1, 0, 1, 2):
            other = at[next_column, np.clip(top + 2 + shift, 0, self._height + 3)]
            near = (
                (other >= 0)
                & (np.abs(raw.top[other] - raw.top) < _RUN_STEP_PX)
                & (np.abs(raw.bottom[other] - raw.bottom) < _RUN_STEP_PX)
            )
            sources.append(np.flatnonzero(near))
            targets.append(other[near])
        i, j = np.concatenate(sources), np.concatenate(targets)
        links = coo_array((np.ones(len(i), np.bool_), (i, j)), shape=(n, n))
        return np.asarray(connected_components(links, directed=False)[1], np.int64)

    def _shifted_columns(self, column: IntArray, labels: IntArray) -> IntArray:
        """Columns, raised by a turn in the left part of the runs that cross the seam."""
        runs = labels.max(initial=-1) + 1
        crosses = np.zeros((runs, 2), np.bool_)
        crosses[labels[column == 0], 0] = True
        crosses[labels[column == self._period - 1], 1] = True
        over = np.all(crosses, axis=1)[labels] & (column < self._period // 2)
        return np.asarray(column + self._period * over, np.int64)

    def _described(
        self, raw: _Raw, means: FloatArray, width: IntArray, sums: _ColumnSums
    ) -> ColumnSegments:
        high = self._tangent_0 + self._tangent_step * raw.top
        low = self._tangent_0 + self._tangent_step * raw.bottom
        profile = sums.profile(raw.column, raw.top, raw.bottom)
        profile = profile - profile.mean(axis=1, keepdims=True)
        deviation = np.sqrt(np.mean(profile**2, axis=1, keepdims=True))
        intensity = profile / np.maximum(deviation, 1e-6) @ self._dct.T
        colour = colour_from_means(means)
        pixel = 2.0 * np.pi / self._period
        sigma_end = _SIGMA_PX * abs(self._tangent_step)
        return ColumnSegments(
            bearing=self._bearings[raw.column],
            sigma_bearing=pixel * np.hypot(_SIGMA_PX, _SIGMA_RUN * width),
            tangents=np.column_stack([low, high]),
            sigma_tangents=np.full((len(raw), 2), sigma_end),
            descriptors=np.column_stack([-low / (high - low), colour, intensity]),
        )


class _ColumnSums:
    """Sums down the columns: exact means over any segment of a column, ends in between pixels."""

    def __init__(self, image: Image) -> None:
        parts = moment_images(image)
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        luminance: Float32 = grey.astype(np.float32)
        self._colours = len(parts)
        self._sums = _summed_down([*parts, luminance, luminance * luminance])

    def means(
        self, column: IntArray, top: FloatArray, bottom: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """(n, 6) means of the colour products, (n,) deviation of the luminance."""
        # The rows whose centres lie within; ``lower`` is the first beyond.
        upper, lower = (np.floor(end).astype(np.int64) + 1 for end in (top, bottom))
        count = (lower - upper).astype(np.float64)
        sums = self._sums[lower, :, column] - self._sums[upper, :, column]
        means = sums / count[:, None]
        colours, light, squared = np.split(means, [self._colours, self._colours + 1], axis=1)
        return colours, np.sqrt(np.maximum(squared - light**2, 0.0))[:, 0]

    def profile(self, column: IntArray, top: FloatArray, bottom: FloatArray) -> FloatArray:
        """(n, 32) mean luminance of equal parts of the segments, from the lower end up."""
        parts = np.linspace(0.0, 1.0, PROFILE_SAMPLES + 1)
        rows = bottom[:, None] + (top - bottom)[:, None] * parts + 0.5
        whole = np.floor(rows).astype(np.int64)
        table = self._sums[:, self._colours]
        below = table[whole, column[:, None]]
        beyond = table[np.minimum(whole + 1, len(table) - 1), column[:, None]]
        total = below + (rows - whole) * (beyond - below)
        return np.asarray(np.diff(total, axis=1) / np.diff(rows, axis=1))


def _summed_down(parts: list[Float32]) -> FloatArray:
    """(h + 1, k, w) sums of the rows above each row, of k images (h, w)."""
    rows = np.stack(parts, axis=1)
    out = np.zeros((len(rows) + 1, *rows.shape[1:]))
    # Row by row, as each lies in one piece: `cumsum` goes down column by column.
    for k, row in enumerate(rows):
        np.add(out[k], row, out=out[k + 1])
    return out


def _summit(before: Float32, middle: Float32, after: Float32) -> FloatArray:
    """Offset in (-0.5, 0.5] of the top of the parabola through three values around a maximum."""
    curvature = before + after - 2.0 * middle
    return np.asarray(0.5 * (before - after) / np.minimum(curvature, -1e-9), np.float64)


def _axes(view: OmniCamera) -> tuple[FloatArray, tuple[float, float]]:
    """Bearings (w,) of the columns; tangent of the first row and its step from row to row."""
    columns = np.arange(view.width, dtype=np.float64)
    rays = view.rays(np.column_stack([columns, np.zeros(view.width)]))
    ends = view.rays(np.array([[0.0, 0.0], [0.0, view.height - 1.0]]))
    tangents = ends[:, 2] / np.hypot(ends[:, 0], ends[:, 1])
    step = float(tangents[1] - tangents[0]) / (view.height - 1)
    return np.arctan2(rays[:, 1], rays[:, 0]), (float(tangents[0]), step)


def empty_segments() -> ColumnSegments:
    """No segment at all."""
    return ColumnSegments(
        bearing=np.empty(0),
        sigma_bearing=np.empty(0),
        tangents=np.empty((0, 2)),
        sigma_tangents=np.empty((0, 2)),
        descriptors=np.empty((0, 4 + COEFFICIENTS)),
    )


# fmt: off
_DEVIATIONS = np.array(
    [0.0704, 0.0021, 0.0017, 0.0035, 0.1387, 0.1322, 0.1365, 0.1114, 0.0875, 0.0736, 0.0633]
)
_CORRELATION_PERCENT = (
    (100,),
    (-5, 100),
    (-4, 83, 100),
    (-5, 66, 55, 100),
    (-14, 1, 0, 6, 100),
    (-2, -2, 2, -9, -2, 100),
    (-6, 0, -6, -2, -9, -9, 100),
    (0, -11, -5, -9, 8, 21, -27, 100),
    (-3, -1, -5, -3, 4, 3, 43, -25, 100),
    (-4, -1, 4, -11, 2, 9, 8, 18, 5, 100),
    (4, -5, -10, -12, -11, -3, 22, -11, 35, -2, 100),
)
# fmt: on


def _covariance() -> FloatArray:
    lower = np.zeros((len(_DEVIATIONS), len(_DEVIATIONS)))
    for i, row in enumerate(_CORRELATION_PERCENT):
        lower[i, : i + 1] = np.array(row) / 100.0
    correlation = lower + lower.T - np.eye(len(_DEVIATIONS))
    return np.asarray(correlation * np.outer(_DEVIATIONS, _DEVIATIONS))


COVARIANCE = _covariance()
"""(11, 11) of differences: arsinh(g - 1/2), C_RB, C_RG, C_GB, DCT-II coefficients 1 to 7."""

_WHITENING = np.linalg.cholesky(np.linalg.inv(COVARIANCE))


def whitened(descriptors: FloatArray) -> FloatArray:
    """(n, 11) vectors whose Euclidean distance is the Mahalanobis distance of descriptors (n, 11).

    The horizon's coordinate g is compared on a scale that is even within a segment's length of the
    segment and logarithmic beyond, where g's own error grows with it.
    """
    even = descriptors.copy()
    even[:, 0] = np.arcsinh(descriptors[:, 0] - 0.5)
    return np.asarray(even @ _WHITENING)


_MAX_VIEW_WIDTH = 2048  # of the unwrapped view, pixels
_MAX_TANGENT = 1.0  # of the elevation, up and down, that the cylinder has
_MAX_CYLINDER_WIDTH = 2048  # of the cylinder, pixels; less for coarser cameras


class View:
    """Another camera's picture of what one camera sees."""

    def __init__(self, source: OmniCamera, target: OmniCamera) -> None:
        self._maps = unwrap_maps(source, target)
        seen = self._maps[0] > -1.0
        self.seen = None if seen.all() else seen

    def of(self, image: Image) -> Image:
        """The picture, black where the source does not see.

        A panorama's seam needs no care: its last column repeats the first.
        """
        return np.asarray(cv2.remap(image, *self._maps, cv2.INTER_LINEAR))


class OmniFeatureExtractor:
    """Extracts both kinds of features from the colour images of one camera."""

    def __init__(self, camera: OmniCamera, settings: OmniFeatureSettings) -> None:
        """Prepares views and detectors; panoramas need no unwrapping for SIFT."""
        self._camera, self._kinds = camera, settings.kinds
        resolution = pixels_a_radian(camera)
        self._sift_view: View | None = None
        if wrapping_period(camera) is None:
            width = min(_MAX_VIEW_WIDTH, round(2.0 * np.pi * resolution))
            high, low = np.deg2rad([MAX_ELEVATION_DEG, MIN_ELEVATION_DEG])
            height = round((high - low) * width / (2.0 * np.pi)) + 1
            view = Equirectangular(width, height, float(high), float(low))
            self._sift_view = View(camera, view)
            self._sift = UprightSift(view, settings.sift, self._sift_view.seen)
        else:
            self._sift = UprightSift(camera, settings.sift)
        width = min(_MAX_CYLINDER_WIDTH, round(2.0 * np.pi * resolution))
        height = round(2.0 * _MAX_TANGENT * width / (2.0 * np.pi)) + 1
        cylinder = Cylinder(width, height, -_MAX_TANGENT, _MAX_TANGENT)
        self._cylinder = View(camera, cylinder)
        self._columns = ColumnSegmentFinder(cylinder, self._cylinder.seen)

    def extract(self, image: Image) -> OmniFeatures:
        """Features of an image (height, width, 3) in R, G, B.

        A blank or dark image has none. Raises FrameError where the image is not this camera's.
        """
        return OmniFeatures(self.extract_sift(image), self.extract_columns(image))

    def extract_sift(self, image: Image) -> UprightFeatures:
        """Upright SIFT features alone; none where the settings exclude them."""
        require_own_image(self._camera, image)
        if self._kinds == "columns":
            return empty_features()
        if self._sift_view is None:
            return self._sift.extract(image)
        found = self._sift.extract(self._sift_view.of(image))
        if not len(found):
            return found
        pixels = self._camera.pixels(unit_rays(found.bearing, found.elevation))
        seen = np.isfinite(pixels).all(axis=1)
        return UprightFeatures(
            pixels[seen],
            found.bearing[seen],
            found.elevation[seen],
            found.covariance[seen],
            found.scale[seen],
            found.descriptors[seen],
            found.colour[seen],
        )

    def extract_columns(self, image: Image) -> ColumnSegments:
        """Column segments alone; none where the settings exclude them."""
        require_own_image(self._camera, image)
        if self._kinds == "sift":
            return empty_segments()
        return self._columns.extract(self._cylinder.of(image))


def pixels_a_radian(camera: OmniCamera) -> float:
    """Finer of both resolutions at the horizon, or near it where the camera does not see that far.

    Pixels a radian; the median around the camera.
    """
    around = np.linspace(-np.pi, np.pi, 72, endpoint=False)
    for elevation in np.deg2rad([0.0, -5.0, 5.0, -15.0, 15.0, -30.0, 30.0]):
        rays = np.column_stack(
            [np.cos(around), np.sin(around), np.full(len(around), np.tan(elevation))]
        )
        pixels = camera.pixels(rays)
        seen = np.isfinite(pixels).all(axis=1)
        if seen.sum() >= 3:
            up = up_in_image(camera, pixels[seen])
            along = np.hypot(*np.diff(pixels[seen], axis=0).T) / np.diff(around[seen])
            return float(max(np.nanmedian(np.hypot(up[:, 0], up[:, 1])), np.nanmedian(along)))
    raise FrameError("the camera sees nothing within 30 degrees of the horizon; check its model")
