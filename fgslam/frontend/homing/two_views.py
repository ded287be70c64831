"""From the features of two images to the homing vector between their places (section III)."""

from __future__ import annotations

import numpy as np

from fgslam.core.homing import BearingMatches, OmniFeatures, Refusal, TwoViewVector
from fgslam.frontend.features.omni_settings import OmniMatchingSettings
from fgslam.frontend.homing.matching import match_features
from fgslam.frontend.homing.ransac import estimate_homing_vector
from fgslam.frontend.homing.settings import HomingVectorSettings


def vector_between(
    present: OmniFeatures,
    target: OmniFeatures,
    matching: OmniMatchingSettings,
    settings: HomingVectorSettings,
    rng: np.random.Generator,
) -> tuple[TwoViewVector | Refusal, BearingMatches]:
    """The homing vector from one image's place to another's, and the tentative matches.

    Args:
        present: features of the image where the robot is.
        target: of the one where it is to go.
        matching: of features.
        settings: of the search, and when it refuses.
        rng: chooses RANSAC's samples.
    """
    matches = match_features(present, target, matching)
    return estimate_homing_vector(matches, settings, rng), matches


def pair_generator(seed: int, a: int, b: int) -> np.random.Generator:
    """What RANSAC draws from for the pair of images (a, b), whichever process and order."""
    return np.random.default_rng((seed, a, b))
