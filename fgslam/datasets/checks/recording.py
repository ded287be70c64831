"""Findings about a recording, and the checks of its images, calibration and time stamps.

The checks look at any Sequence and raise nothing for what is wrong with it: each problem becomes a
:class:`Finding`. Those of odometry and truth are in :mod:`fgslam.datasets.checks.motion`, those of
feature matches in :mod:`fgslam.datasets.checks.matches`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from enum import Enum
from typing import TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.errors import FrameError
from fgslam.core.recordings import Frame, Sequence
from fgslam.core.sensors import CAMERA_NAMES, CameraRig

_LISTED = 5
_WIDEST_DEG = 140.0  # of usual fields of view


class Level(str, Enum):
    """How bad a finding is."""

    INFO = "info"
    WARNING = "warning"
    PROBLEM = "problem"


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of an inspection.

    Attributes:
        level: ``problem`` will spoil a run, ``warning`` may, ``info`` informs.
        subject: what it is about, such as "time" or "odometry".
        text: one sentence with the numbers, and the remedy where there is one.
    """

    level: Level
    subject: str
    text: str


def by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings, the worst first, otherwise in their order."""
    order = (Level.PROBLEM, Level.WARNING, Level.INFO)
    return tuple(sorted(findings, key=lambda f: order.index(f.level)))


def share(part: int, whole: int) -> str:
    """A part of a whole in words: ``3 of 200 (1.5 %)``."""
    return f"{part} of {whole} ({100.0 * part / max(whole, 1):.3g} %)"


def listed(items: list[int]) -> str:
    """The first few numbers of a list in words."""
    more = ", ..." if len(items) > _LISTED else ""
    return ", ".join(str(item) for item in items[:_LISTED]) + more


# --------------------------------------------------------------------------------------------
# Images

Progress: TypeAlias = Callable[[int, int], None]
"""Called with how much is done, and of how much."""

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


_GAP_FACTOR = 1.8


# --------------------------------------------------------------------------------------------
# Calibration and time


def check_calibration(rig: CameraRig) -> tuple[Finding, ...]:
    """Values that a calibration may have but hardly ever does."""
    found = []
    if not (0.0 < rig.cx < rig.width and 0.0 < rig.cy < rig.height):
        found.append(
            f"the principal point ({rig.cx:.1f}, {rig.cy:.1f}) lies outside the "
            f"{rig.width}x{rig.height} image; were the images cropped or resized?"
        )
    if not 0.95 < rig.fx / rig.fy < 1.05:
        found.append(
            f"fx and fy differ by more than 5 % ({rig.fx:.1f}, {rig.fy:.1f} px); were the images "
            "stretched after they were calibrated?"
        )
    view = rig.angles_deg[0]
    if not 15.0 < view < _WIDEST_DEG:
        found.append(
            f"the field of view of {view:.0f} degrees is unusual; is fx in pixels of these images?"
        )
    baselines = [("baseline", rig.baseline), ("vertical baseline", rig.vertical_baseline)]
    for name, value in baselines:
        if value is not None and not 0.002 < value < 3.0:
            found.append(f"the {name} of {value:g} m is unusual; is it in metres?")
    return tuple(Finding(Level.WARNING, "calibration", text) for text in found)


def check_timing(stamps: FloatArray) -> tuple[Finding, ...]:
    """Gaps between frames: steps longer than 1.8 median ones. Stamps (n,) in seconds."""
    if len(stamps) < 3:
        text = f"only {len(stamps)} frames: too few for a trajectory; widen start, stop and stride"
        return (Finding(Level.WARNING, "time", text),)
    steps = np.diff(stamps)
    median = float(np.median(steps))
    long = np.flatnonzero(steps > _GAP_FACTOR * median)
    if len(long) == 0:
        return ()
    worst = int(long[np.argmax(steps[long])])
    text = (
        f"{len(long)} of {len(steps)} steps are longer than {_GAP_FACTOR} times the median "
        f"{median:.3g} s; the longest, {steps[worst]:.3g} s, follows frame {worst}; frames "
        "were dropped, or only key frames kept: odometry must bridge them, or cut with "
        "dataset.start and dataset.stop"
    )
    return (Finding(Level.WARNING, "time", text),)
