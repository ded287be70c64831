"""Routes from a film: which images become path images, what is kept, where images lie on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fgslam as fg
from fgslam.cameras.omni import Equirectangular
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.errors import ConfigError, StoredMapError
from fgslam.core.homing import BearingMatches, OmniFeatures
from fgslam.core.planar import wrap
from fgslam.frontend.features.omni import OmniFeatureExtractor
from fgslam.homing.features import (
    MOST_COLUMNS,
    MOST_SIFT,
    Votes,
    best_all_around,
    compacted,
    pack_features,
)
from fgslam.homing.places import PathPlaces
from fgslam.homing.route import (
    BEND,
    COMMON,
    END,
    FULL,
    GAP,
    PARALLAX_DEG,
    START,
    Taught,
    Teacher,
)
from fgslam.homing.settings import DRIVING
from fgslam.homing.steering import HomingState
from tests import textured_room

FINE = textured_room.CAMERA
CAMERA = Equirectangular(301, 91, FINE.top_elevation, FINE.bottom_elevation)
"""Every other pixel of the room's."""
STEP_M = 0.3


def picture(pose: FloatArray) -> Image:
    """What it sees from a planar pose (3,)."""
    return np.ascontiguousarray(textured_room.picture(pose)[::2, ::2])


def at(metres: float) -> FloatArray:
    """(3,) pose on a straight way through the room, looking along it."""
    return np.array([-2.0 + metres, 0.4, 0.0])


@pytest.fixture(scope="module")
def film() -> list[Image]:
    return [picture(at(k * STEP_M)) for k in range(13)]


def taught_from(images: Sequence[Image]) -> Taught:
    teacher = Teacher(CAMERA, DRIVING)
    for k, image in enumerate(images):
        if k >= teacher.next or k == len(images) - 1:
            teacher.take(k, f"image {k}", image)
    return teacher.finish()


@pytest.fixture(scope="module")
def taught(film: list[Image]) -> Taught:
    return taught_from(film)


# --------------------------------------------------------------------------------------------
# What is kept


def test_the_best_of_each_sector_come_in_turn() -> None:
    """Two sectors with features, one of them crowded: half of what is kept is of each."""
    bearing = np.concatenate([np.full(90, 0.1), np.full(10, 3.3)])
    chosen = best_all_around(bearing, np.arange(100), 16, 8)
    assert chosen.tolist() == [*range(8), *range(90, 98)]
    assert best_all_around(bearing, np.arange(100), 200, 8).tolist() == list(range(100))


