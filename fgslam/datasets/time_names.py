"""Names of files that are times, or differ in one alone.

Times are numbers of ten digits or more, or a whole name of seconds to the microsecond (ETH3D).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise

# Ten digits with zeros before them count images, as in KITTI's drives.
_NAME = re.compile(r"^([1-9]\d{9,18}|\d{1,9}(?=\.\d{6,9}$))(?:\.(\d+)|[_-](\d{3,9}))?$")
_AMID = re.compile(r"(?<!\d)([1-9]\d{9,18})(?:\.(\d+)|[_-](\d{3,9})(?!\d))?(?!\d)")


def time_parts(names: Sequence[str]) -> tuple[list[int], list[str]] | None:
    """Whole numbers, and digits of the fractions, of names that are times; None where they are not.

    So are names that are the same but for one time, ``camera_1225719876.123_left``.
    What follows a dash or an underscore is a fraction, with zeros before it where its width
    varies, unless it counts by one.
    """
    found = [match for name in names if (match := _NAME.match(name))]
    if len(found) < len(names):
        found = _amid(names)
    if not found:
        return None
    width = max(len(match[3] or "") for match in found)
    parts = [match[2] or (match[3] or "").zfill(width) or "0" for match in found]
    behind = [int(match[3]) for match in found if match[3]]
    whole = [int(match[1]) for match in found]
    if not counts_by_one(behind):
        return whole, parts
    return (whole, ["0"] * len(whole)) if len(set(whole)) == len(whole) else None


def _amid(names: Sequence[str]) -> list[re.Match[str]]:
    """The one number in which names differ, where it may be a time and is no counter; else none."""
    for found in zip(*(_AMID.finditer(name) for name in names), strict=False):
        around = {
            match.string[: match.start()] + "\0" + match.string[match.end() :] for match in found
        }
        if len(around) == 1 and not counts_by_one([int(match[1]) for match in found]):
            return list(found)
    return []


def counts_by_one(numbers: Sequence[int]) -> bool:
    """Whether most of the numbers are one more than that before."""
    steps = [b - a for a, b in pairwise(numbers)]
    return len(steps) > 0 and 2 * steps.count(1) > len(steps)
