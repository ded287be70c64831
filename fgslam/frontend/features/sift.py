"""SIFT features of a frame's images, found in parallel (Se et al. 2.1)."""

from __future__ import annotations

from collections.abc import Sequence as Many
from concurrent.futures import Executor

import cv2
import numpy as np

from fgslam.core.arrays import ByteArray, Image, IntArray
from fgslam.core.features import Features
from fgslam.frontend.features.settings import Appearance, SiftSettings

EDGE_THRESHOLD = 10.0  # ratio of principal curvatures above which edges go: OpenCV's own


class SiftExtractor:
    """Finds SIFT features; keeps the finest ``scale_levels`` levels of the pyramid.

    The first level is that of the doubled image, as Lowe proposed. Up-scaling is precise: without
    it OpenCV's key points are a quarter of a pixel off in both axes.
    """

    def __init__(self, settings: SiftSettings, appearance: Appearance) -> None:
        """Makes the detector; OpenCV's own threads are switched off, images run in parallel."""
        cv2.setNumThreads(1)
        self._describe = appearance == "descriptor"
        self._levels = settings.scale_levels
        self._layers = settings.octave_layers
        self._sift = cv2.SIFT.create(
            settings.max_features,
            settings.octave_layers,
            settings.contrast_threshold,
            EDGE_THRESHOLD,
            settings.base_sigma_px,
            cv2.CV_8U,
            True,
        )

    def extract(self, image: Image) -> Features:
        """Features of one grey image (height, width), in OpenCV's order, which is repeatable."""
        # One call for both: two calls would build the pyramid twice.
        if self._describe:
            keypoints, computed = self._sift.detectAndCompute(image, None)
        else:
            keypoints, computed = self._sift.detect(image, None), None
        if computed is None:
            computed = np.zeros((len(keypoints), 128), np.uint8)
        return self._select(keypoints, np.asarray(computed, np.uint8))

    def extract_all(self, images: Many[Image], pool: Executor) -> tuple[Features, ...]:
        """Features of several images, one task each."""
        return tuple(pool.map(self.extract, images))

    def _select(self, keypoints: Many[cv2.KeyPoint], descriptors: ByteArray) -> Features:
        rows = [(*kp.pt, kp.size, kp.angle, kp.octave) for kp in keypoints]
        table = np.array(rows, dtype=np.float64).reshape(-1, 5)
        keep = self._levels_of(table[:, 4].astype(np.int64)) < self._levels
        return Features(
            xy=table[keep, :2],
            scale=0.5 * table[keep, 2],
            orientation=np.deg2rad(table[keep, 3]),
            descriptors=descriptors[keep],
        )

    def _levels_of(self, packed: IntArray) -> IntArray:
        """Levels counted from the finest, 0-based, of OpenCV's packed octave and layer."""
        octave = packed & 255
        octave = np.where(octave >= 128, octave - 256, octave)
        return (octave + 1) * self._layers + ((packed >> 8) & 255) - 1
