"""Three real cameras (docs/results): does the top image raise the precision?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.evidence import epi
from benchmarks.runs import DATA, experiment, find_features, say
from benchmarks.tables import Cell, Table
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.recordings import Sequence
from fgslam.datasets.rendered_lab import RenderedLabSequence
from fgslam.datasets.settings import LightFieldSettings
from fgslam.frontend.features.settings import Appearance
from fgslam.frontend.stereo.matching import StereoMatcher
from fgslam.runs.config import ExperimentConfig
from fgslam.slam.feature_stream import FeatureFrame

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
    real = {m: judge_chess(config, found.sequence, found.frames, m) for m in MODES}
    lab = {m: judge_lab(m) for m in MODES}
    return [
        landmarks_table(config, found.sequence, found.frames),
        _precision_table("Precision of right-left matches, chess (judge: other views)", real),
        _precision_table("Precision of right-left matches, lab (judge: rendered depth)", lab),
    ]


def _matcher(sequence: Sequence, config: ExperimentConfig, mode: Appearance) -> StereoMatcher:
    appearance = replace(config.frontend.appearance, mode=mode)
    return StereoMatcher(sequence.rig, config.frontend.stereo, appearance)


def landmarks_table(
    config: ExperimentConfig, sequence: Sequence, frames: list[FeatureFrame]
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
    config: ExperimentConfig, sequence: Sequence, frames: list[FeatureFrame], mode: Appearance
) -> Judged:
    """Right-left matches of all frames, judged by the views of their row that they did not use."""
    settings, truth = config.dataset, sequence.ground_truth
    if not isinstance(settings, LightFieldSettings) or truth is None:
        raise ValueError("chess_trinocular is a light field")
    row, spacing = epi.open_row(settings), settings.spacing
    matcher = _matcher(sequence, config, mode)
    per_metre = settings.shift_px_per_step * spacing / sequence.rig.baseline
    parts = []
    for frame in frames:
        # The row starts at column 1, the frames at column `spacing`.
        reference = spacing - 1 + frame.i
        left = reference - spacing
        if left < 0:
            continue  # its left view is column 0, whose true position the row does not give
        i, j, confirmed = _pairs(matcher, frame)
        right = frame.features[0].xy[i]
        raw = right + per_metre * truth.poses[frame.i, :2, 3]
        shifted = frame.features[1].xy[j, 0] - right[:, 0]
        disparity = shifted - settings.shift_px_per_step * spacing
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
    row: epi.Row,
    views: tuple[int, int],
    raw: FloatArray,
    disparity: FloatArray,
    confirmed: BoolArray,
) -> Judged:
    reference, left = views
    baseline = row.places[reference, 0] - row.places[left, 0]
    slopes = np.arange(-3.0, 16.01, 0.25) / baseline
    found = epi.judge(row, reference, np.array([left]), raw, slopes)
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
