"""The free floor, random poses all over it, reference paths, and range finders in the house."""

from pathlib import Path

import numpy as np
import pytest

from fgslam.core import geometry
from fgslam.core.errors import ConfigError, DatasetError
from fgslam.core.geometry import wrap
from fgslam.datasets.rendered import RenderedLabSequence
from fgslam.worlds.buildings.house import DEPTH, PLAN, WIDTH, build_house
from fgslam.worlds.driving import RangeSensor
from fgslam.worlds.floor import FloorSpace, PathPlanner
from fgslam.worlds.lab import PlaceChoice, build_place, make_rig, plan_in_place
from fgslam.worlds.patches import PatchArrays, RayCaster, Surface, Thing, box, stack
from fgslam.worlds.renderer import RenderCache
from fgslam.worlds.settings import (
    LabDriveSettings,
    LabRigSettings,
    LabSettings,
    RandomPosesSettings,
    RenderedLabSettings,
)

RIG = make_rig(LabRigSettings(width=32, height=24))
LAB = PlaceChoice("lab", 0, 1, identical_posters=False)


def drive(frames: int | None, **keys: float) -> LabDriveSettings:
    drawn = RandomPosesSettings(**keys)  # type: ignore[arg-type]
    return LabDriveSettings(path="random_poses", frames=frames, random_poses=drawn)


def body(settings: LabDriveSettings, place: PlaceChoice = LAB) -> np.ndarray:
    drawn = plan_in_place(place, settings, RIG)
    return drawn.body_poses(drawn.timestamps)


def test_robot_and_camera_keep_clear_in_all_headings_all_over_the_room() -> None:
    poses = body(drive(200))
    place = build_place(LAB)
    space = FloorSpace(stack(place.things), place.low, place.high)
    for points in (poses, poses @ RIG.bTc):
        assert space.clearance(points[:, :2, 3]).min() >= 0.4
    heading = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    assert np.histogram(heading, bins=4, range=(-np.pi, np.pi))[0].min() > 25
    assert (np.ptp(poses[:, :2, 3], axis=0) > 7.0).all()


def test_random_poses_differ() -> None:
    """How many poses there are changes none of them, another seed all."""
    many, few = body(drive(40)), body(drive(10))
    np.testing.assert_array_equal(many[:10], few)
    other = body(drive(10, seed=1))
    assert np.linalg.norm(other[:, :2, 3] - few[:, :2, 3], axis=1).min() > 1e-3


def test_without_frames_there_are_two_hundred_poses() -> None:
    assert len(body(drive(None))) == 200
    assert len(body(drive(None, burst=3))) == 600


def test_bursts_go_straight_ahead() -> None:
    poses = body(drive(30, burst=3))
    steps = geometry.inverse(poses[:-1]) @ poses[1:]
    within = np.arange(1, 30) % 3 != 0
    ahead = np.tile(np.eye(4), (int(within.sum()), 1, 1))
    ahead[:, 0, 3] = 0.1
    np.testing.assert_allclose(steps[within], ahead, atol=1e-12)
    assert (np.linalg.norm(steps[~within, :3, 3], axis=1) > 0.2).all()


