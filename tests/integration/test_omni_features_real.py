"""Omnidirectional features on real panoramas: the gain over plain SIFT, judged by true poses."""

from __future__ import annotations

import csv
from pathlib import Path

import cv2
import numpy as np
import pytest

from fgslam.cameras.omni import Equirectangular
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.bearings import BearingMatches
from fgslam.core.geometry import between
from fgslam.frontend.features.omni import OmniFeatureExtractor
from fgslam.frontend.homing.two_view import (
    PLAIN_MATCHING,
    EpipolarTest,
    match_features,
    match_sift,
    plain_sift,
)
from fgslam.frontend.settings import OmniFeatureSettings

pytestmark = pytest.mark.data


def pose_and_image(root: Path, panorama: int) -> tuple[FloatArray, np.ndarray]:  # type: ignore[type-arg]
    if not (root / "omni_home").is_dir():
        pytest.skip(f"no recording omni_home in {root}: this test needs it")
    with (root / "omni_home" / "poses.csv").open() as file:
        row = next(r for r in csv.DictReader(file) if int(r["id"]) == panorama)
    image = cv2.imread(str(root / "omni_home" / "panos" / row["file"]))
    assert image is not None
    heading = np.deg2rad(float(row["heading_deg"]))
    pose = np.array([float(row["x_m"]), float(row["y_m"]), heading])
    return pose, np.asarray(image[..., ::-1])


def right(matches: BearingMatches, a: FloatArray, b: FloatArray) -> BoolArray:
    """Within 1.5 degrees of the epipolar plane of the true poses, equal sigmas."""
    relative = between(a, b)
    direction = np.array([np.arctan2(relative[1], relative[0])])
    equal = BearingMatches(
        matches.kind,
        matches.index_a,
        matches.index_b,
        matches.bearing_a,
        matches.elevation_a,
        matches.bearing_b,
        matches.elevation_b,
        np.ones_like(matches.sigma),
        matches.quality,
    )
    residual = EpipolarTest.of(equal).normalised(direction, relative[2:])
    return np.abs(np.ravel(residual)) < np.deg2rad(1.5)


@pytest.mark.slow
def test_more_right_matches_and_no_more_wrong_ones(shared_data: Path) -> None:
    (pose_a, image_a), (pose_b, image_b) = (pose_and_image(shared_data, k) for k in (7, 10))
    camera = Equirectangular(image_a.shape[1], image_a.shape[0])
    plain = match_sift(plain_sift(camera, image_a), plain_sift(camera, image_b), PLAIN_MATCHING)
    extractor = OmniFeatureExtractor(camera, OmniFeatureSettings())
    a, b = extractor.extract(image_a), extractor.extract(image_b)
    ours = match_features(a, b, OmniFeatureSettings().matching)
    plain_right, ours_right = right(plain, pose_a, pose_b), right(ours, pose_a, pose_b)
    sift = ours.kind == 0
    # The aim is more right ones at no more wrong ones: from the most distinctive match on, as
    # many as it takes to reach the wrong ones of plain SIFT.
    ranked = ours_right[sift][np.argsort(-ours.quality[sift], kind="stable")]
    allowed = ranked[np.cumsum(~ranked) <= np.sum(~plain_right)]
    assert allowed.sum() >= 1.4 * plain_right.sum()
    assert ours_right.sum() > max(ours_right[sift].sum(), ours_right[~sift].sum())
