"""Three real cameras (docs/results): does the top image raise the precision?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.runs import CHESS, DATA, experiment, find_features, say
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.log import ImageSequence
from fgslam.datasets.rendered import RenderedLabSequence
from fgslam.frontend.settings import Appearance
from fgslam.frontend.stereo import StereoMatcher
from fgslam.runs.config import ExperimentConfig
from fgslam.slam.feature_stream import FeatureFrame
from scripts.convert.light_field import METRES_PER_UNIT, ROW, SHIFT_PX, SPACING, read_grid

LEAST_LANDMARKS = 400
CORRECT_PX = 1.0
"""Largest error of a correct match's disparity."""
MODES: tuple[Appearance, ...] = ("descriptor", "paper")


@dataclass(frozen=True, eq=False)
class Judged:
    """Right-left matches, each judged right or wrong.

    Attributes:
        correct: (n,) whether the disparity is right.
        decided: (n,) whether that could be judged.
        confirmed: (n,) whether the top image confirmed the match.
    """

    correct: BoolArray
    decided: BoolArray
    confirmed: BoolArray

    def precision(self, chosen: BoolArray) -> float:
        """Share of correct ones among the chosen matches that could be judged."""
        judged = self.decided & chosen
        return float(self.correct[judged].mean()) if judged.any() else float("nan")


def tables(data: Path = DATA) -> list[Table]:
    """Landmarks a frame; precision before and after the top gate, on real and rendered images."""
    config = experiment("chess_trinocular", data=data)
    found = find_features(config)
    say("judging matches by the light field's other views")
    row = open_row(data / CHESS)
    real = {m: judge_chess(config, found.sequence, found.frames, row, m) for m in MODES}
    lab = {m: judge_lab(m) for m in MODES}
    return [
        landmarks_table(config, found.sequence, found.frames),
        _precision_table("Precision of right-left matches, chess (judge: other views)", real),
        _precision_table("Precision of right-left matches, lab (judge: rendered depth)", lab),
    ]


def _matcher(sequence: ImageSequence, config: ExperimentConfig, mode: Appearance) -> StereoMatcher:
    appearance = replace(config.frontend.appearance, mode=mode)
    return StereoMatcher(sequence.rig, config.frontend.stereo, appearance)


def landmarks_table(
    config: ExperimentConfig, sequence: ImageSequence, frames: list[FeatureFrame]
) -> Table:
    """How many landmarks agree in three views, over the frames of the walk."""
    columns = (
        "mode", "features, median", "three views: least", "median", "most",
        f"frames with {LEAST_LANDMARKS} or more",
    )  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    for mode in MODES:
        matcher = _matcher(sequence, config, mode)
        n = np.array([len(matcher.match(frame.features)) for frame in frames])
        features = float(np.median([len(frame.features[0]) for frame in frames]))
        enough = f"{np.count_nonzero(n >= LEAST_LANDMARKS)} of {len(n)}"
        rows.append((mode, features, int(n.min()), float(np.median(n)), int(n.max()), enough))
    return Table("Landmarks that agree in three views, chess at spacing 4", columns, rows)


def judge_chess(
    config: ExperimentConfig,
    sequence: ImageSequence,
    frames: list[FeatureFrame],
    row: Row,
    mode: Appearance,
) -> Judged:
    """Right-left matches of all frames, judged by the views of their row that they did not use."""
    truth = sequence.ground_truth
    if truth is None:
        raise ValueError("chess_trinocular has ground truth")
    matcher = _matcher(sequence, config, mode)
    per_metre = SHIFT_PX * SPACING / sequence.rig.baseline
    parts = []
    for frame in frames:
        # The row starts at column 1, the frames at column SPACING.
        reference = SPACING - 1 + frame.i
        left = reference - SPACING
        if left < 0:
            continue  # its left view is column 0, whose true position the row does not give
        i, j, confirmed = _pairs(matcher, frame)
        right = frame.features[0].xy[i]
        raw = right + per_metre * truth.poses[frame.i, :2, 3]
        shifted = frame.features[1].xy[j, 0] - right[:, 0]
        disparity = shifted - SHIFT_PX * SPACING
        parts.append(_judged(row, (reference, left), raw, disparity, confirmed))
    return _joined(parts)


