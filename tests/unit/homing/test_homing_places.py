"""The place on a path from what images have in common, without pictures: numbers of features."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import textured_room

import fgslam as fg
from fgslam.cameras.omni import (
    Equirectangular,
    HyperbolicMirror,
    LensCamera,
    MirrorFrame,
    OmniCamera,
)
from fgslam.core.arrays import Image
from fgslam.core.bearings import BearingMatches, OmniFeatures, Refusal, RefusalReason, TwoViewVector
from fgslam.core.errors import StoredMapError
from fgslam.core.geometry import pose, so3_exp
from fgslam.frontend.features.omni import OmniFeatureExtractor
from fgslam.homing import places as path_places
from fgslam.homing.places import (
    LEFT_SIGMA,
    Continuity,
    PathPlaces,
    PictureSides,
    in_common,
    metric_place,
)
from fgslam.homing.route import MetricPoses, PathMemory
from fgslam.homing.settings import DRIVING
from fgslam.homing.steering import PathPlace

ALONG = ((540, 278, 5, 0, 5, 33), (388, 380, 49, 0, 78, 87), (239, 418, 85, 54, 219, 137),
         (0, 0, 276, 449, 152, 60), (0, 82, 273, 294, 410, 170), (89, 186, 115, 79, 322, 275),
         (69, 127, 146, 75, 231, 365))  # fmt: skip
"""Features that images along a way of six path images have in common with each: measured with a
fisheye in the rendered house, on a way that ends in the room where it begins."""


def matches_of(count: int, first: int = 0) -> BearingMatches:
    bearing = np.linspace(-3.0, 3.0, count)
    return BearingMatches(
        kind=np.zeros(count, np.int64),
        index_a=np.arange(count),
        index_b=first + np.arange(count),
        bearing_a=bearing,
        elevation_a=0.0 * bearing,
        bearing_b=bearing + 0.1,
        elevation_b=0.0 * bearing,
        sigma=np.ones((count, 4)),
        quality=np.ones(count),
    )


class World:
    """What images show: told by numbers, in place of comparing their features.

    A stand-in for ``compare_views``, which knows images and path images by their identity, and for
    ``vector_between``, which finds no more.

    Attributes:
        direction, rotation, doubt: of all homing vectors; from image to image it turns by 0.1.
        same: that each image sees the same features of path images; others else.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, some: OmniFeatures) -> None:
        self._some = some
        self.path = PathMemory.of([replace(self._some) for _ in ALONG[0]])
        self._seen: tuple[Sequence[int], Mapping[int, int]] = ((), {})
        self.direction, self.rotation, self.doubt = 0.3, 0.1, 0.0
        self._step, self._first, self.same = 0, 0, False
        monkeypatch.setattr(path_places, "compare_views", self._compare)
        monkeypatch.setattr(path_places, "vector_between", self._look_again)

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
        self._first += 0 if self.same else 1000
        return places.look(replace(self._some))

    def _look_again(
        self, image: OmniFeatures, target: OmniFeatures, *__: object, alone: bool
    ) -> tuple[TwoViewVector | Refusal, BearingMatches]:
        answer, matches = self._compare(image, target)
        if answer and self.doubt:
            answer = Refusal(RefusalReason.UNCERTAIN, "open")
        return answer, matches

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
        turn = 0.1 if node is None else self.rotation
        vector = TwoViewVector(self.direction, turn, np.eye(2) * 1e-4, found, 0, self.doubt)
        return vector, matches_of(common, self._first)


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


def test_one_path_image_alone_makes_no_place_known_but_keeps_it_known(world: World) -> None:
    """A corridor that is built twice is not alike at two path images one after the other."""
    lost, places = PathPlaces(world.path, DRIVING), PathPlaces(world.path, DRIVING)
    assert not any(world.look(lost, [0, 0, 60, 0, 0, 0], 200 if k else 0).sure for k in range(8))
    for k in range(3):
        assert not world.look(places, [0, 0, 60, 0, 0, 0], 200 if k else 0).sure
    assert world.look(places, [0, 0, 40, 60, 0, 0], 200).sure
    assert world.look(places, [0, 0, 0, 60, 0, 0], 200).sure
    assert not world.look(places, [0] * 6, 200, matched=[12, 9, 15, 60, 14, 11]).sure


def test_the_same_features_again_are_no_further_evidence(world: World) -> None:
    belief = []
    for world.same in (False, True):
        places = PathPlaces(world.path, DRIVING)
        for row in ([90, 70, 0, 0, 0, 0], [90, 70, 0, 0, 0, 0], *[[0, 0, 0, 0, 60, 0]] * 2):
            world.look(places, row, 200)
        belief.append(places.belief[4])
    assert belief[1] < 0.5 * belief[0]


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


def sigma_of(place: PathPlace) -> float:
    """Radians, of a direction."""
    assert place.vector is not None
    return float(np.sqrt(place.vector.covariance[0, 0]))


