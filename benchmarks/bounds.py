"""Bounds of the evidence: which cells of the tables are bounded, and by what."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

from benchmarks.evidence.real import GOALS
from benchmarks.rows import Row
from benchmarks.tables import Cell, Table

Bounded: TypeAlias = Callable[[Sequence[Table]], list[Row]]


def paper_drive(tables: Sequence[Table]) -> list[Row]:
    """Of the drive with the default of three degrees of freedom (first row after the paper's)."""
    ends, landmarks = _titled(tables, "End pose"), _titled(tables, "Landmarks and matches")
    return [
        Row("end position from the start", _at(ends, "distance cm", 1), "cm", "<=", 5.0),
        Row("end heading from the start", abs(_at(ends, "yaw deg", 1)), "deg", "<=", 0.5),
        Row("ATE", _at(ends, "ATE cm", 1), "cm", "<", 2.0),
        Row("matched, 5 %", _at(landmarks, "matched to the map: 5 %", 1), "", ">=", 40.0),
        Row("landmarks", _at(landmarks, "landmarks", 1), "", ">", 2000.0),
        Row("stereo precision", _at(landmarks, "stereo precision", 1), "", ">=", 0.97),
    ]


def seeds(tables: Sequence[Table]) -> list[Row]:
    """Of the worst seed (the row before the last)."""
    worst = tables[0]
    return [
        Row("largest ATE", _at(worst, "ATE cm", -2), "cm", "<", 2.0),
        Row("largest end position", _at(worst, "end cm", -2), "cm", "<=", 5.0),
        Row("largest end heading", _at(worst, "yaw deg", -2), "deg", "<=", 0.5),
        Row("matched, 5 %, least", _at(worst, "matched, 5 %", -2), "", ">=", 40.0),
        Row("landmarks, least", _at(worst, "landmarks", -2), "", ">", 2000.0),
        Row("precision, least", _at(worst, "precision", -2), "", ">=", 0.97),
    ]


def real(tables: Sequence[Table]) -> list[Row]:
    """Accuracy, and drift where it is bounded, of each real recording."""
    found = []
    for k, goal in enumerate(GOALS):
        name = " ".join((goal.experiment, *goal.overrides))
        found.append(Row(f"{name}: ATE", _at(tables[0], "ATE m", k), "m", "<=", goal.ate_m))
        if goal.drift_percent is not None:
            drift = _at(tables[0], "drift %", k)
            found.append(Row(f"{name}: drift", drift, "%", "<=", goal.drift_percent))
    return found


def person(tables: Sequence[Table]) -> list[Row]:
    """Jumps of the position error with the person in view."""
    jumps = tables[0]
    return [
        Row(str(jumps.rows[k][0]), _at(jumps, "with the person", k), "cm", "<=", 5.0)
        for k in range(2)
    ]


def chess(tables: Sequence[Table]) -> list[Row]:
    """Landmarks in three views with descriptors, and precision with the top image."""
    found = [Row("landmarks, least", _at(tables[0], "three views: least", 0), "", ">=", 400.0)]
    for table in tables[1:]:
        for k, row in enumerate(table.rows):
            before, after = (_at(table, f"precision {when}", k) for when in ("before", "after"))
            found.append(Row(f"{table.title}, {row[0]}: precision", after, "", ">", before))
    return found


def visits(tables: Sequence[Table]) -> list[Row]:
    """Accuracy of a visit to moved furniture over one to an unchanged room."""
    ratio = _at(tables[0], "ATE cm", 1) / _at(tables[0], "ATE cm", 0)
    return [Row("ATE over that in an unchanged room", ratio, "", "<=", 1.5)]


BOUNDS: dict[str, Bounded] = {
    "paper_tables": paper_drive,
    "seeds": seeds,
    "real": real,
    "person": person,
    "chess": chess,
    "visits": visits,
}
"""Rows of each set of tables that has bounds."""


def _titled(tables: Sequence[Table], start: str) -> Table:
    return next(table for table in tables if table.title.startswith(start))


def _at(table: Table, column: str, row: int) -> float:
    cell: Cell = table.column(column)[row]
    if isinstance(cell, str) or cell is None:
        raise ValueError(f"table '{table.title}', column '{column}', row {row}: {cell!r}")
    return cell