def test_features_that_neighbours_show_are_kept_first(film: list[Image]) -> None:
    whole = OmniFeatureExtractor(CAMERA, DRIVING.features).extract(film[0])
    assert len(whole.sift) > MOST_SIFT + 50
    weakest = np.argsort(whole.sift.bearing)[:: len(whole.sift) // 20]
    votes = Votes.none(whole).plus(_matches_of(weakest, len(whole.sift)), 1.0, second=True)
    kept = compacted(whole, votes)
    assert len(kept.sift) == MOST_SIFT
    assert len(kept.columns) <= MOST_COLUMNS
    assert np.isin(whole.sift.bearing[weakest], kept.sift.bearing).all()


def _matches_of(rows: FloatArray, count: int) -> BearingMatches:
    n, none = len(rows), np.zeros(len(rows))
    return BearingMatches(
        kind=np.zeros(n, np.int64),
        index_a=np.zeros(n, np.int64),
        index_b=rows.astype(np.int64),
        bearing_a=none,
        elevation_a=none,
        bearing_b=none,
        elevation_b=none,
        sigma=np.ones((n, 4)),
        quality=none,
    )


def test_rounded_descriptors_compare_nearly_as_before(film: list[Image]) -> None:
    """Distances of square roots, unit vectors: three bits move them by 0.1 of 1.4 at most."""
    whole = OmniFeatureExtractor(CAMERA, DRIVING.features).extract(film[0])
    most = replace(whole, sift=whole.sift.select(np.arange(MOST_SIFT)))
    kept = compacted(most)
    for name in ("bearing", "elevation", "scale"):
        assert np.array_equal(getattr(kept.sift, name), getattr(most.sift, name))
    before, after = (_roots(one) for one in (most, kept))
    apart = np.linalg.norm(before - after, axis=1)
    assert 0.0 < apart.mean() < 0.15
    assert len(np.unique(kept.sift.descriptors)) <= 16


def _roots(image: OmniFeatures) -> FloatArray:
    values = image.sift.descriptors.astype(np.float64)
    return np.asarray(np.sqrt(values / values.sum(axis=1, keepdims=True)))


def test_a_path_image_takes_at_most_20_kilobytes(taught: Taught, tmp_path: Path) -> None:
    assert taught.memory.save(tmp_path / "route.fgpath") <= 20.0
    again = fg.PathMemory.load(tmp_path / "route.fgpath")
    assert again.camera == CAMERA
    assert again.names == taught.memory.names
    first, second = pack_features(taught.memory.images), pack_features(again.images)
    assert all(np.array_equal(first[name], second[name]) for name in first)


# --------------------------------------------------------------------------------------------
# Which images


def test_few_images_are_chosen_and_each_shares_enough_with_the_last(taught: Taught) -> None:
    rows = taught.rows
    assert 2 <= len(rows) <= 6
    assert len(rows) == len(taught.memory)
    assert rows[0].reason == START
    assert rows[-1].reason == END
    assert {row.reason for row in rows[1:-1]} <= {FULL}
    for row in rows[1:-1]:
        assert row.common >= COMMON
        assert row.parallax_deg >= PARALLAX_DEG
        assert abs(row.direction_deg) < 3.0  # straight on
    assert rows[-1].number == 12
    assert taught.seen <= 13


def test_a_leg_ends_where_the_way_bends() -> None:
    """Straight from begin to end of an L it would be 0.6 m off the way at the corner."""
    corner = np.array([-0.8, -1.0])
    there = [np.array([corner[0] - 0.3 * k, corner[1], 0.0]) for k in range(4, 0, -1)]
    on = [np.array([corner[0], corner[1] + 0.3 * k, 1.5]) for k in range(5)]
    rows = taught_from([picture(pose) for pose in (*there, *on)]).rows
    assert [row.reason for row in rows] == [START, BEND, END]
    place = np.array([*there, *on])[rows[1].number]
    assert np.hypot(*(place[:2] - corner)) < 0.31  # one step of the robot


def test_images_of_one_place_are_one_path_image(film: list[Image]) -> None:
    assert len(taught_from([film[0]] * 4).memory) == 1


def test_a_leap_is_a_gap_that_is_named() -> None:
    """From one place to another that shares nothing with it."""
    noise = np.random.default_rng(0).integers(0, 255, (4, *picture(at(0.0)).shape), np.uint8)
    taught = taught_from([picture(at(0.0)), picture(at(0.1)), *noise])
    reasons = [row.reason for row in taught.rows]
    assert reasons[0] == START
    assert GAP in reasons
    assert taught.rows[1].refusal


def test_dark_images_are_passed_over_and_nothing_else_is_no_path(film: list[Image]) -> None:
    dark = np.zeros_like(film[0])
    taught = taught_from([dark, film[0], dark, film[3]])
    assert next(row.number for row in taught.rows) == 1
    assert len(taught.unusable) == 2
    with pytest.raises(StoredMapError, match="no image that can be used"):
        taught_from([dark])


def test_the_library_selects_as_the_command_does(film: list[Image], taught: Taught) -> None:
    path = fg.teach(film, CAMERA, select=True, names=[f"image {k}" for k in range(len(film))])
    assert path.names == taught.memory.names
    with pytest.raises(StoredMapError, match="2 names"):
        fg.teach(film[:4], CAMERA, select=True, names=["a", "b"])


# --------------------------------------------------------------------------------------------
# Following: each image looked at


def test_each_image_finds_its_place_and_the_next_path_image(taught: Taught) -> None:
    """Straight through the room, beside the taught way: next is ahead, the end is noticed."""
    numbers = np.array([row.number for row in taught.rows]) * STEP_M
    last = len(numbers) - 1
    follower = fg.PathFollower(CAMERA, taught.memory, by="looks")
    for k, metres in enumerate(np.arange(0.05, numbers[-1], 0.6)):
        pose = at(float(metres)) + np.array([0.0, 0.06, 0.3])
        command = follower.step(picture(pose), 0.5 * k)
        place = command.place
        assert place is not None
        assert abs(place.nearest - np.argmin(np.abs(numbers - metres))) <= 1
        if place.vector is None or metres > numbers[-1] - 0.4:
            continue
        goal = at(float(numbers[place.target]))
        true = np.arctan2(goal[1] - pose[1], goal[0] - pose[0]) - pose[2]
        assert place.target == last or numbers[place.target] > metres - 0.1
        assert abs(wrap(np.array(place.vector.direction - true))) < np.deg2rad(6.0)
        assert command.heading == place.vector.direction
    for extra in range(4):
        end = follower.step(picture(at(float(numbers[-1]))), 100.0 + extra)
    assert follower.finished
    assert end.state is HomingState.ARRIVED
    assert end.homing.stop
    after = follower.step(picture(at(float(numbers[-1]) + 0.1)), 200.0)  # a recording may go on
    assert after.state is HomingState.ARRIVED
    assert after.place is not None
    assert after.place.nearest == last


def test_the_end_is_said_by_who_passes_it_and_not_by_who_stops_short(taught: Taught) -> None:
    """Images a step apart, beside the taught way: none is at the end itself."""
    numbers = np.array([row.number for row in taught.rows]) * STEP_M
    places = PathPlaces(taught.memory, DRIVING)
    extract = OmniFeatureExtractor(CAMERA, DRIVING.features).extract
    said = []
    for before_end in (1.4, 1.0, 0.6, 0.05):
        pose = at(float(numbers[-1]) - before_end) + np.array([0.0, 0.06, 0.2])
        said.append(places.look(extract(picture(pose))).reached)
    assert said == [False, False, False, True]


def test_a_robot_put_down_anywhere_knows_its_place_after_a_few_images(taught: Taught) -> None:
    """And again after it was carried back."""
    numbers = np.array([row.number for row in taught.rows]) * STEP_M
    follower = fg.PathFollower(CAMERA, taught.memory, by="looks")
    time = 0.0
    for metres in (numbers[-1] - 0.3, 0.2):
        for _ in range(4):
            command = follower.step(picture(at(float(metres))), time)
            time += 0.2
        assert command.place is not None
        assert command.place.sure
        assert abs(command.place.nearest - np.argmin(np.abs(numbers - metres))) <= 1


def test_another_place_is_never_sure(taught: Taught) -> None:
    follower = fg.PathFollower(CAMERA, taught.memory, by="looks")
    noise = np.random.default_rng(1).integers(0, 255, (3, *picture(at(0.0)).shape), np.uint8)
    for k, image in enumerate(noise):
        command = follower.step(image, float(k))
        assert command.v == 0.0
        assert command.homing.stop
        assert command.reason
        assert command.homing.refusal is not None


def test_an_unknown_way_to_follow_is_refused(taught: Taught) -> None:
    with pytest.raises(ConfigError, match="'tracks' or 'looks'"):
        fg.PathFollower(CAMERA, taught.memory, by="luck")  # type: ignore[arg-type]
