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
from fgslam.core.geometry import so3_exp
from fgslam.core.rig_correction import TERMS, camera_displacements
from fgslam.core.sensors import CAMERA_NAMES, CameraRig
from fgslam.frontend.camera_watch import CameraWatch
from fgslam.frontend.turned_cameras import WINDOW, TurnWatch

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
YAW, ROLL = TERMS.index("yaw"), TERMS.index("roll")


def show(watch: TurnWatch, frame: int, rng: np.random.Generator, roll_deg: float = 0.0) -> None:
    """Sixty points of a left camera that is turned."""
    place = rng.uniform([0.0, 0.0], [320.0, 240.0], (60, 2))
    unit = camera_displacements(PAIR, 1, place)[:, 1]
    offset = unit[:, ROLL] * np.deg2rad(roll_deg) + rng.normal(0.0, 0.15, 60)
    watch.take(frame, [offset], [place])


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
        watch.take(frame, [few + float(frame)], [rng.uniform(0.0, 240.0, (19, 2))])
    assert not watch.knocks


def test_a_watch_goes_on_from_its_state_to_the_bit() -> None:
    def watched(stop: int | None) -> TurnWatch:
        rng, watch = np.random.default_rng(3), TurnWatch(PAIR, 0.1)
        for frame in range(9 * WINDOW):
            if frame == stop:
                state, watch = watch.state(), TurnWatch(PAIR, 0.1)
                watch.restore(state)
            show(watch, frame, rng, 0.5 if frame >= 4 * WINDOW else 0.0)
        return watch

    whole = watched(None)
    assert len(whole.knocks) == 1
    for stop in (3 * WINDOW + 2, 5 * WINDOW, 7 * WINDOW + 1):
        again = watched(stop)
        assert again.remarks() == whole.remarks()
        for name, value in whole.state().items():
            np.testing.assert_array_equal(again.state()[name], value)
