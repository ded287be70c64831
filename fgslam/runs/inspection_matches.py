"""Features and matches of sampled frames, as ``inspect`` judges and reports them."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import FrameError
from fgslam.core.features import Features, StereoFeatures
from fgslam.core.geometry import triangulate, triangulation_covariance
from fgslam.core.recordings import Sequence
from fgslam.core.sensors import CAMERA_NAMES, CameraRig
from fgslam.datasets.checks.matches import (
    LEFT_RIGHT,
    TOP_RIGHT,
    Pair,
    camera_order_is_wrong,
    check_disparity_agreement,
    check_disparity_gates,
    check_epipolar,
    check_features,
    check_steadiness,
    check_stereo_counts,
    fit_turn,
)
from fgslam.datasets.checks.recording import Finding, Level, spread_over
from fgslam.frontend.features.matching import mutual_nearest
from fgslam.frontend.features.sift import SiftExtractor
from fgslam.frontend.settings import FrontendSettings, StereoSettings
from fgslam.frontend.stereo import StereoMatcher

_FEWEST_FOR_MEDIAN = 10
_NEAR_LINE_PX = 2.0
_LISTED = 14
_FEWEST_FOR_DEPTH = 10  # a frame; fewer are mostly wrong ones


@dataclass(frozen=True, slots=True, eq=False)
class Free:
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


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """What one frame shows: counts, our own matches, and matches without any gate.

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
    left: Free
    top: Free | None


def look_at_frames(
    sequence: Sequence,
    settings: FrontendSettings,
    frames: int,
    progress: Callable[[int, int], None],
) -> tuple[Look, ...]:
    """Features and matches of up to ``frames`` frames spread over the recording.

    Frames that cannot be read are left out; the checks of the images tell about them.
    """
    # Descriptors are needed whatever the run makes of them.
    extractor = SiftExtractor(settings.sift, "descriptor")
    matcher = StereoMatcher(sequence.rig, settings.stereo, settings.appearance)
    chosen = spread_over(sequence, frames).tolist()
    looks = []
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        for done, i in enumerate(chosen, 1):
            with suppress(FrameError):
                frame = sequence.frame(i)
                features = extractor.extract_all(frame.images, pool)
                looks.append(_look(frame.index, features, matcher))
            progress(done, len(chosen))
    return tuple(looks)


def _look(index: int, features: tuple[Features, ...], matcher: StereoMatcher) -> Look:
    right, left = features[:2]
    return Look(
        index=index,
        features=tuple(len(found) for found in features),
        pairs=len(matcher.match_left(right, left)[0]),
        stereo=matcher.match(features),
        left=_free(right, left, 0),
        top=_free(right, features[2], 1) if len(features) > 2 else None,
    )


def _free(right: Features, other: Features, axis: int) -> Free:
    """Ungated matches whose disparity runs along ``axis``: 0 columns, 1 rows."""
    i, j = mutual_nearest(right.descriptors, other.descriptors)
    difference = other.xy[j] - right.xy[i]
    return Free(i, difference[:, 1 - axis], difference[:, axis], right.xy[i])


# --------------------------------------------------------------------------------------------
# Findings


def judge_matches(
    looks: tuple[Look, ...], rig: CameraRig, settings: StereoSettings
) -> tuple[Finding, ...]:
    """Every finding that the matches give rise to."""
    if not looks:
        return ()
    frames = np.array([look.index for look in looks], np.int64)
    counts = np.array([len(look.stereo) for look in looks], np.int64)
    left = [look.left for look in looks]
    across, along = _joined(left)
    findings = (
        *check_features(np.array([look.features for look in looks], np.int64)),
        *_judge_pair(left, frames, LEFT_RIGHT),
    )
    if camera_order_is_wrong(along):
        return findings  # All else would only follow from that.
    near = np.abs(across - np.median(across)) < _NEAR_LINE_PX if len(across) else across > 0.0
    return (
        *findings,
        *check_stereo_counts(counts, frames),
        *check_disparity_gates(
            along[near], settings.min_disparity_px, settings.largest_disparity_px
        ),
        *_judge_top(looks, frames, rig),
    )


def _judge_pair(matches: list[Free], frames: IntArray, pair: Pair) -> tuple[Finding, ...]:
    across, along = _joined(matches)
    places = np.concatenate([free.places for free in matches])
    found = check_epipolar(across, along, pair, places)
    if not len(across):
        return found
    # A turned camera would give each frame its own median, by where its features are.
    steady = fit_turn(across, places, pair).residuals
    cuts = np.cumsum([len(free.across) for free in matches])[:-1]
    return (*found, *check_steadiness(_medians(np.split(steady, cuts)), frames, pair))


