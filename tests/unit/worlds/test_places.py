"""Places beside the lab: plans, their drives, corridors that look alike, identical posters."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from fgslam.core.errors import ConfigError
from fgslam.core.geometry import wrap
from fgslam.worlds.buildings import corridors as alike
from fgslam.worlds.buildings import office
from fgslam.worlds.buildings.lab import build_lab
from fgslam.worlds.driving import Drive, round_corners
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
from fgslam.worlds.patches import RayCaster, Surface, Thing, box, rectangle, stack
from fgslam.worlds.renderer import Layer, Renderer, bake, pinhole_view
from fgslam.worlds.settings import (
    LabDriveSettings,
    LabRigSettings,
    PathName,
    PlaceName,
)
from fgslam.worlds.textures import GreyBank

RIG = make_rig(LabRigSettings(width=80, height=60))
ROOMS = PlaceChoice("rooms", 0, 1, identical_posters=False)
CORRIDORS = PlaceChoice("corridors", 0, 1, identical_posters=False)
LAB = PlaceChoice("lab", 0, 1, identical_posters=False)


def settings(path: PathName, laps: int = 1) -> LabDriveSettings:
    return LabDriveSettings(path=path, laps=laps, frames=None)


def planned(choice: PlaceChoice, path: PathName, laps: int = 1) -> Drive:
    drive = plan_in_place(choice, settings(path, laps), RIG)
    assert isinstance(drive, Drive)
    return drive


@pytest.fixture(scope="module")
def office_space() -> FloorSpace:
    place = build_place(ROOMS)
    return FloorSpace(stack(place.things), place.low, place.high)


# ---------------------------------------------------------------- the office


def test_rooms_fill_the_building_without_overlap() -> None:
    plan = office.PLAN
    area = sum((r.east - r.west) * (r.north - r.south) for r in plan.rooms)
    assert area == pytest.approx(plan.width * plan.depth)
    grid = np.stack(np.meshgrid(np.arange(0.1, 36, 0.2), np.arange(0.1, 24, 0.2)), axis=-1)
    for x, y in grid.reshape(-1, 2)[::7]:
        assert sum(room.holds(x, y) for room in plan.rooms) == 1


def test_every_door_joins_two_rooms_and_every_room_has_one() -> None:
    plan, joined = office.PLAN, set()
    for door in plan.doors:
        across = np.array([0.0, 0.3]) if door.along_x else np.array([0.3, 0.0])
        sides = [plan.room_at(*(np.array([door.x, door.y]) + s * across)) for s in (-1, 1)]
        names = {room.name for room in sides if room is not None}
        assert len(names) == 2, door
        joined |= names
    assert joined == {room.name for room in plan.rooms}


def test_no_picture_of_the_office_hangs_twice() -> None:
    place = build_place(ROOMS)
    shown = [t.patches[0].surface.texture for t in place.things if "_picture_" in t.name]
    assert len(shown) > 90
    assert len(set(shown)) == len(shown)


def test_second_visit_moves_chairs_and_cartons_only() -> None:
    first = {t.name: t for t in build_place(ROOMS).things}
    second = {t.name: t for t in build_place(replace(ROOMS, visit=2)).things}
    assert first.keys() == second.keys()
    moved = {
        name
        for name, thing in first.items()
        if any(
            not np.array_equal(a.corner, b.corner)
            for a, b in zip(thing.patches, second[name].patches, strict=True)
        )
    }
    assert moved
    assert all(name.rsplit("_", 2)[-2] == "chair" or name.endswith("carton") for name in moved)


def test_tour_is_closed_and_clear_of_everything(office_space: FloorSpace) -> None:
    drive = planned(ROOMS, "tour", 4)
    assert drive.path.closed
    body = drive.body_poses(drive.timestamps)
    np.testing.assert_allclose(body[-1], body[0], atol=1e-9)
    for poses in (body, body @ RIG.bTc):
        assert office_space.clearance(poses[::5, :2, 3]).min() > 0.4


def test_tour_of_three_rounds_is_long_and_slow_enough() -> None:
    drive = planned(ROOMS, "tour", 3)
    assert drive.path.length > 200.0
    planar = drive.planar(drive.timestamps)
    assert np.linalg.norm(np.diff(planar[:, :2], axis=0), axis=1).max() <= 0.2
    turned = wrap(np.diff(planar[:, 2]))
    assert np.rad2deg(np.abs(turned)).max() <= 5.0
    assert len(planned(ROOMS, "tour", 4).timestamps) * 0.9 <= 2500


def test_first_round_comes_to_no_place_twice() -> None:
    path = place_path("rooms", settings("tour"))
    chosen = np.arange(0, len(path.arc), 100)
    arc, xy = path.arc[chosen], path.xy[chosen]
    far = np.abs(arc[:, None] - arc) > 12.0
    far &= np.abs(arc[:, None] - arc) < path.length - 12.0
    apart = np.linalg.norm(xy[:, None] - xy, axis=2)
    assert apart[far].min() > 3.0


def test_later_rounds_see_places_again_in_both_headings() -> None:
    path = place_path("rooms", settings("tour", 4))
    chosen = np.arange(0, len(path.arc), 100)
    arc, xy, heading = path.arc[chosen], path.xy[chosen], path.heading[chosen]
    again = (np.linalg.norm(xy[:, None] - xy, axis=2) < 0.3) & (arc[:, None] - arc > 20.0)
    turned = np.cos(heading[:, None] - heading)[again]
    assert (turned > 0.99).sum() > 50
    assert (turned < -0.99).sum() > 50


# ---------------------------------------------------------------- corridors that look alike


def test_each_leg_is_the_one_before_turned_by_a_quarter() -> None:
    things, lamps = alike.build_alike(np.random.default_rng(0))
    legs = [[t for t in things if t.name.startswith(f"leg_{k}_")] for k in (1, 2, 3, 4)]
    assert len(lamps) % 4 == 0
    middle = np.array([alike.SIDE / 2, alike.SIDE / 2, 0.0])
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for before, after in pairwise(legs):
        a, b = stack(before), stack(after)
        np.testing.assert_allclose((a.corner - middle) @ quarter.T + middle, b.corner, atol=1e-9)
        assert [s.texture for s in a.surfaces] == [s.texture for s in b.surfaces]


def test_array_sections_are_copies() -> None:
    things, _ = alike.build_alike(np.random.default_rng(0))
    first = stack(t for t in things if t.name.startswith("leg_1_section_1_"))
    for k in (2, 3, 4):
        other = stack(t for t in things if t.name.startswith(f"leg_1_section_{k}_"))
        shift = [(k - 1) * alike.SECTION, 0.0, 0.0]
        np.testing.assert_allclose(first.corner + shift, other.corner, atol=1e-9)
        assert [s.texture for s in first.surfaces] == [s.texture for s in other.surfaces]


def test_legs_look_alike_in_the_images() -> None:
    """A pose and its copy a leg on see the same but for chance in the dimness of corners."""
    rng = np.random.default_rng(0)
    place = build_place(CORRIDORS)
    patches = stack(place.things)
    names = {surface.texture for surface in patches.surfaces}
    bank = GreyBank(
        {name: rng.uniform(60, 200, (64, 64)).astype(np.float32) for name in sorted(names)}
    )
    caster = RayCaster(patches)
    light = bake(patches, caster, place.lamps, rng, 0.5, place.light_reach_m)
    layer = Layer(patches, caster, light, bank)
    renderer = Renderer(pinhole_view((RIG.height, RIG.width), RIG.fx, RIG.cx, RIG.cy), bank)
    turn = np.eye(4)
    turn[:3, :3] = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    turn[:2, 3] = [alike.SIDE, 0.0]
    body = np.eye(4)
    body[:2, 3] = [9.0, 0.1]
    here, there = (renderer.image(layer, pose @ RIG.bTc) for pose in (body, turn @ body))
    alike_by = np.abs(here - there).mean()
    body[0, 3] += 2.0
    elsewhere = renderer.image(layer, body @ RIG.bTc)
    assert alike_by < 0.1 * np.abs(here - elsewhere).mean()


def test_drives_of_the_corridors() -> None:
    there_and_back, one_way = planned(CORRIDORS, "tour"), planned(CORRIDORS, "one_way")
    assert there_and_back.path.closed
    assert not one_way.path.closed
    assert np.linalg.norm(one_way.path.xy[-1] - one_way.path.xy[0]) > alike.SECTION
    assert one_way.path.length > 3.0 * alike.SIDE
    place = build_place(CORRIDORS)
    space = FloorSpace(stack(place.things), place.low, place.high)
    for drive in (there_and_back, one_way):
        assert space.clearance(drive.planar(drive.timestamps)[::3, :2]).min() > 0.6


# ---------------------------------------------------------------- identical posters


def test_identical_posters_change_one_poster_and_nothing_else() -> None:
    plain = build_lab(np.random.default_rng([0, 2]), 1)
    alike = build_lab(np.random.default_rng([0, 2]), 1, identical_posters=True)
    different = [k for k, (a, b) in enumerate(zip(plain, alike, strict=True)) if not same(a, b)]
    assert [plain[k].name for k in different] == ["poster_8"]
    copy = alike[different[0]].patches[0]
    original = next(t for t in alike if t.name == "poster_2").patches[0]
    assert copy.surface is original.surface
    for edge in ("edge_u", "edge_v"):
        sizes = [np.linalg.norm(getattr(p, edge)) for p in (copy, original)]
        assert sizes[0] == pytest.approx(sizes[1])
    assert np.linalg.norm(copy.corner - original.corner) > 3.0
    assert abs(copy.corner[2] - original.corner[2]) < 1e-9


def test_rearranged_lab_keeps_everything_and_moves_the_big_things() -> None:
    first = {t.name: t for t in build_place(LAB).things}
    third = {t.name: t for t in build_place(replace(LAB, visit=3)).things}
    assert first.keys() == third.keys()
    moved = {name for name, thing in first.items() if not same(thing, third[name])}
    kinds = {name.rsplit("_", 1)[0] for name in moved}
    assert {"poster", "shelf", "carton", "island"} <= kinds
    assert not {"wall_north", "desk", "pinboard", "door"} & (kinds | moved)
    # Carried, not remade: an exchanged shelf stands upright in the other's place.
    for a, b in (("shelf_1", "shelf_4"), ("shelf_2", "shelf_9"), ("shelf_5", "shelf_6")):
        for old, new in ((a, b), (b, a)):
            was, now = (middle(t) for t in (first[old], third[new]))
            np.testing.assert_allclose(was[:2], now[:2], atol=0.05)
            assert middle(first[new])[2] == pytest.approx(middle(third[new])[2])


def middle(thing: Thing) -> np.ndarray:
    """(3,) of its bounding box."""
    arrays = stack([thing])
    c, u, v = arrays.corner, arrays.edge_u, arrays.edge_v
    points = np.concatenate([c, c + u, c + v, c + u + v])
    return 0.5 * (points.min(axis=0) + points.max(axis=0))


def same(a: Thing, b: Thing) -> bool:
    return a.name == b.name and all(
        np.array_equal(p.corner, q.corner) and p.surface.texture == q.surface.texture
        for p, q in zip(a.patches, b.patches, strict=True)
    )


# ---------------------------------------------------------------- what does not exist


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
    with pytest.raises(ConfigError, match=r"means nothing|nothing is ever moved|only the lab"):
        build_place(choice)


def test_world_is_the_start_of_the_drive_and_of_random_poses_that_of_the_places_own() -> None:
    own = first_pose("lab", settings("laps"))
    assert own[:2, 3] == pytest.approx([-1.8, -3.3])
    drawn = first_pose("lab", settings("random_poses"))
    assert drawn[:2, 3] == pytest.approx([-1.9, -1.16])


# ---------------------------------------------------------------- paths and light


def test_rounded_corners_start_and_end_where_the_corners_do() -> None:
    corners = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 4.0], [9.0, 8.0]])
    path = round_corners(corners, 2.0)
    np.testing.assert_allclose(path.xy[[0, -1]], corners[[0, -1]], atol=1e-5)
    np.testing.assert_allclose(path.heading[-1], np.pi / 4, atol=1e-9)
    assert not path.closed
    # Nowhere further from the corners' polyline than a corner is cut.
    assert np.abs(path.curvature).max() < 1.2


def test_corners_too_near_for_their_bends_are_refused() -> None:
    with pytest.raises(ValueError, match="too near"):
        round_corners(np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 1.0], [9.0, 1.0]]), 2.0)


def test_light_with_a_far_reach_is_light_without_one() -> None:
    grey = Surface("plain")
    patches = stack(
        [
            Thing("floor", (rectangle((-3, 3, 0), (6, 0, 0), (0, -6, 0), grey),)),
            Thing("box", tuple(box((-0.5, -0.5, 0.0), (0.5, 0.5, 0.8), grey))),
        ]
    )
    caster = RayCaster(patches)
    lamps = np.array([[[1.0, 0.0, 2.5], [0.5, 0, 0], [0, 0.5, 0]]])
    baked = {
        reach: bake(patches, caster, lamps, np.random.default_rng(1), 0.3, reach).values
        for reach in (None, 1e4, 3.0)
    }
    np.testing.assert_allclose(baked[1e4], baked[None], atol=1e-5)
    assert (baked[3.0] <= baked[None] + 1e-6).all()
    assert baked[3.0].mean() < 0.9 * baked[None].mean()
