"""Means of a sweep while it runs: of each combination of settings and estimator, over the seeds."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from fgslam.report.content import Column, TextTable
from fgslam.runs.sweeps.case import CaseResult
from fgslam.runs.sweeps.findings import METRICS
from fgslam.runs.sweeps.grid import SEED, Case, Grid
from fgslam.runs.tables import measured_marks, with_marks
from fgslam.runs.workers import Failed

_SHOWN = 16
_EVERY_S = 0.5


@dataclass(slots=True)
class _Mean:
    count: int = 0
    failed: int = 0
    mean: float = math.nan
    predicted: int = 0
    synthetic: bool = False

    @property
    def cells(self) -> tuple[str, str, str]:
        mean = f"{self.mean:.4g}" if self.count else "-"
        return mean, str(self.count), str(self.failed or "")

    def mark(self, numbers: Mapping[str, Any]) -> None:
        self.predicted += numbers.get("predicted_frames") or 0
        self.synthetic |= numbers.get("odometry") == "synthetic"

    def add(self, value: float) -> None:
        self.count += 1
        self.mean = value if self.count == 1 else self.mean + (value - self.mean) / self.count


@dataclass(slots=True, eq=False)
class RunningMeans:
    """A few numbers for each combination, however many cases there are."""

    grid: Grid
    metric: str | None
    _means: dict[str, _Mean] = field(default_factory=dict)
    _told: float = -_EVERY_S

    def add(self, case: Case, outcome: CaseResult | Failed) -> bool:
        """Takes a case in; whether it is time to show the means again."""
        label = self._label(case)
        if not isinstance(outcome, CaseResult):
            self._means.setdefault(label, _Mean()).failed += 1
        else:
            for row in outcome.rows:
                self._choose(row.numbers)
                value = row.numbers.get(self.metric or "")
                name = " ".join(filter(None, (label, row.estimator)))
                known = self._means.setdefault(name, _Mean())
                known.mark(row.numbers)
                if isinstance(value, (int, float)):
                    known.add(float(value))
        due = time.monotonic() - self._told > _EVERY_S
        self._told = time.monotonic() if due else self._told
        return due

    def table(self) -> TextTable:
        """The combinations that have results, as many as fit a terminal."""
        rows = [
            (with_marks(label, measured_marks(one.predicted, one.synthetic)), one.cells)
            for label, one in self._means.items()
        ]
        more = f"; {len(rows) - _SHOWN} more" if len(rows) > _SHOWN else ""
        columns = (Column(self.metric or "metric", ""), Column("cases", ""), Column("failed", ""))
        return TextTable("running", f"means so far{more}", "", columns, tuple(rows[:_SHOWN]))

    def _choose(self, numbers: object) -> None:
        if self.metric is None and isinstance(numbers, dict):
            known = (name for name in METRICS if isinstance(numbers.get(name), float))
            self.metric = next(known, None)

    def _label(self, case: Case) -> str:
        name = self.grid.sources[case.source].name if len(self.grid.sources) > 1 else ""
        texts = (
            f"{axis.key.split('.')[-1]}={axis.values[k]}"
            for axis, k in zip(self.grid.axes, case.place, strict=True)
            if axis.key != SEED and len(axis.values) > 1
        )
        return " ".join(filter(None, (name, *texts)))
