"""What the features of sampled frames say of the cameras: rectification, order, time, gates.

Matches of the right image with the left and the top one are found by descriptors alone, without a
gate on rows or on the sign of the disparity; outliers are expected, so medians decide.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import reduce
from typing import Any, TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray, Rows, robust_spread, thinned
from fgslam.core.errors import FrameError
from fgslam.core.log import ImageSequence
from fgslam.core.sensors import CAMERA_NAMES, CameraRig
from fgslam.core.types import Features, StereoFeatures
from fgslam.frontend.features.matching import mutual_nearest
from fgslam.frontend.features.sift import SiftExtractor
from fgslam.frontend.settings import FrontendSettings, StereoSettings
from fgslam.frontend.stereo import StereoMatcher
from fgslam.runs.findings import Finding, Level, finding, first_of
from fgslam.runs.units import Progress

Facts: TypeAlias = tuple[tuple[str, str], ...]
"""Labels and values."""


@dataclass(frozen=True, slots=True)
class Pair:
    """Two cameras whose disparity runs along rows or along columns, in words.

    Attributes:
        axis: along which the disparity runs: 0 columns, 1 rows.
        subject: of the findings.
        names: the two cameras.
        lines: what must agree between them: rows or columns.
        swapped, unswap: what negative disparities mean, and the remedy.
        crossed: what it means when the disparity runs the other way, and the remedy.
    """

    axis: int
    subject: str
    names: str
    lines: str
    swapped: str
    unswap: str
    crossed: str


LEFT_RIGHT = Pair(
    0,
    "epipolar",
    "left and right",
    "rows",
    "cameras look swapped",
    "swap left and right",
    "the left camera seems to lie above or below the right one, not next to it; give as left a "
    "camera at the right one's left",
)
TOP_RIGHT = Pair(
    1,
    "epipolar, top",
    "top and right",
    "columns",
    "the top camera seems swapped with the right one, or lies below it",
    "swap their images; a camera below cannot be used, so move its images elsewhere",
    "the top camera seems to lie next to the right one, not above it; give as top a camera above "
    "the right one, or move its images elsewhere",
)


@dataclass(frozen=True, slots=True, eq=False)
class Matches(Rows):
    """Matches of the right image with another one in all frames.

    Attributes:
        frame: (n,) position among the sampled frames.
        right: (n,) the right features.
        across: (n,) offset across the epipolar line, other minus right, pixels.
        along: (n,) disparity along it, other minus right, pixels, of either sign.
        places: (n, 2) column and row in the right image.
    """

    frame: IntArray
    right: IntArray
    across: FloatArray
    along: FloatArray
    places: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """What the sampled frames show.

    Attributes:
        frames: (n,) the recording's numbers of them.
        features: (n, cameras) number of features.
        pairs: (n,) number of right-left matches by the gates of a run.
        stereo: of each frame what is left of these after the top camera, if any.
        left, top: matches of descriptors; no top without that camera.
    """

    frames: IntArray
    features: IntArray
    pairs: IntArray
    stereo: tuple[StereoFeatures, ...]
    left: Matches
    top: Matches | None


def match_frames(
    sequence: ImageSequence,
    settings: FrontendSettings,
    frames: int,
    progress: Progress,
) -> Samples | None:
    """Features and matches of up to ``frames`` frames spread over the recording; None: of none.

    Frames that cannot be read are left out; the checks of the images report them.
    """
    # Descriptors are needed whatever the run makes of them.
    extractor = SiftExtractor(settings.sift, "descriptor")
    matcher = StereoMatcher(sequence.rig, settings.stereo, settings.appearance)
    chosen = thinned(len(sequence), frames).tolist()
    numbers: list[int] = []
    counts, pairs, stereo = [], [], []
    others: list[list[Matches]] = [[], []]
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        for done, i in enumerate(chosen, 1):
            with suppress(FrameError):
                frame = sequence.frame(i)
                features = tuple(pool.map(extractor.extract, frame.images))
                for axis, other in enumerate(features[1:]):
                    others[axis].append(_matched(len(numbers), features[0], other, axis))
                numbers.append(frame.index)
                counts.append([len(one) for one in features])
                pairs.append(len(matcher.match_left(features[0], features[1])[0]))
                stereo.append(matcher.match(features))
            progress("matching", done, len(chosen))
    if not numbers:
        return None
    left, top = reduce(Matches.join, others[0]), None
    if others[1]:
        top = reduce(Matches.join, others[1])
    return Samples(np.array(numbers), np.array(counts), np.array(pairs), tuple(stereo), left, top)


def _matched(frame: int, right: Features, other: Features, axis: int) -> Matches:
    i, j = mutual_nearest(right.descriptors, other.descriptors)
    difference = other.xy[j] - right.xy[i]
    across, along = difference[:, 1 - axis], difference[:, axis]
    return Matches(np.full(len(i), frame), i, across, along, right.xy[i])


_FEWEST_MATCHES = 20
_FEWEST_FEATURES, _FEWEST_STEREO = 50, 15
_MAX_COUNT_RATIO = 1.5
_NEAR_LINE_PX = 2.0
_MAX_CUT_OFF = 0.05


def check_matches(
    seen: Samples | None, rig: CameraRig, settings: StereoSettings
) -> tuple[Finding, ...]:
    """Every finding that the matches give rise to."""
    if seen is None:
        return ()
    found = [*_check_features(seen.features), *check_pair(seen.left, seen.frames, LEFT_RIGHT)]
    across, along = seen.left.across, seen.left.along
    if len(along) >= _FEWEST_MATCHES and _negative_share(along) > 0.5:
        return tuple(found)  # All else would only follow from cameras in the wrong order.
    stereo = np.array([len(one) for one in seen.stereo])
    bad = np.flatnonzero(stereo < _FEWEST_STEREO)
    if len(bad):
        values = {"bad": len(bad), "count": len(stereo), "least": _FEWEST_STEREO}
        found.append(finding("few_matches", **values, frames=first_of(seen.frames[bad].tolist())))
    near = np.abs(across - np.median(across)) < _NEAR_LINE_PX if len(across) else across > 0.0
    smallest, largest = settings.min_disparity_px, settings.largest_disparity_px
    found += check_disparity_gates(along[near], smallest, largest)
    if seen.top is not None:
        vertical = check_pair(seen.top, seen.frames, TOP_RIGHT)
        found += vertical
        if all(one.level is not Level.PROBLEM for one in vertical):
            found += _check_agreement(seen.left, seen.top, rig)
    return tuple(found)


def _check_features(counts: IntArray) -> list[Finding]:
    """Whether every camera shows enough features, and about as many. Counts (n, cameras)."""
    medians = np.median(counts, axis=0)
    poor, rich = int(np.argmin(medians)), int(np.argmax(medians))
    names = {"rich": CAMERA_NAMES[rich], "poor": CAMERA_NAMES[poor]}
    found = []
    if medians[poor] < _FEWEST_FEATURES:
        found.append(finding("few_features", camera=names["poor"], count=medians[poor]))
    if medians[rich] > _MAX_COUNT_RATIO * medians[poor]:
        counted = {"more": medians[rich], "fewer": medians[poor]}
        found.append(finding("unequal_features", **names, **counted))
    return found


def check_disparity_gates(
    disparities: FloatArray, smallest: float, largest: float
) -> list[Finding]:
    """Whether the front-end's gates suit the disparities (n,), pixels, found without them."""
    if len(disparities) < _FEWEST_MATCHES:
        return []
    near = float((disparities > largest).mean())
    far = float((disparities < smallest).mean())
    found = []
    if near > _MAX_CUT_OFF:
        reach = 10.0 * np.ceil(0.1 * float(np.percentile(disparities, 99.0)))
        found.append(finding("near_scene", percent=100.0 * near, limit=largest, reach=reach))
    if far > 0.5:
        found.append(finding("far_scene", percent=100.0 * far, limit=smallest))
    return found


