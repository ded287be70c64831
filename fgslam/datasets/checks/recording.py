"""What is in a recording, and every problem found, in words: the checks behind ``inspect``.

The checks look at any Sequence and raise nothing for what is wrong with it: each problem becomes a
:class:`~fgslam.datasets.checks.findings.Finding`. Feature matches are judged in
:mod:`fgslam.datasets.checks.matches`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.recordings import Sequence
from fgslam.core.sensors import CameraRig
from fgslam.datasets.checks.clock import check_clock
from fgslam.datasets.checks.findings import Finding, Level, by_severity
from fgslam.datasets.checks.images import Progress, check_images
from fgslam.datasets.checks.motion import check_odometry, check_odometry_against_truth, check_truth

_GAP_FACTOR = 1.8


@dataclass(frozen=True, slots=True)
class Inspection:
    """Facts (label, value) of a recording, and findings, the worst first."""

    facts: tuple[tuple[str, str], ...]
    findings: tuple[Finding, ...]


def inspect_sequence(
    sequence: Sequence, samples: int = 20, progress: Progress | None = None
) -> Inspection:
    """All checks that need no features; reads ``samples`` frames spread over the recording.

    ``progress`` gets the number of these frames that have been read, and of all of them.
    """
    findings = (
        *(Finding(Level.WARNING, "recording", note) for note in sequence.notes),
        *check_calibration(sequence.rig),
        *check_timing(sequence.timestamps),
        *check_images(sequence, samples, progress),
        *check_odometry(sequence),
        *check_truth(sequence),
        *check_odometry_against_truth(sequence),
        *check_clock(sequence),
    )
    return Inspection(facts(sequence), by_severity(findings))


def facts(sequence: Sequence) -> tuple[tuple[str, str], ...]:
    """Label and value of what the recording is."""
    rig, stamps = sequence.rig, sequence.timestamps
    duration = float(stamps[-1] - stamps[0])
    rate = f"{(len(stamps) - 1) / duration:.3g} Hz" if duration > 0.0 else "single frame"
    view = 2.0 * np.degrees(np.arctan(0.5 * np.array([rig.width / rig.fx, rig.height / rig.fy])))
    vertical = "" if rig.vertical_baseline is None else f", {rig.vertical_baseline:.4g} m vertical"
    place = ", ".join(f"{x + 0.0:.3g}" for x in rig.bTc[:3, 3])
    return (
        ("recording", sequence.name),
        ("frames", f"{len(stamps)} over {duration:.4g} s"),
        ("rate", rate),
        ("cameras", f"{rig.cameras}, {rig.width}x{rig.height}"),
        ("focal length", f"{rig.fx:.5g} x {rig.fy:.5g} px, view {view[0]:.0f} x {view[1]:.0f} deg"),
        ("principal point", f"{rig.cx:.5g}, {rig.cy:.5g} px"),
        ("baseline", f"{rig.baseline:.4g} m{vertical}"),
        ("camera's place", f"({place}) m in the robot's body"),
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
        found.append(
            f"fx and fy differ by more than 5 % ({rig.fx:.1f}, {rig.fy:.1f} px); were the images "
            "stretched after they were calibrated?"
        )
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
