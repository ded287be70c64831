"""Depth of every pixel of the reference image, with its deviation, from two or three cameras.

Semi-global matching (Hirschmueller 2008) of the right image with each other one; its sub-pixel
steps made equally likely by a table; where two pairs agree their mean; then Gauss-Newton on inverse
depth over all pairs at once. docs/howto/dense_map.md.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import Float32, FloatArray, Image
from fgslam.core.correction import camera_displacements
from fgslam.core.sensors import CameraRig, vertical_to_horizontal

Int16: TypeAlias = npt.NDArray[np.int16]

MIN_DISPARITY_PX = 4.0
"""Below it a third of a pixel, the worst of the lock to whole ones, is a tenth of the depth."""

_STEPS = 16  # of a pixel, in OpenCV's disparities
_BLOCK = 7
_AGREE_PX = 1.0  # of the second pass, and of two pairs
_WINDOW = (7, 7)
_PIXELS = 49
_STEPS_OF_NEWTON = 2
_FARTHEST_PX = 0.5  # of one step: as far as a gradient holds
_ALIKE_PX = 0.1  # of one surface are disparities that deviate less
_MATCHER_SIGMA_PX = 0.2  # of the matcher's disparities, steps equalised, in the rendered lab
_ALONG = np.eye(2, dtype=np.float32)  # in which the left and the top image are displaced
_HALF = np.float32(0.5)
_FLAT = 1e-3  # grey levels squared a pixel: no gradient at all
# Variance of a disparity, as in the rendered lab: what no residual shows, residuals that neighbours
# have in common, and the square of how far a disparity is off the mean around it.
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
        most = max(64, -(-rig.width // (8 * _STEPS)) * _STEPS)
        self._matchers = [_Matcher(most) for _ in self._ratios]
        self.steps = np.arange(_STEPS) / _STEPS
        self._maps: list[tuple[Float32, Float32]] = []
        if correction is not None and np.any(correction):
            self._maps = [_sampling(rig, k, correction) for k in range(len(self._ratios) + 1)]

    def learn_steps(self, frames: Iterable[Sequence[Image]]) -> Float32:
        """Finds what each sixteenth of a pixel stands for; the disparities (n,) found, pixels.

        True fractions are equally likely, the matcher's are not: it prefers whole pixels, and
        rounds up below them. By its symmetry the border of steps 8 and 9 is a half.

        Args:
            frames: images (right, left[, top]) of each.
        """
        counts, seen = np.ones(_STEPS), [np.empty(0, np.float32)]
        for images in frames:
            for raw, ratio in zip(self._match(self._grey(images)), self._ratios, strict=True):
                counts += np.bincount(raw[raw > 0] % _STEPS, minlength=_STEPS)
                seen.append((raw[raw > 0] / (_STEPS * ratio)).astype(np.float32))
        shares = np.roll(counts, -(_STEPS // 2 + 1)) / counts.sum()
        middles = np.cumsum(shares) - 0.5 * shares + 0.5
        found = np.roll(middles, _STEPS // 2 + 1)
        self.steps = np.where(np.arange(_STEPS) <= _STEPS // 2, found - 1.0, found)
        found = np.concatenate(seen)
        return found[found >= MIN_DISPARITY_PX]

    def measure(self, images: Sequence[Image]) -> tuple[Float32, Float32]:
        """Disparities (height, width) and their deviations, pixels; 0 where there is none.

        Args:
            images: (right, left[, top]), grey or in colour, rectified.
        """
        grey = self._grey(images)
        found = [
            self._of_steps(raw) / np.float32(ratio)
            for raw, ratio in zip(self._match(grey), self._ratios, strict=True)
        ]
        disparity = found[0]
        if len(found) > 1:
            a, b = found
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

    def _match(self, grey: Sequence[Image]) -> list[Int16]:
        """Of each pair the raw disparities of the reference image, 0 where there is none."""
        out = [self._matchers[0].match(grey[0], grey[1])]
        if len(grey) > 2:  # below each other, the pair's images are turned
            out.append(self._matchers[1].match(grey[0].T, grey[2].T).T)
        return out

    def _of_steps(self, raw: Int16) -> Float32:
        whole, step = np.divmod(raw, _STEPS)
        return np.where(raw > 0, whole + self.steps.astype(np.float32)[step], np.float32(0.0))

    def _refine(self, grey: Sequence[Image], disparity: Float32) -> tuple[Float32, Float32]:
        """Least squares on all pairs' grey values in a window, pulled to the given disparities.

        A step for each pixel alone would let grow what alternates within a window: before each,
        and after the last, disparities are smoothed between edges.
        """
        known = disparity > 0.0
        weight = known.astype(np.float32)
        count = np.maximum(cv2.blur(weight, _WINDOW), 1e-6)
        rows, columns = np.indices(disparity.shape, np.float32)
        reference, *others = (image.astype(np.float32) for image in grey)
        # Between two pixels, at half of the way, as bilinear sampling has them.
        slopes = [
            np.diff(image, axis=1 - k, append=np.float32(0.0)) for k, image in enumerate(others)
        ]

        def mean(values: Float32) -> Float32:
            return np.asarray(cv2.blur(weight * values, _WINDOW) / count)

        def smooth(values: Float32) -> Float32:
            middle = mean(values)  # guided by themselves (He, Sun and Tang 2010)
            varying = np.maximum(mean(values * values) - middle * middle, np.float32(0.0))
            kept = np.asarray(varying / (varying + np.float32(_ALIKE_PX**2)), np.float32)
            smoothed = mean(kept) * values + mean(middle - kept * middle)
            return np.where(known, smoothed, np.float32(0.0))

        start = d = smooth(disparity)
        for _ in range(_STEPS_OF_NEWTON):
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
            pull = noise / np.float32(_PIXELS * _MATCHER_SIGMA_PX**2)
            step = (product + pull * (d - start)) / (energy + pull)
            d = smooth(d - np.clip(step, -_FARTHEST_PX, _FARTHEST_PX))
        # Next to an edge of depth the window holds two surfaces.
        variance = _FLOOR_PX**2 + _CORRELATED * noise / (_PIXELS * energy)
        variance = variance + _EDGE * (mean(d) - d) ** 2
        return d, np.where(known, np.sqrt(variance), 0.0).astype(np.float32)


class _Matcher:
    """Semi-global matching of one pair, its reference the image whose objects lie further left."""

    def __init__(self, disparities: int) -> None:
        self._count = disparities
        area = _BLOCK * _BLOCK
        self._sgbm = cv2.StereoSGBM.create(
            minDisparity=0,
            numDisparities=disparities,
            blockSize=_BLOCK,
            P1=8 * area,
            P2=32 * area,
            uniquenessRatio=10,
            speckleWindowSize=100,
            speckleRange=2,
            mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
        )

    def match(self, reference: Image, other: Image) -> Int16:
        """Raw disparities (height, width), in sixteenths; 0 where either pass finds none."""
        # OpenCV's reference is the left image: both are mirrored.
        own = self._disparities(reference[:, ::-1], other[:, ::-1])[:, ::-1]
        back = self._disparities(other, reference)
        columns = np.arange(own.shape[1])
        there = columns + (own + _STEPS // 2) // _STEPS
        inside = (own > 0) & (there < own.shape[1])
        rows = np.arange(own.shape[0])[:, None]
        again = back[rows, np.where(inside, there, 0)]
        same = inside & (again > 0) & (np.abs(again - own) <= _AGREE_PX * _STEPS)
        return np.where(same, own, 0).astype(np.int16)

    def _disparities(self, left: Image, right: Image) -> Int16:
        n = self._count
        padded = [cv2.copyMakeBorder(i, 0, 0, n, 0, cv2.BORDER_REPLICATE) for i in (left, right)]
        return np.asarray(self._sgbm.compute(*padded)[:, n:], np.int16)


def _sampling(rig: CameraRig, camera: int, correction: FloatArray) -> tuple[Float32, Float32]:
    """Where a camera's image shows each pixel of the image of an exact rig."""
    rows, columns = np.indices((rig.height, rig.width), np.float64)
    pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
    moved = pixels + camera_displacements(rig, camera, pixels) @ correction
    x, y = moved.T.astype(np.float32).reshape(2, rig.height, rig.width)
    return x, y
