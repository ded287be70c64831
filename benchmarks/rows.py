"""What a benchmark measured: numbers beside their bounds, tables, and the command of each."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeAlias

from benchmarks.tables import Table, shown

RESULTS = Path(__file__).parent / "results"
"""Folder of the committed measurements, one file a page."""

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
    """

    name: str
    measured: float
    unit: str = ""
    relation: Relation = "<="
    bound: float | None = None

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
    """

    title: str
    commands: tuple[str, ...] = ()
    text: tuple[str, ...] = ()
    rows: tuple[Row, ...] = ()
    tables: tuple[Table, ...] = ()


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
    rows = tuple(Row(**row) for row in given.pop("rows", ()))
    tables = tuple(
        Table(
            table.get("title", ""),
            tuple(table["columns"]),
            [tuple(row) for row in table["rows"]],
            tuple(table.get("notes", ())),
        )
        for table in given.pop("tables", ())
    )
    lists: dict[str, Any] = {key: tuple(given.pop(key, ())) for key in ("commands", "text")}
    return Section(rows=rows, tables=tables, **lists, **given)


def section_as_json(section: Section) -> dict[str, Any]:
    """The form in which :func:`load_record` reads a section."""
    rows = [{k: v for k, v in vars(row).items() if v not in ("", None)} for row in section.rows]
    return {
        "title": section.title,
        "commands": list(section.commands),
        "rows": rows,
        "tables": [table.as_json() for table in section.tables],
    }


def shown_bound(row: Row) -> str:
    """Bound with its relation and unit, as people read it."""
    if row.bound is None:
        return ""
    return f"{row.relation} {row.bound:g} {row.unit}".strip()


def shown_number(row: Row) -> str:
    """Measured number with its unit."""
    number = f"{row.measured:,.0f}" if abs(row.measured) >= 1e4 else shown_exactly(row.measured)
    return f"{number} {row.unit}".strip()


def shown_exactly(value: float) -> str:
    """The number as it was written down, with no digit added or lost."""
    return shown(value) if isinstance(value, int) else f"{value:.12g}"
