"""Wrong matches on purpose, and images that say nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from homing import two_views

from fgslam.cameras.omni import Equirectangular
from fgslam.core.bearings import FeatureKind, Refusal, RefusalReason
from fgslam.homing.front_end import ImageFrontEnd, mixed_with_wrong, surest_all_around
from fgslam.homing.settings import FrontEndSettings


def front_end() -> ImageFrontEnd:
    return ImageFrontEnd(Equirectangular(256, 128), FrontEndSettings(), np.random.default_rng(0))


def test_share_of_wrong_matches_is_as_asked_and_none_is_right() -> None:
    views = two_views(0, 70)
    kinds = np.where(np.arange(70) < 40, int(FeatureKind.SIFT), int(FeatureKind.COLUMN))
    matches = dataclasses.replace(views.matches, kind=kinds)
    mixed = mixed_with_wrong(matches, 0.3, np.random.default_rng(1))
    added = mixed.select(np.arange(70, len(mixed)))
    assert len(added) / len(mixed) == pytest.approx(0.3, abs=0.01)
    assert not np.any(added.index_a == added.index_b)
    of_b = dict(zip(matches.index_b.tolist(), matches.kind.tolist(), strict=True))
    assert [of_b[k] for k in added.index_b.tolist()] == added.kind.tolist()


@pytest.mark.parametrize(
    ("level", "reason"),
    [(0, RefusalReason.TOO_DARK), (5, RefusalReason.TOO_DARK), (128, RefusalReason.NO_FEATURES)],
)
def test_dark_and_blank_images_are_refused(level: int, reason: RefusalReason) -> None:
    robot = front_end()
    rng = np.random.default_rng(2)
    target = robot.describe(rng.integers(0, 255, (128, 256, 3)).astype(np.uint8))
    answer = robot.begin(np.full((128, 256, 3), level, dtype=np.uint8), target, 0.0)
    assert isinstance(answer, Refusal)
    assert answer.reason is reason


def test_points_are_chosen_from_all_directions_the_surest_first() -> None:
    bearing = np.concatenate([np.linspace(0.1, 0.6, 30), [1.0, 2.0, 3.0, -0.5, -1.0, -2.0, -3.0]])
    quality = np.concatenate([np.linspace(0.9, 0.5, 30), np.full(7, 0.1)])
    views = two_views(0, 37)
    matches = dataclasses.replace(views.matches, bearing_a=bearing, quality=quality)
    chosen = surest_all_around(matches, 10)
    assert set(range(30, 37)) <= set(chosen.tolist())  # every other direction has its say
    np.testing.assert_array_equal(chosen[:3], [0, 1, 2])
    np.testing.assert_array_equal(surest_all_around(matches, 100), np.arange(37))