def test_sigma_covers_what_the_taught_triangle_and_earlier_images_miss(world: World) -> None:
    """The leg turns by 0.1, the vectors to its ends do not; in doubt 0.3 away from before."""
    places = PathPlaces(world.path, DRIVING)
    assert sigma_of(world.look(places, ALONG[3], 0)) == pytest.approx(np.hypot(0.01, 0.1))
    world.direction += 0.3
    assert sigma_of(world.look(places, ALONG[3], 200)) == pytest.approx(np.hypot(0.01, 0.1))
    world.direction, world.doubt = world.direction - 0.3, 0.5
    assert sigma_of(world.look(places, ALONG[3], 200)) == pytest.approx(np.hypot(0.01, 0.3))


def test_a_direction_that_is_wrong_by_half_a_turn_is_seen_by_the_turns_before(world: World) -> None:
    """Its way in the target's axes is right; the robot turned by 0.1 from image to image."""
    places, world.rotation = PathPlaces(world.path, DRIVING), 0.1
    assert world.look(places, ALONG[3], 0).vector is not None
    world.direction, world.rotation = 0.2, 0.0
    assert world.look(places, ALONG[3], 200).vector is not None
    world.direction, world.rotation, world.doubt = 0.1 + np.pi, -0.1 + np.pi, 0.3
    assert world.look(places, ALONG[3], 200).vector is None


# --------------------------------------------------------------------------------------------
# Whether a robot went on or was carried off: by what neighbouring images have in common


CHANCE, MOST = 0.02, 400


def after(steps: Iterable[int], common: int) -> float:
    """Probability of being carried off in one more step."""
    drive = Continuity(CHANCE)
    for one in steps:
        drive.carried_off(one, MOST)
    return drive.carried_off(common, MOST)


def test_few_features_in_common_after_many_is_being_carried_off() -> None:
    assert after([210, 180, 200, 190, 220, 205], 8) > 0.8
    assert after([210, 180, 200, 190, 220, 205], 170) < CHANCE


def test_a_drive_whose_images_share_little_is_no_alarm() -> None:
    """As on a dim floor with a panorama every few metres: some pairs share nothing."""
    assert after([150, 0, 20, 90, 0, 0, 30, 0, 120], 0) < 3.0 * CHANCE


def test_a_robot_that_stood_and_drives_on_was_not_carried_off() -> None:
    """Standing, images are nearly alike; from the first step on 0.6 of it is left."""
    assert after([390, 391, 389, 390] * 20, 230) < 0.5


def test_what_followed_a_leap_does_not_count_as_usual() -> None:
    """Carried off twice: the second time is noticed like the first."""
    usual = [200, 190, 210, 205, 195, 200, 190, 210]
    assert after([*usual, 5, *usual], 5) == pytest.approx(after([*usual, *usual], 5))
    assert after([*usual, 5, *usual], 5) > 0.9


def alarms(steps: Iterable[int]) -> list[bool]:
    """Of each step, whether the robot was rather carried off than not."""
    drive = Continuity(CHANCE)
    return [drive.carried_off(one, 1000) > 0.5 for one in steps]


@pytest.mark.parametrize(
    ("before", "lasting"),
    [
        ([900] * 25, [200] * 200),  # stood, and drives on
        ([300, 310, 290, 305, 295] * 5, [60, 55, 62, 58] * 50),  # faster, or the light went down
        ([900] * 25, [200, 900, 900] * 60),  # by fits and starts
        ([900] * 25, [200] * 30 + [900] * 3 + [200] * 30),  # a short stand more
    ],
)
def test_a_lasting_change_is_taken_as_usual_after_two_alarms(
    before: list[int], lasting: list[int]
) -> None:
    said = alarms([*before, *lasting])
    assert not any(said[: len(before)])
    assert sum(said) == sum(said[len(before) : len(before) + 5]) == 2


def test_carried_off_again_and_again_is_noticed_each_time() -> None:
    """Every seventh image, as by somebody who plays with the robot."""
    legs = [200, 190, 210, 205, 195, 200]
    said = alarms([*legs * 2, *[4, *legs] * 5])
    assert [k for k, one in enumerate(said) if one] == [12, 19, 26, 33, 40]


@pytest.mark.parametrize(
    ("reason", "common"), [(RefusalReason.AT_TARGET, 5), (RefusalReason.TOO_FEW_INLIERS, 0)]
)
def test_without_a_way_between_them_all_matches_are_common(
    reason: RefusalReason, common: int
) -> None:
    none = np.zeros(5)
    matches = BearingMatches(
        kind=np.zeros(5, np.int64),
        index_a=np.arange(5),
        index_b=np.arange(5),
        bearing_a=none,
        elevation_a=none,
        bearing_b=none,
        elevation_b=none,
        sigma=np.ones((5, 4)),
        quality=none,
    )
    assert in_common(Refusal(reason, ""), matches) == common


# --------------------------------------------------------------------------------------------
# Metres on a route whose images carry poses


def three_poses(sigma: float = 0.1) -> MetricPoses:
    """2 m apart along x, the last one unknown."""
    poses = np.stack(
        [pose(so3_exp(np.array([0.0, k, 0.0])), [2.0 * k, 0.0, 1.0]) for k in range(3)]
    )
    poses[2] = np.nan
    return MetricPoses(poses, np.repeat(sigma**2 * np.eye(6)[None], 3, axis=0))


