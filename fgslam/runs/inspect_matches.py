"""What the features of sampled frames say of the cameras: rectification, order, time, gates."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import FrameError
from fgslam.core.geometry import triangulate, triangulation_covariance
from fgslam.core.log import ImageSequence
from fgslam.core.sensors import CAMERA_NAMES, CameraRig
from fgslam.core.types import Features, StereoFeatures
from fgslam.frontend.features.matching import mutual_nearest
from fgslam.frontend.features.sift import SiftExtractor
from fgslam.frontend.settings import FrontendSettings, StereoSettings
from fgslam.frontend.stereo import StereoMatcher
from fgslam.runs.findings import Finding, Level, first_of

Facts: TypeAlias = tuple[tuple[str, str], ...]
"""Labels and values."""


def spread_over(sequence: ImageSequence, samples: int) -> list[int]:
    """Positions of up to ``samples`` frames, evenly spread, with the first and the last."""
    count = min(samples, len(sequence))
    return np.unique(np.linspace(0, len(sequence) - 1, count).astype(np.int64)).tolist()  # type: ignore[no-any-return]


@dataclass(frozen=True, slots=True)
class Pair:
    """How to speak of two cameras whose disparity runs along rows or along columns.

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
    "swap their images; a camera below cannot be used, so leave it out with dataset.use_top",
    "the top camera seems to lie next to the right one, not above it; give as top a camera above "
    "the right one, or leave it out with dataset.use_top",
)


@dataclass(frozen=True, slots=True, eq=False)
class UngatedMatches:
    """Matches of one frame between the right and another image, found by descriptors alone.

    Attributes:
        right: (k,) the right features.
        across: (k,) offset across the epipolar line, other minus right, pixels.
        along: (k,) disparity along it, other minus right, pixels, of either sign.
        places: (k, 2) column and row in the right image.
    """

    right: IntArray
    across: FloatArray
    along: FloatArray
    places: FloatArray

    @staticmethod
    def of(right: Features, other: Features, axis: int) -> UngatedMatches:
        """Those whose disparity runs along ``axis``: 0 columns, 1 rows."""
        i, j = mutual_nearest(right.descriptors, other.descriptors)
        difference = other.xy[j] - right.xy[i]
        return UngatedMatches(i, difference[:, 1 - axis], difference[:, axis], right.xy[i])


@dataclass(frozen=True, slots=True, eq=False)
class FrameMatches:
    """What one frame shows: counts, matches by the gates of a run, and matches without any.

    Attributes:
        index: the recording's number of the frame.
        features: number of features in right, left[, top].
        pairs: number of right-left matches of SIFT features by the gates of a run.
        stereo: what is left of these after the top camera, if any.
        left: ungated matches with the left image.
        top: the same with the top image, or None.
    """

    index: int
    features: tuple[int, ...]
    pairs: int
    stereo: StereoFeatures
    left: UngatedMatches
    top: UngatedMatches | None


def match_frames(
    sequence: ImageSequence,
    settings: FrontendSettings,
    frames: int,
    progress: Callable[[int, int], None],
) -> tuple[FrameMatches, ...]:
    """Features and matches of up to ``frames`` frames spread over the recording.

    Frames that cannot be read are left out; the checks of the images report them.
    """
    # Descriptors are needed whatever the run makes of them.
    extractor = SiftExtractor(settings.sift, "descriptor")
    matcher = StereoMatcher(sequence.rig, settings.stereo, settings.appearance)
    chosen = spread_over(sequence, frames)
    found = []
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        for done, i in enumerate(chosen, 1):
            with suppress(FrameError):
                frame = sequence.frame(i)
                features = extractor.extract_all(frame.images, pool)
                right, left, *top = features
                found.append(
                    FrameMatches(
                        index=frame.index,
                        features=tuple(map(len, features)),
                        pairs=len(matcher.match_left(right, left)[0]),
                        stereo=matcher.match(features),
                        left=UngatedMatches.of(right, left, 0),
                        top=UngatedMatches.of(right, top[0], 1) if top else None,
                    )
                )
            progress(done, len(chosen))
    return tuple(found)


_FEWEST_FOR_MEDIAN = 10
_NEAR_LINE_PX = 2.0


