"""What feature matches between the cameras say about rectification, order, time and gates.

Finding features and matching them is the front-end's business: positions and counts are handed in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.datasets.findings import Finding, Level, listed
from fgslam.datasets.image_checks import CAMERA_NAMES
from fgslam.types import FloatArray, IntArray

_FEWEST_MATCHES = 20
_SIGNIFICANT_DISPARITY_PX = 0.5
_MAX_ROW_OFFSET_PX, _MAX_ROW_SPREAD_PX = 0.75, 1.5
_MAX_FRAME_DRIFT_PX = 0.75
_MAX_BASELINE_ERROR = 0.03
_MAX_COUNT_RATIO = 1.5
_FEWEST_FEATURES, _FEWEST_STEREO = 50, 15
_MAX_CUT_OFF = 0.05


@dataclass(frozen=True, slots=True)
class Pair:
    """How to speak of two cameras whose disparity runs along rows or along columns.

    Attributes:
        subject: of the findings.
        names: the two cameras.
        lines: what must agree between them: rows or columns.
        swapped: what negative disparities mean, and the mend.
        crossed: what it means when the disparity runs the other way, and the mend.
    """

    subject: str
    names: str
    lines: str
    swapped: tuple[str, str]
    crossed: str


LEFT_RIGHT = Pair(
    "epipolar",
    "left and right",
    "rows",
    ("cameras look swapped", "swap left and right"),
    "the left camera seems to lie above or below the right one, not beside it; give as left a "
    "camera at the right one's left",
)
TOP_RIGHT = Pair(
    "epipolar, top",
    "top and right",
    "columns",
    (
        "the top camera looks swapped with the right one, or lies below it",
        "swap their images; a camera below cannot be used, so leave it out with dataset.use_top",
    ),
    "the top camera seems to lie beside the right one, not above it; give as top a camera above "
    "the right one, or leave it out with dataset.use_top",
)


def robust_spread(values: FloatArray) -> float:
    """Median absolute deviation (n,) scaled to a normal distribution's standard deviation."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


# --------------------------------------------------------------------------------------------
# Rectification and order


def check_epipolar(
    offsets: FloatArray, disparities: FloatArray, pair: Pair = LEFT_RIGHT
) -> tuple[Finding, ...]:
    """What matches between two cameras' images say about rectification and order.

    The matches must have been found *without* a gate on rows or on the sign of the disparity,
    over several frames; outliers are expected, so medians decide.

    Args:
        offsets: (n,) row in the left minus row in the right image, pixels; for the top camera
            column in the top minus column in the right image.
        disparities: (n,) column in the left minus column in the right image, pixels; for the top
            camera row in the top minus row in the right image.
        pair: which two cameras.
    """
    count = len(disparities)
    if count < _FEWEST_MATCHES:
        text = (
            f"only {count} matches between {pair.names}: too few to judge the calibration; look at "
            "more frames, or check that both cameras show one scene at one time"
        )
        return (Finding(Level.WARNING, pair.subject, text),)
    offset, spread = float(np.median(offsets)), robust_spread(offsets)
    low, high = np.percentile(disparities, [5.0, 95.0])
    within = float(np.percentile(np.abs(offsets), 95.0))
    summary = (
        f"{pair.lines} of {count} matches differ by {round(offset, 2) + 0.0:+.2f} px (median), spread "
        f"{spread:.2f} px, 95 % within {within:.2f} px; disparities {low:.1f} to {high:.1f} px"
    )
    found = [Finding(Level.INFO, pair.subject, summary)]
    if _crossed(offsets, disparities):
        found.append(Finding(Level.PROBLEM, pair.subject, pair.crossed))
        return tuple(found)
    found.extend(_rectification(offset, spread, pair))
    found.extend(_camera_order(disparities, pair))
    return tuple(found)


