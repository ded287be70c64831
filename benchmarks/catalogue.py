"""Every set of tables that `python -m benchmarks NAME` can measure."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from benchmarks.evidence import (
    chess,
    lasting,
    noise,
    paper_loop,
    paper_views,
    person,
    real,
    recognised,
    seeds,
    unmapped,
    variants,
    visits,
)
from benchmarks.tables import Table

EVIDENCE: dict[str, Callable[[Path], Iterable[Table]]] = {
    "paper_tables": lambda data: [*paper_views.tables(), *paper_loop.tables()],
    "seeds": lambda data: [seeds.table()],
    "person": lambda data: person.tables(),
    "chess": chess.tables,
    "variants": lambda data: [variants.table(data)],
    "paired": lambda data: [variants.paired_table()],
    "real": lambda data: [real.table(data)],
    "noise": lambda data: noise.tables(),
    "lasting": lambda data: lasting.tables(),
    "visits": lambda data: visits.tables(),
    "unmapped": lambda data: unmapped.tables(),
    "recognised": recognised.tables,
}
"""By name; each is called with the folder of the real recordings."""