# --------------------------------------------------------------------------------------------
# Rectification and order


_FEWEST_FOR_MEDIAN = 10
_SIGNIFICANT_DISPARITY_PX = 0.5
_MAX_ROW_OFFSET_PX, _MAX_ROW_SPREAD_PX = 0.75, 1.5
_MAX_EDGE_PX = 1.0
_FIT_STEPS = 20
_MAX_FRAME_DRIFT_PX = 0.75
_MAX_BASELINE_ERROR = 0.03
_SCATTER = (
    "(lens distortion, cameras turned against each other) or not taken at one time; rectify them "
    "with the cameras' calibration, trigger the cameras together"
)


def check_pair(matches: Matches, frames: IntArray, pair: Pair) -> list[Finding]:
    """What matches say about rectification, order and simultaneity of two cameras.

    Args:
        matches: of all frames.
        frames: (k,) the recording's numbers of the frames.
        pair: which two cameras.
    """
    offsets, disparities = matches.across, matches.along
    about: dict[str, Any] = {"pair": pair, "count": len(disparities)}
    if not len(disparities):
        return [finding("few_to_judge", **about)]
    steady, at_edge, cause = _fitted_turn(matches, pair)
    unsteady = _check_steadiness(steady, matches.frame, frames, pair)
    if len(disparities) < _FEWEST_MATCHES:
        return [finding("few_to_judge", **about), *unsteady]
    offset, spread = round(float(np.median(offsets)), 2) + 0.0, robust_spread(offsets)
    low, high = np.percentile(disparities, [5.0, 95.0])
    within = np.percentile(np.abs(offsets), 95.0)
    about |= {"offset": offset, "spread": spread, "within": within, "low": low, "high": high}
    found = [finding("epipolar", **about)]
    # Whether the disparity runs across the direction in which it should.
    middle, along = abs(float(np.median(disparities))), robust_spread(disparities)
    still = middle < _MAX_ROW_OFFSET_PX and along < _MAX_ROW_SPREAD_PX
    big = abs(float(np.median(offsets))) > 2.0 * _MAX_ROW_OFFSET_PX
    if still and (big or spread > _MAX_ROW_SPREAD_PX):
        return [*found, finding("crossed", **about), *unsteady]
    if abs(offset) > _MAX_ROW_OFFSET_PX:
        found.append(finding("shifted", **about))
    if spread > _MAX_ROW_SPREAD_PX:
        explained = robust_spread(steady) < 0.6 * spread
        found.append(finding("scattered", **about, cause=cause if explained else _SCATTER))
    elif at_edge > _MAX_EDGE_PX:
        found.append(finding("edges", **about, edge=at_edge, cause=cause))
    negative = _negative_share(disparities)
    if negative > 0.15:
        code = "swapped" if negative > 0.5 else "negative"
        found.append(finding(code, **about, percent=100.0 * negative))
    return [*found, *unsteady]


