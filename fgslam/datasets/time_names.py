"""Names of files that are times: numbers of ten digits or more, with a fraction or without."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise

# Ten digits with zeros before them count images, as in KITTI's drives.
_NAME = re.compile(r"^([1-9]\d{9,18})(?:\.(\d+)|[_-](\d{3,9}))?$")


def time_parts(names: Sequence[str]) -> tuple[list[int], list[str]] | None:
    """Whole numbers, and digits of the fractions, of names that are times; None where they are not.

    What follows a dash or an underscore is a fraction, with zeros before it where its width
    varies, unless it counts by one.
    """
    found = [match for name in names if (match := _NAME.match(name))]
    if not names or len(found) < len(names):
        return None
    width = max(len(match[3] or "") for match in found)
    parts = [match[2] or (match[3] or "").zfill(width) or "0" for match in found]
    behind = [int(match[3]) for match in found if match[3]]
    whole = [int(match[1]) for match in found]
    if not counts_by_one(behind):
        return whole, parts
    return (whole, ["0"] * len(whole)) if len(set(whole)) == len(whole) else None


def counts_by_one(numbers: Sequence[int]) -> bool:
    """Whether most of the numbers are one more than that before."""
    steps = [b - a for a, b in pairwise(numbers)]
    return len(steps) > 0 and 2 * steps.count(1) > len(steps)
