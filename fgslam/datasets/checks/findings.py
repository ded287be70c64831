"""A finding about a recording: how bad it is, what it is about, and the text."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

_LISTED = 5


class Level(str, Enum):
    """How bad a finding is."""

    INFO = "info"
    WARNING = "warning"
    PROBLEM = "problem"


@dataclass(frozen=True, slots=True)
class Finding:
    """One line of an inspection.

    Attributes:
        level: ``problem`` will spoil a run, ``warning`` may, ``info`` informs.
        subject: what it is about, such as "time" or "odometry".
        text: one sentence with the numbers, and the remedy where there is one.
    """

    level: Level
    subject: str
    text: str


def by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings, the worst first, otherwise in their order."""
    order = (Level.PROBLEM, Level.WARNING, Level.INFO)
    return tuple(sorted(findings, key=lambda f: order.index(f.level)))


def share(part: int, whole: int) -> str:
    """A part of a whole in words: ``3 of 200 (1.5 %)``."""
    return f"{part} of {whole} ({100.0 * part / max(whole, 1):.3g} %)"


def listed(items: list[int]) -> str:
    """The first few numbers of a list in words."""
    more = ", ..." if len(items) > _LISTED else ""
    return ", ".join(str(item) for item in items[:_LISTED]) + more