def check_matches(
    frames: tuple[FrameMatches, ...], rig: CameraRig, settings: StereoSettings
) -> tuple[Finding, ...]:
    """Every finding that the matches give rise to."""
    if not frames:
        return ()
    numbers = np.array([frame.index for frame in frames], np.int64)
    left = [frame.left for frame in frames]
    across, along = (np.concatenate([getattr(m, k) for m in left]) for k in ("across", "along"))
    found = (
        *check_features(np.array([frame.features for frame in frames], np.int64)),
        *_check_pair(left, numbers, LEFT_RIGHT),
    )
    if len(along) >= _FEWEST_MATCHES and _negative_share(along) > 0.5:
        return found  # All else would only follow from cameras in the wrong order.
    near = np.abs(across - np.median(across)) < _NEAR_LINE_PX if len(across) else across > 0.0
    counts = np.array([len(frame.stereo) for frame in frames], np.int64)
    smallest, largest = settings.min_disparity_px, settings.largest_disparity_px
    found += check_stereo_counts(counts, numbers)
    found += check_disparity_gates(along[near], smallest, largest)
    top = [frame.top for frame in frames if frame.top is not None]
    if top:
        vertical = _check_pair(top, numbers, TOP_RIGHT)
        found += vertical
        if all(finding.level is not Level.PROBLEM for finding in vertical):
            found += check_disparity_agreement(*_both_disparities(frames, rig))
    return found


def _check_pair(matches: list[UngatedMatches], frames: IntArray, pair: Pair) -> tuple[Finding, ...]:
    across = np.concatenate([each.across for each in matches])
    along = np.concatenate([each.along for each in matches])
    places = np.concatenate([each.places for each in matches])
    found = check_epipolar(across, along, pair, places)
    if not len(across):
        return found
    # A turned camera would give each frame its own median, by where its features are.
    steady = fit_turn(across, places, pair).residuals
    cuts = np.cumsum([len(each.across) for each in matches])[:-1]
    medians = [
        np.median(part) if len(part) >= _FEWEST_FOR_MEDIAN else np.nan
        for part in np.split(steady, cuts)
    ]
    return (*found, *check_steadiness(np.array(medians), frames, pair))


def _both_disparities(
    frames: tuple[FrameMatches, ...], rig: CameraRig
) -> tuple[FloatArray, FloatArray]:
    """Horizontal and, scaled to it, vertical disparity (k,) of features matched in all images.

    Only matches near both epipolar lines: the others are wrong, or reported already.
    """
    horizontal, vertical = [], []
    for frame in frames:
        if frame.top is None:
            continue
        _, i, j = np.intersect1d(frame.left.right, frame.top.right, return_indices=True)
        near = np.abs(frame.left.across[i]) < _NEAR_LINE_PX
        near &= np.abs(frame.top.across[j]) < _NEAR_LINE_PX
        horizontal.append(frame.left.along[i[near]])
        vertical.append(frame.top.along[j[near]])
    scale = rig.fx * rig.baseline / (rig.fy * (rig.vertical_baseline or rig.baseline))
    return np.concatenate(horizontal), scale * np.concatenate(vertical)


# Rectification and order


_FEWEST_MATCHES = 20
_SIGNIFICANT_DISPARITY_PX = 0.5
_MAX_ROW_OFFSET_PX, _MAX_ROW_SPREAD_PX = 0.75, 1.5
_MAX_EDGE_PX = 1.0
_FIT_STEPS = 20
_MAX_FRAME_DRIFT_PX = 0.75
_SCATTER = (
    "(lens distortion, cameras turned against each other) or not taken at one time; rectify them "
    "with the cameras' calibration, trigger the cameras together"
)


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
    about: dict[str, Any] = {"pair": pair, "count": len(disparities)}
    if len(disparities) < _FEWEST_MATCHES:
        return (Finding("few_to_judge", about),)
    offset, spread = round(float(np.median(offsets)), 2) + 0.0, _robust_spread(offsets)
    low, high = np.percentile(disparities, [5.0, 95.0])
    within = np.percentile(np.abs(offsets), 95.0)
    about |= {"offset": offset, "spread": spread, "within": within, "low": low, "high": high}
    found = [Finding("epipolar", about)]
    # Whether the disparity runs across the direction in which it should.
    middle, along = abs(float(np.median(disparities))), _robust_spread(disparities)
    still = middle < _MAX_ROW_OFFSET_PX and along < _MAX_ROW_SPREAD_PX
    big = abs(float(np.median(offsets))) > 2.0 * _MAX_ROW_OFFSET_PX
    if still and (big or spread > _MAX_ROW_SPREAD_PX):
        return (*found, Finding("crossed", about))
    if abs(offset) > _MAX_ROW_OFFSET_PX:
        found.append(Finding("shifted", about))
    turn = None if places is None else fit_turn(offsets, places, pair)
    if spread > _MAX_ROW_SPREAD_PX:
        explained = turn is not None and _robust_spread(turn.residuals) < 0.6 * spread
        cause = turn.cause(pair) if turn is not None and explained else _SCATTER
        found.append(Finding("scattered", {**about, "cause": cause}))
    elif turn is not None and float(turn.at_edge.max()) > _MAX_EDGE_PX:
        edge = turn.at_edge.max()
        found.append(Finding("edges", {**about, "edge": edge, "cause": turn.cause(pair)}))
    negative = _negative_share(disparities)
    if negative > 0.15:
        code = "swapped" if negative > 0.5 else "negative"
        found.append(Finding(code, {**about, "percent": 100.0 * negative}))
    return tuple(found)