def _pairs(matcher: StereoMatcher, frame: FeatureFrame) -> tuple[IntArray, IntArray, BoolArray]:
    right, left, top = frame.features
    i, j = matcher.match_left(right, left)
    kept, _ = matcher.match_top(right, left, top, (i, j))
    confirmed = np.zeros(len(i), np.bool_)
    confirmed[kept] = True
    return i, j, confirmed


def _judged(
    row: Row,
    views: tuple[int, int],
    raw: FloatArray,
    disparity: FloatArray,
    confirmed: BoolArray,
) -> Judged:
    reference, left = views
    baseline = row.places[reference, 0] - row.places[left, 0]
    slopes = np.arange(-3.0, 16.01, 0.25) / baseline
    found = judge(row, reference, np.array([left]), raw, slopes)
    error = np.abs(found.slope * baseline - disparity)
    return Judged(error <= CORRECT_PX, found.decided, confirmed)


def judge_lab(mode: Appearance) -> Judged:
    """Right-left matches of the rendered lab, judged by the exact depth at the feature."""
    config = experiment("lab_loop", ["dataset.stride=6"])
    found = find_features(config)
    sequence = found.sequence
    if not isinstance(sequence, RenderedLabSequence):
        raise ValueError("lab_loop is rendered")
    matcher = _matcher(sequence, config, mode)
    parts = []
    for frame in found.frames:
        i, j, confirmed = _pairs(matcher, frame)
        right = frame.features[0].xy[i]
        disparity = frame.features[1].xy[j, 0] - right[:, 0]
        true = (
            sequence.rig.fx * sequence.rig.baseline / _depths_around(sequence.depth(frame.i), right)
        )
        correct = np.abs(true - disparity[:, None]).min(axis=1) <= CORRECT_PX
        parts.append(Judged(correct, np.ones(len(i), np.bool_), confirmed))
    return _joined(parts)


def _depths_around(depth: FloatArray, xy: FloatArray) -> FloatArray:
    """(n, 4) depths of the pixels around sub-pixel points: at an edge either side is right."""
    low = np.floor(xy).astype(np.int64)
    columns = np.clip(low[:, 0, None] + [0, 1, 0, 1], 0, depth.shape[1] - 1)
    rows = np.clip(low[:, 1, None] + [0, 0, 1, 1], 0, depth.shape[0] - 1)
    return np.asarray(depth[rows, columns])


def _joined(parts: list[Judged]) -> Judged:
    return Judged(
        np.concatenate([part.correct for part in parts]),
        np.concatenate([part.decided for part in parts]),
        np.concatenate([part.confirmed for part in parts]),
    )


def _precision_table(title: str, judged: Mapping[Appearance, Judged]) -> Table:
    columns = (
        "mode", "right-left matches", "judge undecided", "precision before",
        "kept by the top image", "precision after", "precision of those dropped",
    )  # fmt: skip
    rows: list[tuple[Cell, ...]] = []
    for mode, j in judged.items():
        everything = np.ones(len(j.correct), np.bool_)
        rows.append(
            (
                mode,
                len(everything),
                int(np.count_nonzero(~j.decided)),
                j.precision(everything),
                int(j.confirmed.sum()),
                j.precision(j.confirmed),
                j.precision(~j.confirmed),
            )
        )
    note = f"correct: disparity within {CORRECT_PX:g} px of the judge's"
    return Table(title, columns, rows, (note,))


