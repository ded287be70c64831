"""What is taken to be so of a recording: one list of entries, each with its source and its option.

Readers add what they alone know (the unit of depth, topics, pairing, times); the rest follows from
the recording (:func:`fgslam.datasets.opening.ledger_of`). Shown by `fgslam inspect`, kept in
`metrics.json`, on the page.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

IMAGES, PAIRING, TIMES = "images", "clock and pairing", "times"
LENGTH, DEPTH, LENS, ODOMETRY = "unit of length", "unit of depth", "lens model", "odometry"
"""What entries are about."""

_METRES, _ANGLES = r"\b[ck]?m\b", r"\bdeg\b"
_MOVES = {
    **dict.fromkeys((LENGTH, DEPTH), (_METRES,)),
    **dict.fromkeys((IMAGES, PAIRING, LENS), (_METRES, _ANGLES)),
}
"""Units of the figures that rest on an entry; times and the frame of odometry move none."""


class Entry(NamedTuple):
    """One thing that is taken to be so.

    Attributes:
        what: it is about.
        value: as it is taken.
        source: where that is stated, or how it was guessed.
        option: what changes it; empty where nothing does.
        guessed: whether nothing states it.
    """

    what: str
    value: str
    source: str
    option: str = ""
    guessed: bool = False

    @property
    def shown(self) -> str:
        """In words."""
        mark = "guessed: " if self.guessed else ""
        return f"{self.value} ({mark}{self.source}{f'; {self.option}' if self.option else ''})"


def rests_on_guess(figure: str, entries: Sequence[Entry]) -> bool:
    """Whether a figure, by the unit in its text or its heading, rests on one of the guesses."""
    units = {unit for entry in entries if entry.guessed for unit in _MOVES.get(entry.what, ())}
    return any(re.search(unit, figure) for unit in units)


def as_values(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Plain values for `metrics.json`."""
    return [entry._asdict() for entry in entries]


def of_values(values: object) -> tuple[Entry, ...]:
    """The entries again; what is none is left out."""
    rows = values if isinstance(values, list) else []
    wanted = set(Entry._fields)
    return tuple(Entry(**row) for row in rows if isinstance(row, Mapping) and set(row) == wanted)
