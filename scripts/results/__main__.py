"""Prints the tables of docs/results.md as Markdown; `--out` writes them as JSON, too."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from pathlib import Path

from fgslam.core.errors import FgslamError
from scripts.results import (
    chess,
    lasting,
    noise,
    paper_loop,
    paper_views,
    person,
    real,
    recognised,
    seeds,
    strangers,
    variants,
    visits,
)
from scripts.results.report import Table, write_json
from scripts.results.runs import DATA, say

WHAT: dict[str, Callable[[Path], Iterable[Table]]] = {
    "paper_tables": lambda data: [*paper_views.tables(), *paper_loop.tables()],
    "seeds": lambda data: [seeds.table()],
    "person": lambda data: person.tables(),
    "chess": lambda data: chess.tables(data),
    "variants": lambda data: [variants.table(data)],
    "paired": lambda data: [variants.paired_table()],
    "real": lambda data: [real.table(data)],
    "noise": lambda data: noise.tables(),
    "lasting": lambda data: lasting.tables(),
    "visits": lambda data: visits.tables(),
    "strangers": lambda data: strangers.tables(),
    "recognised": lambda data: recognised.tables(data),
}


def main() -> int:
    """Returns the exit status: 2 on a user's mistake."""
    parser = argparse.ArgumentParser(prog="python -m scripts.results", description=__doc__)
    parser.add_argument("what", choices=sorted(WHAT), help="which evidence to produce")
    parser.add_argument("--out", type=Path, help="write the tables as JSON to this file")
    parser.add_argument(
        "--data",
        type=Path,
        default=DATA,
        help="folder of the real recordings (default: %(default)s)",
    )
    arguments = parser.parse_args()
    try:
        tables = list(WHAT[arguments.what](arguments.data))
    except FgslamError as error:
        say(f"error: {error}")
        return 2
    sys.stdout.write("\n".join(table.markdown() for table in tables))
    if arguments.out is not None:
        write_json(arguments.out, tables)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
