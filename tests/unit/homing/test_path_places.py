"""The place on a path from what images have in common, without pictures: numbers of features."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from fgslam.core.homing import (
    BearingMatches,
    OmniFeatures,
    Refusal,
    RefusalReason,
    TwoViewVector,
)
from fgslam.frontend.features.omni import OmniFeatureExtractor
from fgslam.homing import places as path_places
from fgslam.homing.places import PathPlaces
from fgslam.homing.route import PathMemory
from fgslam.homing.settings import DRIVING
from fgslam.homing.steering import PathPlace
from tests import textured_room

ALONG = ((540, 278, 5, 0, 5, 33), (388, 380, 49, 0, 78, 87), (239, 418, 85, 54, 219, 137),
         (0, 0, 276, 449, 152, 60), (0, 82, 273, 294, 410, 170), (89, 186, 115, 79, 322, 275),
         (69, 127, 146, 75, 231, 365))  # fmt: skip
"""Features that images along a way of six path images have in common with each: measured with a
fisheye in the rendered house, on a way that ends in the room where it begins."""


def matches_of(count: int) -> BearingMatches:
    bearing = np.linspace(-3.0, 3.0, count)
    return BearingMatches(
        kind=np.zeros(count, np.int64),
        index_a=np.arange(count),
        index_b=np.arange(count),
        bearing_a=bearing,
        elevation_a=0.0 * bearing,
        bearing_b=bearing + 0.1,
        elevation_b=0.0 * bearing,
        sigma=np.ones((count, 4)),
        quality=np.ones(count),
    )


class World:
    """What images show: told by numbers, in place of comparing their features.

    A stand-in for ``compare_views``: it knows images and path images by their identity.

    Attributes:
        direction, doubt: of all homing vectors.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, some: OmniFeatures) -> None:
        self._some = some
        self.path = PathMemory.of([replace(self._some) for _ in ALONG[0]])
        self._seen: tuple[Sequence[int], Mapping[int, int]] = ((), {})
        self.direction, self.doubt = 0.3, 0.0
        self._step = 0
        monkeypatch.setattr(path_places, "compare_views", self._compare)

    def look(
        self, places: PathPlaces, inliers: Sequence[int], step: int, matched: Sequence[int] = ()
    ) -> PathPlace:
        """The place of an image with so many inliers at each path image and since the last one.

        Args:
            places: under test.
            inliers: as a row of ``ALONG``; 0 is a refusal.
            step: features in common with the image before.
            matched: matches without a homing vector at each path image.
        """
        self._seen, self._step = (inliers, dict(enumerate(matched))), step
        return places.look(replace(self._some))

    def _compare(
        self, _: OmniFeatures, target: OmniFeatures, *__: object
    ) -> tuple[TwoViewVector | Refusal, BearingMatches]:
        inliers, matched = self._seen
        node = next((k for k, one in enumerate(self.path.images) if one is target), None)
        common = self._step if node is None else inliers[node]
        if common == 0:
            count = 0 if node is None else matched.get(node, 0)
            return Refusal(RefusalReason.TOO_FEW_INLIERS, "few"), matches_of(count)
        found = np.ones(common, np.bool_)
        vector = TwoViewVector(self.direction, 0.1, np.eye(2) * 1e-4, found, 0, self.doubt)
        return vector, matches_of(common)


@pytest.fixture(scope="module")
def some() -> OmniFeatures:
    """Of any image: what they look like does not matter."""
    image = textured_room.picture(np.array([-2.0, 0.4, 0.0]))
    whole = OmniFeatureExtractor(textured_room.CAMERA, DRIVING.features).extract(image)
    return replace(whole, sift=whole.sift.select(np.arange(50)))


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch, some: OmniFeatures) -> World:
    return World(monkeypatch, some)


def test_a_robot_that_is_carried_off_doubts_at_once(world: World) -> None:
    """From the end into sight of it: the end explains what is seen, but not best."""
    places = PathPlaces(world.path, DRIVING)
    for k, row in enumerate(ALONG):
        before = world.look(places, row, 200 if k else 0)
    assert before.sure
    assert before.nearest == 5
    assert world.look(places, ALONG[1], 25).nearest <= 1
    there = world.look(places, ALONG[1], 210)
    assert there.sure
    assert there.nearest <= 1


def test_what_the_present_image_speaks_against_is_not_stated(world: World) -> None:
    """Carried off unnoticed, between two places that share as much as neighbouring images do."""
    places = PathPlaces(world.path, DRIVING)
    for k, row in enumerate(ALONG[4:]):
        world.look(places, row, 200 if k else 0)
    after = [world.look(places, ALONG[2], 200) for _ in range(5)]
    assert not any(place.sure and place.nearest > 3 for place in after)
    assert after[-1].sure
    assert after[-1].nearest == 1


def test_matches_alone_do_not_tell_that_it_is_the_route(world: World) -> None:
    """In another place one of many path images has the most matches, again and again."""
    places = PathPlaces(world.path, DRIVING)
    for _ in range(20):
        place = world.look(places, [0] * 6, 200, matched=[12, 40, 15, 9, 14, 11])
        assert place.probability < 0.5
        assert place.vector is None


def test_on_the_route_matches_tell_the_place_between_homing_vectors(world: World) -> None:
    places = PathPlaces(world.path, DRIVING)
    world.look(places, ALONG[3], 0)
    assert world.look(places, [0] * 6, 200, matched=[12, 9, 15, 60, 14, 11]).nearest == 3
    assert world.look(places, [0] * 6, 200, matched=[12, 9, 15, 10, 60, 11]).nearest >= 3
    assert world.look(places, [0] * 6, 200, matched=[12, 9, 15, 10, 60, 11]).nearest == 4


def test_the_first_direction_to_a_path_image_must_be_clear_or_be_seen_again(world: World) -> None:
    """Another one fits nearly as well; what agrees with clear ones before is taken at once."""
    clear, open_ = PathPlaces(world.path, DRIVING), PathPlaces(world.path, DRIVING)
    assert world.look(clear, ALONG[3], 0).vector is not None
    world.doubt = 0.3
    assert world.look(clear, ALONG[3], 200).vector is not None
    given = []
    for direction in (0.3, 2.0, 2.0, 2.0, 2.0):
        world.direction = direction
        place = world.look(open_, ALONG[3], 200)
        given.append(place.vector is not None)
    assert given == [False, False, False, True, True]