def test_part_of_a_leg_becomes_metres_with_its_deviation() -> None:
    place = metric_place(three_poses(), 1, 0.25)
    assert place is not None
    np.testing.assert_allclose(place.position, [1.5, 0.0, 1.0], rtol=0, atol=1e-12)
    assert place.to_target == pytest.approx(0.5)
    assert place.sigma == pytest.approx(np.sqrt((2.0 * LEFT_SIGMA) ** 2 + 3 * 0.1**2))


@pytest.mark.parametrize(("target", "left"), [(0, 0.5), (1, np.nan), (2, 0.5)])
def test_what_is_not_known_has_no_metres(target: int, left: float) -> None:
    assert metric_place(three_poses(), target, left) is None
    assert metric_place(None, target, left) is None


def test_poses_survive_the_route_s_file_and_damage_is_refused(tmp_path: Path) -> None:
    from landmark_world import landmark_features

    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-3, 3, (60, 2)), np.full(60, 0.5)])
    images = tuple(landmark_features(points, np.zeros(3), 5.0, 0.0, rng) for _ in range(3))
    memory = PathMemory(images, ("a", "b", "c"), None, three_poses())
    memory.save(tmp_path / "r.fgpath")
    again = fg.PathMemory.load(tmp_path / "r.fgpath")
    assert again.metric is not None
    np.testing.assert_array_equal(again.metric.poses, three_poses().poses)
    np.testing.assert_array_equal(again.metric.covariances, three_poses().covariances)
    poses, covariances = three_poses().poses, three_poses().covariances
    for metric, words in (
        (MetricPoses(2.0 * poses, covariances), "one is no rigid motion"),
        (MetricPoses(poses, -covariances), "number 0 is no covariance"),
        (MetricPoses(poses[:2], covariances[:2]), "not one an image"),
    ):
        PathMemory(images, ("a", "b", "c"), None, metric).save(tmp_path / "bad.npz")
        with pytest.raises(StoredMapError, match=f"metric poses: {words}"):
            PathMemory.load(tmp_path / "bad.npz")


# --------------------------------------------------------------------------------------------
# Pictures that fit a route only mirrored or turned over are told, those that are right are not


FINE = textured_room.CAMERA
CAMERA = Equirectangular(301, 91, FINE.top_elevation, FINE.bottom_elevation)


def seen_at(metres: float) -> Image:
    pose = np.array([-2.0 + metres, 0.4, 0.0])
    return np.ascontiguousarray(textured_room.picture(pose)[::2, ::2])


@pytest.fixture(scope="module")
def path() -> PathMemory:
    return fg.teach([seen_at(metres) for metres in (0.5, 2.0)], CAMERA)


def told(path: PathMemory, turn: Callable[[Image], Image], count: int) -> list[str | None]:
    sides = PictureSides(CAMERA, path, DRIVING)
    found = [sides.look(turn(seen_at(0.3 + 0.5 * k))) for k in range(count)]
    assert not sides.settled
    return found


def test_three_pictures_tell_how_they_are_turned(path: PathMemory) -> None:
    over = "upside down: turn them by 180 degrees"
    assert told(path, lambda image: image[::-1, ::-1], 3) == [None, None, over]


def test_pictures_of_another_place_tell_nothing(path: PathMemory) -> None:
    noise = np.random.default_rng(3).integers(0, 255, (91, 301, 3), np.uint8)
    assert told(path, lambda _: noise, 2) == [None, None]


MIRROR = HyperbolicMirror(MirrorFrame(320, 240, (150.0, 120.0)), 15.0, 110.0, 0.92, 60.0)
MATRIX = (90.0, 0.0, 160.0, 0.0, 90.0, 120.0, 0.0, 0.0, 1.0)
FISHEYE = LensCamera(320, 240, "equidistant", MATRIX, (0.0,) * 4, (0.0, 110.0))


@pytest.mark.parametrize(("camera", "key"), [(MIRROR, "clockwise"), (FISHEYE, "middle")])
def test_a_cameras_keys_that_may_be_wrong_are_tried(
    path: PathMemory, camera: OmniCamera, key: str
) -> None:
    """The room as the other camera would see it, told by its key."""
    other = (
        replace(camera, up=True)
        if isinstance(camera, LensCamera)
        else replace(camera, frame=replace(camera.frame, clockwise=False))
    )
    columns, rows = np.meshgrid(np.arange(320.0), np.arange(240.0))
    seen = FINE.pixels(other.rays(np.column_stack([columns.ravel(), rows.ravel()])))
    inside = np.isfinite(seen).all(axis=1)
    sides, said = PictureSides(camera, path, DRIVING), None
    for metres in (0.4, 0.7, 1.8):
        room = textured_room.picture(np.array([-2.0 + metres, 0.4, 0.0]))
        image = np.zeros((320 * 240, 3), np.uint8)
        column, row = np.rint(seen[inside]).astype(int).T
        image[inside] = room[row, column]
        said = sides.look(image.reshape(240, 320, 3))
    assert said is not None
    assert key in said
