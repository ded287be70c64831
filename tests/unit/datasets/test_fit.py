"""Calibrations that do not fit the images are told from the images themselves."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from fgslam.cameras.rig import load_rig
from fgslam.core.arrays import Image
from fgslam.core.errors import FrameError
from fgslam.datasets.fit import fit_notes
from fgslam.datasets.opening import open_recording
from fgslam.datasets.settings import EurocSettings


def pair(disparity: int, rows: int) -> tuple[Image, Image]:
    """Right and left image of a textured wall."""
    noise = np.random.default_rng(2).integers(0, 256, (60, 90), np.uint8)
    wall = np.asarray(cv2.resize(noise, (360, 240), interpolation=cv2.INTER_CUBIC), np.uint8)
    left = np.roll(wall, (rows, disparity), (0, 1))
    return wall[20:-20, 40:-40], left[20:-20, 40:-40]


@pytest.mark.parametrize(
    ("disparity", "rows", "words"),
    [
        (12, 0, None),
        (12, 1, None),
        (12, 6, r"the rows of \d+ matches differ by \+6.0 px \(median\)"),
        (-12, 0, "left and right are swapped: 100 % of"),
        (-12, 6, "left and right look swapped"),
    ],
)
def test_rows_and_order_are_judged(disparity: int, rows: int, words: str | None) -> None:
    notes = fit_notes(lambda _: pair(disparity, rows), 5)
    if words is None:
        assert notes == ()
        return
    (note,) = notes
    assert "\n" not in note
    assert re.search(words, note)


def test_frames_that_cannot_be_read_are_passed_over() -> None:
    def load(index: int) -> tuple[Image, ...]:
        if index < 2:
            raise FrameError("no file")
        return pair(12, 6)

    assert "in the first 3 pairs" in fit_notes(load, 8)[0]
    assert fit_notes(load, 2) == ()
    assert fit_notes(lambda _: (np.zeros((60, 80), np.uint8),) * 2, 3) == ()


CHESSBOARDS = {
    "opencv": ("opencv/extrinsics.yml", None, (640, 480), False, None),
    "another calibration": (
        "opencv/intrinsics_opencv_samples_DOES_NOT_FIT.yml",
        "opencv/extrinsics.yml",
        (640, 480),
        False,
        "does not fit",
    ),
    "barry": ("barry/extrinsics.yml", None, (640, 512), False, None),
    "barry, swapped once more": ("barry/extrinsics.yml", None, (640, 512), True, "look swapped"),
}


@pytest.mark.data
@pytest.mark.parametrize("kind", CHESSBOARDS)
def test_real_pairs(shared_data: Path, kind: str) -> None:
    file, second, size, exchanged, words = CHESSBOARDS[kind]
    folder = shared_data / "cameras" / "stereo_chessboard"
    if not folder.is_dir():
        pytest.skip(f"no chessboard pairs at {folder}")
    rig = load_rig(folder / file, folder / second if second else None, size=size)
    sides = ("left", "right") if exchanged else ("right", "left")

    def load(index: int) -> tuple[Image, ...]:
        names = [folder / kind.split(",", 1)[0].replace("another calibration", "opencv") / f
                 for f in (f"{side}{index + 1:02d}.jpg" for side in sides)]  # fmt: skip
        images = [cv2.imread(str(name), cv2.IMREAD_GRAYSCALE) for name in names]
        return rig.rectified(tuple(np.asarray(image, np.uint8) for image in images))

    notes = fit_notes(load, 3)
    assert notes == () if words is None else words in notes[0]


@pytest.mark.data
def test_a_real_drive_fits_its_calibration_and_no_other(shared_data: Path) -> None:
    """EuRoC's own sensor.yaml against that of another camera of the same size (MYNT EYE)."""
    root = shared_data / "euroc_v101_raw"
    other = shared_data / "cameras/calibrations/vins_fusion/mynteye/mynteye_stereo_imu_config.yaml"
    if not root.is_dir() or not other.is_file():
        pytest.skip(f"no raw recording at {root}, or no calibration at {other}")
    found = open_recording(EurocSettings(path=str(root), stop=3))
    assert found.unrectified
    assert not any("does not fit" in note for note in found.notes)
    wrong = open_recording(EurocSettings(path=str(root), stop=3, camera_file=str(other)))
    assert "the calibration does not fit the images" in wrong.notes[0]