HALF_PATCH = 3
_KEEP = 0.6  # share of the views that must see the point: the best ones count
_PENALTY = 30.0  # grey levels at which a difference counts as an occlusion
_AMBIGUOUS = 1.25  # a second minimum this near to the first leaves the judge undecided
_DISTINCT_PX = 0.75  # apart from the first by more than this, at the matches' baseline


@dataclass(frozen=True, eq=False)
class Row:
    """Unshifted views of one grid row.

    Attributes:
        images: (n, height, width) grey levels.
        places: (n, 2) true (x, y) in metres, x with the image's columns, y down.
    """

    images: FloatArray
    places: FloatArray


def open_row(root: Path) -> Row:
    """All views of the grid's row in which the cameras walk, but for the first."""
    grid = read_grid(root)
    views = sorted(view for view in grid.files if view[0] == ROW)[1:]
    places = np.array([grid.positions[view] for view in views])
    images = np.array([grid.image(view) for view in views], np.float64)
    return Row(images, (places - places[0]) * METRES_PER_UNIT)


@dataclass(frozen=True, eq=False)
class SlopeFound:
    """What the judge says of points.

    Attributes:
        slope: (n,) of the best line, pixels a metre.
        decided: (n,) whether no other line is nearly as good.
    """

    slope: FloatArray
    decided: BoolArray


def judge(
    row: Row, reference: int, hidden: IntArray, xy: FloatArray, slopes: FloatArray
) -> SlopeFound:
    """Finds the slope of points by the views that the matches did not use.

    Args:
        row: the views.
        reference: index of the view in which the points were found.
        hidden: indices of the views that the judge must not see.
        xy: (n, 2) points in the unshifted reference view.
        slopes: (m,) to try, pixels a metre, ascending and evenly spaced.
    """
    seen = np.setdiff1d(np.arange(len(row.images)), np.append(hidden, reference))
    patch = _sample(row.images[reference], xy)
    cost = np.empty((len(slopes), len(xy)))
    for k, slope in enumerate(slopes):
        difference = np.array(
            [
                np.abs(_sample(row.images[v], xy - slope * _step(row, reference, v)) - patch)
                for v in seen
            ]
        )
        each = np.minimum(difference, _PENALTY).mean(axis=2)
        keep = int(np.ceil(_KEEP * len(seen)))
        cost[k] = np.partition(each, keep - 1, axis=0)[:keep].mean(axis=0)
    best = cost.argmin(axis=0)
    step = row.places[reference, 0] - row.places[hidden[0], 0] if len(hidden) else 1.0
    apart = np.abs(slopes[:, None] - slopes[best]) * abs(step) > _DISTINCT_PX
    second = np.where(apart, cost, np.inf).min(axis=0)
    return SlopeFound(slopes[best], second > _AMBIGUOUS * cost.min(axis=0))


def _step(row: Row, reference: int, view: int) -> FloatArray:
    """(2,) camera motion in metres from the reference to a view."""
    return np.asarray(row.places[view] - row.places[reference])


def _sample(image: FloatArray, centres: FloatArray) -> FloatArray:
    """Patches (n, k) around sub-pixel centres (n, 2), bilinear, clipped at the border."""
    offset = np.arange(-HALF_PATCH, HALF_PATCH + 1)
    columns = centres[:, 0, None, None] + offset[None, None, :]
    rows = centres[:, 1, None, None] + offset[None, :, None]
    columns, rows = np.broadcast_arrays(columns, rows)
    height, width = image.shape
    columns = np.clip(columns, 0.0, width - 1.001)
    rows = np.clip(rows, 0.0, height - 1.001)
    c, r = columns.astype(np.int64), rows.astype(np.int64)
    fc, fr = columns - c, rows - r
    upper = image[r, c] * (1.0 - fc) + image[r, c + 1] * fc
    lower = image[r + 1, c] * (1.0 - fc) + image[r + 1, c + 1] * fc
    return np.asarray((upper * (1.0 - fr) + lower * fr).reshape(len(centres), -1))