def _robust_spread(values: FloatArray) -> float:
    """Median absolute deviation (n,) scaled to a normal distribution's standard deviation."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def _negative_share(disparities: FloatArray) -> float:
    significant = disparities[np.abs(disparities) > _SIGNIFICANT_DISPARITY_PX]
    return float((significant < 0.0).mean()) if len(significant) else 0.0


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

    def cause(self, pair: Pair) -> str:
        """The larger of the two slopes in words, with the remedy."""
        other = pair.names.split(" ", maxsplit=1)[0]
        if self.roll_matters:
            # Columns grow against the sense in which rows do when an image is turned.
            angle = np.degrees(self.roll) * (1.0 if pair.axis == 0 else -1.0)
            sense = "clockwise" if angle > 0.0 else "anticlockwise"
            cause = f"the {other} image is turned {sense} by about {abs(angle):.2g} degrees"
        else:
            size = "larger" if self.growth > 0.0 else "smaller"
            cause = f"the {other} image is {size} by about {100.0 * abs(self.growth):.2g} %"
        return f"({cause} against the right one); rectify them with the cameras' calibration"


def fit_turn(offsets: FloatArray, places: FloatArray, pair: Pair = LEFT_RIGHT) -> Turn:
    """Robust fit (Cauchy weights) of offsets (n,) to places (n, 2) as in check_epipolar."""
    centred = places - np.median(places, axis=0)
    along, across = centred[:, pair.axis], centred[:, 1 - pair.axis]
    design = np.column_stack([np.ones(len(offsets)), along, across])
    target = offsets - np.median(offsets)
    slopes: FloatArray = np.zeros(3)
    for _ in range(_FIT_STEPS):
        left = target - design @ slopes
        weight = 1.0 / (1.0 + (left / max(_robust_spread(left), 0.1)) ** 2)
        solution = np.linalg.lstsq(design * weight[:, None], target * weight, rcond=None)[0]
        slopes = np.asarray(solution, np.float64)
    edge = np.percentile(np.abs(design[:, 1:]), 95.0, axis=0) * np.abs(slopes[1:])
    residuals = offsets - design[:, 1:] @ slopes[1:]
    return Turn(float(slopes[1]), float(slopes[2]), residuals, edge)


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
    low, high = medians[known].min(), medians[known].max()
    values = {"pair": pair, "low": low, "high": high, "frames": first_of(frames[bad].tolist())}
    return (Finding("unsteady", values),)


# Counts and gates


_MAX_BASELINE_ERROR = 0.03
_MAX_COUNT_RATIO = 1.5
_FEWEST_FEATURES, _FEWEST_STEREO = 50, 15
_MAX_CUT_OFF = 0.05


def check_disparity_agreement(horizontal: FloatArray, vertical: FloatArray) -> tuple[Finding, ...]:
    """Whether both disparities of features seen by three cameras give one depth.

    Args:
        horizontal: (n,) disparities of right and left, pixels.
        vertical: (n,) those of right and top, scaled by the calibration to horizontal ones.
    """
    sound = (horizontal > 2.0) & (vertical > 2.0)
    if sound.sum() < _FEWEST_MATCHES:
        return (Finding("few_in_three", {"count": int(sound.sum())}),)
    ratio = float(np.median(vertical[sound] / horizontal[sound]))
    differences = np.abs(vertical - horizontal)
    percent = 100.0 * np.mean(differences < 1.0)
    values = {"count": len(horizontal), "median": np.median(differences), "percent": percent}
    found = [Finding("disparities", values)]
    if abs(ratio - 1.0) > _MAX_BASELINE_ERROR:
        found.append(Finding("baselines", {"ratio": ratio}))
    return tuple(found)


def check_features(counts: IntArray) -> tuple[Finding, ...]:
    """Whether every camera shows enough features, and about as many. Counts (n, cameras)."""
    if not len(counts):
        return ()
    medians = np.median(counts, axis=0)
    poor, rich = int(np.argmin(medians)), int(np.argmax(medians))
    found = []
    if medians[poor] < _FEWEST_FEATURES:
        values = {"camera": CAMERA_NAMES[poor], "count": medians[poor]}
        found.append(Finding("few_features", values))
    if medians[rich] > _MAX_COUNT_RATIO * medians[poor]:
        names = {"rich": CAMERA_NAMES[rich], "poor": CAMERA_NAMES[poor]}
        values = {**names, "more": medians[rich], "fewer": medians[poor]}
        found.append(Finding("unequal_features", values))
    return tuple(found)


def check_stereo_counts(counts: IntArray, frames: IntArray) -> tuple[Finding, ...]:
    """Frames (n,) whose number of matched features (n,) is too small for a pose."""
    bad = np.flatnonzero(counts < _FEWEST_STEREO)
    if not len(bad):
        return ()
    values = {"bad": len(bad), "count": len(counts), "least": _FEWEST_STEREO}
    return (Finding("few_matches", {**values, "frames": first_of(frames[bad].tolist())}),)


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
        values = {"percent": 100.0 * near, "limit": largest, "reach": reach}
        found.append(Finding("near_scene", values))
    if far > 0.5:
        found.append(Finding("far_scene", {"percent": 100.0 * far, "limit": smallest}))
    return tuple(found)


# Facts


_LISTED = 14
_FEWEST_FOR_DEPTH = 10  # a frame; fewer are mostly wrong ones


def match_facts(
    frames: tuple[FrameMatches, ...], rig: CameraRig, settings: StereoSettings
) -> Facts:
    """Label and value of what the features and matches of the sampled frames are."""
    if not frames:
        return (("frames matched", "none could be read"),)
    names = [str(frame.index) for frame in frames]
    if len(names) > _LISTED:
        names = [*names[: _LISTED - 2], "...", names[-1]]
    counts = np.array([frame.features for frame in frames])
    features = [f"{CAMERA_NAMES[c]} {_range_of(counts[:, c])}" for c in range(counts.shape[1])]
    pairs = _range_of(np.array([frame.pairs for frame in frames]))
    facts = [
        ("frames matched", f"{len(frames)}: {', '.join(names)}"),
        ("SIFT features", ", ".join(features)),
        ("right-left matches", f"{pairs} a frame"),
    ]
    if rig.cameras == 3:
        all_three = _range_of(np.array([len(frame.stereo) for frame in frames]))
        facts.append(("three-camera matches", f"{all_three} a frame"))
    measurement = np.concatenate([frame.stereo.measurement for frame in frames])
    if len(measurement) < _FEWEST_FOR_DEPTH * len(frames):
        return (*facts, ("depth", "unknown: too few matches"))
    low, middle, high = np.percentile(measurement[:, 2], [5.0, 50.0, 95.0])
    near, usual, far = np.percentile(triangulate(rig, measurement)[:, 2], [5.0, 50.0, 95.0])
    noise = np.zeros((len(measurement), 3, 3))
    noise[:, 2, 2] = 2.0 * settings.pixel_sigma**2  # a disparity is a difference of two positions
    blur = np.sqrt(np.median(triangulation_covariance(rig, measurement, noise)[:, 2, 2]))
    depth = f"{near:.3g} to {far:.3g} m (5 to 95 %), median {usual:.3g} +- {blur:.2g} m"
    disparity = f"{low:.1f} to {high:.1f} px (5 to 95 %), median {middle:.1f} px"
    return (*facts, ("disparity", disparity), ("depth", depth))


def _range_of(counts: IntArray) -> str:
    """Median and range in words."""
    return f"{np.median(counts):.0f} ({counts.min()}-{counts.max()})"
