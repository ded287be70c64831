"""A camera that is knocked is named, with its turn; a sound rig, and what passes by, never."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator

import cv2
import numpy as np
import pytest
from _pytest.mark import ParameterSet

import fgslam as fg
from fgslam.core.arrays import FloatArray, Image
from fgslam.core.correction import TERMS, camera_displacements
from fgslam.core.geometry import so3_exp
from fgslam.core.sensors import CAMERA_NAMES, CameraRig
from fgslam.core.store import restore, state_of
from fgslam.frontend.camera_faults import (
    WINDOW,
    CameraWatch,
    Knock,
    LineRows,
    Turns,
    TurnWatch,
    turns_of,
)

KNOCKED_AT = 5 * WINDOW
FRAMES = 10 * WINDOW
TURN_DEG = 0.3
AXES = ("pitch", "yaw", "roll")
Images = tuple[Image, ...]


@pytest.fixture(scope="module")
def lab() -> tuple[CameraRig, list[Images]]:
    """Images in the order right, left, top."""
    recording = fg.rendered_recording("lab", frames=FRAMES)
    found = [recording[k][1] for k in range(FRAMES)]
    return recording.rig, [(x[1], x[0], x[2]) for x in found if x is not None]


def turned(rig: CameraRig, image: Image, turn_deg: FloatArray) -> Image:
    """What the camera shows after a turn about its x, y and z axis: a homography, exactly."""
    matrix = np.array([[rig.fx, 0.0, rig.cx], [0.0, rig.fy, rig.cy], [0.0, 0.0, 1.0]])
    homography = matrix @ so3_exp(np.deg2rad(turn_deg)).T @ np.linalg.inv(matrix)
    size = (rig.width, rig.height)
    return np.asarray(
        cv2.warpPerspective(image, homography, size, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )


def test_frames_are_named_by_their_own_numbers(lab: tuple[CameraRig, list[Images]]) -> None:
    """Frames without images count, too: every second one, say."""
    rig, frames = lab
    watch = CameraWatch(rig)
    for k, images in enumerate(frames):
        left = turned(rig, images[1], about(0)) if k >= KNOCKED_AT else images[1]
        watch.look((images[0], left, images[2]), 100 + 2 * k)
    (line,) = watch.remarks()
    assert f"at about frame {100 + 2 * KNOCKED_AT} of" in line
    assert watch.knocked


def said_of(rig: CameraRig, frames: list[Images], camera: int, turn_deg: FloatArray) -> list[str]:
    """Remarks on a drive in whose middle a camera is turned."""
    watch = CameraWatch(rig)
    for k, images in enumerate(frames):
        shown = list(images[: rig.cameras])
        if k >= KNOCKED_AT:
            shown[camera] = turned(rig, shown[camera], turn_deg)
        assert watch.look(tuple(shown)) == ""
    return list(watch.remarks())


def about(axis: int) -> FloatArray:
    return np.asarray(TURN_DEG * np.eye(3)[axis], np.float64)


def cases() -> Iterator[ParameterSet]:
    """Every camera about every axis; those that repeat the others are slow."""
    for camera, axis in itertools.product(range(3), range(3)):
        first = (camera, axis) in ((0, 0), (1, 0), (1, 1), (2, 1))
        marks = () if first else (pytest.mark.slow,)
        yield pytest.param(camera, axis, marks=marks, id=f"{CAMERA_NAMES[camera]}-{AXES[axis]}")


@pytest.mark.parametrize(("camera", "axis"), list(cases()))
def test_the_knocked_one_of_three_cameras_is_named_with_its_turn(
    lab: tuple[CameraRig, list[Images]], camera: int, axis: int
) -> None:
    (line,) = said_of(*lab, camera, about(axis))
    assert line.startswith(f"the {CAMERA_NAMES[camera]} camera was turned by ")
    size, words = line.removeprefix(f"the {CAMERA_NAMES[camera]} camera was turned by ").split(
        " degrees in ", 1
    )
    assert words.startswith(AXES[axis])
    assert abs(float(size)) == pytest.approx(TURN_DEG, abs=0.05)
    assert f"at about frame {KNOCKED_AT} of the run" in line
    assert line.count("degrees in") == 1  # no other axis


@pytest.mark.parametrize(
    "axis", [0, pytest.param(1, marks=pytest.mark.slow), pytest.param(2, marks=pytest.mark.slow)]
)
def test_of_a_pair_the_turn_of_one_against_the_other_is_said(
    lab: tuple[CameraRig, list[Images]], axis: int
) -> None:
    rig, frames = lab
    pair = dataclasses.replace(rig, vertical_baseline=None)
    (line,) = said_of(pair, frames, 1, about(axis))
    assert "the left camera was turned by" in line
    assert f"degrees in {AXES[axis]}" in line
    assert "against the right one (or that one by the opposite)" in line


def test_nothing_is_said_of_a_sound_drive(lab: tuple[CameraRig, list[Images]]) -> None:
    assert said_of(*lab, 1, np.zeros(3)) == []


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


def disturbed(first: int, length: int, turns_deg: FloatArray, axis: int) -> TurnWatch:
    """A watch after a drive in which a camera is turned for ``length`` frames."""
    rng, watch = np.random.default_rng(length), TurnWatch(PAIR, 0.1)
    for frame in range(8 * WINDOW):
        turn = turns_deg[frame - first] if first <= frame < first + length else 0.0
        watch.take(frame, [seen(rng, turn * np.eye(3)[axis])])
    return watch


@pytest.mark.parametrize("length", range(2, 9))
def test_disturbance_of_few_frames_is_no_knock(length: int) -> None:
    for offset, size in itertools.product(range(WINDOW), (0.3, 2.0)):
        watch = disturbed(4 * WINDOW + offset, length, np.full(length, size), offset % 3)
        assert watch.knocks == [], (offset, size)


def test_opposite_disturbances_in_consecutive_windows_are_no_knock() -> None:
    turns = np.repeat([1.0, -1.0, 1.0, -1.0], WINDOW)
    for count in (2, 3, 4):
        assert disturbed(3 * WINDOW, count * WINDOW, turns, 0).knocks == []


@pytest.mark.parametrize("lag", [0.1, -0.3, 0.5])
@pytest.mark.parametrize("apparent_deg", [0.2, 0.3])
def test_pitching_robot_with_cameras_out_of_step_is_no_knock(
    apparent_deg: float, lag: float, rng: np.random.Generator
) -> None:
    """Each camera shows its own moment: points are off their lines by lag times their shift."""
    watch, apparent_px = TurnWatch(PAIR, 0.1), PAIR.fy * np.deg2rad(apparent_deg)
    for frame in range(300):
        shift = apparent_px / lag * np.sin(2.0 * np.pi * frame / 60.0)
        watch.take(frame, [seen(rng, np.zeros(3), shift, lag)])
    assert watch.knocks == []


@pytest.mark.parametrize("offset", range(WINDOW))
@pytest.mark.parametrize("lag", [0.0, 0.3])
def test_knock_is_found_wherever_it_lies_in_a_window(
    lag: float, offset: int, rng: np.random.Generator
) -> None:
    watch, at = TurnWatch(PAIR, 0.1), 5 * WINDOW + offset
    for frame in range(12 * WINDOW):
        turn = np.array([0.3, 0.0, 0.0]) * (frame >= at)
        watch.take(frame, [seen(rng, turn, 2.0 * np.sin(frame), lag)])
    (line,) = watch.remarks()
    size, words = line.removeprefix("the left camera was turned by ").split(" degrees in ", 1)
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
    (line,) = watch.remarks()
    assert line.startswith("the left camera is loose: it turned 3 times, by up to 0.60 degrees")
    assert f"from about frame {5 * WINDOW} to {15 * WINDOW} of the run" in line


def test_what_passes_within_a_window_is_no_knock(rng: np.random.Generator) -> None:
    watch = TurnWatch(PAIR, 0.1)
    for frame in range(10 * WINDOW):
        show(watch, frame, rng, 1.0 if frame // WINDOW == 4 else 0.0)
    assert watch.remarks() == ()


def test_noise_is_no_knock_in_a_long_drive(rng: np.random.Generator) -> None:
    watch = TurnWatch(PAIR, 0.1)
    for frame in range(100 * WINDOW):
        show(watch, frame, rng)
    assert watch.knocks == []


def test_two_knocks_are_told_apart(rng: np.random.Generator) -> None:
    watch = TurnWatch(PAIR, 0.1)
    for frame in range(15 * WINDOW):
        show(watch, frame, rng, (0.0, 0.4, -0.2)[frame // (5 * WINDOW)])
    first, second = watch.remarks()
    for line, expected in ((first, 0.4), (second, -0.6)):
        size, words = line.removeprefix("the left camera was turned by ").split(" degrees in ", 1)
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
