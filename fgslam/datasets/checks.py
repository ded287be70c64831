"""What is in a recording, and every problem found, in words: the checks behind ``inspect``.

The checks look at any Sequence and raise nothing for what is wrong with it: each problem becomes a
:class:`~fgslam.datasets.findings.Finding`. Statistics of feature matches are handed in, because
finding features is the front-end's business.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.datasets.findings import Finding, Level, listed, share
from fgslam.datasets.motion_checks import check_odometry, check_odometry_against_truth, check_truth
from fgslam.errors import FrameError
from fgslam.types import CameraRig, FloatArray, Frame, Image, Sequence

CAMERA_NAMES = ("right", "left", "top")
_DARK, _BRIGHT, _FLAT_SIGMA = 8.0, 247.0, 2.0
_MAX_BRIGHTNESS_RATIO = 1.5
_GAP_FACTOR = 1.8
_FEWEST_MATCHES = 20
_SIGNIFICANT_DISPARITY_PX = 0.5
_MAX_ROW_OFFSET_PX, _MAX_ROW_SPREAD_PX = 0.75, 1.5


@dataclass(frozen=True, slots=True)
class Inspection:
    """Facts (label, value) of a recording, and findings, the worst first."""

    facts: tuple[tuple[str, str], ...]
    findings: tuple[Finding, ...]


def inspect_sequence(sequence: Sequence, samples: int = 20) -> Inspection:
    """All checks that need no features; reads ``samples`` frames spread over the recording."""
    findings = (
        *(Finding(Level.WARNING, "recording", note) for note in sequence.notes),
        *check_calibration(sequence.rig),
        *check_timing(sequence.timestamps),
        *check_images(sequence, samples),
        *check_odometry(sequence),
        *check_truth(sequence),
        *check_odometry_against_truth(sequence),
    )
    order = (Level.PROBLEM, Level.WARNING, Level.INFO)
    return Inspection(facts(sequence), tuple(sorted(findings, key=lambda f: order.index(f.level))))


def facts(sequence: Sequence) -> tuple[tuple[str, str], ...]:
    """Label and value of what the recording is."""
    rig, stamps = sequence.rig, sequence.timestamps
    duration = float(stamps[-1] - stamps[0])
    rate = f"{(len(stamps) - 1) / duration:.3g} Hz" if duration > 0.0 else "single frame"
    view = 2.0 * np.degrees(np.arctan(0.5 * np.array([rig.width / rig.fx, rig.height / rig.fy])))
    vertical = "" if rig.vertical_baseline is None else f", {rig.vertical_baseline:.4g} m vertical"
    return (
        ("recording", sequence.name),
        ("frames", f"{len(stamps)} over {duration:.4g} s"),
        ("rate", rate),
        ("cameras", f"{rig.cameras}, {rig.width}x{rig.height}"),
        ("focal length", f"{rig.fx:.5g} x {rig.fy:.5g} px, view {view[0]:.0f} x {view[1]:.0f} deg"),
        ("baseline", f"{rig.baseline:.4g} m{vertical}"),
        ("one pixel of disparity", f"is {rig.fx * rig.baseline:.3g} m away"),
        ("identity", sequence.identity[:16]),
    )


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
        found.append(f"fx and fy differ by more than 5 % ({rig.fx:.1f}, {rig.fy:.1f} px)")
    view = float(2.0 * np.degrees(np.arctan(0.5 * rig.width / rig.fx)))
    if not 15.0 < view < 140.0:
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
        text = f"only {len(stamps)} frames: too few for a trajectory"
        return (Finding(Level.WARNING, "time", text),)
    steps = np.diff(stamps)
    median = float(np.median(steps))
    long = np.flatnonzero(steps > _GAP_FACTOR * median)
    if len(long) == 0:
        return ()
    worst = int(long[np.argmax(steps[long])])
    text = (
        f"{len(long)} of {len(steps)} steps are longer than {_GAP_FACTOR} times the median "
        f"{median:.3g} s; the longest, {steps[worst]:.3g} s, follows frame {worst}"
    )
    return (Finding(Level.WARNING, "time", text),)


# --------------------------------------------------------------------------------------------
# Images


def check_images(sequence: Sequence, samples: int = 20) -> tuple[Finding, ...]:
    """Unreadable, black, white and flat images, cameras of unequal brightness, copies.

    Reads up to ``samples`` frames, evenly spread, with the first and the last.
    """
    chosen = np.unique(np.linspace(0, len(sequence) - 1, min(samples, len(sequence))).astype(int))
    frames: list[Frame] = []
    found: list[Finding] = []
    unreadable: list[tuple[int, str]] = []
    for i in chosen.tolist():
        try:
            frames.append(sequence.frame(i))
        except FrameError as error:
            unreadable.append((i, str(error)))
    if unreadable:
        text = (
            f"{share(len(unreadable), len(chosen))} sampled frames cannot be read, the first: "
            f"{unreadable[0][1]}"
        )
        found.append(Finding(Level.PROBLEM, "images", text))
    found.extend(_uninformative_images(frames))
    found.extend(_unequal_cameras(frames))
    return tuple(found)


def _uninformative_images(frames: list[Frame]) -> list[Finding]:
    """Images in which nothing can be seen, by kind and camera."""
    found = []
    kinds = (("black", "too dark"), ("white", "over-exposed"), ("flat", "without any structure"))
    for kind, meaning in kinds:
        for c, camera in enumerate(CAMERA_NAMES):
            bad = [f.index for f in frames if c < len(f.images) and _kind(f.images[c]) == kind]
            if bad:
                text = (
                    f"the {camera} image is all {kind} ({meaning}) in "
                    f"{share(len(bad), len(frames))} sampled frames: {listed(bad)}; no feature can "
                    "be found there"
                )
                found.append(Finding(Level.PROBLEM, "images", text))
    return found


def _kind(image: Image) -> str:
    """``black``, ``white``, ``flat`` or ``good``."""
    low, high = np.percentile(image, [1.0, 99.0])
    if high < _DARK:
        return "black"
    if low > _BRIGHT:
        return "white"
    return "flat" if float(image.std()) < _FLAT_SIGMA else "good"


def _unequal_cameras(frames: list[Frame]) -> list[Finding]:
    """Cameras that show the same image, or images of different brightness."""
    if not frames:
        return []
    found = []
    for c, camera in enumerate(CAMERA_NAMES[1 : len(frames[0].images)], 1):
        pairs = [(f.images[0], f.images[c], f.index) for f in frames]
        copies = [k for right, other, k in pairs if np.array_equal(right, other)]
        if copies:
            text = (
                f"right and {camera} image are identical in {share(len(copies), len(frames))} "
                "sampled frames: the recording holds one camera twice"
            )
            found.append(Finding(Level.PROBLEM, "images", text))
        ratios = [(float(right.mean()) + 1.0) / (float(o.mean()) + 1.0) for right, o, _ in pairs]
        ratio = float(np.median(ratios))
        if max(ratio, 1.0 / ratio) > _MAX_BRIGHTNESS_RATIO:
            text = f"the right camera is {ratio:.2g} times as bright as the {camera} one"
            found.append(Finding(Level.WARNING, "images", text))
    return found


# --------------------------------------------------------------------------------------------
# Matches


def check_epipolar(vertical_offsets: FloatArray, disparities: FloatArray) -> tuple[Finding, ...]:
    """What matches between the left and the right images say about rectification and order.

    The matches must have been found *without* a gate on rows or on the sign of the disparity,
    over several frames; outliers are expected, so medians decide.

    Args:
        vertical_offsets: (n,) row in the left minus row in the right image, pixels.
        disparities: (n,) column in the left minus column in the right image, pixels.
    """
    count = len(disparities)
    if count < _FEWEST_MATCHES:
        text = f"only {count} matches between left and right: too few to judge the calibration"
        return (Finding(Level.WARNING, "epipolar", text),)
    offset = float(np.median(vertical_offsets))
    spread = float(1.4826 * np.median(np.abs(vertical_offsets - offset)))
    low, high = np.percentile(disparities, [5.0, 95.0])
    summary = (
        f"rows of {count} matches differ by {offset:+.2f} px (median), spread {spread:.2f} px; "
        f"disparities {low:.1f} to {high:.1f} px"
    )
    found = [Finding(Level.INFO, "epipolar", summary)]
    found.extend(_rectification(offset, spread))
    found.extend(_camera_order(disparities))
    return tuple(found)


def _rectification(offset: float, spread: float) -> list[Finding]:
    found = []
    if abs(offset) > _MAX_ROW_OFFSET_PX:
        text = (
            f"rows disagree by {offset:+.1f} px: the pair is not rectified, or shifted; rectify "
            "again, or shift one camera's images"
        )
        found.append(Finding(Level.PROBLEM, "epipolar", text))
    if spread > _MAX_ROW_SPREAD_PX:
        text = (
            f"rows scatter by {spread:.1f} px: the images are not rectified (lens distortion, or "
            "cameras turned against each other)"
        )
        found.append(Finding(Level.PROBLEM, "epipolar", text))
    return found


def _camera_order(disparities: FloatArray) -> list[Finding]:
    significant = disparities[np.abs(disparities) > _SIGNIFICANT_DISPARITY_PX]
    negative = float((significant < 0.0).mean()) if len(significant) else 0.0
    if negative > 0.5:
        text = (
            f"cameras look swapped: {100.0 * negative:.0f} % of matches have negative disparity; "
            "swap left and right"
        )
        return [Finding(Level.PROBLEM, "epipolar", text)]
    if negative > 0.15:
        text = (
            f"{100.0 * negative:.0f} % of matches have negative disparity: many wrong matches, or "
            "zero disparity is not at infinity"
        )
        return [Finding(Level.WARNING, "epipolar", text)]
    return []
