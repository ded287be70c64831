"""The house's parts: wheelchair, range finders, free floor, reference paths, people, camera."""

import numpy as np
import pytest

from fgslam.cameras.omni.mirrors import HyperbolicMirror
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import CalibrationError, DatasetError
from fgslam.core.planar import between, wrap
from fgslam.worlds import house as house_world
from fgslam.worlds.buildings.house import DEPTH, PLAN, WIDTH, build_house
from fgslam.worlds.driving import wheelchair
from fgslam.worlds.driving.floor_space import FloorSpace
from fgslam.worlds.driving.reference_paths import PathPlanner
from fgslam.worlds.driving.wheelchair import RangeSensor, Wheelchair
from fgslam.worlds.house import (
    CameraTilt,
    camera_pose,
    exposed,
    make_house_camera,
    miscalibrated,
)
from fgslam.worlds.people import Walker
from fgslam.worlds.rendering.image_effects import noisy
from fgslam.worlds.rendering.patches import PatchArrays, RayCaster, Surface, Thing, box, stack
from fgslam.worlds.settings import (
    HouseCalibrationSettings,
    HouseCameraSettings,
    OmniHouseSettings,
)


@pytest.fixture
def exact_drive(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("SPEED_SCALE", "TURN_SCALE", "PULL_DEG_M", "SLIP_M_SQRT_M", "SLIP_DEG_SQRT_M"):
        monkeypatch.setattr(wheelchair, name, 0.0)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


# --------------------------------------------------------------------------------------------
# Wheelchair


def test_speed_follows_command_after_the_latency_and_within_limits() -> None:
    chair = Wheelchair(np.zeros(3), rng())
    chair.command(9.0, -9.0)
    speeds, turns = [], []
    for _ in range(200):
        chair.advance(0.01)
        speeds.append(chair.speed)
        turns.append(chair.turn_rate)
    waiting = round(wheelchair.LATENCY_S / 0.01)
    assert np.array_equal(speeds[:waiting], np.zeros(waiting))
    assert speeds[waiting] == pytest.approx(wheelchair.MAX_ACCELERATION_M_S2 * 0.01)
    assert np.diff(speeds).max() <= wheelchair.MAX_ACCELERATION_M_S2 * 0.01 + 1e-12
    assert max(speeds) == pytest.approx(wheelchair.MAX_SPEED_M_S)
    assert min(turns) == pytest.approx(-np.deg2rad(wheelchair.MAX_TURN_DEG_S))
    limit = np.deg2rad(wheelchair.MAX_TURN_ACCELERATION_DEG_S2) * 0.01
    assert np.abs(np.diff(turns)).max() <= limit + 1e-12


@pytest.mark.usefixtures("exact_drive")
def test_without_slip_it_drives_the_circle_of_its_command() -> None:
    chair = Wheelchair(np.array([1.0, 2.0, 0.4]), rng())
    chair.command(0.3, 0.2)
    chair.advance(5.0)
    first = chair.pose.copy()
    chair.advance(4.0)
    step = between(first, chair.pose)
    expected = 1.5 * np.array([np.sin(0.8), 1.0 - np.cos(0.8)])
    np.testing.assert_allclose(step[:2], expected, atol=1e-5)
    assert step[2] == pytest.approx(0.8)


def test_slip_has_the_stated_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """End points of 200 drives of 2 m scatter as the constants say."""
    monkeypatch.setattr(wheelchair, "LATENCY_S", 0.0)
    monkeypatch.setattr(wheelchair, "MAX_ACCELERATION_M_S2", 10.0)
    ends = []
    for seed in range(200):
        chair = Wheelchair(np.zeros(3), rng(seed))
        chair.command(0.5, 0.0)
        chair.advance(4.0)
        ends.append(chair.pose)
    heading = np.array(ends)[:, 2]
    way = np.linalg.norm(np.array(ends)[:, :2], axis=1)
    expected = np.deg2rad(np.hypot(2.0 * 1.0, 1.0 * np.sqrt(2.0)))
    # The standard error of a deviation from 200 samples is 5 %.
    assert heading.std() == pytest.approx(expected, rel=0.16)
    assert way.std() == pytest.approx(np.hypot(2.0 * 0.03, 0.02 * np.sqrt(2.0)), rel=0.16)
    assert abs(heading.mean()) < 4 * expected / 14


@pytest.mark.usefixtures("exact_drive")
def test_a_wall_stops_it_but_lets_it_turn_and_back_out() -> None:
    chair = Wheelchair(np.zeros(3), rng(), lambda place: bool(place[0] > 0.5))
    chair.command(0.5, 0.0)
    chair.advance(4.0)
    assert chair.collided
    assert 0.48 < chair.pose[0] <= 0.5
    chair.command(-0.3, 0.3)
    # Until the command takes effect it still pushes against the wall.
    chair.advance(0.2)
    chair.advance(1.8)
    assert not chair.collided
    assert chair.pose[0] < 0.3
    assert chair.pose[2] > 0.3


def test_steps_of_any_length_add_up() -> None:
    """Fifteen frames a second are no whole number of the integration's steps."""
    chair = Wheelchair(np.zeros(3), rng())
    for _ in range(150):
        chair.advance(1.0 / 15.0)
    assert chair.time == pytest.approx(10.0, abs=0.0051)


@pytest.mark.parametrize("speed", [np.nan, np.inf])
def test_commands_are_finite_and_time_goes_forwards(speed: float) -> None:
    chair = Wheelchair(np.zeros(3), rng())
    with pytest.raises(ValueError, match="not finite"):
        chair.command(speed, 0.0)
    with pytest.raises(ValueError, match="forwards"):
        chair.advance(0.0)


# --------------------------------------------------------------------------------------------
# House, free floor, paths


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


# --------------------------------------------------------------------------------------------
# Range finders, people, camera


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


def test_walker_goes_to_and_fro_and_waits_for_the_robot() -> None:
    route = np.array([[0.0, 0.0], [4.0, 0.0]])
    walker = Walker(route, 0.0)
    far = np.array([50.0, 50.0])
    places = []
    for _ in range(140):
        walker.advance(0.1, far)
        places.append(walker.stance().x)
    assert max(places) == pytest.approx(4.0, abs=0.1)
    assert min(places[60:]) == pytest.approx(0.0, abs=0.1)
    assert np.abs(np.diff(places)).max() <= 0.08 + 1e-9
    meeting = Walker(route, 1.0)
    for _ in range(10):
        meeting.advance(0.1, np.array([2.0, 0.0]))
    assert meeting.stance().x == pytest.approx(1.0, abs=0.05)
    for _ in range(20):
        meeting.advance(0.1, np.array([2.0, 0.0]))
    assert meeting.stance().x < 0.6


def test_tilt_is_bounded_and_leans_the_camera() -> None:
    tilt = CameraTilt(OmniHouseSettings(tilt_deg=2.0), rng(1))
    angles = np.rad2deg(tilt.angles(3.0))
    assert np.linalg.norm(angles) == pytest.approx(2.0)
    sway = CameraTilt(OmniHouseSettings(sway_deg=1.5), rng(1))
    seen = np.rad2deg([sway.angles(t) for t in np.linspace(0, 60, 600)])
    np.testing.assert_allclose(np.abs(seen).max(axis=0), 1.5, atol=0.01)
    pitched = camera_pose(np.array([1.0, 2.0, 0.5]), 1.2, np.array([0.0, 0.1]))
    # Pitch about the left axis is nose down.
    np.testing.assert_allclose(pitched[2, 0], -np.sin(0.1))
    np.testing.assert_allclose(pitched[:3, 3], [1.0, 2.0, 1.2])
    rolled: FloatArray = camera_pose(np.zeros(3), 1.2, np.array([0.1, 0.0]))
    np.testing.assert_allclose(rolled[2, 1], np.sin(0.1))


def test_a_wrong_calibration_is_off_by_what_is_asked_for() -> None:
    true = make_house_camera(HouseCameraSettings())
    assert isinstance(true, HyperbolicMirror)
    assert miscalibrated(true, HouseCalibrationSettings(), rng()) is true
    errors = HouseCalibrationSettings(mirror=0.05, centre_px=4.0)
    for seed in range(8):
        wrong = miscalibrated(true, errors, rng(seed))
        assert isinstance(wrong, HyperbolicMirror)
        assert abs(wrong.xi / true.xi - 1.0) == pytest.approx(0.05)
        assert abs(wrong.focal_px / true.focal_px - 1.0) == pytest.approx(0.05)
        moved = np.subtract(wrong.frame.centre, true.frame.centre)
        assert np.hypot(*moved) == pytest.approx(4.0)
        assert (wrong.inner_radius, wrong.outer_radius) == (true.inner_radius, true.outer_radius)


def test_a_panorama_has_no_mirror_to_be_wrong_about() -> None:
    camera = make_house_camera(HouseCameraSettings("equirectangular"))
    with pytest.raises(CalibrationError, match=r"dataset\.calibration: .* take mirror"):
        miscalibrated(camera, HouseCalibrationSettings(mirror=0.01), rng())


def test_exposure_and_noise() -> None:
    levels = np.full((3, 20_000), 100.0, np.float32)
    # The gain is 1.25; at a quarter of the wave's 20 s is its crest.
    np.testing.assert_allclose(exposed(levels, 0.2, 5.0), 100 * 1.25 * 1.2, rtol=1e-5)
    seen = noisy(levels, 2.0, (1, 2, 3))
    assert seen.std() == pytest.approx(2.0, rel=0.03)
    np.testing.assert_array_equal(seen, noisy(levels, 2.0, (1, 2, 3)))
    assert not np.array_equal(seen, noisy(levels, 2.0, (1, 2, 4)))
    np.testing.assert_array_equal(levels, np.full((3, 20_000), 100.0, np.float32))


def test_mirror_shows_its_elevations(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = make_house_camera(HouseCameraSettings())
    rays = camera.rays(
        np.indices((camera.height, camera.width)).reshape(2, -1)[::-1].T.astype(float)
    )
    elevation = np.rad2deg(np.arcsin(rays[np.isfinite(rays[:, 0]), 2]))
    assert elevation.max() == pytest.approx(15.0, abs=0.5)
    assert elevation.min() == pytest.approx(-65.0, abs=3.0)
    monkeypatch.setattr(house_world, "_MIRROR_XI", 0.5)
    monkeypatch.setattr(house_world, "_MIRROR_ELEVATIONS_DEG", (-65.0, 40.0))
    with pytest.raises(CalibrationError, match="below arcsin"):
        make_house_camera(HouseCameraSettings())
