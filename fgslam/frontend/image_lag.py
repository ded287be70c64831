"""By how many frames one camera's image is older than another's, from the two images alone.

In a rectified rig a point lies in the same line of both images (its row, of the left camera; its
column, of the top one), if they were taken at one moment. An image that is a frame old shows it in
the line of the frame before. So over many points

    offset across the lines = lag * (line in the frame before - line now) + calibration + noise,

with the lag 0 of a sound pair and 1 of one frame, whatever depth and motion are. What the rig's
calibration leaves is a free smooth displacement with the prior of
:mod:`fgslam.core.rig_correction`. docs/derivations/camera_faults.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import cv2
import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, Image, Rows
from fgslam.core.rig_correction import TERMS, camera_displacements, prior_information
from fgslam.core.robust import KERNEL, cauchy_fit
from fgslam.core.sensors import CameraRig

_POINTS = 80
_CORNER_QUALITY = 0.01  # of the best corner's
_DISTANCE_PX = 8
_WINDOW_PX = 15
_LEVELS = 4
_SEARCH = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.02)
_MIN_EIGENVALUE = 1e-3
_MAX_BACK_PX = 0.5  # from where a point began, followed there and back
_FEWEST = 12  # points: more than the unknowns
_LEAST_SPREAD_PX = 0.1  # of points followed on sharp images
_SIGNAL = 3.0
"""Spreads that the shift must amount to. Both sides err alike by the noise of the present image's
patch, which at a standstill looks like half a frame; at three spreads it is 0.06 of one."""
_UNKNOWN_LAG = 10.0  # frames, standard deviation of its prior: none to speak of


@dataclass(frozen=True, slots=True, eq=False)
class LineRows(Rows):
    """Points of one frame: offset (n,) across the lines, shift (n,) since, place (n, 2) in pixels.

    The place is where the camera beside the reference shows the point, in the rig's own pixels.
    """

    offset: FloatArray
    shift: FloatArray
    place: FloatArray

    @staticmethod
    def none() -> LineRows:
        """No point."""
        return LineRows(np.empty(0), np.empty(0), np.empty((0, 2)))


@dataclass(frozen=True, slots=True)
class Lag:
    """Frames by which an image is old, and the standard deviation of that; NaN where unknown."""

    frames: float
    sigma: float

    @property
    def late(self) -> float:
        """Deviations by which it is nearer to one frame than to none; NaN where unknown."""
        return (self.frames - 0.5) / self.sigma


class LagModel:
    """What the calibration of a rig may explain of the offsets in one of its other cameras."""

    def __init__(self, rig: CameraRig, camera: int) -> None:
        """``camera``: 1 left, 2 top."""
        self._rig, self._camera = rig, camera
        self._own = slice(len(TERMS) * (camera - 1), len(TERMS) * camera)
        self._prior = prior_information(rig)[self._own, self._own]

    @property
    def across(self) -> int:
        """The coordinate in which a point agrees between the images: 1 row, 0 column."""
        return 1 if self._camera == 1 else 0

    def lag(self, rows: LineRows, spread_px: float) -> Lag:
        """Robust least squares with a sandwich covariance (Huber 1981, ch. 6).

        Args:
            rows: points of one or several frames.
            spread_px: least spread of the residuals, pixels: that of exact images.
        """
        if len(rows) < _FEWEST:
            return Lag(np.nan, np.nan)
        of_place = camera_displacements(self._rig, self._camera, rows.place)
        design = np.column_stack([rows.shift, of_place[:, self.across, self._own]])
        prior = np.zeros((design.shape[1],) * 2)
        prior[0, 0], prior[1:, 1:] = _UNKNOWN_LAG**-2, self._prior
        fit = cauchy_fit(design, rows.offset, prior, spread_px)
        if np.sqrt(np.mean(rows.shift**2)) < _SIGNAL * fit.spread:
            return Lag(np.nan, np.nan)
        residual = rows.offset - design @ fit.found
        return Lag(float(fit.found[0]), _sigma(design, residual, fit.spread, prior))


def _sigma(design: FloatArray, residual: FloatArray, spread: float, prior: FloatArray) -> float:
    """Standard deviation of the first unknown: the sandwich of Cauchy's M-estimator."""
    squared = (residual / (KERNEL * spread)) ** 2
    weight = 1.0 / (1.0 + squared)
    slope = (1.0 - squared) * weight**2  # derivative of the influence weight * residual
    freedom = len(design) / max(len(design) - design.shape[1], 1)
    noise = freedom * np.maximum((weight * residual) ** 2, (weight * spread) ** 2 / KERNEL**2)
    bread = np.linalg.inv((design.T * slope) @ design + spread**2 * prior)
    meat = (design.T * noise) @ design + spread**4 * prior
    return float(np.sqrt((bread @ meat @ bread)[0, 0]))


class Shrunk:
    """The images of one frame, made small, of equal contrast, and their corners."""

    def __init__(self, images: tuple[Image, ...], factor: int) -> None:
        """Shrinks by a whole ``factor``."""
        self.factor = factor
        self.grey = [_shrunk(image, factor) for image in images]
        spread = [max(float(cv2.meanStdDev(image)[1][0, 0]), 1.0) for image in self.grey]
        self.images: list[Image] = [
            np.asarray(cv2.convertScaleAbs(image, alpha=min(spread[0] / own, 4.0)), np.uint8)
            for image, own in zip(self.grey, spread, strict=True)
        ]

    def corners(self) -> FloatArray:
        """Points (n, 2) of the reference image that can be followed."""
        found = cv2.goodFeaturesToTrack(self.images[0], _POINTS, _CORNER_QUALITY, _DISTANCE_PX)
        return np.empty((0, 2)) if found is None else np.asarray(found, np.float64).reshape(-1, 2)


def _shrunk(image: Image, factor: int) -> Image:
    if factor == 1:
        return image
    size = (image.shape[1] // factor, image.shape[0] // factor)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


Followed: TypeAlias = tuple[FloatArray, BoolArray]
"""Where points (n, 2) are in another image, and which (n,) of them are there."""


def followed(a: Image, b: Image, points: FloatArray) -> Followed:
    """Where points (n, 2) of image ``a`` are in ``b``, and which (n,) come back when followed back.

    Pyramidal Lucas-Kanade (Bouguet 2000).
    """
    if not len(points):
        return points, np.zeros(0, np.bool_)
    start, window = points.astype(np.float32), (_WINDOW_PX, _WINDOW_PX)
    found, good, _ = cv2.calcOpticalFlowPyrLK(
        a, b, start, start.copy(), None, None, window, _LEVELS, _SEARCH, 0, _MIN_EIGENVALUE
    )
    # The way back starts at its end, so that the finest level alone does.
    back, good_back, _ = cv2.calcOpticalFlowPyrLK(
        b, a, found, start.copy(), None, None, window, 0, _SEARCH,
        cv2.OPTFLOW_USE_INITIAL_FLOW, _MIN_EIGENVALUE,
    )  # fmt: skip
    missed = np.abs(back - start).max(axis=1)
    kept = (good.ravel() == 1) & (good_back.ravel() == 1) & (missed <= _MAX_BACK_PX)
    return np.asarray(found, np.float64), np.asarray(kept)


def spread_of(factor: int) -> float:
    """Least spread of points followed on images made small, in the rig's own pixels."""
    return factor * _LEAST_SPREAD_PX