def camera_order_is_wrong(disparities: FloatArray) -> bool:
    """Whether most of the significant disparities (n,) are negative."""
    return len(disparities) >= _FEWEST_MATCHES and _negative_share(disparities) > 0.5


def _crossed(offsets: FloatArray, disparities: FloatArray) -> bool:
    """Whether the disparity runs across the direction in which it should."""
    across, along = robust_spread(offsets), robust_spread(disparities)
    big = abs(float(np.median(offsets))) > 2.0 * _MAX_ROW_OFFSET_PX
    still = abs(float(np.median(disparities))) < _MAX_ROW_OFFSET_PX and along < _MAX_ROW_SPREAD_PX
    return still and (big or across > _MAX_ROW_SPREAD_PX)


def _rectification(offset: float, spread: float, pair: Pair) -> list[Finding]:
    found = []
    if abs(offset) > _MAX_ROW_OFFSET_PX:
        text = (
            f"{pair.lines} disagree by {offset:+.1f} px: the pair is not rectified, or shifted; "
            "rectify again, or shift one camera's images"
        )
        found.append(Finding(Level.PROBLEM, pair.subject, text))
    if spread > _MAX_ROW_SPREAD_PX:
        text = (
            f"{pair.lines} scatter by {spread:.1f} px: the images are not rectified (lens "
            "distortion, or cameras turned against each other); rectify them with the cameras' "
            "calibration"
        )
        found.append(Finding(Level.PROBLEM, pair.subject, text))
    return found


def _negative_share(disparities: FloatArray) -> float:
    significant = disparities[np.abs(disparities) > _SIGNIFICANT_DISPARITY_PX]
    return float((significant < 0.0).mean()) if len(significant) else 0.0


def _camera_order(disparities: FloatArray, pair: Pair) -> list[Finding]:
    negative = _negative_share(disparities)
    told = f"{100.0 * negative:.0f} % of matches have negative disparity"
    if negative > 0.5:
        meaning, mend = pair.swapped
        return [Finding(Level.PROBLEM, pair.subject, f"{meaning}: {told}; {mend}")]
    if negative > 0.15:
        text = (
            f"{told}: many wrong matches, or zero disparity is not at infinity; shift the images "
            "so that far points have disparity zero, and correct cx"
        )
        return [Finding(Level.WARNING, pair.subject, text)]
    return []


def check_steadiness(
    medians: FloatArray, frames: IntArray, pair: Pair = LEFT_RIGHT
) -> tuple[Finding, ...]:
    """Whether the offset across the lines is the same in all frames.

    Cameras that are not triggered together see a moving rig from two places.

    Args:
        medians: (n,) each frame's median offset, pixels; NaN where too few matched.
        frames: (n,) the recording's numbers of these frames.
        pair: which two cameras.
    """
    known = np.isfinite(medians)
    if known.sum() < 3:
        return ()
    away = np.abs(medians - np.median(medians[known]))
    bad = np.flatnonzero(known & (away > _MAX_FRAME_DRIFT_PX))
    if not len(bad):
        return ()
    low, high = float(medians[known].min()), float(medians[known].max())
    text = (
        f"the offset of the {pair.lines} changes from frame to frame ({low:+.2f} to {high:+.2f} "
        f"px), most in frames {listed(frames[bad].tolist())}: trigger the cameras together, or fix "
        "them to one stiff bar"
    )
    return (Finding(Level.WARNING, pair.subject, text),)


