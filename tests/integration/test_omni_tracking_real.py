"""Tracking and matching on real mirror pictures (`shared/data/omni_mirror`)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fgslam.cameras.omni_files import make_camera
from fgslam.cameras.rings import find_mirror_circle
from fgslam.cameras.settings import HyperbolicMirrorSettings
from fgslam.core.bearings import FeatureKind, TwoViewVector
from fgslam.datasets.images import read_colour_image
from fgslam.datasets.opening import open_omni
from fgslam.datasets.settings import OmniVideoSettings
from fgslam.frontend.features.omni import OmniFeatureExtractor
from fgslam.frontend.homing.tracking import ReplenishedTracker
from fgslam.frontend.homing.two_view import match_features
from fgslam.frontend.homing.vector import estimate_homing_vector
from fgslam.frontend.settings import HomingVectorSettings, OmniFeatureSettings, OmniMatchingSettings

pytestmark = pytest.mark.data

FRAMES = 60


def present(root: Path, name: str) -> Path:
    if not (root / name).exists():
        pytest.skip(f"no {name} in {root}: this test needs it")
    return root / name


def test_a_hundred_points_through_the_mirror_video(shared_data: Path) -> None:
    """Two seconds of the walk; the whole of it is `experiments/mirror_video.yaml`."""
    video = present(shared_data, "omni_mirror/bloggie_walk.mp4")
    recording = open_omni(OmniVideoSettings(path=str(video)))
    tracker = ReplenishedTracker(recording.camera, 110, 160)
    lives: dict[int, int] = {}
    for i in range(FRAMES):
        found = tracker.take(recording.image(i), float(recording.timestamps[i])).tracked
        assert len(found) >= 100
        assert np.isfinite(found.bearing).all()
        for identity in found.ids.tolist():
            lives[identity] = lives.get(identity, 0) + 1
    assert np.median(list(lives.values())) >= 10


@pytest.mark.slow
def test_the_wide_baseline_pair_is_matched_with_both_kinds(shared_data: Path) -> None:
    """Not calibrated: centre from the rim's circle, 25 degrees above the horizon assumed."""
    paths = [present(shared_data, f"omni_mirror/kit_pair_{side}.png") for side in ("left", "right")]
    images = [read_colour_image(path) for path in paths]
    circles = [
        find_mirror_circle(image, np.random.default_rng(0), ((730.0, 735.0), 700.0))
        for image in images
    ]
    centre = np.mean([circle.centre for circle in circles], axis=0)
    settings = HyperbolicMirrorSettings(
        centre=(float(centre[0]), float(centre[1])), ring_px=(87.65, 690.0)
    )
    extractor = OmniFeatureExtractor(make_camera(settings, (1400, 1400)), OmniFeatureSettings())
    matches = match_features(*map(extractor.extract, images), OmniMatchingSettings())
    vector = estimate_homing_vector(matches, HomingVectorSettings(), np.random.default_rng(0))
    assert isinstance(vector, TwoViewVector)
    kinds = matches.kind[vector.inliers]
    assert np.count_nonzero(kinds == FeatureKind.SIFT) >= 150
    assert np.count_nonzero(kinds == FeatureKind.COLUMN) >= 5
    # Two mirrors side by side on one roof: the same heading, the other to the right.
    assert abs(np.rad2deg(vector.rotation)) < 8.0
    assert abs(np.rad2deg(vector.direction) + 90.0) < 15.0
