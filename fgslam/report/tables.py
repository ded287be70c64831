"""Plain tables and documents: CSV files and JSON, written whole or not at all."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np

from fgslam.core.files import write_text
from fgslam.evaluation.metrics import JsonValue
from fgslam.report.metrics import plain

Cell: TypeAlias = "str | bool | int | float | np.generic | None"


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Cell]]) -> None:
    """Writes a table: ten significant digits; empty where a value is None or not finite.

    Raises:
        ValueError: a row has not as many cells as there are columns.
        OutputError: the file cannot be written.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        if len(row) != len(columns):
            raise ValueError(f"{len(row)} cells in a table of {len(columns)} columns")
        writer.writerow([_text(cell) for cell in row])
    write_text(path, out.getvalue())


def write_json(path: Path, document: Mapping[str, JsonValue]) -> None:
    """Writes a document; what is not finite becomes null. Raises OutputError."""
    write_text(path, json.dumps(plain(document), indent=2, allow_nan=False) + "\n")


def _text(cell: Cell) -> str:
    if isinstance(cell, np.generic):
        cell = cell.item()
    if cell is None or (isinstance(cell, float) and not math.isfinite(cell)):
        return ""
    if isinstance(cell, bool):
        return "true" if cell else "false"
    return f"{cell:.10g}" if isinstance(cell, float) else str(cell)