def _negative_share(disparities: FloatArray) -> float:
    significant = disparities[np.abs(disparities) > _SIGNIFICANT_DISPARITY_PX]
    return float((significant < 0.0).mean()) if len(significant) else 0.0


def _fitted_turn(matches: Matches, pair: Pair) -> tuple[FloatArray, float, str]:
    """Robust fit (Cauchy weights) of the offsets across the lines to the place in the image.

    The slope along the lines is the angle in radians by which one image is turned, that across them
    the fraction by which it is larger.

    Returns:
        Offsets (n,) without the part of the two slopes, what these make at the outermost matches,
        both in pixels, and the larger of the two in words, with the remedy.
    """
    offsets, places = matches.across, matches.places
    centred = places - np.median(places, axis=0)
    design = np.column_stack(
        [np.ones(len(offsets)), centred[:, pair.axis], centred[:, 1 - pair.axis]]
    )
    target = offsets - np.median(offsets)
    slopes: FloatArray = np.zeros(3)
    for _ in range(_FIT_STEPS):
        left = target - design @ slopes
        weight = 1.0 / (1.0 + (left / max(robust_spread(left), 0.1)) ** 2)
        solution = np.linalg.lstsq(design * weight[:, None], target * weight, rcond=None)[0]
        slopes = np.asarray(solution, np.float64)
    edge = np.percentile(np.abs(design[:, 1:]), 95.0, axis=0) * np.abs(slopes[1:])
    other = pair.names.split(" ", maxsplit=1)[0]
    if edge[0] >= edge[1]:
        # Columns grow against the sense in which rows do when an image is turned.
        angle = np.degrees(slopes[1]) * (1.0 if pair.axis == 0 else -1.0)
        sense = "clockwise" if angle > 0.0 else "anticlockwise"
        cause = f"the {other} image is turned {sense} by about {abs(angle):.2g} degrees"
    else:
        size = "larger" if slopes[2] > 0.0 else "smaller"
        cause = f"the {other} image is {size} by about {100.0 * abs(slopes[2]):.2g} %"
    cause = f"({cause} against the right one); rectify them with the cameras' calibration"
    return offsets - design[:, 1:] @ slopes[1:], float(edge.max()), cause


