"""Compares a finished comparison with numbers that are committed: `make baseline`.

`python -m benchmarks.baseline check FOLDER FILE` exits with 1 where a number got worse by more than
its tolerance; `write` in the place of `check` writes the numbers of the folder into the file.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pandas

_FLOOR = 1e-6  # metres, degrees: less is rounding, whatever the ratio
_ONE_IS_BEST = ("nees_", "nis_")


def deviations(baseline: Mapping[str, Any], found: Mapping[str, Any]) -> Iterator[tuple[bool, str]]:
    """Values outside their tolerances: whether each got worse, and a line about it.

    Args:
        baseline: the document of a file.
        found: means of the estimators by title.
    """
    (expected,) = baseline["runs"].values()
    for title, numbers in expected.items():
        for name, value in numbers.items():
            now = found.get(title, {}).get(name)
            if now is None:
                yield True, f"{title}: {name}: {value:.6g} in the baseline, not known now"
            elif abs(now - value) > max(_tolerance(baseline, name) * abs(value), _FLOOR):
                worse = _badness(name, now) > _badness(name, value)
                yield worse, f"{title}: {name}: {value:.6g} in the baseline, {now:.6g} now"


def with_numbers(baseline: Mapping[str, Any], found: Mapping[str, Any]) -> dict[str, Any]:
    """The document with the numbers of a comparison in the place of its own."""
    names = baseline["relative_tolerances"]
    known = {title: {n: one[n] for n in names if n in one} for title, one in found.items()}
    return {**baseline, "runs": dict.fromkeys(baseline["runs"], known)}


def read_means(folder: Path) -> dict[str, dict[str, float]]:
    """Means over the seeds by estimator and column, of what ended well."""
    table = pandas.read_parquet(folder / "results.parquet")
    means = table[table["failure"].isna()].groupby("estimator").mean(numeric_only=True)
    return {
        str(title): {str(name): float(value) for name, value in own.dropna().items()}
        for title, own in means.iterrows()
    }


def _tolerance(baseline: Mapping[str, Any], name: str) -> float:
    return float(baseline["relative_tolerances"][name])


def _badness(name: str, value: float) -> float:
    if not name.startswith(_ONE_IS_BEST):
        return value
    return abs(math.log(value)) if value > 0.0 else math.inf


def main() -> int:
    """Checks or writes one baseline; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("task", choices=("check", "write"))
    parser.add_argument("folder", type=Path, help="of the comparison")
    parser.add_argument("file", type=Path, help="the baseline")
    given = parser.parse_args()
    found = read_means(given.folder)
    baseline = json.loads(given.file.read_text(encoding="utf-8"))
    if given.task == "write":
        text = json.dumps(with_numbers(baseline, found), indent=2, allow_nan=False)
        given.file.write_text(text + "\n", encoding="utf-8")
        return 0
    lines = list(deviations(baseline, found))
    for worse, line in lines:
        print("REGRESSION" if worse else "deviation", line)
    print(f"{given.file}: {len(lines)} values are outside their tolerances")
    return int(any(worse for worse, _ in lines))


if __name__ == "__main__":
    raise SystemExit(main())
