"""Features of the reference image alone, measured in the other images by their patches.

A block matcher on images of half the size (Konolige 1998) tells the disparity of every feature of
the reference image to a pixel or two; its patch (:mod:`fgslam.frontend.features.patches`), aligned
in each other image from there, tells it exactly. So the other images need no features.
"""

from __future__ import annotations

import cv2
import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, Image
from fgslam.core.features import PATCH_PX, Features, StereoFeatures
from fgslam.core.recordings import Frame, clearance
from fgslam.core.rig_correction import RigCorrection
from fgslam.core.sensors import CameraRig, vertical_to_horizontal
from fgslam.frontend.features.fine_image import FineImage
from fgslam.frontend.features.patches import ReferencePatches, align, anchor
from fgslam.frontend.stereo import StereoMatcher

GREY_NOISE = 4.0  # sigma of a grey value: noise, and what no affine map does
DEFORMATION = 0.05  # sigma of a patch's stretching between two images
ALIGNMENTS_ACROSS = 3  # in another camera's image, from a disparity known to a pixel or two
_MIN_CORRELATION = 0.8
"""Of a patch with what it is in another image, gain and offset taken out. Of patches whose partner
is elsewhere, or is none, two or three in a hundred reach it by chance."""

_BLOCK_PX = 9  # of the images of half the size: about a patch
_LARGEST_SHARE = 0.5  # of the image's width: the largest disparity looked for, where none is set
_UNIQUE_PERCENT = 10  # by which the best block must beat any other
_BELOW_ZERO = 2  # pixels of half the size that disparities may be too small, by the calibration
_FRACTIONS = 16.0  # of a pixel, in which OpenCV states disparities
_AT_ONCE = 8192  # patches, some ten kilobytes each; OpenCV samples less than 32767 rows at once


class PatchStereo:
    """Turns features of the reference image into stereo features."""

    def __init__(self, rig: CameraRig, stereo: StereoMatcher, largest_px: float) -> None:
        """``stereo`` measures, by its gates; disparities up to ``largest_px`` are looked for."""
        self._rig = rig
        self._stereo = stereo
        limit = largest_px if np.isfinite(largest_px) else _LARGEST_SHARE * rig.width
        reach = 0.5 * min(limit, rig.width) + _BELOW_ZERO
        self._margin = 16 * int(np.ceil(reach / 16.0))
        self._blocks = cv2.StereoBM.create(self._margin, _BLOCK_PX)
        self._blocks.setMinDisparity(-_BELOW_ZERO)
        self._blocks.setTextureThreshold(0)
        self._blocks.setUniquenessRatio(_UNIQUE_PERCENT)
        self._blocks.setDisp12MaxDiff(1)  # the same from either image

    def match(
        self, frame: Frame, found: Features, correction: RigCorrection | None = None
    ) -> StereoFeatures:
        """The features that all images show, measured in each.

        Args:
            frame: the images, right, left[, top], and where they show nothing.
            found: features of the right one.
            correction: of the rig; None where its calibration is taken as stated.
        """
        found = found.select(np.asarray(np.isfinite(found.xy).all(axis=1)))
        coarse = self._coarse(frame.images, found.xy)
        known = np.isfinite(coarse)
        found, coarse = found.select(known), coarse[known]
        views = [FineImage(image) for image in frame.images]
        pixels = np.empty((len(found.xy), len(frame.images), 2))
        good: BoolArray = np.empty(len(found.xy), np.bool_)
        for first in range(0, len(found.xy), _AT_ONCE):
            some = slice(first, first + _AT_ONCE)
            pixels[some], good[some] = self._aligned(frame, views, found.xy[some], coarse[some])
        rest = (found.scale, found.orientation, found.descriptors)
        in_each = tuple(
            Features(pixels[:, camera], *rest).select(good) for camera in range(len(frame.images))
        )
        return self._stereo.measured(in_each, self._stereo.by_reference(), correction)[0]

    def _aligned(
        self, frame: Frame, views: list[FineImage], places: FloatArray, coarse: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Pixels (n, cameras, 2) of places (n, 2) in each image, and which all of them show."""
        patches = anchor(views[0], places, PATCH_PX, GREY_NOISE, DEFORMATION)
        good: BoolArray = np.ones(len(places), np.bool_)
        pixels = [places]
        for camera, view in enumerate(views[1:], 1):
            seen, alike = across(self._rig, view, camera, patches, places, coarse)
            pixels.append(seen)
            good &= alike >= _MIN_CORRELATION
        for margin, seen in zip(frame.margins, pixels, strict=False):  # none: all are full
            good &= clearance(margin, seen) > PATCH_PX // 2
        return np.stack(pixels, axis=1), good

    def _coarse(self, images: tuple[Image, ...], places: FloatArray) -> FloatArray:
        """Disparities (n,) at places (n, 2) of the right image, to a pixel or two; NaN unknown."""
        if min(images[0].shape) < 2 * _BLOCK_PX:
            return np.full(len(places), np.nan)
        table = self._blocks.compute(*(self._prepared(image) for image in images[:2]))
        at = np.rint((places - 0.5) / 2.0).astype(np.int64)
        width = table.shape[1] - self._margin - _BELOW_ZERO
        column = self._margin + np.clip(width - 1 - at[:, 0], 0, width - 1)
        found = table[np.clip(at[:, 1], 0, len(table) - 1), column].astype(np.float64)
        known = found >= -_FRACTIONS * _BELOW_ZERO
        return np.where(known, 2.0 * found / _FRACTIONS, np.nan)

    def _prepared(self, image: Image) -> Image:
        """The image at half its size, mirrored, with margins.

        OpenCV's reference is the left image: seen in a mirror, ours is. It says nothing of what
        lies nearer to the border than the largest disparity.
        """
        half = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        mirrored = cv2.flip(half, 1)
        sides = (0, 0, self._margin, _BELOW_ZERO)
        return np.asarray(cv2.copyMakeBorder(mirrored, *sides, cv2.BORDER_REPLICATE), np.uint8)


def across(
    rig: CameraRig,
    view: FineImage,
    camera: int,
    patches: ReferencePatches,
    places: FloatArray,
    disparity: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) of points in another camera's image, and how well (n,) they correlate there.

    Args:
        rig: the cameras.
        view: of the other camera.
        camera: 1 left, 2 top.
        patches: of the points, as they look in the reference image.
        places: (n, 2) there.
        disparity: (n,) expected, within a few pixels.
    """
    seen = places.copy()
    if camera == 1:
        seen[:, 0] += disparity
    else:
        seen[:, 1] += disparity / vertical_to_horizontal(rig)
    correlation = np.empty(0)
    for _ in range(ALIGNMENTS_ACROSS):
        patches, seen, correlation = align(patches, view, seen)
    last = np.array([rig.width, rig.height]) - 1.0
    inside = ((seen >= 0.0) & (seen <= last)).all(axis=1)
    return seen, np.where(inside, correlation, -1.0)
