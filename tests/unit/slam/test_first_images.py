"""A remark on images that stereo matching cannot use, and none on sound ones."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import fgslam as fg
from fgslam.core.arrays import Image

FRAMES = 4
Images = tuple[Image, ...]


@pytest.fixture(scope="module")
def recording() -> fg.Recording:
    return fg.rendered_recording("lab", frames=FRAMES)


def remarks(
    recording: fg.Recording, change: Callable[[Images], Images], cameras: int = 3
) -> tuple[str, ...]:
    pair = replace(recording.rig, vertical_baseline=None)
    with fg.Slam(recording.rig if cameras == 3 else pair, "odometry") as slam:
        for t, images, odometry in recording:
            assert images is not None
            slam.track(t, change(images), odometry)
    return slam.result().remarks


def test_sound_images_give_no_remark(recording: fg.Recording) -> None:
    assert remarks(recording, lambda images: images) == ()
    # 16 bits are as good, where they are used.
    assert remarks(recording, lambda images: tuple(x.astype(np.uint16) << 8 for x in images)) == ()


def test_dark_images_are_matched_without_a_remark(recording: fg.Recording) -> None:
    assert remarks(recording, lambda images: tuple(x // 32 for x in images)) == ()


def test_bits_that_are_given_and_lost_are_remarked(recording: fg.Recording) -> None:
    (remark,) = remarks(recording, lambda images: tuple(x.astype(np.uint16) << 4 for x in images))
    assert re.search(r"reach 1[0-5] of 255: shift 12-bit values to 16 bits", remark), remark


def test_swapped_images_are_reported_as_swapped(recording: fg.Recording) -> None:
    remark, *_ = remarks(recording, lambda images: (images[1], images[0], *images[2:]))
    assert remark.startswith("the images of the right and the left camera are swapped: 4 of 4")
    assert "(swap their images; " in remark


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda images: tuple(x // 255 for x in images),
            "dark, their largest grey value is [01] of",
        ),
        (lambda images: tuple(np.full_like(x, 128) for x in images), "dark, or 12-bit values"),
    ],
    ids=["dark", "blank"],
)
def test_images_without_stereo_matches_give_one_line(
    recording: fg.Recording, change: Callable[[Images], Images], words: str
) -> None:
    (remark,) = remarks(recording, change)
    assert remark.startswith(f"no stereo matches in the first {FRAMES} frames: ")
    assert "\n" not in remark
    assert re.search(words, remark), remark


def test_a_camera_that_is_mirrored_on_the_way_is_reported(recording: fg.Recording) -> None:
    """From the second frame on the left image is matched by chance alone."""
    seen = 0

    def change(images: Images) -> Images:
        nonlocal seen
        seen += 1
        return images[:2] if seen == 1 else (images[0], images[1][::-1, ::-1].copy())

    said = remarks(recording, change, cameras=2)
    assert any("moved, turned, mirrored, covered) (the right image alone" in one for one in said), (
        said
    )


def test_a_covered_camera_of_two_is_not_taken_for_swapped(
    recording: fg.Recording,
) -> None:
    rng = np.random.default_rng(0)

    def covered(images: Images) -> Images:
        noise = np.clip(rng.normal(30.0, 2.0, images[0].shape), 0.0, 255.0)
        return np.asarray(noise, np.uint8), images[1]

    *_, remark = remarks(recording, covered, cameras=2)
    assert remark.startswith(f"no stereo matches in the first {FRAMES} frames: ")
    assert re.search(r"vary by \d\d in the right image, by 2 in the left one", remark), remark
