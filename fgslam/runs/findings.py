"""Findings of an inspection as data: a code and values; their sentences stand here in a table."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum
from typing import Any

TRUTH, ODOMETRY, AGAINST_TRUTH = "ground truth", "odometry", "odometry against truth"


class Level(str, Enum):
    """How bad a finding is: a problem will spoil a run, a warning may, info informs."""

    PROBLEM = "problem"
    WARNING = "warning"
    INFO = "info"


@dataclass(frozen=True)
class Finding:
    """One line of an inspection.

    Attributes:
        code: in :data:`FINDINGS`.
        level: how bad it is.
        subject: what it is about, such as "time" or "odometry".
        text: one sentence with the numbers, and the remedy where there is one.
    """

    code: str
    level: Level
    subject: str
    text: str


def finding(code: str, **values: Any) -> Finding:
    """The finding of a code, with the values of its sentence."""
    level, subject, text = FINDINGS[code]
    return Finding(code, level, subject.format(**values), text.format(**values))


def by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings, the worst first, otherwise in their order."""
    return tuple(sorted(findings, key=lambda found: list(Level).index(found.level)))


def share(part: int, whole: int) -> str:
    """A part of a whole in words: ``3 of 200 (1.5 %)``."""
    return f"{part} of {whole} ({100.0 * part / max(whole, 1):.3g} %)"


def first_of(items: list[int]) -> str:
    """The first five numbers of a list in words."""
    return ", ".join(str(item) for item in items[:5]) + (", ..." if len(items) > 5 else "")


