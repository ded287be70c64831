"""SIFT features of a frame's images, found in parallel (Se et al. 2.1)."""

from __future__ import annotations

from collections.abc import Sequence as Many
from concurrent.futures import Executor

import cv2
import numpy as np

from fgslam.core.arrays import ByteArray, Image, IntArray
from fgslam.core.features import Features
from fgslam.frontend.features.exposure import contrast_share, noise_sigma
from fgslam.frontend.features.settings import Appearance, SiftSettings

SCALE_LEVELS = 8  # searched, finest first, as in the paper
OCTAVE_LAYERS = 2  # levels an octave: a factor of 1.41; the paper's is 1.5
EDGE_THRESHOLD = 10.0  # ratio of principal curvatures above which edges go: OpenCV's own
_NOISE_ANSWER = 0.4
"""Contrast that 1 of 100 features of white noise exceed at the first level, in the noise's sigmas.

Found on noise, base sigma 1.6 and two levels an octave; it is smaller for others, and falls with
the scale."""

_WHITE = 255.0


class SiftExtractor:
    """Finds SIFT features; keeps the finest levels of the pyramid.

    The first level is that of the doubled image, as Lowe proposed. Up-scaling is precise: without
    it OpenCV's key points are a quarter of a pixel off in both axes.
    """

    def __init__(self, settings: SiftSettings, appearance: Appearance) -> None:
        """Makes the detector; OpenCV's own threads are switched off, images run in parallel."""
        cv2.setNumThreads(1)
        self._settings = settings
        self._describe = appearance == "descriptor"
        self._sift = self._detector(settings.contrast_threshold)

    def extract(self, image: Image) -> Features:
        """Features of one grey image (height, width), in OpenCV's order, which is repeatable.

        With ``contrast: relative`` those that the image would have if it were well exposed, without
        what is likely to be noise. An image that is well exposed is taken as it is.
        """
        share = 1.0 if self._settings.contrast == "absolute" else contrast_share(image)
        if share == 1.0:
            return self._select(*self._found(self._sift, image), noise=0.0)
        dim = self._detector(share * self._settings.contrast_threshold)
        return self._select(*self._found(dim, image), noise_sigma(image))

    def extract_all(self, images: Many[Image], pool: Executor) -> tuple[Features, ...]:
        """Features of several images, one task each."""
        return tuple(pool.map(self.extract, images))

    def _detector(self, contrast_threshold: float) -> cv2.SIFT:
        return cv2.SIFT.create(
            self._settings.max_features,
            OCTAVE_LAYERS,
            contrast_threshold,
            EDGE_THRESHOLD,
            self._settings.base_sigma_px,
            cv2.CV_8U,
            True,
        )

    def _found(self, sift: cv2.SIFT, image: Image) -> tuple[Many[cv2.KeyPoint], ByteArray]:
        # One call for both: two calls would build the pyramid twice.
        if self._describe:
            keypoints, computed = sift.detectAndCompute(image, None)
        else:
            keypoints, computed = sift.detect(image, None), None
        if computed is None:
            computed = np.zeros((len(keypoints), 128), np.uint8)
        return keypoints, np.asarray(computed, np.uint8)

    def _select(
        self, keypoints: Many[cv2.KeyPoint], descriptors: ByteArray, noise: float
    ) -> Features:
        """Features of the levels searched that answer more than noise of that sigma would."""
        # Column by column: half the time of one row a key point.
        level = self._levels_of(np.array([kp.octave for kp in keypoints], np.int64))
        by_noise = _NOISE_ANSWER * noise * 2.0 ** (-level / OCTAVE_LAYERS)
        response = np.array([kp.response for kp in keypoints])
        keep = (level < SCALE_LEVELS) & (_WHITE * response >= by_noise)
        xy = np.asarray(cv2.KeyPoint.convert(keypoints), np.float64).reshape(-1, 2)
        return Features(
            xy=xy[keep],
            scale=0.5 * np.array([kp.size for kp in keypoints])[keep],
            orientation=np.deg2rad(np.array([kp.angle for kp in keypoints])[keep]),
            descriptors=descriptors[keep],
        )

    def _levels_of(self, packed: IntArray) -> IntArray:
        """Levels counted from the finest, 0-based, of OpenCV's packed octave and layer."""
        octave = packed & 255
        octave = np.where(octave >= 128, octave - 256, octave)
        return (octave + 1) * OCTAVE_LAYERS + ((packed >> 8) & 255) - 1
