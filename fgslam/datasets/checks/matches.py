"""Checks of feature matches between the cameras: rectification, order, time, gates.

Finding features and matching them is the front-end's business: positions and counts are handed in.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.sensors import CAMERA_NAMES
from fgslam.datasets.checks.recording import Finding, Level, listed

_FEWEST_MATCHES = 20
_SIGNIFICANT_DISPARITY_PX = 0.5
_MAX_ROW_OFFSET_PX, _MAX_ROW_SPREAD_PX = 0.75, 1.5
_MAX_EDGE_PX = 1.0
_FIT_STEPS = 20
_SCATTER = (
    "(lens distortion, cameras turned against each other) or not taken at one time; rectify them "
    "with the cameras' calibration, trigger the cameras together"
)
_MAX_FRAME_DRIFT_PX = 0.75
_MAX_BASELINE_ERROR = 0.03
_MAX_COUNT_RATIO = 1.5
_FEWEST_FEATURES, _FEWEST_STEREO = 50, 15
_MAX_CUT_OFF = 0.05


@dataclass(frozen=True, slots=True)
class Pair:
    """How to speak of two cameras whose disparity runs along rows or along columns.

    Attributes:
        axis: along which the disparity runs: 0 columns, 1 rows.
        subject: of the findings.
        names: the two cameras.
        lines: what must agree between them: rows or columns.
        swapped: what negative disparities mean, and the remedy.
        crossed: what it means when the disparity runs the other way, and the remedy.
    """

    axis: int
    subject: str
    names: str
    lines: str
    swapped: tuple[str, str]
    crossed: str


LEFT_RIGHT = Pair(
    0,
    "epipolar",
    "left and right",
    "rows",
    ("cameras look swapped", "swap left and right"),
    "the left camera seems to lie above or below the right one, not beside it; give as left a "
    "camera at the right one's left",
)
TOP_RIGHT = Pair(
    1,
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
    offsets: FloatArray,
    disparities: FloatArray,
    pair: Pair = LEFT_RIGHT,
    places: FloatArray | None = None,
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
        places: (n, 2) the right features' (column, row), pixels, from which the cause of unequal
            rows is found; None where it need not be.
    """
    count = len(disparities)
    if count < _FEWEST_MATCHES:
        text = (
            f"only {count} matches between {pair.names}: too few to judge the calibration; look at "
            "more frames, or check that both cameras show one scene at one time"
        )
        return (Finding(Level.WARNING, pair.subject, text),)
    offset, spread = round(float(np.median(offsets)), 2) + 0.0, robust_spread(offsets)
    low, high = np.percentile(disparities, [5.0, 95.0])
    within = float(np.percentile(np.abs(offsets), 95.0))
    summary = (
        f"{pair.lines} of {count} matches differ by {offset:+.2f} px (median), spread "
        f"{spread:.2f} px, 95 % within {within:.2f} px; disparities {low:.1f} to {high:.1f} px"
    )
    found = [Finding(Level.INFO, pair.subject, summary)]
    if _crossed(offsets, disparities):
        found.append(Finding(Level.PROBLEM, pair.subject, pair.crossed))
        return tuple(found)
    turn = None if places is None else fit_turn(offsets, places, pair)
    found.extend(_rectification(offset, spread, pair, turn))
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


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """The offsets across the lines as a linear function of the place in the image.

    Attributes:
        roll: slope along the lines: the angle in radians by which one image is turned.
        growth: slope across the lines: the fraction by which one image is larger.
        residuals: (n,) offsets in pixels without the part of the two slopes.
        at_edge: (2,) offsets in pixels that the two slopes make at the outermost matches.
    """

    roll: float
    growth: float
    residuals: FloatArray
    at_edge: FloatArray

    @property
    def roll_matters(self) -> bool:
        """Whether the turn moves the outermost matches more than the size does."""
        return bool(self.at_edge[0] >= self.at_edge[1])


