"""The rendered house as a whole: images, targets, driving, truth, panoramas."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from fgslam.worlds.driving import RADIUS_M
from fgslam.worlds.house import OmniWorld
from fgslam.worlds.settings import (
    HouseCameraSettings,
    HousePathSettings,
    OmniHouseSettings,
)

SETTINGS = OmniHouseSettings(path=HousePathSettings(legs=3, spacing_m=2.0))
DISTURBED = replace(SETTINGS, people=3, tilt_deg=1.0)


@pytest.fixture(scope="module")
def world() -> OmniWorld:
    return OmniWorld(SETTINGS, 1)


def count_sift(image: np.ndarray) -> int:
    return len(cv2.SIFT_create().detect(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None))


def test_pictures_have_texture_and_colour(world: OmniWorld) -> None:
    assert len(world.targets) == len(world.target_poses) == 3
    for image in world.targets:
        assert image.shape == (240, 320, 3)
        assert count_sift(image) > 100
        inside = image[image.max(axis=2) > 12].astype(float)
        assert 50.0 < inside.mean() < 160.0
        colourful = np.ptp(inside, axis=1) / inside.max(axis=1) > 0.25
        assert colourful.mean() > 0.15


def test_same_seed_and_commands_give_the_same_bytes() -> None:
    first, second, other = (OmniWorld(DISTURBED, seed) for seed in (7, 7, 8))
    for k in range(6):
        turn = 0.3 * (-1) ** k
        for one in (first, second, other):
            one.drive(0.4, turn, 0.1)
        # Looking twice, or not at all, changes nothing of what follows.
        if k == 2:
            first.image(first.time)
    assert np.array_equal(first.true_pose, second.true_pose)
    assert not np.array_equal(first.true_pose, other.true_pose)
    assert np.array_equal(first.image(first.time), second.image(second.time))
    assert np.array_equal(first.targets[1], second.targets[1])
    for a, b in zip(first.scan(), second.scan(), strict=True):
        assert np.array_equal(a, b)
    # A new drive from the start is the first one over again.
    after = first.image(first.time)
    first.put(first.reference_poses[0])
    for k in range(6):
        first.drive(0.4, 0.3 * (-1) ** k, 0.1)
    assert np.array_equal(first.image(first.time), after)


def test_targets_were_taken_at_another_time(world: OmniWorld) -> None:
    """From the same pose: another picture, though of the same place."""
    world.put(world.target_poses[0])
    now, then = world.image(0.0).astype(float), world.targets[0].astype(float)
    assert 2.0 < np.abs(now - then).mean() < 30.0
    assert np.corrcoef(now.ravel(), then.ravel())[0, 1] > 0.9
    assert 0.7 * now.mean() < then.mean() < now.mean()
    again = world.image(0.1).astype(float)
    noise = (again - now)[np.minimum(now, again).min(axis=2) > 30]
    assert noise.std() == pytest.approx(np.sqrt(2.0) * SETTINGS.noise_grey, rel=0.1)
    world.put(world.reference_poses[0])


def test_truth_of_matches(world: OmniWorld) -> None:
    """What a pixel shows from one place is found from another, and looks alike there."""
    a, b = world.reference_poses[:2]
    rng = np.random.default_rng(3)
    pixels = rng.uniform((50.0, 10.0), (270.0, 230.0), (2000, 2))
    points = world.points(a, pixels)
    valid = np.isfinite(points).all(axis=1)
    back, shows = world.seen(a, points[valid])
    np.testing.assert_allclose(back[shows], pixels[valid][shows], atol=1e-7)
    assert shows.mean() > 0.98
    there, seen = world.seen(b, points[valid])
    assert 0.3 < seen.mean() < 1.0
    colours = []
    for pose, where in ((a, pixels[valid][seen]), (b, there[seen])):
        column, row = np.rint(where).astype(int).T
        colours.append(world.picture(pose, 0).astype(float)[row, column])
    difference = np.abs(colours[0] - colours[1]).mean(axis=1)
    shuffled = np.abs(colours[0] - rng.permutation(colours[1])).mean(axis=1)
    assert np.median(difference) < 0.35 * np.median(shuffled)


def test_wheelchair_is_stopped_by_furniture_and_walls(world: OmniWorld) -> None:
    world.put(world.reference_poses[0])
    least, ran_into = np.inf, False
    for _ in range(300):
        world.drive(0.5, 0.0, 0.1)
        least = min(least, float(world.clearance(world.true_pose[None, :2])[0]))
        ran_into |= world.collided
    assert ran_into
    assert least > RADIUS_M - 0.01
    assert world.time == pytest.approx(30.0)
    world.put(world.reference_poses[0])
    assert world.time == 0.0


def test_people_walk_about() -> None:
    peopled = OmniWorld(replace(DISTURBED, tilt_deg=0.0, noise_grey=0.0), 2)
    empty = OmniWorld(replace(SETTINGS, noise_grey=0.0), 2)
    alone = empty.image(0.0).astype(int)
    changed = []
    for _ in range(30):
        peopled.drive(0.0, 0.0, 1.0)
        changed.append((np.abs(peopled.image(0.0) - alone) > 30).any(axis=2).mean())
    # Somebody comes by, nobody blocks the view, and they do not stand still.
    assert 0.004 < max(changed) < 0.5
    assert np.std(changed) > 0.0005


def test_panorama_camera_takes_pictures_of_its_size() -> None:
    settings = replace(SETTINGS, camera=HouseCameraSettings("equirectangular", width=256))
    picture = OmniWorld(settings, 0).picture(np.array([8.0, 3.0, 0.0]), 1000)
    assert picture.shape == (128, 256, 3)
    assert count_sift(picture) > 50
