"""Routes from a film: which images become path images, what is kept, where images lie on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import textured_room
from landmark_world import no_columns
from simulated import assert_same_value

import fgslam as fg
from fgslam.cameras.omni import (
    Cylinder,
    Equirectangular,
    HyperbolicMirror,
    LensCamera,
    MirrorFrame,
    OmniCamera,
    RadialPolynomial,
)
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.bearings import BearingMatches, ColumnSegments, OmniFeatures, UprightFeatures
from fgslam.core.errors import ConfigError, StoredMapError
from fgslam.core.geometry import wrap
from fgslam.frontend.features.omni import OmniFeatureExtractor
from fgslam.homing.features import (
    MOST_COLUMNS,
    MOST_SIFT,
    CoarseFeatures,
    CoarseSift,
    Votes,
    best_all_around,
    compacted,
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
    PathMemory,
    Taught,
    Teacher,
)
from fgslam.homing.settings import DRIVING
from fgslam.homing.steering import HomingState

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


def test_of_columns_with_equal_votes_the_longest_are_kept() -> None:
    rng, most = np.random.default_rng(2), 2 * MOST_COLUMNS
    lengths = rng.permutation(most) / most
    columns = ColumnSegments(
        np.full(most, 0.1), np.full(most, 0.01), np.column_stack([-lengths, np.zeros(most)]),
        np.full((most, 2), 0.01), np.zeros((most, 11)),
    )  # fmt: skip
    kept = compacted(OmniFeatures(some_features(0, 0).sift, columns)).columns
    assert sorted(-kept.tangents[:, 0]) == sorted(lengths)[MOST_COLUMNS:]


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
    for before, after in zip(taught.memory.images, again.images, strict=True):
        assert_same_value(CoarseFeatures.of(after), CoarseFeatures.of(before))


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


# --------------------------------------------------------------------------------------------
# What is remembered of a path, and the file it is kept in


def some_features(seed: int, sift: int = 300, columns: int = 150) -> OmniFeatures:
    """Random ones of the sizes and ranges of real ones."""
    rng = np.random.default_rng(seed)
    spread = rng.normal(0.0, 0.004, (sift, 2, 2))
    found = UprightFeatures(
        pixels=rng.uniform(0.0, 300.0, (sift, 2)),
        bearing=rng.uniform(-np.pi, np.pi, sift),
        elevation=rng.uniform(-1.0, 1.0, sift),
        covariance=spread @ spread.transpose(0, 2, 1) + 1e-6 * np.eye(2),
        scale=rng.uniform(0.005, 0.2, sift),
        descriptors=rng.integers(0, 256, (sift, 128)).astype(np.uint8),
        colour=rng.uniform(0.8, 2.0, (sift, 3)),
    )
    segments = ColumnSegments(
        bearing=rng.uniform(-np.pi, np.pi, columns),
        sigma_bearing=rng.uniform(0.001, 0.02, columns),
        tangents=np.sort(rng.uniform(-1.0, 1.0, (columns, 2)), axis=1),
        sigma_tangents=rng.uniform(0.001, 0.02, (columns, 2)),
        descriptors=rng.normal(0.0, 1.0, (columns, 11)),
    )
    return OmniFeatures(found, segments)


EMPTY = OmniFeatures(some_features(0, 0).sift, no_columns())


def test_a_file_with_names_of_other_images_is_refused(tmp_path: Path) -> None:
    memory = PathMemory.of([EMPTY, EMPTY], ["a", "b"])
    replace(memory, names=("a",)).save(tmp_path / "path.npz")
    with pytest.raises(StoredMapError, match="not one name an image"):
        PathMemory.load(tmp_path / "path.npz")


def test_features_come_back_within_their_rounding(tmp_path: Path) -> None:
    """Descriptors to the bit, angles to half a step, deviations and sizes to 3 %."""
    memory = PathMemory.of([some_features(1), EMPTY, some_features(2, 40, 0)], ["a", "b", "ü"])
    memory.save(tmp_path / "path.npz")
    again = PathMemory.load(tmp_path / "path.npz")
    assert again.names == ("a", "b", "ü")
    assert [len(i.sift) for i in again.images] == [300, 0, 40]
    for before, after in zip(memory.images, again.images, strict=True):
        assert np.array_equal(after.sift.descriptors, before.sift.descriptors)
        assert after.sift.descriptors.dtype == np.uint8
        for name in ("bearing", "elevation"):
            given, read = getattr(before.sift, name), getattr(after.sift, name)
            assert read == pytest.approx(given, abs=0.5 * np.pi / 32767.0 + 1e-9)
            assert read.dtype == np.float64
        assert after.sift.scale == pytest.approx(before.sift.scale, rel=0.03)
        assert after.sift.colour == pytest.approx(before.sift.colour, rel=8e-3)
        sigma = np.sqrt(before.sift.covariance[:, [0, 1], [0, 1]])
        read_sigma = np.sqrt(after.sift.covariance[:, [0, 1], [0, 1]])
        assert read_sigma == pytest.approx(sigma, rel=0.03)
        assert _correlation(after.sift) == pytest.approx(_correlation(before.sift), abs=0.005)
        assert after.columns.bearing == pytest.approx(before.columns.bearing, abs=5e-5)
        assert after.columns.tangents == pytest.approx(before.columns.tangents, rel=7e-5)
        assert after.columns.descriptors == pytest.approx(before.columns.descriptors, rel=7e-5)


def _correlation(features: UprightFeatures) -> FloatArray:
    c = features.covariance
    return np.asarray(c[:, 0, 1] / np.sqrt(c[:, 0, 0] * c[:, 1, 1]))


CAMERAS = (
    Equirectangular(640, 320, 1.2, -1.1),
    Cylinder(640, 200, -0.8, 0.9),
    HyperbolicMirror(MirrorFrame(320, 240, (159.1, 118.7)), 20.0, 110.0, xi=0.92, focal_px=90.0),
    RadialPolynomial(MirrorFrame(320, 240, (160.0, 120.0), 0.3, False), 20.0, 110.0, (-0.9, 0.01)),
    LensCamera(
        *(320, 240, "ocam", (1.0, -0.002, 160.0, 0.001, 1.01, 120.0, 0.0, 0.0, 1.0)),
        distortion=(-60.0, 0.0, 0.006),
        ring=(20.0, 110.0),
    ),
)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda camera: type(camera).__name__)
def test_the_camera_comes_back_to_the_bit(tmp_path: Path, camera: OmniCamera) -> None:
    PathMemory.of([EMPTY], camera=camera).save(tmp_path / "path.npz")
    assert PathMemory.load(tmp_path / "path.npz").camera == camera


def test_no_pixels_are_kept(tmp_path: Path) -> None:
    """Neither the image's nor where features lay in it; a second saving changes nothing."""
    PathMemory.of([some_features(1)]).save(tmp_path / "one.npz")
    again = PathMemory.load(tmp_path / "one.npz")
    assert np.isnan(again.images[0].sift.pixels).all()
    again.save(tmp_path / "two.npz")
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "two.npz").read_bytes()
    # All that features have is kept, but for that.
    stored, whole = ({f.name for f in fields(kind)} for kind in (CoarseSift, UprightFeatures))
    assert whole - stored == {"pixels", "covariance"}
    assert stored - whole == {"spread", "correlation"}
