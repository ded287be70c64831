"""Cameras that are late, frozen, swapped, dark or turned."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy import ndimage

import fgslam as fg
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.correction import TERMS, camera_displacements
from fgslam.core.geometry import pose, so3_exp
from fgslam.core.sensors import CAMERA_NAMES, CameraRig
from fgslam.core.store import restore, state_of
from fgslam.frontend.camera_faults import (
    WINDOW,
    CameraWatch,
    Knock,
    Lag,
    LagModel,
    LineRows,
    Turns,
    TurnWatch,
    turns_of,
)
from fgslam.frontend.features.sift import contrast_share, noise_sigma
from fgslam.report.content import sentence
from fgslam.worlds.lab import (
    PlaceChoice,
    World,
    make_rig,
    open_room,
    plan_in_place,
)
from fgslam.worlds.settings import LabRigSettings, RenderedLabSettings

# ------------------------------------------------------------------------------------------
# A camera that is late, frozen, swapped or darker is found out within frames; a sound one never


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
    """What is reported of each frame; the fault lasts from ``BEGINS`` on, ``until`` the frame."""
    watch = CameraWatch(rig)
    end = len(frames) if until is None else until
    reported = [
        watch.look(fault(frames, k) if BEGINS <= k < end else frames[k]) for k in range(len(frames))
    ]
    return reported, watch


def assert_found(reported: list[str], name: str) -> None:
    """Silence before the fault, the camera by name within ten frames, and to the end."""
    assert not any(reported[:BEGINS])
    first = next(k for k, words in enumerate(reported) if words)
    assert first < BEGINS + SOON
    assert all(f"the {name} camera" in words for words in reported[first + 1 :])


@pytest.mark.parametrize(("fault", "camera"), [(late, 0), (late, 2), (frozen, 1), (stuck, 2)])
def test_an_old_image_is_found_in_the_lab(
    lab: tuple[CameraRig, list[Images]], fault: Callable[[int], Fault], camera: int
) -> None:
    reported, _ = watched(*lab, fault(camera))
    assert_found(reported, CAMERA_NAMES[camera])


@pytest.mark.data
@pytest.mark.parametrize(("fault", "camera"), [(late, 1), (frozen, 0)])
def test_an_old_image_is_found_on_a_real_road(
    road: tuple[CameraRig, list[Images]], fault: Callable[[int], Fault], camera: int
) -> None:
    reported, _ = watched(*road, fault(camera))
    assert_found(reported, CAMERA_NAMES[camera])


def test_swapped_cameras_are_found_in_the_lab(lab: tuple[CameraRig, list[Images]]) -> None:
    reported, _ = watched(*lab, swapped)
    assert not any(reported[:BEGINS])
    assert all("right and the left camera are swapped" in words for words in reported[BEGINS + 1 :])


@pytest.mark.parametrize("camera", [0, 1])
def test_a_darker_camera_is_reported_and_its_frames_are_used(
    lab: tuple[CameraRig, list[Images]], camera: int
) -> None:
    reported, watch = watched(*lab, darker(camera))
    assert not any(reported)
    remarks = watch.remarks()
    assert len(remarks) == (2 if camera == 0 else 1)  # a dark reference differs from both others
    assert remarks[0].code == "unequal_exposure"
    assert watched(*lab, darker(camera), until=BEGINS)[1].remarks() == ()


def test_one_repeated_image_costs_one_frame(lab: tuple[CameraRig, list[Images]]) -> None:
    reported, _ = watched(*lab, stuck(1), until=BEGINS + 1)
    assert [k for k, words in enumerate(reported) if words] == [BEGINS]
    assert reported[BEGINS] == "the left camera delivers the image of the frame before once more"


def test_doubled_frames_are_reported_and_a_standing_robot_is_not(
    lab: tuple[CameraRig, list[Images]],
) -> None:
    rig, images = lab
    for order, codes in (([0, 0, 1, 1, 2, 2], ["images_doubled"]), ([0, 1, 1, 1, 1, 2], [])):
        watch = CameraWatch(rig)
        assert [watch.look(images[k]) for k in order] == [""] * len(order)
        assert [one.code for one in watch.remarks()] == codes


def test_a_camera_that_has_recovered_is_used_again(lab: tuple[CameraRig, list[Images]]) -> None:
    reported, _ = watched(*lab, late(2), until=BEGINS + 5)
    assert any(reported)
    assert not any(reported[-3:])


def test_watching_goes_on_where_it_stopped(lab: tuple[CameraRig, list[Images]]) -> None:
    rig, frames = lab
    fault = late(1)
    whole, _ = watched(rig, frames, fault)
    for stop in (BEGINS, BEGINS + 3):
        first, then = CameraWatch(rig), CameraWatch(rig)
        given = [fault(frames, k) if k >= BEGINS else frames[k] for k in range(len(frames))]
        reported = [first.look(images) for images in given[:stop]]
        restore(then, state_of(first))
        assert reported + [then.look(images) for images in given[stop:]] == whole
        np.testing.assert_equal(state_of(first), state_of(first))


@pytest.mark.parametrize("yaw", [4.8, pytest.param(5.6, marks=pytest.mark.slow)])
def test_steps_as_long_as_the_baseline_are_no_lag(yaw: float) -> None:
    """Sideways by 10 cm the left camera comes to where the right one was: all slips are alike."""
    settings = RenderedLabSettings(rig=LabRigSettings(vertical_baseline_m=None))
    place, rig = PlaceChoice.of(settings), make_rig(settings.rig)
    world, drive = World(rig, open_room(place)), plan_in_place(place, settings.drive, rig)
    body = drive.body_poses(drive.timestamps[:1])[0]
    body[:3, :3] = so3_exp(np.array([0.0, 0.0, yaw])) @ body[:3, :3]
    frames = []
    for k in range(8):
        wTc = body @ rig.bTc @ pose(np.eye(3), np.array([0.1 * (k - 4), 0.0, 0.0]))
        both = [world.image(wTc @ offset, []) for offset in rig.camera_poses]
        frames.append(tuple(noisy(np.asarray(image), k) for image in both))
    watch = CameraWatch(rig)
    assert not any(watch.look(images) for images in frames)


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize("stride", range(1, 7))
@pytest.mark.parametrize("name", ["kitti06", "euroc_v101_kf100", "kitti_raw_0926_5hz"])
def test_a_late_camera_is_found_at_any_stride(shared_data: Path, name: str, stride: int) -> None:
    recording = fg.open_recording(shared_data / name)
    frames = frames_of(recording, len(recording))[::stride]
    watch = CameraWatch(recording.rig)
    assert not any(watch.look(images) for images in frames)
    late_left = [with_one(frames[k], 1, frames[k - 1][1]) for k in range(1, len(frames))]
    watch = CameraWatch(recording.rig)
    reported = [watch.look(images) for images in late_left]
    assert any("the left camera delivers old images" in words for words in reported)


SOUND = (
    "kitti06",
    "kitti_raw_0926_5hz",
    "euroc_v101_kf100",
    "euroc_v101_raw",
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
    reported = [watch.look(images) for images in frames_of(recording, len(recording))]
    assert not any(reported)
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


def test_the_lag_is_as_uncertain_as_stated(rng: np.random.Generator) -> None:
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


def test_lag_is_unknown_without_motion(rng: np.random.Generator) -> None:
    """The patch's own noise is in offset and shift alike, as if the image were half a frame old."""
    place = rng.uniform([5, 5], [315, 235], (80, 2))
    common = 0.1 * rng.standard_normal(80)
    drawn = LineRows(
        common + 0.05 * rng.standard_normal(80), common + 0.05 * rng.standard_normal(80), place
    )
    assert np.isnan(LagModel(RIG, 1).lag(drawn, 0.1).frames)
    assert np.isnan(LagModel(RIG, 1).lag(drawn.select(np.arange(5)), 0.1).frames)
    assert np.isnan(Lag(np.nan, np.nan).late)