def test_places_that_cannot_be_driven_to_are_not_drawn() -> None:
    """The ring's inner square is empty floor behind walls."""
    poses = body(drive(150), PlaceChoice("corridors", 0, 1, identical_posters=False))
    inside = np.all((poses[:, :2, 3] > 1.2) & (poses[:, :2, 3] < 22.8), axis=1)
    assert not inside.any()


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        (drive(10, burst=3), "no multiple"),
        (drive(100, burst=100), "no place with room for .*burst 100"),
    ],
)
def test_poses_that_do_not_exist_are_refused(bad: LabDriveSettings, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        body(bad)


# ---------------------------------------------------------------- as a recording


@pytest.fixture
def _unrendered(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The geometry of a recording without its images."""
    monkeypatch.setenv("FGSLAM_CACHE", str(tmp_path))
    monkeypatch.setattr(RenderCache, "present", lambda *_: True)


@pytest.mark.usefixtures("_unrendered")
def test_truth_is_in_the_world_of_the_mapping_drive() -> None:
    mapping = RenderedLabSequence(LabSettings(), 0)
    carried = RenderedLabSequence(LabSettings(drive=drive(6)), 0)
    np.testing.assert_array_equal(carried.room_from_world, mapping.room_from_world)
    np.testing.assert_allclose(mapping.ground_truth.poses[0], np.eye(4), atol=1e-12)
    room = carried.room_from_world @ carried.ground_truth.poses
    np.testing.assert_allclose(room, carried.room_from_camera(carried.timestamps), atol=1e-12)


@pytest.mark.usefixtures("_unrendered")
def test_which_frames_are_used_is_no_part_of_a_recording_s_identity() -> None:
    """So that a run can go on with the frames after those that its map was made of."""

    def identity(**selection: int) -> str:
        settings = RenderedLabSettings(**selection)
        used = settings.start, settings.stop, settings.stride
        return RenderedLabSequence(settings, 0, *used).identity

    assert identity() == identity(stop=4) == identity(start=4, stop=9, stride=2)
    assert identity() != identity(room_seed=9)


@pytest.mark.usefixtures("_unrendered")
def test_no_odometry_is_given_where_the_robot_was_carried() -> None:
    carried = RenderedLabSequence(LabSettings(drive=drive(9, burst=3)), 0)
    known = [carried.odometry(i) is not None for i in range(9)]
    assert known == [False, True, True] * 3
    step = carried.odometry(1)
    assert step is not None
    assert step.motion[0, 3] == pytest.approx(0.1, abs=0.05)
    strided = RenderedLabSequence(LabSettings(drive=drive(9, burst=3)), 0, stride=2)
    assert [strided.odometry(i) is not None for i in range(5)] == [False, True, False, False, True]


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        (LabSettings(), "23b8a10e304c4be44dc4"),
        (RenderedLabSettings(start=3, stop=9, stride=2), "23b8a10e304c4be44dc4"),
        (LabSettings(visit=2), "31858c82fd4d4a0de238"),
    ],
    ids=["paper", "selection", "visit"],
)
@pytest.mark.usefixtures("_unrendered")
def test_cache_keys_of_the_lab_do_not_change_with_later_settings(
    settings: LabSettings, key: str, tmp_path: Path
) -> None:
    assert cache_key(settings, tmp_path) == key


def cache_key(settings: LabSettings, cache: Path) -> str:
    """The name of the folder that a recording's frames are kept in."""
    before = set(cache.iterdir())
    RenderedLabSequence(settings, 0)
    (made,) = set(cache.iterdir()) - before
    return made.name.removeprefix("lab-")


@pytest.mark.usefixtures("_unrendered")
def test_other_places_and_posters_have_other_cache_keys(tmp_path: Path) -> None:
    drives = {
        "rooms": LabDriveSettings(path="tour", frames=None),
        "corridors": LabDriveSettings(path="tour", frames=None),
    }
    for settings in (
        LabSettings(),
        LabSettings(posters="identical"),
        *(LabSettings(place=name, drive=d) for name, d in drives.items()),  # type: ignore[arg-type]
        LabSettings(drive=drive(9)),
        LabSettings(drive=drive(9, seed=1)),
    ):
        assert len(cache_key(settings, tmp_path)) == 20  # a folder that no other settings made


# --------------------------------------------------------------------------------------------
# The house's floor and paths


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.fixture(scope="module")
def house() -> tuple[Thing, ...]:
    return build_house(rng(0))[0]


@pytest.fixture(scope="module")
def patches(house: tuple[Thing, ...]) -> PatchArrays:
    return stack(house)


@pytest.fixture(scope="module")
def space(patches: PatchArrays) -> FloorSpace:
    return FloorSpace(patches, np.zeros(2), np.array([WIDTH, DEPTH]))


def textures(patches: PatchArrays) -> list[str]:
    return [surface.texture for surface in patches.surfaces]


def test_same_seed_gives_the_same_house(house: tuple[Thing, ...], patches: PatchArrays) -> None:
    again = stack(build_house(rng(0))[0])
    np.testing.assert_array_equal(again.corner, patches.corner)
    assert textures(again) == textures(patches)
    other = stack(build_house(rng(1))[0])
    assert textures(other) != textures(patches)


def test_some_picture_hangs_in_every_room(house: tuple[Thing, ...]) -> None:
    for name in ("painting_0", "poster_0"):
        rooms = {
            thing.name.split("_")[0]
            for thing in house
            if "picture" in thing.name and thing.patches[0].surface.texture == name
        }
        assert len(rooms) >= 5


def test_all_furniture_stands_in_its_room(house: tuple[Thing, ...]) -> None:
    low, high = np.array([0.0, 0.0, 0.0]), np.array([WIDTH, DEPTH, 2.7])
    for thing in house:
        for patch in thing.patches:
            corners = patch.corner + np.array(
                [0 * patch.edge_u, patch.edge_u, patch.edge_v, patch.edge_u + patch.edge_v]
            )
            assert (corners > low - 0.1).all(), thing.name
            assert (corners < high + 0.1).all(), thing.name


def test_clearance_is_the_distance_to_a_box() -> None:
    things = [Thing("box", tuple(box((1.0, 1.0, 0.0), (2.0, 2.0, 0.8), Surface("any"))))]
    high = [Thing("lintel", tuple(box((0.0, 0.0, 2.1), (3.0, 3.0, 2.4), Surface("any"))))]
    space = FloorSpace(stack(things + high), np.zeros(2), np.array([3.0, 3.0]))
    points = np.array([[0.5, 1.5], [2.4, 2.3], [1.5, 0.9]])
    np.testing.assert_allclose(space.clearance(points), [0.5, 0.5, 0.1], atol=1e-12)
    assert space.line_is_free(
        np.array([0.4, 0.4]), np.array([[0.4, 2.6], [2.6, 2.6]]), 0.3
    ).tolist() == [
        True,
        False,
    ]


@pytest.mark.parametrize("within", [None, "hall"])
@pytest.mark.parametrize("spacing", [2.0, 3.0, 4.0])
def test_reference_path_is_drivable(space: FloorSpace, spacing: float, within: str | None) -> None:
    planner = PathPlanner(space, 0.55)
    rooms = set()
    for seed in range(5):
        poses = planner.reference_path(spacing, 10, rng(seed), within)
        assert poses.shape == (11, 3)
        step = np.diff(poses[:, :2], axis=0)
        np.testing.assert_allclose(np.linalg.norm(step, axis=1), spacing)
        heading = np.arctan2(step[:, 1], step[:, 0])
        np.testing.assert_allclose(wrap(heading - poses[:-1, 2]), 0.0, atol=1e-12)
        part = np.linspace(0.0, 1.0, 25)[:, None]
        for start, move in zip(poses[:-1, :2], step, strict=True):
            assert space.clearance(start + part * move).min() > 0.52
        names = {room.name for x, y, _ in poses if (room := PLAN.room_at(x, y))}
        assert within is None or names == {within}
        rooms |= names
    np.testing.assert_array_equal(poses, planner.reference_path(spacing, 10, rng(4), within))
    assert within is not None or len(rooms) >= 4


def test_impossible_path_is_refused(space: FloorSpace) -> None:
    with pytest.raises(DatasetError, match=r"no path of 60 legs of 8\.0 m .* in the hall; lower"):
        PathPlanner(space, 0.9).reference_path(8.0, 60, rng(), "hall")


def make_sensor(noise: float, patches: PatchArrays) -> RangeSensor:
    return RangeSensor(RayCaster(patches), noise)


def test_scan_agrees_with_the_floors_outlines(patches: PatchArrays, space: FloorSpace) -> None:
    """No beam ends before the nearest obstacle; the nearest beam ends close to it."""
    sensor = make_sensor(0.0, patches)
    for pose in PathPlanner(space, 0.55).reference_path(2.0, 4, rng(3)):
        angles, ranges = sensor.scan(pose, np.empty((0, 3)), rng())
        clearance = space.clearance(pose[None, :2])[0]
        assert ranges.min() > clearance - 1e-5
        ends = pose[:2] + ranges[:, None] * np.column_stack(
            [np.cos(angles + pose[2]), np.sin(angles + pose[2])]
        )
        hit = ranges < 5.0
        assert np.median(space.clearance(ends[hit])) < 0.02


def test_scan_sees_people_with_noise_and_nothing_beyond_its_range(patches: PatchArrays) -> None:
    sensor = make_sensor(0.02, patches)
    pose = np.array([10.0, 8.7, 0.0])
    disc = np.array([[11.5, 8.7, 0.3]])
    ahead = [sensor.scan(pose, disc, rng(seed))[1][0] for seed in range(300)]
    assert np.mean(ahead) == pytest.approx(1.2, abs=0.005)
    assert np.std(ahead) == pytest.approx(0.02, rel=0.2)
    angles, ranges = sensor.scan(pose, np.empty((0, 3)), rng())
    assert angles[0] == 0.0
    assert ranges[0] == 5.0
