"""The baseline of all comparisons: SIFT as OpenCV has it, with Lowe's ratio test alone."""

from __future__ import annotations

import cv2
import numpy as np

from fgslam.cameras.omni.camera import OmniCamera, measure
from fgslam.core.arrays import Image
from fgslam.core.homing import BearingMatches, UprightFeatures
from fgslam.frontend.features.colour_sift import up_in_image
from fgslam.frontend.features.omni_settings import OmniMatchingSettings
from fgslam.frontend.homing.matching import match_sift

_NO_COLOUR_LIMIT = 1e9


def plain_sift(camera: OmniCamera, image: Image, sigma_px: float = 1.2) -> UprightFeatures:
    """OpenCV's SIFT with its own parameters, orientations and all, on an image (h, w, 3).

    Features that the camera does not see are left out. There is no colour: it is zero.
    """
    detector = cv2.SIFT.create(enable_precise_upscale=True)
    keypoints, descriptors = detector.detectAndCompute(
        cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None
    )
    if descriptors is None:
        descriptors = np.zeros((0, 128), np.float32)
    table = np.array([(*k.pt, 0.5 * k.size) for k in keypoints], np.float64).reshape(-1, 3)
    bearing, elevation, covariance = measure(camera, table[:, :2], sigma_px)
    up = np.linalg.norm(up_in_image(camera, table[:, :2]), axis=1)
    seen = np.isfinite(bearing) & np.isfinite(up)
    return UprightFeatures(
        pixels=table[seen, :2],
        bearing=bearing[seen],
        elevation=elevation[seen],
        covariance=covariance[seen],
        scale=table[seen, 2] / up[seen],
        descriptors=np.asarray(descriptors, np.uint8)[seen],
        colour=np.zeros((int(seen.sum()), 3)),
    )


def match_plain(a: UprightFeatures, b: UprightFeatures, ratio: float = 0.8) -> BearingMatches:
    """Mutual nearest descriptors that pass the ratio test, and no other test."""
    settings = OmniMatchingSettings(
        ratio=ratio, root=False, max_colour_distance=_NO_COLOUR_LIMIT, planar_gates=False
    )
    return match_sift(a, b, settings)
