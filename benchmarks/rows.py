"""Pages of results before they are written: numbers beside their bounds, tables, commands."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

from benchmarks.measured import FORMULA, computed, value_at
from benchmarks.tables import Cell, Table, shown

RESULTS = Path(__file__).parent / "results"
"""Folder of what pages say and of their bounds, one file a page."""

Relation: TypeAlias = Literal["<=", "<", ">=", ">"]


class RecordError(ValueError):
    """A file of measurements is not what :func:`load_record` expects; says file and entry."""


@dataclass(frozen=True)
class Row:
    """A measured number and the bound that it has to keep.

    Attributes:
        name: what is measured.
        measured: the number.
        unit: of number and bound; empty for ratios and counts.
        relation: how the number must stand to the bound.
        bound: None where nothing is required.
        source: the stored measurement that it is computed from; empty for one written down by hand.
    """

    name: str
    measured: float
    unit: str = ""
    relation: Relation = "<="
    bound: float | None = None
    source: str = ""

    def __post_init__(self) -> None:
        """Raises TypeError where the measured value is not a number."""
        if not isinstance(self.measured, (int, float)):
            raise TypeError(f"row '{self.name}': {self.measured!r} is not a number")

    @property
    def met(self) -> bool | None:
        """Whether the bound is kept; None without one."""
        if self.bound is None:
            return None
        kept = {
            "<=": self.measured <= self.bound,
            "<": self.measured < self.bound,
            ">=": self.measured >= self.bound,
            ">": self.measured > self.bound,
        }
        return kept[self.relation]


@dataclass(frozen=True)
class Section:
    """One experiment of a page.

    Attributes:
        title: heading.
        commands: that give the numbers, from the root of the checkout.
        text: paragraphs: what is measured, and what limits it.
        rows: numbers with bounds.
        tables: numbers without.
        pictures: of :data:`benchmarks.curves.PICTURES`, each with what it shows.
    """

    title: str
    commands: tuple[str, ...] = ()
    text: tuple[str, ...] = ()
    rows: tuple[Row, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: Mapping[str, str] = field(default_factory=dict)

    @property
    def sources(self) -> tuple[str, ...]:
        """Stored measurements that rows and tables are computed from; empty ones by hand."""
        given = [row.source for row in self.rows] + [s for t in self.tables for s in t.sources]
        return tuple(dict.fromkeys(given))


@dataclass(frozen=True)
class Record:
    """One page of results.

    Attributes:
        name: of the file and of the page.
        title: heading.
        text: paragraphs at the top.
        version: of fgslam that was measured.
        date: of the measurement, year-month-day.
        sections: in the page's order.
    """

    name: str
    title: str
    version: str
    date: str
    text: tuple[str, ...] = ()
    sections: tuple[Section, ...] = field(default_factory=tuple)

    @property
    def rows(self) -> tuple[Row, ...]:
        """All rows with a bound."""
        return tuple(row for s in self.sections for row in s.rows if row.bound is not None)


def load_record(path: Path) -> Record:
    """The measurements of one file.

    Raises:
        RecordError: a key is missing or unknown, or a table's row has the wrong length.
    """
    try:
        given = json.loads(path.read_text(encoding="utf-8"))
        sections = tuple(_section(part) for part in given.pop("sections"))
        given["text"] = tuple(given.get("text", ()))
        return Record(path.stem, sections=sections, **given)
    except (KeyError, TypeError, ValueError) as error:
        raise RecordError(f"{path}: {error}; see benchmarks/rows.py for the form") from error


def _section(given: dict[str, Any]) -> Section:
    rows = tuple(map(_row, given.pop("rows", ())))
    tables = tuple(map(_table, given.pop("tables", ())))
    lists: dict[str, Any] = {key: tuple(given.pop(key, ())) for key in ("commands", "text")}
    return Section(rows=rows, tables=tables, **lists, **given)


def _row(given: dict[str, Any]) -> Row:
    if "from" not in given:
        return Row(**given)
    rest = {key: value for key, value in given.items() if key not in FORMULA}
    return Row(measured=computed(given), source=_source(given), **rest)


def _table(given: dict[str, Any]) -> Table:
    """A table: of a measurement (`from`, perhaps some `columns` and `lines` only), or by cells."""
    title, notes = given.get("title", ""), tuple(given.get("notes", ()))
    if "from" in given:
        stored = value_at(given["from"])
        columns = tuple(given.get("columns", stored))
        rows = list(zip(*(stored[column] for column in columns), strict=True))
        rows = [rows[k] for k in given.get("lines", range(len(rows)))]
        return Table(title, columns, rows, notes, (_source(given),))
    cells = [cell for row in given["rows"] for cell in row if isinstance(cell, dict)]
    rows = [tuple(map(_cell, row)) for row in given["rows"]]
    sources = tuple(dict.fromkeys(map(_source, cells))) or ("",)
    return Table(title, tuple(given["columns"]), rows, notes, sources)


def _cell(given: Cell | dict[str, Any]) -> Cell:
    return computed(given) if isinstance(given, dict) else given


def _source(given: Mapping[str, Any]) -> str:
    return str(given["from"].split("/")[0])


def shown_bound(row: Row) -> str:
    """Bound with its relation and unit, as people read it."""
    if row.bound is None:
        return ""
    return f"{row.relation} {row.bound:g} {row.unit}".strip()


def shown_number(row: Row) -> str:
    """Measured number with its unit: as it was written down, or three digits of a computed one."""
    if abs(row.measured) >= 1e4:
        number = f"{row.measured:,.0f}"
    elif isinstance(row.measured, int) or (row.source and abs(row.measured) >= 1e-3):
        number = shown(row.measured)
    else:
        number = f"{row.measured:.12g}"
    return f"{number} {row.unit}".strip()
