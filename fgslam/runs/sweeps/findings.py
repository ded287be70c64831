"""What a sweep says: means with intervals, and paired tests over the seeds, corrected by Holm.

A *variant* is a combination of settings and an estimator; seeds and experiments are what it is
repeated over. Two variants are compared on the repetitions that both have.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError
from fgslam.evaluation.judging import MeanInterval, PairedTest, holm, mean_interval, paired_test
from fgslam.runs.sweeps.grid import SEED, Grid
from fgslam.runs.sweeps.table import ESTIMATOR, EXPERIMENT, FAILURE, Columns, SweepTable
from fgslam.runs.tables import measured_marks, with_marks

METRICS = ("ate_final_m", "ate_online_m", "end_error_final_m", "nees_pose_final_per_dof")
"""What is shown of a sweep where its table has it; the first one is tested, the smaller better."""
ALL_PAIRS_OF = 12
"""Variants of which every two are compared; of more each one with the first."""
SIGNIFICANT = 0.05

Values: TypeAlias = dict[tuple[Any, ...], float]
"""A metric by repetition: experiment and seed."""


@dataclass(frozen=True, slots=True, eq=False)
class Variant:
    """A combination of settings and an estimator.

    Attributes:
        label: in words.
        settings: value of each axis but the seed's, by its key.
        estimator: its title; empty where the task has none.
        values: each metric by repetition, where it is known.
        failures: repetitions that gave none.
        predicted: poses of all repetitions that no landmark measured.
        synthetic: the odometry of some was made from the ground truth.
    """

    label: str
    settings: Mapping[str, Any]
    estimator: str
    values: Mapping[str, Values]
    failures: int
    predicted: int = 0
    synthetic: bool = False

    @property
    def shown(self) -> str:
        """The label with marks of what is not measured, for tables and figures."""
        return with_marks(self.label, measured_marks(self.predicted, self.synthetic))

    def mean(self, metric: str) -> MeanInterval | None:
        """Over its repetitions; None where none is known."""
        return mean_interval(np.array(list(self.values[metric].values())))


@dataclass(frozen=True, slots=True)
class Comparison:
    """Variant A against B; ``p_value`` is corrected for all comparisons of the sweep."""

    a: str
    b: str
    test: PairedTest
    p_value: float | None

    @property
    def better(self) -> str:
        """Which of them is; empty where none is shown to be."""
        if self.p_value is None or self.p_value >= SIGNIFICANT:
            return ""
        return self.a if self.test.difference.mean < 0.0 else self.b


@dataclass(frozen=True, slots=True, eq=False)
class Findings:
    """What the table says of its metrics.

    Attributes:
        metric: that is tested.
        metrics: that are shown, this one first.
        variants: in the order of the table.
        comparisons: of every two of them, or of each with the first.
        axes: keys of the axes that have several numbers for values, but the seed's.
    """

    metric: str
    metrics: tuple[str, ...]
    variants: tuple[Variant, ...]
    comparisons: tuple[Comparison, ...]
    axes: tuple[str, ...]


def find(table: SweepTable, grid: Grid, metric: str | None = None) -> Findings | None:
    """Findings; None where the table has no number.

    Raises:
        ConfigError: ``metric`` is no column of numbers.
    """
    known = [name for name, cells in table.numbers.items() if _is_numeric(cells)]
    if metric is not None and known and metric not in known:
        raise ConfigError(f"--metric {metric}: no column of numbers; known: {', '.join(known)}")
    if not known:
        return None
    preferred = [name for name in METRICS if name in known] or known[:1]
    metrics = tuple(dict.fromkeys([*([metric] if metric else []), *preferred]))
    varied = [axis.key for axis in grid.axes if len(axis.values) > 1 and axis.key != SEED]
    variants = tuple(_variants(table, varied, metrics))
    numeric = [key for key in varied if all(_is_number(v.settings[key]) for v in variants)]
    tests = _compare(variants, metrics[0])
    return Findings(metrics[0], metrics, variants, tests, tuple(numeric))


def _is_numeric(cells: Sequence[Any]) -> bool:
    found = [cell for cell in cells if cell is not None]
    return bool(found) and all(map(_is_number, found))


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _variants(
    table: SweepTable, varied: Sequence[str], metrics: Sequence[str]
) -> Iterator[Variant]:
    keys = table.keys
    several = len({title for title in keys[ESTIMATOR] if title}) > 1
    rows: dict[tuple[Any, ...], list[int]] = {}
    for row in range(len(table)):
        if keys[ESTIMATOR][row] is not None or not _failed(table, row):
            variant = (*(keys[key][row] for key in varied), keys[ESTIMATOR][row] or "")
            rows.setdefault(variant, []).append(row)
    for (*settings, title), own in rows.items():
        named = dict(zip(varied, settings, strict=True))
        words = [f"{key.split('.')[-1]}={value}" for key, value in named.items()]
        label = " ".join([*words, *([title] if several or not words else [])])
        values = {metric: _values(table.numbers, keys, metric, own) for metric in metrics}
        failures = sum(_failed(table, row) for row in own)
        marks = _measured(table.numbers, own)
        yield Variant(label or "all", named, title, values, failures, *marks)


def _measured(numbers: Columns, rows: Sequence[int]) -> tuple[int, bool]:
    """How many poses of the rows no landmark measured; whether odometry of some is synthetic."""
    nothing: list[Any] = [None] * (max(rows, default=0) + 1)
    predicted = numbers.get("predicted_frames", nothing)
    odometry = numbers.get("odometry", nothing)
    return sum(predicted[row] or 0 for row in rows), any(odometry[k] == "synthetic" for k in rows)


def _failed(table: SweepTable, row: int) -> bool:
    return FAILURE in table.numbers and table.numbers[FAILURE][row] is not None


def _values(numbers: Columns, keys: Columns, metric: str, rows: Sequence[int]) -> Values:
    """Of the rows that ended well: an estimator that gave up early has an easier drive."""
    seeds = keys.get(SEED) or [None] * len(keys[EXPERIMENT])
    failed = numbers.get(FAILURE) or [None] * len(seeds)
    return {
        (keys[EXPERIMENT][row], seeds[row]): float(numbers[metric][row])
        for row in rows
        if numbers[metric][row] is not None and failed[row] is None
    }


def _compare(variants: Sequence[Variant], metric: str) -> tuple[Comparison, ...]:
    every = len(variants) <= ALL_PAIRS_OF
    pairs = list(combinations(variants, 2)) if every else [(v, variants[0]) for v in variants[1:]]
    tests = [(a, b, paired_test(*_paired(a.values[metric], b.values[metric]))) for a, b in pairs]
    known = [(a, b, test) for a, b, test in tests if test is not None and test.difference.count > 1]
    corrected = iter(holm([t.p_value for _, _, t in known if t.p_value is not None]))
    return tuple(
        Comparison(a.shown, b.shown, test, None if test.p_value is None else next(corrected))
        for a, b, test in known
    )


def _paired(a: Values, b: Values) -> tuple[FloatArray, FloatArray]:
    both = [key for key in a if key in b]
    return np.array([a[key] for key in both]), np.array([b[key] for key in both])