PROBLEM, WARNING, INFO = Level
FINDINGS: dict[str, tuple[Level, str, str]] = {
    "note": (WARNING, "recording", "{text}"),
    "unreadable": (PROBLEM, "images", "{share} sampled frames cannot be read, the first: {first}"),
    "uninformative": (PROBLEM, "images", "the {camera} image is all {kind} ({meaning}) in {share} "
     "sampled frames: {frames}; no feature can be found there, so a run relies on odometry alone: "
     "leave them out with dataset.start and dataset.stop, or record again"),
    "copies": (PROBLEM, "images", "right and {camera} image are identical in {share} sampled "
     "frames: the recording holds one camera twice; restore the {camera} camera's images"),
    "brightness": (WARNING, "images", "the right camera is {ratio:.2g} times as bright as the "
     "{camera} one; give both one exposure time and gain"),
    "principal_point": (WARNING, "calibration", "the principal point ({rig.cx:.1f}, {rig.cy:.1f}) "
     "lies outside the {rig.width}x{rig.height} image; were the images cropped or resized?"),
    "focal_lengths": (WARNING, "calibration", "fx and fy differ by more than 5 % ({rig.fx:.1f}, "
     "{rig.fy:.1f} px); were the images stretched after they were calibrated?"),
    "field_of_view": (WARNING, "calibration", "the field of view of {view:.0f} degrees is unusual; "
     "is fx in pixels of these images?"),
    "baseline": (WARNING, "calibration", "the {name} of {value:g} m is unusual; is it in metres?"),
    "few_frames": (WARNING, "time", "only {count} frames: too few for a trajectory; widen start, "
     "stop and stride"),
    "gaps": (WARNING, "time", "{long} of {steps} steps are longer than {factor} times the median "
     "{median:.3g} s; the longest, {longest:.3g} s, follows frame {worst}; frames were dropped, or "
     "only key frames kept: odometry must bridge them, or cut with dataset.start and dataset.stop"),
    "odometry_malformed": (PROBLEM, ODOMETRY, "{text}"),
    "no_odometry": (INFO, ODOMETRY, "none recorded; set odometry.kind to constant_velocity, or "
     "synthetic if there is truth"),
    "odometry_covers": (INFO, ODOMETRY, "covers {share} steps"),
    "odometry_gaps": (WARNING, ODOMETRY, "none before frames {frames}; constant velocity stands in "
     "there"),
    "odometry_frozen": (WARNING, ODOMETRY, "states no motion in any of {steps} steps; if the robot "
     "moved, it is of another source: choose a topic or file, or set odometry.kind to "
     "constant_velocity"),
    "no_truth": (INFO, TRUTH, "none, so no accuracy can be computed"),
    "truth_covers": (INFO, TRUTH, "covers {share} frames, path length {length:.4g} m"),
    "truth_jumps": (WARNING, TRUTH, "moves suddenly before its poses {poses}: more than {factor:g} "
     "times as fast as before and after, and as in nine of ten steps"),
    "odometry_error": (INFO, AGAINST_TRUTH, "differs from truth by {yaw_deg:.2g} degrees in yaw "
     "and {forward_cm:.2g} cm forward a step (median over {steps} steps)"),
    "odometry_noise": (WARNING, AGAINST_TRUTH, "the error in {name} is {ratio:.1f} times the "
     "stated noise; raise its sigma in the odometry settings, or check mounting and time offset"),
    "odometry_clock": (WARNING, AGAINST_TRUTH, "turns agree best when the odometry's stamps are "
     "shifted by {shift:+.3f} s; add that to odometry.time_offset_s"),
    "few_features": (WARNING, "features", "the {camera} images have only {count:.0f} SIFT features "
     "(median); lower frontend.sift.contrast_threshold, or give more light or texture"),
    "unequal_features": (WARNING, "features", "the {rich} images have {more:.0f} features but the "
     "{poor} ones {fewer:.0f}; check focus, exposure and dirt of the {poor} camera"),
    "few_to_judge": (WARNING, "{pair.subject}", "only {count} matches between {pair.names}: too "
     "few to judge the calibration; look at more frames, or check that both cameras show one scene "
     "at one time"),
    "edges": (WARNING, "{pair.subject}", "{pair.lines} disagree by {edge:.1f} px at the images' "
     "edges: they are not quite rectified {cause}"),
    "negative": (WARNING, "{pair.subject}", "{percent:.0f} % of matches have negative disparity: "
     "many wrong matches, or zero disparity is not at infinity; shift the images so that far "
     "points have disparity zero, and correct cx"),
    "unsteady": (WARNING, "{pair.subject}", "the offset of the {pair.lines} changes from frame to "
     "frame ({low:+.2f} to {high:+.2f} px), most in frames {frames}: trigger the cameras together, "
     "or fix them to one stiff bar"),
    "epipolar": (INFO, "{pair.subject}", "{pair.lines} of {count} matches differ by {offset:+.2f} "
     "px (median), spread {spread:.2f} px, 95 % within {within:.2f} px; disparities {low:.1f} to "
     "{high:.1f} px"),
    "crossed": (PROBLEM, "{pair.subject}", "{pair.crossed}"),
    "shifted": (PROBLEM, "{pair.subject}", "{pair.lines} disagree by {offset:+.1f} px: the pair is "
     "not rectified, or shifted; rectify again, or shift one camera's images"),
    "scattered": (PROBLEM, "{pair.subject}", "{pair.lines} scatter by {spread:.1f} px: the images "
     "are not rectified {cause}"),
    "swapped": (PROBLEM, "{pair.subject}", "{pair.swapped}: {percent:.0f} % of matches have "
     "negative disparity; {pair.unswap}"),
    "few_matches": (WARNING, "matches", "{bad} of {count} frames have fewer than {least} matches: "
     "{frames}; correct what is reported of the images and cameras, else lower "
     "frontend.sift.contrast_threshold"),
    "near_scene": (WARNING, "matches", "{percent:.0f} % of matches have more than "
     "frontend.stereo.max_disparity_px = {limit:g} and are lost; raise it to {reach:.0f}"),
    "far_scene": (WARNING, "matches", "{percent:.0f} % of matches have less than "
     "frontend.stereo.min_disparity_px = {limit:g}: the scene is far for this baseline; use larger "
     "images or a longer baseline"),
    "few_in_three": (WARNING, "three cameras", "only {count} features are matched in all three "
     "images: too few to judge the top camera; look at more frames, or check that it shows the "
     "same scene"),
    "baselines": (WARNING, "three cameras", "the vertical disparity is {ratio:.3f} times what the "
     "horizontal one and the calibration say; correct the ratio of the two baselines (or of fx and "
     "fy) by that"),
    "disparities": (INFO, "three cameras", "both disparities of {count} features differ by "
     "{median:.2f} px (median), {percent:.0f} % by less than 1 px"),
}  # fmt: skip
"""Level, subject and sentence by code."""
