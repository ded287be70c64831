"""Measures speed or accuracy, stores what was measured, writes the pages of results.

`python -m benchmarks NAME` prints one set of tables as Markdown; `speed`, `long_drive`, `soak`,
`ring` and `sweep` write `bench.json`, `bench_long.json` and so on; `keep PATH` stores such a
file, or the numbers of a run folder, in benchmarks/measured; `pages` writes docs/results from
benchmarks/results and benchmarks/measured.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.evidence import (
    chess,
    compact_memory,
    consistency,
    dense,
    drives,
    euroc_raw,
    false_matches,
    front_ends,
    honesty,
    hybrid,
    lasting,
    lenses,
    light,
    noise,
    paper_views,
    peers,
    person,
    relocalising,
    rig_honesty,
    staircase,
    variants,
    visits,
    witnesses,
    wrong_mirror,
)
from benchmarks.measured import keep
from benchmarks.pages import write_pages
from benchmarks.runs import DATA, say
from benchmarks.speed import long_drive, parts, ring, soak, sweeps
from benchmarks.tables import Table
from fgslam.core.errors import ConfigError, FgslamError

EVIDENCE: dict[str, Callable[[Path], Iterable[Table]]] = {
    "paper_tables": lambda data: [*paper_views.tables(), *drives.paper_tables()],
    "seeds": lambda data: [drives.seeds_table()],
    "person": lambda data: person.tables(),
    "chess": chess.tables,
    "variants": lambda data: [variants.table(data)],
    "paired": lambda data: [variants.paired_table()],
    "real": lambda data: [drives.real_table(data)],
    "dense": dense.tables,
    "euroc_raw": euroc_raw.tables,
    "hybrid": hybrid.tables,
    "front_ends": front_ends.tables,
    "light": light.tables,
    "false_matches": lambda data: false_matches.tables(),
    "honesty": lambda data: honesty.tables(),
    "noise": lambda data: noise.tables(),
    "lasting": lambda data: lasting.tables(),
    "lenses": lambda data: lenses.tables(),
    "rig_honesty": rig_honesty.tables,
    "staircase": staircase.tables,
    "visits": lambda data: visits.tables(),
    "consistency": lambda data: consistency.tables(),
    "compact_memory": lambda data: compact_memory.tables(),
    "witnesses": witnesses.tables,
    "witnesses_seeds": lambda data: [witnesses.seeds_table()],
    "wrong_mirror": lambda data: wrong_mirror.tables(),
    "unmapped": lambda data: relocalising.unmapped_tables(),
    "recognised": relocalising.recognised_tables,
}
"""Sets of tables by name; each is called with the folder of the real recordings."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status: 0, or 2 on a user's mistake."""
    given = _parser().parse_args(arguments)
    try:
        _do(given)
    except FgslamError as error:
        say(f"error: {error}")
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    names = (
        "pages",
        "keep",
        "speed",
        "long_drive",
        "soak",
        "ring",
        "sweep",
        "peers",
        *sorted(EVIDENCE),
    )
    parser.add_argument("what", choices=names, metavar="NAME", help=", ".join(names))
    parser.add_argument(
        "path", type=Path, nargs="?", help="keep: run folder or file of --out; peers: one recording"
    )
    parser.add_argument("--out", type=Path, help="write the numbers as JSON to this file")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the real recordings")
    parser.add_argument("--frames", type=int, default=2000, help="speed: frames over images")
    parser.add_argument("--cases", type=int, default=sweeps.CASES, help="sweep: cases, 20 or more")
    choices = ("all", *parts.PARTS)
    parser.add_argument("--part", choices=choices, default="all", help="speed: which part")
    return parser


def _do(given: argparse.Namespace) -> None:
    if given.what == "pages":
        write_pages()
    elif given.what == "keep":
        if given.path is None:
            raise ConfigError("keep what? give a run folder, or a file that --out has written")
        say(f"kept {keep(given.path)}; now `python -m benchmarks pages`")
    elif given.what == "speed":
        _write_ratios(parts.measure(given.part, given.frames), given.out or Path("bench.json"))
    elif given.what == "ring":
        _write_ratios(ring.numbers(), given.out or Path("bench_ring.json"))
    elif given.what == "sweep":
        _write_ratios(sweeps.numbers(given.cases), given.out or Path("bench_sweep.json"))
    elif given.what == "long_drive":
        _write_ratios(long_drive.ratios_beside_batch(), given.out or Path("bench_long.json"))
    elif given.what == "soak":
        _write_ratios(soak.traces(), given.out or Path("bench_soak.json"))
    else:
        own = given.what == "peers"
        found = peers.tables(given.data, given.path) if own else EVIDENCE[given.what](given.data)
        _print_tables(found, given.out)


def _write_ratios(ratios: Mapping[str, float], path: Path) -> None:
    _write(path, ratios)
    parts.show(ratios)


def _print_tables(found: Iterable[Table], out: Path | None) -> None:
    tables = tuple(found)
    sys.stdout.write("\n".join(table.markdown() for table in tables))
    if out is not None:
        _write(out, {table.title: table.as_columns() for table in tables})


def _write(path: Path, numbers: Mapping[str, Any]) -> None:
    path.write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    raise SystemExit(main())
