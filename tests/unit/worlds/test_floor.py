"""Clearances of the free floor, reference paths and range finders in the house."""

import numpy as np
import pytest

from fgslam.core.errors import DatasetError
from fgslam.core.geometry import wrap
from fgslam.worlds.driving import RangeSensor
from fgslam.worlds.floor import FloorSpace, PathPlanner
from fgslam.worlds.patches import PatchArrays, RayCaster, Surface, Thing, box, stack
from fgslam.worlds.places import HOUSE, build_house


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.fixture(scope="module")
def patches() -> PatchArrays:
    return stack(build_house(rng(0)).things)


@pytest.fixture(scope="module")
def space(patches: PatchArrays) -> FloorSpace:
    return FloorSpace(patches, np.zeros(2), np.array([HOUSE.width, HOUSE.depth]))


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


@pytest.mark.parametrize("spacing", [2.0, 4.0])
def test_reference_path_is_drivable(space: FloorSpace, spacing: float) -> None:
    planner = PathPlanner(space, 0.55)
    rooms = set()
    for seed in range(5):
        poses = planner.reference_path(spacing, 10, rng(seed))
        assert poses.shape == (11, 3)
        step = np.diff(poses[:, :2], axis=0)
        np.testing.assert_allclose(np.linalg.norm(step, axis=1), spacing)
        heading = np.arctan2(step[:, 1], step[:, 0])
        np.testing.assert_allclose(wrap(heading - poses[:-1, 2]), 0.0, atol=1e-12)
        part = np.linspace(0.0, 1.0, 25)[:, None]
        for start, move in zip(poses[:-1, :2], step, strict=True):
            assert space.clearance(start + part * move).min() > 0.52
        rooms |= {room.name for x, y, _ in poses for room in HOUSE.rooms if room.holds(x, y)}
    np.testing.assert_array_equal(poses, planner.reference_path(spacing, 10, rng(4)))
    assert len(rooms) >= 4


def test_impossible_path_is_refused(space: FloorSpace) -> None:
    with pytest.raises(DatasetError, match=r"no path of 60 legs of 19\.0 m .* in the house; lower"):
        PathPlanner(space, 0.55).reference_path(19.0, 60, rng())


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
