"""Tables of results: Markdown for people, JSON for machines."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeAlias

Cell: TypeAlias = str | int | float | None

_DIGITS = 3


@dataclass(frozen=True)
class Table:
    """One table: floats are kept in full for JSON and shown with three digits.

    ``sources`` names the stored measurements that a page's table is computed from.
    """

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[Cell, ...]]
    notes: tuple[str, ...] = ()
    sources: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Every row fills every column. Raises ValueError otherwise."""
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(
                    f"table '{self.title}': {len(row)} cells for {len(self.columns)} columns: {row}"
                )

    def column(self, name: str) -> list[Cell]:
        """All cells of the column called ``name``. Raises ValueError where there is none."""
        at = self.columns.index(name)
        return [row[at] for row in self.rows]

    def markdown(self) -> str:
        """A Markdown table under its title, the notes below."""
        lines = [f"### {self.title}", "", *grid(self.columns, [map(shown, r) for r in self.rows])]
        lines += ["", *(f"- {note}" for note in self.notes)]
        return "\n".join(lines).rstrip() + "\n"

    def as_columns(self) -> dict[str, list[Cell]]:
        """Cells of each column, not finite numbers as None."""
        return {name: [_finite(cell) for cell in self.column(name)] for name in self.columns}


def shown(cell: Cell) -> str:
    """A cell as people read it; a dash where nothing is known."""
    if cell is None or (isinstance(cell, float) and not math.isfinite(cell)):
        return "-"
    if isinstance(cell, float):
        decimals = _DIGITS - 1 - (math.floor(math.log10(abs(cell))) if cell else 0)
        text = f"{cell:.{max(0, min(decimals, 4))}f}"
        return text if text.strip("-0.") else text.removeprefix("-")
    return str(cell)


def grid(columns: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """Lines of a Markdown table without padding."""
    heads = list(columns)
    lines = ["| " + " | ".join(cells) + " |" for cells in (heads, *rows)]
    return [lines[0], "|" + "---|" * len(heads), *lines[1:]]


def _finite(cell: Cell) -> Cell:
    return None if isinstance(cell, float) and not math.isfinite(cell) else cell
