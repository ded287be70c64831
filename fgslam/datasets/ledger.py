"""What is taken to be so of a recording: one list of entries, each with its source and its option.

Readers add what they alone know (the unit of depth, topics, pairing, times); the rest follows from
the recording (:func:`fgslam.datasets.opening.ledger_of`). Shown by `fgslam inspect`, kept in
`metrics.json`, on the page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

UNITS = ("unit of length", "unit of depth")
"""Entries that all lengths of a run rest on."""


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


def entry_of_times(lists: Sequence[Path], assumed: Sequence[str], fps: float | None) -> Entry:
    """Where the stamps of image files are from: a list, the rate that is given, names, nothing."""
    if lists:
        return Entry("times", "stamps", ", ".join(map(str, lists)), "--fps")
    if fps is not None:
        return Entry("times", f"{fps:g} Hz", "--fps", "--fps")
    guessed = any("--fps" in note for note in assumed)
    value, source = ("even", "nothing states them") if guessed else ("stamps", "names of the files")
    return Entry("times", value, source, "--fps", guessed)


def entry_of_pairs(notes: Sequence[str]) -> Entry:
    """How images of one moment were found, by what was noticed."""
    for words, value in (
        ("by their order", "by their order"),
        ("and is taken so", "by stamps less a constant offset of the clocks"),
    ):
        if note := next((note for note in notes if words in note), ""):
            return Entry("clock and pairing", value, note, guessed=True)
    return Entry("clock and pairing", "by name or nearest in time, within 20 ms", "names or stamps")


def as_values(entries: Sequence[Entry]) -> list[dict[str, Any]]:
    """Plain values for `metrics.json`."""
    return [entry._asdict() for entry in entries]


def of_values(values: object) -> tuple[Entry, ...]:
    """The entries again; what is none is left out."""
    rows = values if isinstance(values, list) else []
    wanted = set(Entry._fields)
    return tuple(Entry(**row) for row in rows if isinstance(row, Mapping) and set(row) == wanted)
