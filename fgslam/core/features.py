"""Features of images, features matched over the rig, and appearances of landmarks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, ByteArray, FloatArray, IntArray, Rows
from fgslam.core.measurements import Observations


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Features(Rows):
    """Features of one image.

    Attributes:
        xy: (n, 2) sub-pixel (column, row).
        scale: (n,) standard deviation of the Gaussian at which the feature was found, in pixels.
        orientation: (n,) radians, clockwise from the image's x axis, in [0, 2 pi).
        descriptors: (n, 128) uint8; as an own extractor gives them, (n, d) of any kind.
    """

    xy: FloatArray
    scale: FloatArray
    orientation: FloatArray
    descriptors: npt.NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class StereoFeatures(Rows):
    """Features matched over the rig: the paper's [r, c, s, o, d, X, Y, Z] (Se et al. 3).

    Attributes:
        measurement: (n, 3) (column, row, disparity) in the reference image, pixels.
        measurement_covariance: (n, 3, 3) of the above, pixels squared.
        scale: (n,) mean over the images, pixels.
        orientation: (n,) circular mean over the images, radians.
        descriptors: (n, 128) uint8, of the reference image.
        position: (n, 3) in the reference camera's frame, metres.
        position_covariance: (n, 3, 3), metres squared.
        pixels: (n, 3, 2) raw (column, row) in right, left and top image; NaN without a top camera.
        complete: (n,) found in every image of the rig, complete ones first; None if all are. The
            others may be a landmark known already; they start none.
    """

    measurement: FloatArray
    measurement_covariance: FloatArray
    scale: FloatArray
    orientation: FloatArray
    descriptors: ByteArray
    position: FloatArray
    position_covariance: FloatArray
    pixels: FloatArray
    complete: BoolArray | None = None

    @property
    def whole(self) -> StereoFeatures:
        """Those found in every image, under the same numbers."""
        if self.complete is None:
            return self
        found = self.select(np.flatnonzero(self.complete))
        return replace(found, complete=None)

    def noisier(self, factors: FloatArray) -> StereoFeatures:
        """The same with variances that are larger by factors (n,)."""
        by = factors[:, None, None]
        return replace(
            self,
            measurement_covariance=by * self.measurement_covariance,
            position_covariance=by * self.position_covariance,
        )

    def observations(self, which: IntArray, ids: IntArray, is_new: bool) -> Observations:
        """Some of the features as observations of the landmarks ``ids``."""
        return Observations(
            ids,
            self.measurement[which],
            self.measurement_covariance[which],
            self.pixels[which],
            np.full(len(which), is_new),
        )

    @staticmethod
    def empty() -> StereoFeatures:
        """No feature at all."""
        return StereoFeatures(
            measurement=np.empty((0, 3)),
            measurement_covariance=np.empty((0, 3, 3)),
            scale=np.empty(0),
            orientation=np.empty(0),
            descriptors=np.empty((0, 128), np.uint8),
            position=np.empty((0, 3)),
            position_covariance=np.empty((0, 3, 3)),
            pixels=np.empty((0, 3, 2)),
        )


Words = npt.NDArray[np.int16]
"""(v,) the cell of the vocabulary (``frontend.features.vocabulary``) of each descriptor."""


PATCH_PX = 15
"""Side of a landmark's patch."""
WHOLE_PX = 6
"""Reach of a patch from its middle, pixels: what lies beyond has a fifteenth of its weight."""
CUT_PIXELS = (PATCH_PX + 2) ** 2
"""Grey values of a patch with the rim that its slopes need."""


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LandmarkPatches(Rows):
    """Landmarks' own patches: what the reference image showed around each when it was first seen.

    Attributes:
        grey: (n, :data:`CUT_PIXELS`) grey values; (n, 0) where none are kept.
        distances: (n,) by which sizes shrink, metres, when it was seen so; 0 without a patch.
    """

    grey: ByteArray
    distances: FloatArray

    @staticmethod
    def none(count: int, pixels: int = CUT_PIXELS) -> LandmarkPatches:
        """Of landmarks without a patch."""
        return LandmarkPatches(np.zeros((count, pixels), np.uint8), np.zeros(count))

    @property
    def kept(self) -> bool:
        """Whether there is room for any."""
        return int(self.grey.shape[1]) > 0


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LandmarkAppearances(Rows):
    """Appearances of landmarks, one row a stored view; there may be several (Se et al. 6.3).

    Attributes:
        ids: (v,) identity of the landmark that each view belongs to, ascending.
        descriptors: (v, 128) uint8.
        size: (v,) physical size, scale times depth: pixels times metres.
        orientation: (v,) radians, as in the image.
        direction: (v, 3) unit vector from the camera to the landmark, world; NaN where unknown.
        words: (v,) of the descriptors, where they are at hand; None where they must be found. No
            part of what is known: they follow from the descriptors.
    """

    ids: IntArray
    descriptors: ByteArray
    size: FloatArray
    orientation: FloatArray
    direction: FloatArray
    words: Words | None = None

    def of(self, ids: IntArray) -> LandmarkAppearances:
        """Only the views of the named landmarks (any order; unknown ones give none)."""
        return self.select(np.isin(self.ids, ids))
