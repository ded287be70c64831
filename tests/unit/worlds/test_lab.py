"""Drives in the places, what a place does not offer, and places as recordings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgslam.core import geometry
from fgslam.core.errors import ConfigError
from fgslam.datasets.rendered import RenderedLabSequence
from fgslam.worlds.driving import Drive
from fgslam.worlds.floor import FloorSpace
from fgslam.worlds.lab import (
    PATHS,
    PlaceChoice,
    build_place,
    first_pose,
    make_rig,
    place_path,
    plan_in_place,
)
from fgslam.worlds.patches import stack
from fgslam.worlds.renderer import RenderCache
from fgslam.worlds.settings import (
    LabDriveSettings,
    LabRigSettings,
    LabSettings,
    PathName,
    PlaceName,
    RandomPosesSettings,
    RenderedLabSettings,
)

RIG = make_rig(LabRigSettings(width=80, height=60))
ROOMS, CORRIDORS, LAB = PlaceChoice("rooms"), PlaceChoice("corridors"), PlaceChoice("lab")


def settings(path: PathName, laps: int = 1) -> LabDriveSettings:
    return LabDriveSettings(path=path, laps=laps, frames=None)


def planned(choice: PlaceChoice, path: PathName, laps: int = 1) -> Drive:
    return plan_in_place(choice, settings(path, laps), RIG)


@pytest.fixture(scope="module")
def office_space() -> FloorSpace:
    place = build_place(ROOMS)
    return FloorSpace(stack(place.things), place.low, place.high)


def random_poses(frames: int | None, **keys: int) -> LabDriveSettings:
    drawn = RandomPosesSettings(**keys)
    return LabDriveSettings(path="random_poses", frames=frames, random_poses=drawn)


def body(settings: LabDriveSettings, place: PlaceChoice = LAB) -> np.ndarray:
    drawn = plan_in_place(place, settings, RIG)
    return drawn.body_poses(drawn.timestamps)


def test_tour_is_closed_and_clear_of_everything(office_space: FloorSpace) -> None:
    drive = planned(ROOMS, "tour", 4)
    assert place_path("rooms", LabDriveSettings(path="tour", laps=4)).closed
    body = drive.body_poses(drive.timestamps)
    np.testing.assert_allclose(body[-1], body[0], atol=1e-9)
    for poses in (body, body @ RIG.bTc):
        assert office_space.clearance(poses[::5, :2, 3]).min() > 0.4


def test_first_round_comes_to_no_place_twice() -> None:
    path = place_path("rooms", settings("tour"))
    chosen = np.arange(0, len(path.arc), 100)
    arc, xy = path.arc[chosen], path.xy[chosen]
    far = np.abs(arc[:, None] - arc) > 12.0
    far &= np.abs(arc[:, None] - arc) < path.length - 12.0
    apart = np.linalg.norm(xy[:, None] - xy, axis=2)
    assert apart[far].min() > 3.0


def test_drives_of_the_corridors() -> None:
    assert place_path("corridors", settings("tour")).closed
    path = place_path("corridors", settings("one_way"))
    assert not path.closed
    assert np.linalg.norm(path.xy[-1] - path.xy[0]) > 6.0
    assert path.length > 3.0 * 24.0
    place = build_place(CORRIDORS)
    space = FloorSpace(stack(place.things), place.low, place.high)
    for drive in (planned(CORRIDORS, "tour"), planned(CORRIDORS, "one_way")):
        assert space.clearance(drive.planar(drive.timestamps)[::3, :2]).min() > 0.6


@pytest.mark.parametrize(
    ("place", "path"),
    [("lab", "tour"), ("rooms", "paper_loop"), ("rooms", "one_way"), ("corridors", "laps")],
)
def test_drive_that_a_place_has_not_is_refused(place: PlaceName, path: PathName) -> None:
    with pytest.raises(ConfigError, match=f"choose one of {PATHS[place][0]}"):
        place_path(place, settings(path))


@pytest.mark.parametrize(
    "choice",
    [replace(ROOMS, identical_posters=True), replace(CORRIDORS, visit=2), replace(ROOMS, visit=3)],
    ids=["posters", "visit", "rearranged"],
)
def test_what_a_place_has_not_is_refused(choice: PlaceChoice) -> None:
    with pytest.raises(ConfigError, match=r"means nothing|dataset\.visit [23]"):
        build_place(choice)


def test_world_is_the_start_of_the_drive_and_of_random_poses_that_of_the_places_own() -> None:
    own = first_pose("lab", settings("laps"))
    assert own[:2, 3] == pytest.approx([-1.8, -3.3])
    drawn = first_pose("lab", settings("random_poses"))
    assert drawn[:2, 3] == pytest.approx([-1.9, -1.16])


def test_robot_and_camera_keep_clear_in_all_headings_all_over_the_room() -> None:
    poses = body(random_poses(200))
    place = build_place(LAB)
    space = FloorSpace(stack(place.things), place.low, place.high)
    for points in (poses, poses @ RIG.bTc):
        assert space.clearance(points[:, :2, 3]).min() >= 0.4
    heading = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    assert np.histogram(heading, bins=4, range=(-np.pi, np.pi))[0].min() > 25
    assert (np.ptp(poses[:, :2, 3], axis=0) > 7.0).all()


def test_random_poses_differ() -> None:
    """How many poses there are changes none of them, another seed all."""
    many, few = body(random_poses(40)), body(random_poses(10))
    np.testing.assert_array_equal(many[:10], few)
    other = body(random_poses(10, seed=1))
    assert np.linalg.norm(other[:, :2, 3] - few[:, :2, 3], axis=1).min() > 1e-3


def test_bursts_go_straight_ahead() -> None:
    poses = body(random_poses(30, burst=3))
    steps = geometry.inverse(poses[:-1]) @ poses[1:]
    within = np.arange(1, 30) % 3 != 0
    ahead = np.tile(np.eye(4), (int(within.sum()), 1, 1))
    ahead[:, 0, 3] = 0.1
    np.testing.assert_allclose(steps[within], ahead, atol=1e-12)
    assert (np.linalg.norm(steps[~within, :3, 3], axis=1) > 0.2).all()


def test_places_that_cannot_be_driven_to_are_not_drawn() -> None:
    """The ring's inner square is empty floor behind walls."""
    poses = body(random_poses(150), CORRIDORS)
    inside = np.all((poses[:, :2, 3] > 1.2) & (poses[:, :2, 3] < 22.8), axis=1)
    assert not inside.any()


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        (random_poses(10, burst=3), "no multiple"),
        (random_poses(100, burst=100), "no place with room for .*burst 100"),
    ],
)
def test_poses_that_do_not_exist_are_refused(bad: LabDriveSettings, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        body(bad)


@pytest.fixture
def _unrendered(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The geometry of a recording without its images."""
    monkeypatch.setenv("FGSLAM_CACHE", str(tmp_path))
    monkeypatch.setattr(RenderCache, "present", lambda *_: True)


@pytest.mark.usefixtures("_unrendered")
def test_truth_is_in_the_world_of_the_mapping_drive() -> None:
    mapping = RenderedLabSequence(LabSettings(), 0)
    carried = RenderedLabSequence(LabSettings(drive=random_poses(6)), 0)
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
    carried = RenderedLabSequence(LabSettings(drive=random_poses(9, burst=3)), 0)
    known = [carried.odometry(i) is not None for i in range(9)]
    assert known == [False, True, True] * 3
    step = carried.odometry(1)
    assert step is not None
    assert step.motion[0, 3] == pytest.approx(0.1, abs=0.05)
    strided = RenderedLabSequence(LabSettings(drive=random_poses(9, burst=3)), 0, stride=2)
    assert [strided.odometry(i) is not None for i in range(5)] == [False, True, False, False, True]


@pytest.mark.parametrize(
    ("settings", "key"),
    [
        (LabSettings(), "418a16d402db4e1170ea"),
        (RenderedLabSettings(start=3, stop=9, stride=2), "418a16d402db4e1170ea"),
        (LabSettings(visit=2), "df6de2b8715b6bc84d72"),
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
