import sys

import numpy as np
import pytest

from fgslam.worlds.buildings.lab import HALF_SIDE, HEIGHT, build_lab
from fgslam.worlds.lab import make_rig
from fgslam.worlds.patches import RayCaster, Thing, stack
from fgslam.worlds.people import across_view, person
from fgslam.worlds.settings import LabDriveSettings, LabRigSettings
from fgslam.worlds.textures import PHOTOGRAPHS, book_row, build_library, photograph
from tests.simulated import plan_drive

VISITS = (1, 2, 3)


def lab(visit: int) -> tuple[Thing, ...]:
    return build_lab(np.random.default_rng([0, 2]), visit)


def corners(thing: Thing) -> np.ndarray:
    arrays = stack([thing])
    c, u, v = arrays.corner, arrays.edge_u, arrays.edge_v
    return np.concatenate([c, c + u, c + v, c + u + v])


@pytest.mark.parametrize("visit", VISITS)
def test_things_are_inside_the_room_with_unique_names(visit: int) -> None:
    things = lab(visit)
    assert len({thing.name for thing in things}) == len(things)
    for thing in things:
        points = corners(thing)
        assert np.abs(points[:, :2]).max() <= HALF_SIDE + 1e-9, thing.name
        assert points[:, 2].min() >= -1e-9, thing.name
        assert points[:, 2].max() <= HEIGHT + 1e-9, thing.name


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
    drive = plan_drive(LabDriveSettings(path=path, frames=None))  # type: ignore[arg-type]
    solid = [t for t in lab(visit) if t.name not in ("floor", "ceiling")]
    caster = RayCaster(stack(solid))
    for height in (0.2, 0.6, 1.0):
        points = np.column_stack([drive.path.xy[::50], np.full(len(drive.path.xy[::50]), height)])
        assert caster.distance(points).min() > 0.25


def test_second_visit_moves_loose_things_only() -> None:
    moved = []
    for before, after in zip(lab(1), lab(2), strict=True):
        assert before.name == after.name
        a, b = corners(before), corners(after)
        if not np.array_equal(a, b):
            moved.append(before.name)
    assert "chair" in moved
    assert 8 <= len(moved) <= 14
    assert all(name.startswith(("chair", "carton", "plotter")) for name in moved)


@pytest.mark.slow
def test_textures_repeat_exactly_from_their_seed() -> None:
    once, again = (build_library(np.random.default_rng(5)) for _ in range(2))
    assert list(once) == list(again)
    for name, texture in once.items():
        np.testing.assert_array_equal(texture, again[name])
        assert texture.dtype == np.float32
        assert all(side & (side - 1) == 0 for side in texture.shape), name
        assert 0.0 < texture.min() <= texture.max() < 255.0, name
    rows = [book_row(np.random.default_rng(seed), 64, 256) for seed in (5, 6)]
    assert not np.array_equal(*rows)


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_photographs_are_in_the_wheel(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pooch", None)
    image = photograph(name, 64)
    assert image.shape == (64, 64)
    assert image.std() > 5.0


def test_person_walks_through_the_middle_of_the_view() -> None:
    drive, rig = plan_drive(LabDriveSettings()), make_rig(LabRigSettings())
    walk = across_view(10.0, 15.0, drive, rig)
    assert walk.stance(9.99) is None
    assert walk.stance(15.01) is None
    camera = (drive.body_poses(np.array([12.5])) @ rig.bTc)[0]
    stance = walk.stance(12.5)
    assert stance is not None
    point = (np.array([stance.x, stance.y, camera[2, 3]]) - camera[:3, 3]) @ camera[:3, :3]
    np.testing.assert_allclose(point, [0.0, 0.0, 1.8], atol=1e-9)
    first, last = walk.stance(10.0), walk.stance(15.0)
    assert first is not None
    assert last is not None
    for end, sign in ((first, 1.0), (last, -1.0)):
        x = (np.array([end.x, end.y, 0.0]) - camera[:3, 3]) @ camera[:3, 0]
        assert sign * x > 2.0 * np.tan(np.deg2rad(30.0)) + 0.3


def test_person_stands_on_the_floor_with_a_head_of_human_height() -> None:
    drive, rig = plan_drive(LabDriveSettings()), make_rig(LabRigSettings())
    walk = across_view(10.0, 15.5, drive, rig)
    spread = []
    for seconds in np.linspace(walk.begins, walk.ends, 9):
        stance = walk.stance(float(seconds))
        assert stance is not None
        points = corners(person(stance))
        assert points[:, 2].max() == pytest.approx(1.78)
        assert -0.05 < points[:, 2].min() < 0.2
        legs = points[points[:, 2] < 0.3]
        spread.append(np.ptp(legs[:, :2], axis=0).max())
    assert max(spread) > min(spread) + 0.2
