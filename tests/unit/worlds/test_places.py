"""Plans, furniture and what hangs where, in the lab, the office, the corridors and the house."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from fgslam.worlds import places
from fgslam.worlds.lab import PlaceChoice, build_place, make_rig, place_path
from fgslam.worlds.patches import RayCaster, Thing, stack
from fgslam.worlds.places import HOUSE, FloorPlan, Place, build_corridors, build_house, build_lab
from fgslam.worlds.settings import LabDriveSettings, LabRigSettings

RIG = make_rig(LabRigSettings(width=80, height=60))
ROOMS = PlaceChoice("rooms")
OFFICE = places.OFFICE
VISITS = (1, 2, 3)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def lab(visit: int) -> tuple[Thing, ...]:
    return build_lab(np.random.default_rng([0, 2]), visit).things


def corners(thing: Thing) -> np.ndarray:
    arrays = stack([thing])
    c, u, v = arrays.corner, arrays.edge_u, arrays.edge_v
    return np.concatenate([c, c + u, c + v, c + u + v])


def middle(thing: Thing) -> np.ndarray:
    """(3,) of its bounding box."""
    points = corners(thing)
    return 0.5 * (points.min(axis=0) + points.max(axis=0))


def same(a: Thing, b: Thing) -> bool:
    return a.name == b.name and all(
        np.array_equal(p.corner, q.corner) and p.surface.texture == q.surface.texture
        for p, q in zip(a.patches, b.patches, strict=True)
    )


def changed(first: Place, second: Place) -> set[str]:
    """Names of the things that differ between two visits."""
    pairs = zip(first.things, second.things, strict=True)
    return {a.name for a, b in pairs if not same(a, b)}


def rooms_at(plan: FloorPlan, x: float, y: float) -> list[str]:
    return [room.name for room in plan.rooms if room.holds(x, y)]


@pytest.fixture(scope="module")
def house() -> tuple[Thing, ...]:
    return build_house(rng(0)).things


@pytest.mark.parametrize("plan", [OFFICE, HOUSE], ids=["office", "house"])
def test_rooms_fill_the_building_without_overlap(plan: FloorPlan) -> None:
    assert sum(np.prod(room.size) for room in plan.rooms) == pytest.approx(plan.width * plan.depth)
    x, y = np.arange(0.1, plan.width, 0.2), np.arange(0.1, plan.depth, 0.2)
    for place in np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)[::7]:
        assert len(rooms_at(plan, *place)) == 1


@pytest.mark.parametrize("plan", [OFFICE, HOUSE], ids=["office", "house"])
def test_every_door_joins_two_rooms_and_every_room_has_one(plan: FloorPlan) -> None:
    joined = set()
    for door in plan.doors:
        across = np.array([0.0, 0.3]) if door.along_x else np.array([0.3, 0.0])
        sides = [np.array([door.x, door.y]) + side * across for side in (-1, 1)]
        names = {name for place in sides for name in rooms_at(plan, *place)}
        assert len(names) == 2, door
        joined |= names
    assert joined == {room.name for room in plan.rooms}


@pytest.mark.parametrize("build", [build_house, build_corridors, build_lab])
def test_same_seed_gives_the_same_place(build: Callable[[np.random.Generator], Place]) -> None:
    first, again, other = (build(rng(seed)) for seed in (0, 0, 1))
    assert not changed(first, again)
    assert [t for t in first.things if "shelf" in t.name] != []
    textures = [
        [p.surface.texture for t in place.things for p in t.patches] for place in (first, other)
    ]
    assert textures[0] != textures[1]


def test_second_visit_of_the_office_moves_chairs_and_cartons_only() -> None:
    moved = changed(build_place(ROOMS), build_place(replace(ROOMS, visit=2)))
    assert moved
    assert all(name.rsplit("_", 2)[-2] == "chair" or name.endswith("carton") for name in moved)


def test_all_furniture_stands_in_its_room(house: tuple[Thing, ...]) -> None:
    low, high = np.array([0.0, 0.0, 0.0]), np.array([HOUSE.width, HOUSE.depth, 2.7])
    for thing in house:
        for patch in thing.patches:
            corners = patch.corner + np.array(
                [0 * patch.edge_u, patch.edge_u, patch.edge_v, patch.edge_u + patch.edge_v]
            )
            assert (corners > low - 0.1).all(), thing.name
            assert (corners < high + 0.1).all(), thing.name


@pytest.mark.parametrize("build", [build_house, build_corridors, build_lab])
def test_lamps_hang_within_the_place(build: Callable[[np.random.Generator], Place]) -> None:
    place = build(rng())
    for corner in (place.lamps[:, 0, :2], place.lamps.sum(axis=1)[:, :2]):
        assert ((corner > place.low) & (corner < place.high)).all()


def test_each_leg_is_the_one_before_turned_by_a_quarter() -> None:
    place = build_corridors(rng())
    things, lamps = place.things, place.lamps
    legs = [[t for t in things if t.name.startswith(f"leg_{k}_")] for k in (1, 2, 3, 4)]
    assert len(lamps) % 4 == 0
    middle = np.array([24.0 / 2, 24.0 / 2, 0.0])
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for before, after in pairwise(legs):
        a, b = stack(before), stack(after)
        np.testing.assert_allclose((a.corner - middle) @ quarter.T + middle, b.corner, atol=1e-9)
        assert [s.texture for s in a.surfaces] == [s.texture for s in b.surfaces]


@pytest.mark.parametrize("visit", VISITS)
def test_things_are_inside_the_room_with_unique_names(visit: int) -> None:
    things = lab(visit)
    assert len({thing.name for thing in things}) == len(things)
    for thing in things:
        points = corners(thing)
        assert np.abs(points[:, :2]).max() <= places.HALF_SIDE + 1e-9, thing.name
        assert points[:, 2].min() >= -1e-9, thing.name
        assert points[:, 2].max() <= places.LAB_HEIGHT + 1e-9, thing.name


@pytest.mark.parametrize("visit", VISITS)
def test_things_stand_on_something(visit: int) -> None:
    """What does not stand on the floor rests on something, by a ray cast down from its bottom."""
    things = [t for t in lab(visit) if t.name.startswith(("carton", "chair", "plotter", "desk"))]
    for thing in things:
        points = corners(thing)
        low = points[:, 2].min()
        if low < 0.02 or thing.name.startswith("chair"):
            assert low < 0.06, thing.name
            continue
        middle = points[points[:, 2] < low + 1e-6][:, :2].mean(axis=0)
        foot = np.append(middle + 0.03, low + 5e-3)  # not on a seam of what lies below
        caster = RayCaster(stack(t for t in lab(visit) if t.name != thing.name))
        _, distance = caster.cast(foot, np.array([[0.0, 0.0, -1.0]], dtype=np.float32))
        assert distance[0] < 0.02, thing.name


@pytest.mark.parametrize("visit", VISITS)
@pytest.mark.parametrize("path", ["paper_loop", "laps"])
def test_paths_are_clear_for_a_robot_of_half_a_metre(visit: int, path: str) -> None:
    drive = LabDriveSettings(path=path, frames=None)  # type: ignore[arg-type]
    xy = place_path("lab", drive).xy[::50]
    solid = [t for t in lab(visit) if t.name not in ("floor", "ceiling")]
    caster = RayCaster(stack(solid))
    for height in (0.2, 0.6, 1.0):
        points = np.column_stack([xy, np.full(len(xy), height)])
        assert caster.distance(points).min() > 0.25


def test_second_visit_of_the_lab_moves_loose_things_only() -> None:
    moved = changed(*(build_place(PlaceChoice("lab", visit=visit)) for visit in (1, 2)))
    assert "chair" in moved
    assert 8 <= len(moved) <= 14
    assert all(name.startswith(("chair", "carton", "plotter")) for name in moved)


def test_identical_posters_change_one_poster_and_nothing_else() -> None:
    plain = lab(1)
    alike = build_lab(np.random.default_rng([0, 2]), 1, identical_posters=True).things
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
    first = {t.name: t for t in lab(1)}
    third = {t.name: t for t in lab(3)}
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
