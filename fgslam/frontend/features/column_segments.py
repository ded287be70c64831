"""Invariant column segments of one cylindrical view (Goedemé et al. III-A2).

The view's rows are proportional to the tangent T of the elevation. A point at height z above the
camera and range d lies at T = z / d, so between two places a column segment is only stretched about
the horizon. Hence an element that does not change, g = -T_low / (T_high - T_low); and the profile
along the segment, resampled to a fixed number of parts, does not change either.

A descriptor has 11 elements: g, three colour moments along the segment, and coefficients 1 to 7 of
the DCT-II of the luminance profile, normalised to mean 0 and deviation 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fgslam.cameras.omni import OmniCamera
from fgslam.core.arrays import BoolArray, FloatArray, Image, IntArray, Rows
from fgslam.core.homing import ColumnSegments
from fgslam.frontend.features.colour_moments import colour_from_means, moment_images
from fgslam.frontend.features.colour_sift import inner_part, wrapping_period

_SIGMA_PX = 1.8  # of an end, and of a run of one column (docs/derivations/omni_features.md)
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

Float32Array = npt.NDArray[np.float32]


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

        ``seen`` (height, width) tells where the view has a picture; None for everywhere.
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

    def _gradient(self, image: Image) -> Float32Array:
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
        beside = (raw.column + 1) % self._period
        sources, targets = [], []
        for shift in (-2, -1, 0, 1, 2):
            other = at[beside, np.clip(top + 2 + shift, 0, self._height + 3)]
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
    """Sums down the columns: exact means over any stretch of a column, ends in between pixels."""

    def __init__(self, image: Image) -> None:
        parts = moment_images(image)
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        luminance: Float32Array = grey.astype(np.float32)
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


def _summed_down(parts: list[Float32Array]) -> FloatArray:
    """(h + 1, k, w) sums of the rows above each row, of k images (h, w)."""
    rows = np.stack(parts, axis=1)
    out = np.zeros((len(rows) + 1, *rows.shape[1:]))
    # Row by row, as each lies in one piece: `cumsum` goes down column by column.
    for k, row in enumerate(rows):
        np.add(out[k], row, out=out[k + 1])
    return out


def _summit(before: Float32Array, middle: Float32Array, after: Float32Array) -> FloatArray:
    """Offset in (-0.5, 0.5] of the top of the parabola through three values around a maximum."""
    bend = before + after - 2.0 * middle
    return np.asarray(0.5 * (before - after) / np.minimum(bend, -1e-9), np.float64)


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
