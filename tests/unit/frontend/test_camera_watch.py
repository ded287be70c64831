"""A camera that is late, frozen, swapped or darker is found out within frames; a sound one never.

Faults are put into sound recordings: the rendered lab, and a real road.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import fgslam as fg
from fgslam.core.arrays import Image
from fgslam.core.sensors import CAMERA_NAMES, CameraRig
from fgslam.core.store import restore, state_of
from fgslam.frontend.camera_faults import CameraWatch, Lag, LagModel, LineRows

BEGINS = 12  # the fault
SOON = 10  # frames until it is found
FRAMES = BEGINS + SOON + 2
Images = tuple[Image, ...]
Fault = Callable[[list[Images], int], Images]


def frames_of(recording: fg.Recording, count: int = FRAMES) -> list[Images]:
    """Images in the order right, left[, top]."""
    found = [recording[k][1] for k in range(count)]
    assert all(images is not None for images in found)
    return [(x[1], x[0], *x[2:]) for x in found if x is not None]


@pytest.fixture(scope="module")
def lab() -> tuple[CameraRig, list[Images]]:
    recording = fg.rendered_recording("lab", frames=FRAMES)
    return recording.rig, frames_of(recording)


@pytest.fixture(scope="module")
def road(shared_data: Path) -> tuple[CameraRig, list[Images]]:
    recording = fg.open_recording(shared_data / "kitti06")
    return recording.rig, frames_of(recording)


def noisy(image: Image, seed: int) -> Image:
    """No image of a real sensor is another one's equal."""
    drawn = np.random.default_rng(seed).normal(0.0, 2.0, image.shape)
    return np.clip(np.rint(image + drawn), 0, 255).astype(np.uint8)


def with_one(images: Images, camera: int, image: Image) -> Images:
    return tuple(image if k == camera else one for k, one in enumerate(images))


def late(camera: int) -> Fault:
    return lambda frames, k: with_one(frames[k], camera, noisy(frames[k - 1][camera], k))


def frozen(camera: int) -> Fault:
    return lambda frames, k: with_one(frames[k], camera, noisy(frames[BEGINS][camera], k))


def stuck(camera: int) -> Fault:
    return lambda frames, k: with_one(frames[k], camera, frames[BEGINS - 1][camera])


def swapped(frames: list[Images], k: int) -> Images:
    return (frames[k][1], frames[k][0], *frames[k][2:])


def darker(camera: int) -> Fault:
    return lambda frames, k: with_one(frames[k], camera, (0.7 * frames[k][camera]).astype(np.uint8))


def watched(
    rig: CameraRig, frames: list[Images], fault: Fault, until: int | None = None
) -> tuple[list[str], CameraWatch]:
    """What is said of each frame; the fault lasts from ``BEGINS`` on, ``until`` the frame."""
    watch = CameraWatch(rig)
    end = len(frames) if until is None else until
    said = [
        watch.look(fault(frames, k) if BEGINS <= k < end else frames[k]) for k in range(len(frames))
    ]
    return said, watch


def assert_found(said: list[str], name: str) -> None:
    """Silence before the fault, the camera by name within ten frames, and to the end."""
    assert not any(said[:BEGINS])
    first = next(k for k, words in enumerate(said) if words)
    assert first < BEGINS + SOON
    assert all(f"the {name} camera" in words for words in said[first + 1 :])


@pytest.mark.parametrize("camera", range(3))
@pytest.mark.parametrize("fault", [late, frozen, stuck])
def test_an_old_image_is_found_in_the_lab(
    lab: tuple[CameraRig, list[Images]], fault: Callable[[int], Fault], camera: int
) -> None:
    said, _ = watched(*lab, fault(camera))
    assert_found(said, CAMERA_NAMES[camera])


@pytest.mark.data
@pytest.mark.parametrize("camera", range(2))
@pytest.mark.parametrize("fault", [late, frozen, stuck])
def test_an_old_image_is_found_on_a_real_road(
    road: tuple[CameraRig, list[Images]], fault: Callable[[int], Fault], camera: int
) -> None:
    said, _ = watched(*road, fault(camera))
    assert_found(said, CAMERA_NAMES[camera])


def test_swapped_cameras_are_found_in_the_lab(lab: tuple[CameraRig, list[Images]]) -> None:
    said, _ = watched(*lab, swapped)
    assert not any(said[:BEGINS])
    assert all("right and the left camera are swapped" in words for words in said[BEGINS + 1 :])


@pytest.mark.data
def test_swapped_cameras_are_found_on_a_real_road(road: tuple[CameraRig, list[Images]]) -> None:
    said, _ = watched(*road, swapped)
    assert not any(said[:BEGINS])
    assert all("right and the left camera are swapped" in words for words in said[BEGINS + 1 :])


@pytest.mark.parametrize("camera", range(3))
def test_a_darker_camera_is_said_and_its_frames_are_used(
    lab: tuple[CameraRig, list[Images]], camera: int
) -> None:
    said, watch = watched(*lab, darker(camera))
    assert not any(said)
    remarks = watch.remarks()
    assert len(remarks) == (2 if camera == 0 else 1)  # a dark reference differs from both others
    assert "more than a third of a stop" in remarks[0]
    assert watched(*lab, darker(camera), until=BEGINS)[1].remarks() == ()


