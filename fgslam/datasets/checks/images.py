"""Checks of the images themselves: unreadable, empty of content, copied, unequally bright."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import Image, IntArray
from fgslam.core.errors import FrameError
from fgslam.core.recordings import Frame, Sequence
from fgslam.datasets.checks.findings import Finding, Level, listed, share

Progress: TypeAlias = Callable[[int, int], None]
"""Called with how much is done, and of how much."""

CAMERA_NAMES = ("right", "left", "top")
_DARK, _BRIGHT, _FLAT_SIGMA = 8.0, 247.0, 2.0
_MAX_BRIGHTNESS_RATIO = 1.5
_KINDS = (("black", "too dark"), ("white", "over-exposed"), ("flat", "without any structure"))


@dataclass(frozen=True, slots=True)
class _Look:
    """What is kept of one frame: per camera its kind, mean grey value, and equality to the right.

    The images are not kept: a long recording would fill the memory.
    """

    index: int
    kinds: tuple[str, ...]
    means: tuple[float, ...]
    copies: tuple[bool, ...]


def spread_over(sequence: Sequence, samples: int) -> IntArray:
    """Positions (n,) of up to ``samples`` frames, evenly spread, with the first and the last."""
    count = min(samples, len(sequence))
    return np.unique(np.linspace(0, len(sequence) - 1, count).astype(np.int64))


def check_images(
    sequence: Sequence, samples: int = 20, progress: Progress | None = None
) -> tuple[Finding, ...]:
    """Unreadable, black, white and flat images, cameras of unequal brightness, copies.

    Reads up to ``samples`` frames, evenly spread, with the first and the last.
    """
    chosen = spread_over(sequence, samples)
    looks: list[_Look] = []
    unreadable: list[str] = []
    for done, i in enumerate(chosen.tolist(), 1):
        try:
            looks.append(_look(sequence.frame(i)))
        except FrameError as error:
            unreadable.append(str(error))
        if progress is not None:
            progress(done, len(chosen))
    found: list[Finding] = []
    if unreadable:
        text = (
            f"{share(len(unreadable), len(chosen))} sampled frames cannot be read, the first: "
            f"{unreadable[0]}"
        )
        found.append(Finding(Level.PROBLEM, "images", text))
    found.extend(_uninformative_images(looks))
    found.extend(_unequal_cameras(looks))
    return tuple(found)


def _look(frame: Frame) -> _Look:
    right = frame.images[0]
    return _Look(
        index=frame.index,
        kinds=tuple(_kind(image) for image in frame.images),
        means=tuple(float(image.mean()) for image in frame.images),
        copies=tuple(np.array_equal(right, image) for image in frame.images),
    )


def _kind(image: Image) -> str:
    """``black``, ``white``, ``flat`` or ``good``."""
    low, high = np.percentile(image, [1.0, 99.0])
    if high < _DARK:
        return "black"
    if low > _BRIGHT:
        return "white"
    return "flat" if float(image.std()) < _FLAT_SIGMA else "good"


def _uninformative_images(looks: list[_Look]) -> list[Finding]:
    """Images in which nothing can be seen, by kind and camera."""
    found = []
    for kind, meaning in _KINDS:
        for c, camera in enumerate(CAMERA_NAMES):
            bad = [k.index for k in looks if c < len(k.kinds) and k.kinds[c] == kind]
            if bad:
                text = (
                    f"the {camera} image is all {kind} ({meaning}) in "
                    f"{share(len(bad), len(looks))} sampled frames: {listed(bad)}; no feature can "
                    "be found there, so a run relies on odometry alone: leave them out with "
                    "dataset.start and dataset.stop, or record again"
                )
                found.append(Finding(Level.PROBLEM, "images", text))
    return found


def _unequal_cameras(looks: list[_Look]) -> list[Finding]:
    """Cameras that show the same image, or images of different brightness."""
    found = []
    for c, camera in enumerate(CAMERA_NAMES[1:], 1):
        # Images without content are reported already; they are all equal.
        both = [k for k in looks if c < len(k.kinds) and k.kinds[0] == k.kinds[c] == "good"]
        if not both:
            continue
        copies = sum(k.copies[c] for k in both)
        if copies:
            text = (
                f"right and {camera} image are identical in {share(copies, len(both))} "
                f"sampled frames: the recording holds one camera twice; restore the {camera} "
                "camera's images"
            )
            found.append(Finding(Level.PROBLEM, "images", text))
        ratio = float(np.median([(k.means[0] + 1.0) / (k.means[c] + 1.0) for k in both]))
        if max(ratio, 1.0 / ratio) > _MAX_BRIGHTNESS_RATIO:
            text = (
                f"the right camera is {ratio:.2g} times as bright as the {camera} one; give both "
                "one exposure time and gain"
            )
            found.append(Finding(Level.WARNING, "images", text))
    return found
