"""The table of a sweep: a row for each case and estimator, columns of configuration and metrics."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import yaml

from fgslam.report.content import write_parquet
from fgslam.runs.sweeps.case import CaseResult, Row
from fgslam.runs.sweeps.grid import Case, Grid

TABLE_FILE = "results.parquet"
TIMES_FILE = "times.parquet"

CASE, EXPERIMENT, ESTIMATOR, FAILURE, SECONDS = (
    "case",
    "experiment",
    "estimator",
    "failure",
    "case_seconds",
)
Columns: TypeAlias = dict[str, list[Any]]
"""Cells by name of the column, all of one length; None where a value is not known."""


@dataclass(frozen=True, slots=True, eq=False)
class SweepTable:
    """What is known so far.

    Attributes:
        keys: columns that say which case and estimator a row is of.
        numbers: columns of metrics; the same cases give the same bytes.
        times: columns of what differs between executions.
    """

    keys: Columns
    numbers: Columns
    times: Columns

    def __len__(self) -> int:
        return len(self.keys[CASE])

    def write(self, folder: Path, grid: Grid) -> None:
        """Both tables as Parquet, with the experiments in their metadata. Raises OutputError."""
        about = {
            f"fgslam.experiment.{source.name}": yaml.safe_dump(dict(source.values), sort_keys=False)
            for source in grid.sources
        }
        write_parquet(folder / TABLE_FILE, self.keys | self.numbers, about)
        write_parquet(folder / TIMES_FILE, self.keys | self.times, about)


def make_table(grid: Grid, found: Iterator[tuple[Case, CaseResult | str]]) -> SweepTable:
    """The table of cases, in the order of the grid; a text says why a case has no result."""
    settings = [axis.settings for axis in grid.axes]
    keys: Columns = {
        name: [] for name in (CASE, EXPERIMENT, *(axis.key for axis in grid.axes), ESTIMATOR)
    }
    numbers, times, rows = _Growing(), _Growing(), 0
    for case, result in found:
        chosen = [values[k] for values, k in zip(settings, case.place, strict=True)]
        for row in _rows(result):
            start = (case.number, grid.sources[case.source].name, *chosen, row.estimator or None)
            for cells, value in zip(keys.values(), start, strict=True):
                cells.append(value)
            numbers.add(rows, row.numbers)
            times.add(rows, row.times)
            rows += 1
    return SweepTable(keys, numbers.whole(rows), times.whole(rows))


def _rows(result: CaseResult | str) -> Sequence[Row]:
    if isinstance(result, str):
        return [Row("", {FAILURE: result}, {})]
    timed = {SECONDS: result.seconds}
    return [dataclasses.replace(row, times={**timed, **row.times}) for row in result.rows]


class _Growing:
    """Columns that are found while rows come."""

    def __init__(self) -> None:
        self._columns: Columns = {}

    def add(self, row: int, values: Mapping[str, Any]) -> None:
        for name, value in values.items():
            cells = self._columns.setdefault(name, [])
            cells.extend([None] * (row - len(cells)))
            cells.append(value)

    def whole(self, rows: int) -> Columns:
        """All columns at full length and of one type each; the failure last."""
        names = [*(name for name in self._columns if name != FAILURE)]
        names += [FAILURE] if FAILURE in self._columns else []
        return {
            name: _of_one_type(cells + [None] * (rows - len(cells)))
            for name, cells in ((name, self._columns[name]) for name in names)
        }


def _of_one_type(cells: list[Any]) -> list[Any]:
    kinds = {type(cell) for cell in cells if cell is not None}
    if kinds <= {int, float} and float in kinds:
        return [None if cell is None else float(cell) for cell in cells]
    return cells if len(kinds) < 2 else [None if cell is None else str(cell) for cell in cells]