def check_disparity_agreement(horizontal: FloatArray, vertical: FloatArray) -> tuple[Finding, ...]:
    """Whether both disparities of features seen by three cameras tell one depth.

    Args:
        horizontal: (n,) disparities of right and left, pixels.
        vertical: (n,) those of right and top, scaled by the calibration to horizontal ones.
    """
    subject = "three cameras"
    sound = (horizontal > 2.0) & (vertical > 2.0)
    if sound.sum() < _FEWEST_MATCHES:
        text = (
            f"only {int(sound.sum())} features are matched in all three images: too few to judge "
            "the top camera; look at more frames, or check that it shows the same scene"
        )
        return (Finding(Level.WARNING, subject, text),)
    ratio = float(np.median(vertical[sound] / horizontal[sound]))
    differences = np.abs(vertical - horizontal)
    text = (
        f"both disparities of {len(horizontal)} features differ by {np.median(differences):.2f} px "
        f"(median), {100.0 * np.mean(differences < 1.0):.0f} % by less than 1 px"
    )
    found = [Finding(Level.INFO, subject, text)]
    if abs(ratio - 1.0) > _MAX_BASELINE_ERROR:
        text = (
            f"the vertical disparity is {ratio:.3f} times what the horizontal one and the "
            "calibration say; correct the ratio of the two baselines (or of fx and fy) by that"
        )
        found.append(Finding(Level.WARNING, subject, text))
    return tuple(found)


# --------------------------------------------------------------------------------------------
# Counts and gates


def check_features(counts: IntArray) -> tuple[Finding, ...]:
    """Whether every camera shows enough features, and about as many. Counts (n, cameras)."""
    if not len(counts):
        return ()
    medians = np.median(counts, axis=0)
    poor, rich = int(np.argmin(medians)), int(np.argmax(medians))
    found = []
    if medians[poor] < _FEWEST_FEATURES:
        text = (
            f"the {CAMERA_NAMES[poor]} images have only {medians[poor]:.0f} SIFT features (median);"
            " lower frontend.sift.contrast_threshold, or give more light or texture"
        )
        found.append(Finding(Level.WARNING, "features", text))
    if medians[rich] > _MAX_COUNT_RATIO * medians[poor]:
        text = (
            f"the {CAMERA_NAMES[rich]} images have {medians[rich]:.0f} features but the "
            f"{CAMERA_NAMES[poor]} ones {medians[poor]:.0f}; check focus, exposure and dirt of the "
            f"{CAMERA_NAMES[poor]} camera"
        )
        found.append(Finding(Level.WARNING, "features", text))
    return tuple(found)


def check_stereo_counts(counts: IntArray, frames: IntArray) -> tuple[Finding, ...]:
    """Frames (n,) whose number of matched features (n,) is too small for a pose."""
    bad = np.flatnonzero(counts < _FEWEST_STEREO)
    if not len(bad):
        return ()
    text = (
        f"{len(bad)} of {len(counts)} frames have fewer than {_FEWEST_STEREO} matches: "
        f"{listed(frames[bad].tolist())}; mend what is said of the images and cameras, else lower "
        "frontend.sift.contrast_threshold"
    )
    return (Finding(Level.WARNING, "matches", text),)


def check_disparity_gates(
    disparities: FloatArray, smallest: float, largest: float
) -> tuple[Finding, ...]:
    """Whether the front-end's gates on the disparity suit the scene.

    Args:
        disparities: (n,) of matches found without these gates, pixels.
        smallest: least disparity that the front-end accepts.
        largest: the greatest.
    """
    if len(disparities) < _FEWEST_MATCHES:
        return ()
    near = float((disparities > largest).mean())
    far = float((disparities < smallest).mean())
    found = []
    if near > _MAX_CUT_OFF:
        reach = 10.0 * np.ceil(0.1 * float(np.percentile(disparities, 99.0)))
        text = (
            f"{100.0 * near:.0f} % of matches have more than frontend.stereo.max_disparity_px = "
            f"{largest:g} and are lost; raise it to {reach:.0f}"
        )
        found.append(Finding(Level.WARNING, "matches", text))
    if far > 0.5:
        text = (
            f"{100.0 * far:.0f} % of matches have less than frontend.stereo.min_disparity_px = "
            f"{smallest:g}: the scene is far for this baseline; use larger images or a longer "
            "baseline"
        )
        found.append(Finding(Level.WARNING, "matches", text))
    return tuple(found)
