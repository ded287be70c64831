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
    """One line of an inspection: its code in :data:`FINDINGS`, and the values of its sentence."""

    code: str
    values: dict[str, Any]

    @property
    def level(self) -> Level:
        """How bad it is."""
        return FINDINGS[self.code][0]

    @property
    def subject(self) -> str:
        """What it is about, such as "time" or "odometry"."""
        return FINDINGS[self.code][1].format(**self.values)

    @property
    def text(self) -> str:
        """One sentence with the numbers, and the remedy where there is one."""
        return FINDINGS[self.code][2].format(**self.values)


def finding(code: str, **values: Any) -> Finding:
    """The finding of a code, with the values of its sentence."""
    return Finding(code, values)


def by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings, the worst first, otherwise in their order."""
    return tuple(sorted(findings, key=lambda found: list(Level).index(found.level)))


def share(part: int, whole: int) -> str:
    """A part of a whole in words: ``3 of 200 (1.5 %)``."""
    return f"{part} of {whole} ({100.0 * part / max(whole, 1):.3g} %)"


def first_of(items: list[int]) -> str:
    """The first five numbers of a list in words."""
    return ", ".join(str(item) for item in items[:5]) + (", ..." if len(items) > 5 else "")


def _sentences(level: Level, subject: str, **texts: str) -> dict[str, tuple[Level, str, str]]:
    return {code: (level, subject, text) for code, text in texts.items()}


FINDINGS: dict[str, tuple[Level, str, str]] = {
    **_sentences(
        Level.WARNING,
        "recording",
        note="{text}",
    ),
    **_sentences(
        Level.PROBLEM,
        "images",
        unreadable="{share} sampled frames cannot be read, the first: {first}",
        uninformative="the {camera} image is all {kind} ({meaning}) in {share} sampled frames: "
        "{frames}; no feature can be found there, so a run relies on odometry alone: leave them "
        "out with dataset.start and dataset.stop, or record again",
        copies="right and {camera} image are identical in {share} sampled frames: the recording "
        "holds one camera twice; restore the {camera} camera's images",
    ),
    **_sentences(
        Level.WARNING,
        "images",
        brightness="the right camera is {ratio:.2g} times as bright as the {camera} one; give both "
        "one exposure time and gain",
    ),
    **_sentences(
        Level.WARNING,
        "calibration",
        principal_point="the principal point ({rig.cx:.1f}, {rig.cy:.1f}) lies outside the "
        "{rig.width}x{rig.height} image; were the images cropped or resized?",
        focal_lengths="fx and fy differ by more than 5 % ({rig.fx:.1f}, {rig.fy:.1f} px); were the "
        "images stretched after they were calibrated?",
        field_of_view="the field of view of {view:.0f} degrees is unusual; is fx in pixels of these"
        " images?",
        baseline="the {name} of {value:g} m is unusual; is it in metres?",
    ),
    **_sentences(
        Level.WARNING,
        "time",
        few_frames="only {count} frames: too few for a trajectory; widen start, stop and stride",
        gaps="{long} of {steps} steps are longer than {factor} times the median {median:.3g} s; "
        "the longest, {longest:.3g} s, follows frame {worst}; frames were dropped, or only "
        "key frames kept: odometry must bridge them, or cut with dataset.start and "
        "dataset.stop",
    ),
    **_sentences(
        Level.PROBLEM,
        ODOMETRY,
        odometry_malformed="{text}",
    ),
    **_sentences(
        Level.INFO,
        ODOMETRY,
        no_odometry="none recorded; set odometry.kind to constant_velocity, or synthetic if there "
        "is truth",
        odometry_covers="covers {share} steps",
    ),
    **_sentences(
        Level.WARNING,
        ODOMETRY,
        odometry_gaps="none before frames {frames}; constant velocity stands in there",
        odometry_frozen="states no motion in any of {steps} steps; if the robot moved, it is of "
        "another source: choose a topic or file, or set odometry.kind to constant_velocity",
    ),
    **_sentences(
        Level.INFO,
        TRUTH,
        no_truth="none, so no accuracy can be computed",
        truth_covers="covers {share} frames, path length {length:.4g} m",
    ),
    **_sentences(
        Level.WARNING,
        TRUTH,
        truth_jumps="moves suddenly before its poses {poses}: more than {factor:g} times as fast as"
        " before and after, and as in nine of ten steps",
    ),
    **_sentences(
        Level.INFO,
        AGAINST_TRUTH,
        odometry_error="differs from truth by {yaw_deg:.2g} degrees in yaw and {forward_cm:.2g} cm "
        "forward a step (median over {steps} steps)",
    ),
    **_sentences(
        Level.WARNING,
        AGAINST_TRUTH,
        odometry_noise="the error in {name} is {ratio:.1f} times the stated noise; raise its sigma "
        "in the odometry settings, or check mounting and time offset",
        odometry_clock="turns agree best when the odometry's stamps are shifted by {shift:+.2f} s "
        "({best:.2g} instead of {now:.2g} degrees a step, median); add that to "
        "odometry.time_offset_s",
    ),
    **_sentences(
        Level.WARNING,
        "features",
        few_features="the {camera} images have only {count:.0f} SIFT features (median); lower "
        "frontend.sift.contrast_threshold, or give more light or texture",
        unequal_features="the {rich} images have {more:.0f} features but the {poor} ones "
        "{fewer:.0f}; check focus, exposure and dirt of the {poor} camera",
    ),
    **_sentences(
        Level.WARNING,
        "{pair.subject}",
        few_to_judge="only {count} matches between {pair.names}: too few to judge the calibration; "
        "look at more frames, or check that both cameras show one scene at one time",
        edges="{pair.lines} disagree by {edge:.1f} px at the images' edges: they are not quite "
        "rectified {cause}",
        negative="{percent:.0f} % of matches have negative disparity: many wrong matches, or zero "
        "disparity is not at infinity; shift the images so that far points have disparity "
        "zero, and correct cx",
        unsteady="the offset of the {pair.lines} changes from frame to frame ({low:+.2f} to "
        "{high:+.2f} px), most in frames {frames}: trigger the cameras together, or fix them "
        "to one stiff bar",
    ),
    **_sentences(
        Level.INFO,
        "{pair.subject}",
        epipolar="{pair.lines} of {count} matches differ by {offset:+.2f} px (median), spread "
        "{spread:.2f} px, 95 % within {within:.2f} px; disparities {low:.1f} to {high:.1f} px",
    ),
    **_sentences(
        Level.PROBLEM,
        "{pair.subject}",
        crossed="{pair.crossed}",
        shifted="{pair.lines} disagree by {offset:+.1f} px: the pair is not rectified, or shifted; "
        "rectify again, or shift one camera's images",
        scattered="{pair.lines} scatter by {spread:.1f} px: the images are not rectified {cause}",
        swapped="{pair.swapped}: {percent:.0f} % of matches have negative disparity; {pair.unswap}",
    ),
    **_sentences(
        Level.WARNING,
        "matches",
        few_matches="{bad} of {count} frames have fewer than {least} matches: {frames}; correct "
        "what is reported of the images and cameras, else lower frontend.sift.contrast_threshold",
        near_scene="{percent:.0f} % of matches have more than frontend.stereo.max_disparity_px = "
        "{limit:g} and are lost; raise it to {reach:.0f}",
        far_scene="{percent:.0f} % of matches have less than frontend.stereo.min_disparity_px = "
        "{limit:g}: the scene is far for this baseline; use larger images or a longer "
        "baseline",
    ),
    **_sentences(
        Level.WARNING,
        "three cameras",
        few_in_three="only {count} features are matched in all three images: too few to judge the "
        "top camera; look at more frames, or check that it shows the same scene",
        baselines="the vertical disparity is {ratio:.3f} times what the horizontal one and the "
        "calibration say; correct the ratio of the two baselines (or of fx and fy) by that",
    ),
    **_sentences(
        Level.INFO,
        "three cameras",
        disparities="both disparities of {count} features differ by {median:.2f} px (median), "
        "{percent:.0f} % by less than 1 px",
    ),
}
"""Level, subject and sentence by code."""