def _check_steadiness(
    steady: FloatArray, frame: IntArray, frames: IntArray, pair: Pair
) -> list[Finding]:
    """Whether the offset across the lines is the same in all frames.

    Cameras that are not triggered together see a moving rig from two places. A turned camera would
    give each frame its own median, by where its features are: offsets (n,) are without that.
    """
    parts = [steady[frame == k] for k in range(len(frames))]
    medians = np.array(
        [np.median(part) if len(part) >= _FEWEST_FOR_MEDIAN else np.nan for part in parts]
    )
    known = np.isfinite(medians)
    if known.sum() < 3:
        return []
    away = np.abs(medians - np.median(medians[known]))
    bad = np.flatnonzero(known & (away > _MAX_FRAME_DRIFT_PX))
    if not len(bad):
        return []
    low, high = medians[known].min(), medians[known].max()
    named = first_of(frames[bad].tolist())
    return [finding("unsteady", pair=pair, low=low, high=high, frames=named)]


def _check_agreement(left: Matches, top: Matches, rig: CameraRig) -> list[Finding]:
    """Whether both disparities of features matched in all images give one depth.

    Only matches near both epipolar lines: the others are wrong, or reported already.
    """
    most = 1 + max(left.right.max(initial=0), top.right.max(initial=0))
    keys = (one.frame * most + one.right for one in (left, top))
    _, i, j = np.intersect1d(*keys, return_indices=True)
    near = np.abs(left.across[i]) < _NEAR_LINE_PX
    near &= np.abs(top.across[j]) < _NEAR_LINE_PX
    scale = rig.fx * rig.baseline / (rig.fy * (rig.vertical_baseline or rig.baseline))
    horizontal, vertical = left.along[i[near]], scale * top.along[j[near]]
    sound = (horizontal > 2.0) & (vertical > 2.0)
    if sound.sum() < _FEWEST_MATCHES:
        return [finding("few_in_three", count=int(sound.sum()))]
    ratio = float(np.median(vertical[sound] / horizontal[sound]))
    differences = np.abs(vertical - horizontal)
    percent = 100.0 * np.mean(differences < 1.0)
    values = {"count": len(horizontal), "median": np.median(differences), "percent": percent}
    found = [finding("disparities", **values)]
    if abs(ratio - 1.0) > _MAX_BASELINE_ERROR:
        found.append(finding("baselines", ratio=ratio))
    return found


# --------------------------------------------------------------------------------------------
# Facts


_LISTED = 14
_FEWEST_FOR_DEPTH = 10  # a frame; fewer are mostly wrong ones


def match_facts(seen: Samples | None, rig: CameraRig, settings: StereoSettings) -> Facts:
    """Label and value of what the features and matches of the sampled frames are."""
    if seen is None:
        return (("frames matched", "none could be read"),)
    names = [str(number) for number in seen.frames]
    if len(names) > _LISTED:
        names = [*names[: _LISTED - 2], "...", names[-1]]
    features = [
        f"{name} {_range_of(counts)}"
        for name, counts in zip(CAMERA_NAMES, seen.features.T, strict=False)
    ]
    facts = [
        ("frames matched", f"{len(seen.frames)}: {', '.join(names)}"),
        ("SIFT features", ", ".join(features)),
        ("right-left matches", f"{_range_of(seen.pairs)} a frame"),
    ]
    if rig.cameras == 3:
        all_three = _range_of(np.array([len(one) for one in seen.stereo]))
        facts.append(("three-camera matches", f"{all_three} a frame"))
    measurement = np.concatenate([one.measurement for one in seen.stereo])
    if len(measurement) < _FEWEST_FOR_DEPTH * len(seen.frames):
        return (*facts, ("depth", "unknown: too few matches"))
    low, middle, high = np.percentile(measurement[:, 2], [5.0, 50.0, 95.0])
    near, usual, far = np.percentile(rig.triangulate(measurement)[:, 2], [5.0, 50.0, 95.0])
    noise = np.zeros((len(measurement), 3, 3))
    noise[:, 2, 2] = 2.0 * settings.pixel_sigma**2  # a disparity is a difference of two positions
    blur = np.sqrt(np.median(rig.triangulation_covariance(measurement, noise)[:, 2, 2]))
    depth = f"{near:.3g} to {far:.3g} m (5 to 95 %), median {usual:.3g} +- {blur:.2g} m"
    disparity = f"{low:.1f} to {high:.1f} px (5 to 95 %), median {middle:.1f} px"
    return (*facts, ("disparity", disparity), ("depth", depth))


def _range_of(counts: IntArray) -> str:
    """Median and range in words."""
    return f"{np.median(counts):.0f} ({counts.min()}-{counts.max()})"
