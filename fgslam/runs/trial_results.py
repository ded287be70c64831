"""What many trials say together: means, pooled consistency, paired tests, in files and words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import TypeAlias

import numpy as np

from fgslam.backend.settings import family_of
from fgslam.core.arrays import FloatArray
from fgslam.evaluation.comparing import MeanInterval, PairedTest, mean_interval, paired_test
from fgslam.evaluation.consistency import Consistency, Nees, judge
from fgslam.evaluation.metrics import EstimatorMetrics, JsonValue, value_at
from fgslam.report.tables import RESULT_COLUMNS, TIME_COLUMNS, write_comparison_csv, write_metrics

TrialRow: TypeAlias = tuple[int, dict[str, EstimatorMetrics], dict[str, dict[str, Nees]]]

_SIGNIFICANT = 0.05
_AVERAGED = (
    "ate_rmse_m",
    "rpe_trans_m",
    "rpe_rot_deg",
    "drift_percent",
    "end_error_m",
    "end_error_deg",
    "landmark_rmse_m",
    "landmark_median_m",
    "online.ate_rmse_m",
    "online.rpe_trans_m",
    "online.rpe_rot_deg",
    "online.end_error_m",
    "online.end_error_deg",
    "nis_per_dof",
)


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Smoother against filter by final ATE."""

    smoother: str
    filter: str
    best_filter: bool
    test: PairedTest

    @property
    def sentence(self) -> str:
        """The outcome in plain words."""
        test, n = self.test, self.test.difference.count
        found = test.p_value is not None and test.p_value < _SIGNIFICANT
        best = " (the best filter)" if self.best_filter else ""
        if found and test.difference.mean < 0.0:
            start = f"{self.smoother} beats {self.filter}{best} in {test.wins} of {n} trials"
        elif found:
            start = f"{self.filter}{best} beats {self.smoother} in {test.losses} of {n} trials"
        else:
            start = (
                f"no difference shown between {self.smoother} and {self.filter}{best}: better in "
                f"{test.wins}, worse in {test.losses} of {n} trials"
            )
        return f"{start}; {self._size()}"

    def _size(self) -> str:
        test, mean = self.test, self.test.difference
        ratio = "" if test.ratio is None else f", {test.ratio:.2f} times"
        p_value = "all equal" if test.p_value is None else f"p = {test.p_value:.2g}"
        sign = -1.0 if mean.mean <= 0.0 else 1.0
        ends = "one trial has no interval"
        if mean.lower is not None and mean.upper is not None:
            low, high = sorted((100.0 * sign * mean.lower, 100.0 * sign * mean.upper))
            ends = f"95 % [{low:.3f}, {high:.3f}]"
        word = "lower" if sign < 0.0 else "higher"
        return (
            f"{self.smoother}'s final ATE is {word} by {100.0 * abs(mean.mean):.3f} cm, "
            f"{ends}{ratio}; {p_value}"
        )


@dataclass(frozen=True, slots=True, eq=False)
class TrialSummary:
    """All trials together.

    Attributes:
        rows: seed, metrics and normalised errors of each trial, by title of the estimator.
        means: mean and interval over the trials, by title and path in the metrics.
        pooled: verdict on all trials, by title and `pose`, `online_pose` or `landmark`.
        pairs: each smoother against each filter.
        kinds: of the estimators, by title.
    """

    rows: tuple[TrialRow, ...]
    means: dict[str, dict[str, MeanInterval | None]]
    pooled: dict[str, dict[str, Consistency | None]]
    pairs: tuple[Pair, ...]
    kinds: dict[str, str]


def summarise(rows: Sequence[TrialRow], kinds: Mapping[str, str]) -> TrialSummary:
    """Means, pooled NEES and paired tests; ``kinds`` of the estimators by title."""
    values = {t: {p: _column(rows, t, p) for p in _AVERAGED} for t in kinds}
    means = {t: {p: mean_interval(v) for p, v in paths.items()} for t, paths in values.items()}
    pooled = {
        title: {
            name: judge(
                [nees[title][name] for _, metrics, nees in rows if _ended_well(metrics[title])]
            )
            for name in ("pose", "online_pose", "landmark")
        }
        for title in kinds
    }
    ate = {title: paths["ate_rmse_m"] for title, paths in values.items()}
    return TrialSummary(tuple(rows), means, pooled, tuple(_pairs(ate, kinds)), dict(kinds))


