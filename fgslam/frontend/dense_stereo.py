"""Depth of every pixel of the reference image, with its deviation, from two or three cameras.

Semi-global matching (Hirschmueller 2008) of the right image with each other one, its rounding
undone; where two pairs agree their mean; then a step of Gauss-Newton on inverse depth over all
pairs at once. docs/howto/dense_map.md.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from fgslam.core.arrays import Float32, FloatArray, Image
from fgslam.core.correction import camera_displacements
from fgslam.core.sensors import CameraRig, vertical_to_horizontal

MIN_DISPARITY_PX = 4.0
"""Below it a third of a pixel, the worst of the lock to whole ones, is a tenth of the depth."""

_STEPS = 16  # of a pixel, in OpenCV's disparities
_BLOCK = 7  # of the matcher, and the window of what is made of its disparities
_AGREE_PX = 1  # of both directions of a match, and of two pairs
_MATCHER_SIGMA_PX = 0.2  # of its disparities; those of one surface deviate no more (dense_map.md)
_FARTHEST_PX = 0.5  # of a step: as far as a gradient holds
_ALONG = np.eye(2, dtype=np.float32)  # in which the left and the top image are displaced
_HALF = np.float32(0.5)
_FLAT = 1e-3  # grey levels squared a pixel: no gradient at all
# Variance of a disparity: what no residual shows, residuals that neighbours have in common, and the
# square of how far a disparity is off the mean around it. Chosen in the lab; in offices twice or
# half of either moves what is within one sigma from 93 to 92 or 93 % (dense_map.md).
_FLOOR_PX, _CORRELATED, _EDGE = 0.05, 4.0, 2.0


class DenseStereo:
    """Disparities of a rig's reference images, in pixels of the horizontal pair."""

    def __init__(
        self, rig: CameraRig, cameras: int | None = None, correction: FloatArray | None = None
    ) -> None:
        """Matches each other camera, or only so many.

        Args:
            rig: the rectified cameras.
            cameras: 2 leaves the vertical pair out.
            correction: (p,) of the rig against its calibration, which is taken off the images.
        """
        self.rig = rig
        # Of an inverse depth's disparity in pixels of the horizontal pair to that in each image.
        self._ratios = (1.0, 1.0 / vertical_to_horizontal(rig))[: (cameras or rig.cameras) - 1]
        self._padding = max(64, -(-rig.width // (8 * _STEPS)) * _STEPS)
        self._matcher = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=self._padding,
            blockSize=_BLOCK,
            P1=8 * _BLOCK**2,
            P2=32 * _BLOCK**2,
            disp12MaxDiff=_AGREE_PX,
            uniquenessRatio=10,
            speckleWindowSize=100,
            speckleRange=2,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )
        self._maps: list[tuple[Float32, Float32]] = []
        if correction is not None and np.any(correction):
            self._maps = [_sampling(rig, k, correction) for k in range(len(self._ratios) + 1)]

    def measure(self, images: Sequence[Image]) -> tuple[Float32, Float32]:
        """Disparities (height, width) and their deviations, pixels; 0 where there is none.

        Args:
            images: (right, left[, top]), grey or in colour, rectified.
        """
        grey = self._grey(images)
        disparity = self._match(grey[0], grey[1])
        if len(grey) > 2:  # below each other, the pair's images are turned
            a, b = disparity, self._match(grey[0].T, grey[2].T).T / np.float32(self._ratios[1])
            both = np.where(np.abs(a - b) <= _AGREE_PX, 0.5 * (a + b), 0.0)
            disparity = np.where((a > 0.0) & (b > 0.0), both, np.maximum(a, b))
        return self._refine(grey, np.where(disparity >= MIN_DISPARITY_PX, disparity, 0.0))

    def corrected(self, images: Sequence[Image]) -> list[Image]:
        """The images as an exact rig had taken them."""
        used = images[: len(self._ratios) + 1]
        if not self._maps:
            return list(used)
        return [
            np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR), np.uint8)
            for image, maps in zip(used, self._maps, strict=True)
        ]

    def _grey(self, images: Sequence[Image]) -> list[Image]:
        return [
            i if i.ndim == 2 else np.asarray(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), np.uint8)
            for i in images[: len(self._ratios) + 1]
        ]

    def _match(self, reference: Image, other: Image) -> Float32:
        """Disparities (height, width) of a pair, 0 where there is none."""
        # OpenCV's reference is the left image: both are mirrored. Columns to match beyond the edge.
        left, right = (
            cv2.copyMakeBorder(image[:, ::-1], 0, 0, self._padding, 0, cv2.BORDER_REPLICATE)
            for image in (reference, other)
        )
        raw = self._matcher.compute(left, right)[:, : self._padding - 1 : -1]
        # Halves of a step are cut off towards the whole pixel from both sides (stereosgbm.cpp):
        # those below it are a step too high, and at it half a step.
        step = raw % _STEPS
        exact = raw - (step > _STEPS // 2) - _HALF * (step == 0)
        return np.where(raw > 0, exact / np.float32(_STEPS), np.float32(0.0)).astype(np.float32)

    def _refine(self, grey: Sequence[Image], disparity: Float32) -> tuple[Float32, Float32]:
        """A step of least squares on all pairs' grey values in a window, pulled to the given ones.

        Disparities are smoothed between edges before, and after: a step for each pixel alone would
        let grow what alternates within a window.
        """
        known = disparity > 0.0
        weight = known.astype(np.float32)
        count = np.maximum(cv2.blur(weight, (_BLOCK, _BLOCK)), 1e-6)
        rows, columns = np.indices(disparity.shape, np.float32)
        reference, *others = (image.astype(np.float32) for image in grey)
        # Between two pixels, at half of the way, as bilinear sampling has them.
        slopes = [
            np.diff(image, axis=1 - k, append=np.float32(0.0)) for k, image in enumerate(others)
        ]

        def mean(values: Float32) -> Float32:
            return np.asarray(cv2.blur(weight * values, (_BLOCK, _BLOCK)) / count)

        def smooth(values: Float32) -> Float32:
            middle = mean(values)  # guided by themselves (He, Sun and Tang 2010)
            varying = np.maximum(mean(values * values) - middle * middle, np.float32(0.0))
            kept = np.asarray(varying / (varying + np.float32(_MATCHER_SIGMA_PX**2)), np.float32)
            smoothed = mean(kept) * values + mean(middle - kept * middle)
            return np.where(known, smoothed, np.float32(0.0))

        d = smooth(disparity)
        energy = product = squares = np.zeros_like(disparity)
        for k, (image, slope) in enumerate(zip(others, slopes, strict=True)):
            ratio, along = np.float32(self._ratios[k]), _ALONG[k]
            x, y = columns + along[0] * ratio * d, rows + along[1] * ratio * d
            apart = cv2.remap(image, x, y, cv2.INTER_LINEAR) - reference
            x, y = x - along[0] * _HALF, y - along[1] * _HALF
            gradient = ratio * cv2.remap(slope, x, y, cv2.INTER_LINEAR)
            # Cameras differ in brightness: what a whole window has is no shift.
            g, r = mean(gradient), mean(apart)
            energy = energy + mean(gradient * gradient) - g * g
            product = product + mean(gradient * apart) - g * r
            squares = squares + mean(apart * apart) - r * r
        noise = np.maximum(squares, 0.0) / np.float32(len(others))
        energy = np.maximum(energy, np.float32(_FLAT))
        pull = noise / np.float32((_BLOCK * _MATCHER_SIGMA_PX) ** 2)
        d = smooth(d - np.clip(product / (energy + pull), -_FARTHEST_PX, _FARTHEST_PX))
        # Next to an edge of depth the window holds two surfaces.
        variance = _FLOOR_PX**2 + _CORRELATED * noise / (_BLOCK**2 * energy)
        variance = variance + _EDGE * (mean(d) - d) ** 2
        return d, np.where(known, np.sqrt(variance), 0.0).astype(np.float32)


def _sampling(rig: CameraRig, camera: int, correction: FloatArray) -> tuple[Float32, Float32]:
    """Where a camera's image shows each pixel of the image of an exact rig."""
    rows, columns = np.indices((rig.height, rig.width), np.float64)
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    moved = pixels + camera_displacements(rig, camera, pixels) @ correction
    x, y = moved.T.astype(np.float32).reshape(2, rig.height, rig.width)
    return x, y
