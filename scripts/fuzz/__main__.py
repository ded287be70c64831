"""`python -m scripts.fuzz`."""

from __future__ import annotations

import argparse
import resource
import sys
import time

from scripts.fuzz.cases import KINDS, faults

MOST_MB = 2000.0


def main() -> None:
    """Tries cases of each kind; exits with 1 where there is a fault."""
    parser = argparse.ArgumentParser(description="damaged and odd inputs by the thousand")
    parser.add_argument("--cases", type=int, default=200, help="of each kind")
    parser.add_argument("--seed", type=int, default=0, help="number of the first case")
    parser.add_argument("--kind", choices=[kind.name for kind in KINDS], help="default: all")
    given = parser.parse_args()
    wrong: list[str] = []
    for kind in KINDS:
        if given.kind not in (None, kind.name):
            continue
        began = time.monotonic()
        counts, lines = faults(kind, range(given.seed, given.seed + given.cases))
        wrong += lines
        print(f"{kind.name:14} {dict(counts)} in {time.monotonic() - began:.0f} s", flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(*wrong, f"{len(wrong)} faults, {peak:.0f} MB at most", sep="\n")
    sys.exit(bool(wrong) or peak > MOST_MB)


if __name__ == "__main__":
    main()
