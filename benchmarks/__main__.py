"""Measures speed or accuracy, or writes the pages of results.

`python -m benchmarks NAME` prints one set of tables as Markdown; `speed` and `long_drive` write
`bench.json` and `bench_long.json`; `pages` writes docs/results from benchmarks/results.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from benchmarks.bounds import BOUNDS
from benchmarks.catalogue import EVIDENCE
from benchmarks.pages import bounds, write_pages
from benchmarks.rows import Section, section_as_json
from benchmarks.runs import DATA, say
from benchmarks.speed import long_drive, parts
from fgslam.core.errors import FgslamError


def main(arguments: Sequence[str] | None = None) -> int:
    """Exit status: 0, or 2 on a user's mistake."""
    given = _parser().parse_args(arguments)
    try:
        if given.what == "pages":
            write_pages()
        elif given.what == "speed":
            _write_ratios(parts.measure(given.part, given.frames), given.out or "bench.json")
        elif given.what == "long_drive":
            _write_ratios(long_drive.ratios_beside_batch(), given.out or "bench_long.json")
        else:
            _print_tables(given.what, given.data, given.out)
    except FgslamError as error:
        say(f"error: {error}")
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    names = ("pages", "speed", "long_drive", *sorted(EVIDENCE))
    parser.add_argument("what", choices=names, metavar="NAME", help=", ".join(names))
    parser.add_argument("--out", type=Path, help="write the numbers as JSON to this file")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the real recordings")
    parser.add_argument("--frames", type=int, default=2000, help="speed: frames over images")
    choices = ("all", *parts.PARTS)
    parser.add_argument("--part", choices=choices, default="all", help="speed: which part")
    return parser


def _write_ratios(ratios: Mapping[str, float], path: str | Path) -> None:
    Path(path).write_text(json.dumps(ratios, indent=2) + "\n", encoding="utf-8")
    parts.show(ratios)


def _print_tables(name: str, data: Path, out: Path | None) -> None:
    tables = tuple(EVIDENCE[name](data))
    rows = tuple(BOUNDS[name](tables)) if name in BOUNDS else ()
    parts_shown = [table.markdown() for table in tables]
    sys.stdout.write("\n".join([*parts_shown, *(bounds(rows) if rows else ())]) + "\n")
    if out is not None:
        section = Section(name, (f"python -m benchmarks {name}",), rows=rows, tables=tables)
        out.write_text(json.dumps(section_as_json(section), indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    raise SystemExit(main())