def fit_turn(offsets: FloatArray, places: FloatArray, pair: Pair = LEFT_RIGHT) -> Turn:
    """Robust fit (Cauchy weights) of offsets (n,) to places (n, 2) as in check_epipolar."""
    centred = places - np.median(places, axis=0)
    along, across = centred[:, pair.axis], centred[:, 1 - pair.axis]
    design = np.column_stack([np.ones(len(offsets)), along, across])
    target = offsets - np.median(offsets)
    slopes: FloatArray = np.zeros(3)
    for _ in range(_FIT_STEPS):
        left = target - design @ slopes
        weight = 1.0 / (1.0 + (left / max(robust_spread(left), 0.1)) ** 2)
        solution = np.linalg.lstsq(design * weight[:, None], target * weight, rcond=None)[0]
        slopes = np.asarray(solution, np.float64)
    edge = np.percentile(np.abs(design[:, 1:]), 95.0, axis=0) * np.abs(slopes[1:])
    residuals = offsets - design[:, 1:] @ slopes[1:]
    return Turn(float(slopes[1]), float(slopes[2]), residuals, edge)


def _rectification(offset: float, spread: float, pair: Pair, turn: Turn | None) -> list[Finding]:
    found = []
    if abs(offset) > _MAX_ROW_OFFSET_PX:
        text = (
            f"{pair.lines} disagree by {offset:+.1f} px: the pair is not rectified, or shifted; "
            "rectify again, or shift one camera's images"
        )
        found.append(Finding(Level.PROBLEM, pair.subject, text))
    explained = turn is not None and robust_spread(turn.residuals) < 0.6 * spread
    if spread > _MAX_ROW_SPREAD_PX:
        cause = _cause(turn, pair) if turn is not None and explained else _SCATTER
        text = f"{pair.lines} scatter by {spread:.1f} px: the images are not rectified {cause}"
        found.append(Finding(Level.PROBLEM, pair.subject, text))
    elif turn is not None and float(turn.at_edge.max()) > _MAX_EDGE_PX:
        text = (
            f"{pair.lines} disagree by {turn.at_edge.max():.1f} px at the images' edges: they are "
            f"not quite rectified {_cause(turn, pair)}"
        )
        found.append(Finding(Level.WARNING, pair.subject, text))
    return found


def _cause(turn: Turn, pair: Pair) -> str:
    """The larger of the two slopes in words, with the remedy."""
    other = pair.names.split(" ", maxsplit=1)[0]
    if turn.roll_matters:
        # Columns grow against the sense in which rows do when an image is turned.
        angle = np.degrees(turn.roll) * (1.0 if pair.axis == 0 else -1.0)
        sense = "clockwise" if angle > 0.0 else "anticlockwise"
        cause = f"the {other} image is turned {sense} by about {abs(angle):.2g} degrees"
    else:
        size = "larger" if turn.growth > 0.0 else "smaller"
        cause = f"the {other} image is {size} by about {100.0 * abs(turn.growth):.2g} %"
    return f"({cause} against the right one); rectify them with the cameras' calibration"


def _negative_share(disparities: FloatArray) -> float:
    significant = disparities[np.abs(disparities) > _SIGNIFICANT_DISPARITY_PX]
    return float((significant < 0.0).mean()) if len(significant) else 0.0


def _camera_order(disparities: FloatArray, pair: Pair) -> list[Finding]:
    negative = _negative_share(disparities)
    share = f"{100.0 * negative:.0f} % of matches have negative disparity"
    if negative > 0.5:
        meaning, remedy = pair.swapped
        return [Finding(Level.PROBLEM, pair.subject, f"{meaning}: {share}; {remedy}")]
    if negative > 0.15:
        text = (
            f"{share}: many wrong matches, or zero disparity is not at infinity; shift the images "
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
    """Whether both disparities of features seen by three cameras give one depth.

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
        f"{listed(frames[bad].tolist())}; correct what is reported of the images and cameras, else "
        "lower frontend.sift.contrast_threshold"
    )
    return (Finding(Level.WARNING, "matches", text),)


def check_disparity_gates(
    disparities: FloatArray, smallest: float, largest: float
) -> tuple[Finding, ...]:
    """Whether the front-end's gates on the disparity suit the scene.

    Args:
        disparities: (n,) of matches found without these gates, pixels.
        smallest: least disparity that the front-end accepts.
        largest: the greatest; infinite without a limit.
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