# ------------------------------------------------------------------------------------------
# Contrast and noise of an image, which detection is relative to


def as_image(grey: FloatArray) -> Image:
    return np.rint(np.clip(grey, 0, 255)).astype(np.uint8)


def ramp(low: float, high: float) -> FloatArray:
    return np.tile(np.linspace(low, high, 320), (240, 1))


@pytest.mark.parametrize("gain", [1.0, 0.5, 0.25, 0.1])
def test_contrast_falls_with_the_light(gain: float) -> None:
    # 98 % of a ramp lie in 98 % of its range; two thirds of the scale are a share of one.
    expected = min(1.0, gain * 0.98 * 160 / 170)
    assert contrast_share(as_image(ramp(0, 160 * gain))) == pytest.approx(expected, abs=0.01)


def test_brightness_alone_is_no_contrast() -> None:
    assert contrast_share(as_image(ramp(0, 50))) == contrast_share(as_image(ramp(200, 250)))
    assert contrast_share(np.full((240, 320), 90, np.uint8)) == 0.0


def test_a_lamp_is_not_what_an_image_is_exposed_for() -> None:
    dark = as_image(ramp(0, 16))
    lamp = dark.copy()
    lamp[100:120, 100:130] = 255  # less than a hundredth of the pixels
    assert contrast_share(lamp) == pytest.approx(contrast_share(dark), abs=0.01)