@pytest.mark.data
@pytest.mark.parametrize("camera", range(2))
def test_a_darker_camera_is_said_on_a_real_road(
    road: tuple[CameraRig, list[Images]], camera: int
) -> None:
    said, watch = watched(*road, darker(camera))
    assert not any(said)
    assert "more than a third of a stop" in watch.remarks()[0]


def test_one_repeated_image_costs_one_frame(lab: tuple[CameraRig, list[Images]]) -> None:
    said, _ = watched(*lab, stuck(1), until=BEGINS + 1)
    assert [k for k, words in enumerate(said) if words] == [BEGINS]
    assert said[BEGINS] == "the left camera delivers the image of the frame before once more"


def test_a_camera_that_has_recovered_is_used_again(lab: tuple[CameraRig, list[Images]]) -> None:
    said, _ = watched(*lab, late(2), until=BEGINS + 5)
    assert any(said)
    assert not any(said[-3:])


def test_watching_goes_on_where_it_stopped(lab: tuple[CameraRig, list[Images]]) -> None:
    rig, frames = lab
    fault = late(1)
    whole, _ = watched(rig, frames, fault)
    for stop in (1, BEGINS, BEGINS + 1, BEGINS + 3):
        first, then = CameraWatch(rig), CameraWatch(rig)
        given = [fault(frames, k) if k >= BEGINS else frames[k] for k in range(len(frames))]
        said = [first.look(images) for images in given[:stop]]
        restore(then, state_of(first))
        assert said + [then.look(images) for images in given[stop:]] == whole
        np.testing.assert_equal(state_of(first), state_of(first))


SOUND = (
    "kitti06",
    "kitti_raw_0926_5hz",
    "euroc_v101_kf100",
    "euroc_v101_raw",
    "stanford_chess_grid",
    "rgbd_fr1",
    "stereo_raw/euroc_V1_01_cut",
    "stereo_raw/kimera_test_pairs/ForStereoFrame",
    "bumblebee2_pairs",
    "bags/converted_from_euroc/euroc_ros1.bag",
    "bags/converted_from_euroc/euroc_ros2_mcap",
    "bags/converted_from_euroc/euroc_ros2_sqlite3",
)


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("name", SOUND)
def test_no_sound_recording_gives_an_alarm(shared_data: Path, name: str) -> None:
    recording = fg.open_recording(shared_data / name)
    watch = CameraWatch(recording.rig)
    said = [watch.look(images) for images in frames_of(recording, len(recording))]
    assert not any(said)
    assert watch.remarks() == ()


@pytest.mark.slow
def test_the_whole_lab_gives_no_alarm() -> None:
    recording = fg.rendered_recording("lab")
    watch = CameraWatch(recording.rig)
    assert not any(watch.look(images) for images in frames_of(recording, len(recording)))
    assert watch.remarks() == ()


# --------------------------------------------------------------------------------------------
# The lag of points whose lines are known


RIG = CameraRig(320, 240, 277.0, 277.0, 159.5, 119.5, 0.1, None, np.eye(4))


def points(rng: np.random.Generator, lag: float, sigma: float, n: int = 80) -> LineRows:
    place = rng.uniform([5, 5], [315, 235], (n, 2))
    shift = rng.normal(0.0, 2.0, n)
    return LineRows(lag * shift + sigma * rng.standard_normal(n), shift, place)


def test_the_lag_is_as_uncertain_as_it_says(rng: np.random.Generator) -> None:
    model = LagModel(RIG, 1)
    found = [model.lag(points(rng, lag, 0.3), 0.1) for lag in 50 * [0.0, 0.4, 1.0]]
    error = np.array([one.frames for one in found]) - np.array(50 * [0.0, 0.4, 1.0])
    nees = np.mean((error / [one.sigma for one in found]) ** 2)
    assert 0.7 < nees < 1.4  # 150 drawn, three deviations of a mean chi-square of one


def test_wrong_matches_are_no_lag(rng: np.random.Generator) -> None:
    drawn = points(rng, 0.0, 0.2)
    drawn.offset[:20] = rng.uniform(-10, 10, 20)
    found = LagModel(RIG, 1).lag(drawn, 0.1)
    assert found.late < -5.0


def test_a_turned_camera_is_no_late_one(rng: np.random.Generator) -> None:
    """A roll of 0.4 degrees moves rows at the edge by more than a pixel, in every frame."""
    drawn = points(rng, 0.0, 0.2)
    drawn.offset[:] += np.deg2rad(0.4) * (drawn.place[:, 0] - 159.5)
    assert LagModel(RIG, 1).lag(drawn, 0.1).late < -5.0


def test_what_stands_still_tells_no_lag(rng: np.random.Generator) -> None:
    """The patch's own noise is in offset and shift alike, as if the image were half a frame old."""
    place = rng.uniform([5, 5], [315, 235], (80, 2))
    common = 0.1 * rng.standard_normal(80)
    drawn = LineRows(
        common + 0.05 * rng.standard_normal(80), common + 0.05 * rng.standard_normal(80), place
    )
    assert np.isnan(LagModel(RIG, 1).lag(drawn, 0.1).frames)
    assert np.isnan(LagModel(RIG, 1).lag(drawn.select(np.arange(5)), 0.1).frames)
    assert np.isnan(Lag(np.nan, np.nan).late)
