"""Text files of numbers, read strictly: errors name the file, the line and the remedy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import DatasetError
from fgslam.core.files import read_lines


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Numbers of a text file: values (n, columns) and the line (n,) each row came from, from 1."""

    path: Path
    values: FloatArray
    lines: IntArray

    def __len__(self) -> int:
        return len(self.lines)

    def column(self, k: int) -> FloatArray:
        """Column ``k`` (n,)."""
        return np.asarray(self.values[:, k])


def read_table(
    path: Path,
    columns: tuple[str, ...],
    delimiter: str | None = None,
    error: type[DatasetError] = DatasetError,
) -> Table:
    """The first ``len(columns)`` numbers of every line; further columns are ignored.

    Args:
        path: the file.
        columns: names of the columns, for the messages.
        delimiter: what separates them; None for white space.
        error: class of the errors to raise.

    Raises:
        DatasetError: (or ``error``) the file is unreadable, or a line has too few columns, a word
            that is no number, or a number that is not finite.
    """
    rows = read_lines(path, error)
    values = np.empty((len(rows), len(columns)))
    for k, (line, text) in enumerate(rows):
        values[k] = _parse_row(path, line, text.split(delimiter), columns, error)
    return Table(path, values, np.array([line for line, _ in rows], np.int64))


def _parse_row(
    path: Path, line: int, words: list[str], columns: tuple[str, ...], error: type[DatasetError]
) -> list[float]:
    if len(words) < len(columns):
        raise error(
            f"{path}, line {line}: {len(words)} columns, expected {len(columns)} "
            f"({', '.join(columns)}); complete or remove the line"
        )
    row = []
    for name, word in zip(columns, words, strict=False):
        try:
            value = float(word)
        except ValueError:
            raise error(
                f"{path}, line {line}: {name} is {word.strip()!r}, not a number; correct the line"
            ) from None
        if not np.isfinite(value):
            raise error(
                f"{path}, line {line}: {name} is {word.strip()}, not finite; correct or remove the "
                "line"
            )
        row.append(value)
    return row


def require_increasing(
    table: Table, stamps: FloatArray, error: type[DatasetError] = DatasetError
) -> None:
    """Raises ``error``, naming the line, unless the time stamps (n,) increase strictly."""
    bad = np.flatnonzero(np.diff(stamps) <= 0.0)
    if len(bad):
        k = int(bad[0])
        raise error(
            f"{table.path}, line {table.lines[k + 1]}: time {stamps[k + 1]:.6f} s does not come "
            f"after {stamps[k]:.6f} s of line {table.lines[k]}; put the lines in time order and "
            "remove duplicates"
        )