def write_trials(folder: Path, name: str, summary: TrialSummary, failures: Sequence[str]) -> None:
    """trials.csv (the same bytes for the same seeds), trials_timing.csv and metrics.json."""
    rows = [(str(seed), metrics) for seed, metrics, _ in summary.rows]
    write_comparison_csv(folder / "trials.csv", rows, RESULT_COLUMNS, "seed")
    write_comparison_csv(folder / "trials_timing.csv", rows, TIME_COLUMNS, "seed")
    about: dict[str, JsonValue] = {
        "name": name,
        "trials": len(rows),
        "seeds": [seed for seed, _, _ in summary.rows],
        "failures": list(failures),
        "comparisons": [_pair_json(pair) for pair in summary.pairs],
    }
    frames = max(int(value_at(m.as_json(), "frames") or 0) for _, ms in rows for m in ms.values())
    estimators = {title: together(summary, title) for title in summary.means}
    write_metrics(folder / "metrics.json", frames, estimators, about)


def _pair_json(pair: Pair) -> dict[str, JsonValue]:
    names = {"smoother": pair.smoother, "filter": pair.filter, "best_filter": pair.best_filter}
    return {**names, **asdict(pair.test), "sentence": pair.sentence}


def failures_of(summary: TrialSummary) -> list[str]:
    """A line for each estimator that ended early in a trial."""
    return [
        f"seed {seed}, {title}: {why}"
        for seed, metrics, _ in summary.rows
        for title, one in metrics.items()
        if (why := value_at(one.as_json(), "failure"))
    ]


def together(summary: TrialSummary, title: str) -> EstimatorMetrics:
    """Names of the contract hold means over the trials; NEES is pooled."""
    means, pooled = summary.means[title], summary.pooled[title]
    intervals: dict[str, JsonValue] = {
        path: None if found is None else asdict(found) for path, found in means.items()
    }
    online = {
        path.removeprefix("online."): intervals.pop(path)
        for path in _AVERAGED
        if path.startswith("online.")
    }
    return EstimatorMetrics(
        ate_rmse_m=_mean(means["ate_rmse_m"]),
        rpe_trans_m=_mean(means["rpe_trans_m"]),
        rpe_rot_deg=_mean(means["rpe_rot_deg"]),
        drift_percent=_mean(means["drift_percent"]),
        end_error_m=_mean(means["end_error_m"]),
        end_error_deg=_mean(means["end_error_deg"]),
        nees_pose_per_dof=_per_dof(pooled["pose"]),
        nees_landmark_per_dof=_per_dof(pooled["landmark"]),
        more={
            "kind": summary.kinds[title],
            "landmark_rmse_m": _mean(means["landmark_rmse_m"]),
            "landmark_median_m": _mean(means["landmark_median_m"]),
            "online": {"ate_rmse_m": _mean(means["online.ate_rmse_m"])},
            "nis_per_dof": _mean(means["nis_per_dof"]),
            "nees_pose": _json(pooled["pose"]),
            "nees_online_pose": _json(pooled["online_pose"]),
            "nees_landmark": _json(pooled["landmark"]),
            "intervals": intervals,
            "intervals_online": online,
        },
    )


def _pairs(ate: Mapping[str, FloatArray], kinds: Mapping[str, str]) -> list[Pair]:
    families = {title: family_of(kind) for title, kind in kinds.items()}
    filters = [t for t, f in families.items() if f == "filter" and np.isfinite(ate[t]).any()]
    smoothers = [t for t, family in families.items() if family == "smoother"]
    if not filters:
        return []
    best = min(filters, key=lambda title: float(np.nanmean(ate[title])))
    tests = [(s, f, paired_test(ate[s], ate[f])) for s, f in product(smoothers, filters)]
    return [Pair(s, f, f == best, test) for s, f, test in tests if test is not None]


def _column(rows: Sequence[TrialRow], title: str, path: str) -> FloatArray:
    """One number of all trials; NaN where it is not known, or the estimator ended early."""
    found = [metrics[title] for _, metrics, _ in rows]
    values = [value_at(m.as_json(), path) if _ended_well(m) else None for m in found]
    return np.array([np.nan if value is None else value for value in values], np.float64)


def _ended_well(metrics: EstimatorMetrics) -> bool:
    return not metrics.more.get("failure")


def _mean(found: MeanInterval | None) -> float | None:
    return None if found is None else found.mean


def _per_dof(found: Consistency | None) -> float | None:
    return None if found is None else found.per_dof


def _json(found: Consistency | None) -> JsonValue:
    return None if found is None else asdict(found)