def _judge_top(looks: tuple[Look, ...], frames: IntArray, rig: CameraRig) -> tuple[Finding, ...]:
    top = [look.top for look in looks if look.top is not None]
    if not top:
        return ()
    found = _judge_pair(top, frames, TOP_RIGHT)
    if any(finding.level is Level.PROBLEM for finding in found):
        return found
    return (*found, *check_disparity_agreement(*_both_disparities(looks, rig)))


def _joined(matches: list[Free]) -> tuple[FloatArray, FloatArray]:
    """Offsets across and disparities along of all frames."""
    across = np.concatenate([free.across for free in matches])
    return across, np.concatenate([free.along for free in matches])


def _medians(offsets: list[FloatArray]) -> FloatArray:
    """Median offset (n,) of each frame, NaN where too few matched."""
    return np.array(
        [np.median(found) if len(found) >= _FEWEST_FOR_MEDIAN else np.nan for found in offsets]
    )


def _both_disparities(looks: tuple[Look, ...], rig: CameraRig) -> tuple[FloatArray, FloatArray]:
    """Horizontal and, scaled to it, vertical disparity (k,) of features matched in all images.

    Only matches near both epipolar lines: the others are wrong, or reported already.
    """
    horizontal, vertical = [], []
    for look in looks:
        if look.top is None:
            continue
        _, i, j = np.intersect1d(look.left.right, look.top.right, return_indices=True)
        near = np.abs(look.left.across[i]) < _NEAR_LINE_PX
        near &= np.abs(look.top.across[j]) < _NEAR_LINE_PX
        horizontal.append(look.left.along[i[near]])
        vertical.append(look.top.along[j[near]])
    scale = rig.fx * rig.baseline / (rig.fy * (rig.vertical_baseline or rig.baseline))
    return np.concatenate(horizontal), scale * np.concatenate(vertical)


# --------------------------------------------------------------------------------------------
# Facts


def match_facts(
    looks: tuple[Look, ...], rig: CameraRig, settings: StereoSettings
) -> tuple[tuple[str, str], ...]:
    """Label and value of what the features and matches of the sampled frames are."""
    if not looks:
        return (("frames matched", "none could be read"),)
    counts = np.array([look.features for look in looks])
    names = CAMERA_NAMES[: counts.shape[1]]
    found = [_spread(counts[:, c]) for c in range(counts.shape[1])]
    facts = [
        ("frames matched", f"{len(looks)}: {_numbers([look.index for look in looks])}"),
        ("SIFT features", ", ".join(f"{n} {s}" for n, s in zip(names, found, strict=True))),
        ("right-left matches", f"{_spread(np.array([look.pairs for look in looks]))} a frame"),
    ]
    if rig.cameras == 3:
        all_three = np.array([len(look.stereo) for look in looks])
        facts.append(("three-camera matches", f"{_spread(all_three)} a frame"))
    measurement = np.concatenate([look.stereo.measurement for look in looks])
    return (*facts, *_depth_facts(measurement, len(looks), rig, settings))


def _depth_facts(
    measurement: FloatArray, frames: int, rig: CameraRig, settings: StereoSettings
) -> tuple[tuple[str, str], ...]:
    if len(measurement) < _FEWEST_FOR_DEPTH * frames:
        return (("depth", "unknown: too few matches"),)
    low, middle, high = np.percentile(measurement[:, 2], [5.0, 50.0, 95.0])
    near, usual, far = np.percentile(triangulate(rig, measurement)[:, 2], [5.0, 50.0, 95.0])
    noise = np.zeros((len(measurement), 3, 3))
    noise[:, 2, 2] = 2.0 * settings.pixel_sigma**2  # a disparity is a difference of two positions
    blur = np.sqrt(np.median(triangulation_covariance(rig, measurement, noise)[:, 2, 2]))
    return (
        ("disparity", f"{low:.1f} to {high:.1f} px (5 to 95 %), median {middle:.1f} px"),
        (
            "depth",
            f"{near:.3g} to {far:.3g} m (5 to 95 %), median {usual:.3g} +- {blur:.2g} m",
        ),
    )


def _numbers(frames: list[int]) -> str:
    """All numbers, or the first and the last of many."""
    if len(frames) <= _LISTED:
        return ", ".join(str(k) for k in frames)
    return f"{', '.join(str(k) for k in frames[: _LISTED - 2])}, ..., {frames[-1]}"


def _spread(counts: IntArray) -> str:
    """Median and range in words."""
    return f"{np.median(counts):.0f} ({counts.min()}-{counts.max()})"