@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.0, 5.0])
@pytest.mark.parametrize("structure", ["even", "ramp", "blobs"])
def test_noise_is_measured_whatever_the_image_shows(sigma: float, structure: str) -> None:
    rng = np.random.default_rng(1)
    blobs = 128 + 900 * ndimage.gaussian_filter(rng.standard_normal((240, 320)), 8.0)
    grey = {"even": np.full((240, 320), 128.0), "ramp": ramp(40, 210), "blobs": blobs}[structure]
    image = as_image(grey + sigma * rng.standard_normal(grey.shape))
    # Rounding adds 1/12; the median of whole numbers is one, a sixth of 0.67 wide at most.
    assert noise_sigma(image) == pytest.approx(np.hypot(sigma, 12**-0.5), abs=0.15)


@pytest.mark.parametrize("size", [(3, 3), (4, 5), (31, 17)])
@pytest.mark.parametrize("levels", [2, 256])
def test_noise_is_the_median_of_the_answers(size: tuple[int, int], levels: int) -> None:
    image = np.random.default_rng(2).integers(0, levels, size) * (255 // (levels - 1))
    image[:3, :3] = 255 * (np.indices((3, 3)).sum(axis=0) % 2)  # the largest answer there is
    answers = np.abs(ndimage.convolve(image, [[1, -2, 1], [-2, 4, -2], [1, -2, 1]])[1:-1, 1:-1])
    expected = max(np.median(answers) / (0.6745 * 6.0), 12**-0.5)
    assert noise_sigma(image.astype(np.uint8)[:, ::-1][:, ::-1]) == pytest.approx(expected)


# ------------------------------------------------------------------------------------------
# A camera that is knocked is named, with its turn; a sound rig, and what passes by, never


KNOCKED_AT = 5 * WINDOW
TURNED_FRAMES = 10 * WINDOW
TURN_DEG = 0.3
AXES = ("pitch", "yaw", "roll")


@pytest.fixture(scope="module")
def turned_lab() -> tuple[CameraRig, list[Images]]:
    """Images in the order right, left, top."""
    recording = fg.rendered_recording("lab", frames=TURNED_FRAMES)
    found = [recording[k][1] for k in range(TURNED_FRAMES)]
    return recording.rig, [(x[1], x[0], x[2]) for x in found if x is not None]


def turned(rig: CameraRig, image: Image, turn_deg: FloatArray) -> Image:
    """What the camera shows after a turn about its x, y and z axis: a homography, exactly."""
    matrix = np.array([[rig.fx, 0.0, rig.cx], [0.0, rig.fy, rig.cy], [0.0, 0.0, 1.0]])
    homography = matrix @ so3_exp(np.deg2rad(turn_deg)).T @ np.linalg.inv(matrix)
    size = (rig.width, rig.height)
    return np.asarray(
        cv2.warpPerspective(image, homography, size, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )


def test_frames_are_named_by_their_own_numbers(turned_lab: tuple[CameraRig, list[Images]]) -> None:
    """Frames without images count, too: every second one, say."""
    rig, frames = turned_lab
    watch = CameraWatch(rig)
    for k, images in enumerate(frames):
        left = turned(rig, images[1], about(0)) if k >= KNOCKED_AT else images[1]
        watch.look((images[0], left, images[2]), 100 + 2 * k)
    (remark,) = watch.remarks()
    assert remark.frames == (100 + 2 * KNOCKED_AT,)
    assert watch.knocked


def reported_of(
    rig: CameraRig, frames: list[Images], camera: int, turn_deg: FloatArray
) -> list[str]:
    """Remarks on a drive in whose middle a camera is turned."""
    watch = CameraWatch(rig)
    for k, images in enumerate(frames):
        shown = list(images[: rig.cameras])
        if k >= KNOCKED_AT:
            shown[camera] = turned(rig, shown[camera], turn_deg)
        assert watch.look(tuple(shown)) == ""
    return list(map(sentence, watch.remarks()))


def about(axis: int) -> FloatArray:
    return np.asarray(TURN_DEG * np.eye(3)[axis], np.float64)


@pytest.mark.parametrize(("camera", "axis"), [(0, 0), (1, 1), (2, 2)])
def test_the_knocked_one_of_three_cameras_is_named_with_its_turn(
    turned_lab: tuple[CameraRig, list[Images]], camera: int, axis: int
) -> None:
    (line,) = reported_of(*turned_lab, camera, about(axis))
    assert line.startswith(f"the {CAMERA_NAMES[camera]} camera was turned by ")
    size, words = line.removeprefix(f"the {CAMERA_NAMES[camera]} camera was turned by ").split(
        " degrees in ", 1
    )
    assert words.startswith(AXES[axis])
    assert abs(float(size)) == pytest.approx(TURN_DEG, abs=0.05)
    assert f"at about frame {KNOCKED_AT} of the run" in line
    assert line.count("degrees in") == 1  # no other axis


def test_of_a_pair_the_turn_of_one_against_the_other_is_reported(
    turned_lab: tuple[CameraRig, list[Images]],
) -> None:
    (rig, frames), axis = turned_lab, 0
    pair = dataclasses.replace(rig, vertical_baseline=None)
    (line,) = reported_of(pair, frames, 1, about(axis))
    assert "the left camera was turned by" in line
    assert f"degrees in {AXES[axis]}" in line
    assert "against the right one (or that one by the opposite)" in line


def test_nothing_is_reported_of_a_sound_drive(turned_lab: tuple[CameraRig, list[Images]]) -> None:
    assert reported_of(*turned_lab, 1, np.zeros(3)) == []


# --------------------------------------------------------------------------------------------
# Simulated points


PAIR = CameraRig(320, 240, 277.0, 277.0, 159.5, 119.5, 0.1, None, np.eye(4))
NOISE_PX = 0.15


def seen(
    rng: np.random.Generator, turn_deg: FloatArray, shift_px: float = 0.0, lag: float = 0.0
) -> LineRows:
    """Sixty points of a left camera that is turned, and late by ``lag`` frames."""
    place = rng.uniform([0.0, 0.0], [320.0, 240.0], (60, 2))
    unit = camera_displacements(PAIR, 1, place)[:, 1]
    columns = [TERMS.index(axis) for axis in AXES]
    shift = shift_px + rng.normal(0.0, 0.3, 60)  # of points that are near and far
    offset = unit[:, columns] @ np.deg2rad(turn_deg) + lag * shift
    return LineRows(offset + rng.normal(0.0, NOISE_PX, 60), shift, place)


def show(watch: TurnWatch, frame: int, rng: np.random.Generator, roll_deg: float = 0.0) -> None:
    watch.take(frame, [seen(rng, np.array([0.0, 0.0, roll_deg]))])


def by_landmarks(lag: float) -> tuple[str, CameraWatch]:
    """Blank images, whose landmarks show a left camera that is rolled from the fourth window on."""
    rng, watch, reported = np.random.default_rng(5), CameraWatch(PAIR), ""
    for frame in range(8 * WINDOW):
        images = [np.full((240, 320), 100 + frame + k, np.uint8) for k in (0, 1)]
        roll = 0.3 * (frame >= 4 * WINDOW)
        rows = seen(rng, np.array([0.0, 0.0, roll]), 3.0, lag)
        right = rows.place - np.stack([np.full(60, 9.0), rows.offset], axis=1)
        before = right + np.stack([np.zeros(60), rows.shift], axis=1)
        pixels = np.stack([right, rows.place, np.full((60, 2), np.nan)], axis=1)
        reported += watch.look((images[0], images[1]), frame, False, (before, pixels))
    return reported, watch


def test_tracked_landmarks_show_a_knock_where_images_have_no_corner() -> None:
    reported, watch = by_landmarks(0.0)
    assert not reported
    assert watch.knocked


def test_landmarks_that_show_images_of_two_moments_are_not_relied_on() -> None:
    _, watch = by_landmarks(1.0)
    assert not watch.knocked


def disturbed(first: int, length: int, turns_deg: FloatArray, axis: int) -> TurnWatch:
    """A watch after a drive in which a camera is turned for ``length`` frames."""
    rng, watch = np.random.default_rng(length), TurnWatch(PAIR, 0.1)
    for frame in range(8 * WINDOW):
        turn = turns_deg[frame - first] if first <= frame < first + length else 0.0
        watch.take(frame, [seen(rng, turn * np.eye(3)[axis])])
    return watch


@pytest.mark.parametrize("length", [2, 5, 8])
def test_disturbance_of_few_frames_is_no_knock(length: int) -> None:
    for offset, size in itertools.product(range(WINDOW), (0.3, 2.0)):
        watch = disturbed(4 * WINDOW + offset, length, np.full(length, size), offset % 3)
        assert watch.knocks == [], (offset, size)


def test_opposite_disturbances_in_consecutive_windows_are_no_knock() -> None:
    turns = np.repeat([1.0, -1.0, 1.0, -1.0], WINDOW)
    for count in (2, 3, 4):
        assert disturbed(3 * WINDOW, count * WINDOW, turns, 0).knocks == []


@pytest.mark.parametrize(("apparent_deg", "lag"), [(0.3, 0.1), (0.3, -0.3), (0.2, 0.5)])
def test_pitching_robot_with_cameras_out_of_step_is_no_knock(
    apparent_deg: float, lag: float, rng: np.random.Generator
) -> None:
    """Each camera shows its own moment: points are off their lines by lag times their shift."""
    watch, apparent_px = TurnWatch(PAIR, 0.1), PAIR.fy * np.deg2rad(apparent_deg)
    for frame in range(300):
        shift = apparent_px / lag * np.sin(2.0 * np.pi * frame / 60.0)
        watch.take(frame, [seen(rng, np.zeros(3), shift, lag)])
    assert watch.knocks == []


@pytest.mark.parametrize(
    ("lag", "offset"), [(0.0, 0), *((0.3, offset) for offset in range(1, WINDOW, 2))]
)
def test_knock_is_found_wherever_it_lies_in_a_window(
    lag: float, offset: int, rng: np.random.Generator
) -> None:
    watch, at = TurnWatch(PAIR, 0.1), 5 * WINDOW + offset
    for frame in range(12 * WINDOW):
        turn = np.array([0.3, 0.0, 0.0]) * (frame >= at)
        watch.take(frame, [seen(rng, turn, 2.0 * np.sin(frame), lag)])
    (remark,) = watch.remarks()
    assert remark.values["camera"] == "left"
    size, words = str(remark.values["turns"]).split(" degrees in ", 1)
    assert words.startswith("pitch")
    assert float(size) == pytest.approx(0.3, abs=0.05)
    assert abs(watch.knocks[0].frame - at) <= WINDOW


def test_knock_is_found_after_a_change_too_small_to_report(rng: np.random.Generator) -> None:
    """The step of 0.08 degrees is no measure of the noise of the windows."""
    watch = TurnWatch(PAIR, 0.1)
    for frame in range(16 * WINDOW):
        show(watch, frame, rng, (0.0, 0.08, 0.08, 0.28)[frame // (4 * WINDOW)])
    assert [knock.frame for knock in watch.knocks] == [12 * WINDOW]


def test_knocks_without_a_sure_axis_are_not_reported(rng: np.random.Generator) -> None:
    watch = TurnWatch(PAIR, 0.1)
    for frame in range(5 * WINDOW):
        show(watch, frame, rng)
    same = Turns.none(1)
    for _ in range(5 * WINDOW):
        same = same.plus(turns_of(PAIR, [seen(rng, np.zeros(3))], 0.1))
    watch.knocks.append(Knock(WINDOW, same))
    assert watch.remarks() == ()


def test_camera_that_turns_again_and_again_is_loose(rng: np.random.Generator) -> None:
    watch = TurnWatch(PAIR, 0.1)
    for frame in range(20 * WINDOW):
        show(watch, frame, rng, (0.0, 0.4, -0.2, 0.2)[frame // (5 * WINDOW)])
    (remark,) = watch.remarks()
    assert (remark.code, remark.values["camera"]) == ("camera_loose", "left")
    assert remark.values["degrees"] == pytest.approx(0.6, abs=0.005)
    assert remark.frames == (5 * WINDOW, 10 * WINDOW, 15 * WINDOW)


def test_noise_is_no_knock_in_a_long_drive(rng: np.random.Generator) -> None:
    watch = TurnWatch(PAIR, 0.1)
    for frame in range(100 * WINDOW):
        show(watch, frame, rng)
    assert watch.knocks == []


def test_two_knocks_are_separated(rng: np.random.Generator) -> None:
    watch = TurnWatch(PAIR, 0.1)
    for frame in range(15 * WINDOW):
        show(watch, frame, rng, (0.0, 0.4, -0.2)[frame // (5 * WINDOW)])
    first, second = watch.remarks()
    for remark, expected in ((first, 0.4), (second, -0.6)):
        size, words = str(remark.values["turns"]).split(" degrees in ", 1)
        assert words.startswith("roll")
        assert float(size) == pytest.approx(expected, abs=0.02)
    assert [knock.frame for knock in watch.knocks] == [5 * WINDOW, 10 * WINDOW]


def test_frames_with_few_points_count_for_nothing(rng: np.random.Generator) -> None:
    watch = TurnWatch(PAIR, 0.1)
    few = np.zeros(19)
    for frame in range(20 * WINDOW):
        place = rng.uniform(0.0, 240.0, (19, 2))
        watch.take(frame, [LineRows(few + float(frame), few, place)])
    assert not watch.knocks


def test_a_watch_goes_on_from_its_state_to_the_bit() -> None:
    def watched(stop: int | None) -> TurnWatch:
        rng, watch = np.random.default_rng(3), TurnWatch(PAIR, 0.1)
        for frame in range(9 * WINDOW):
            if frame == stop:
                state, watch = state_of(watch), TurnWatch(PAIR, 0.1)
                restore(watch, state)
            show(watch, frame, rng, 0.5 if frame >= 4 * WINDOW else 0.0)
        return watch

    whole = watched(None)
    assert len(whole.knocks) == 1
    for stop in (3 * WINDOW + 2, 5 * WINDOW, 6 * WINDOW + 3, 8 * WINDOW + 1):
        again = watched(stop)
        assert again.remarks() == whole.remarks()
        for name, value in state_of(whole).items():
            np.testing.assert_array_equal(state_of(again)[name], value)
