"""What a page of results shows, whichever task made them: sentences, tables, figures, pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from fgslam.report.figures.traces import Figure


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a table: heading with unit, and what it means."""

    name: str
    meaning: str


@dataclass(frozen=True, slots=True)
class TextTable:
    """A table as it is read: values as text, their units in the headings.

    Attributes:
        key: unique in the page.
        heading: its title.
        first: heading of the rows' names.
        columns: m headings with their meanings.
        rows: name of each row and its m values; `-` where a value is not known.
    """

    key: str
    heading: str
    first: str
    columns: tuple[Column, ...] = ()
    rows: tuple[tuple[str, tuple[str, ...]], ...] = ()

    def __post_init__(self) -> None:
        for title, values in self.rows:
            if len(values) != len(self.columns):
                raise ValueError(
                    f"{title}: {len(values)} values in a table of {len(self.columns)} columns"
                )


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture beside the figures: PNG or JPEG, with a caption that says what it shows."""

    caption: str
    content: bytes = field(repr=False)


@dataclass(frozen=True, slots=True, eq=False)
class Page:
    """All that one page shows.

    Attributes:
        title, subtitle: headings.
        headline: sentences with the main results, most important first.
        notes: what was tolerated in the recording, warnings, in words.
        tables, figures, pictures: in the order of the page.
        series: what the figures' lines belong to (estimators, legs); each can be switched off, and
            the i-th has the i-th colour.
        undrawn: those of the series that no figure shows: they have no switch.
        failed: those of the series that failed, which tables say.
        has_truth: whether the figures draw a truth beside the series.
        remarks: of the estimators, in words; None where the page has no section for them.
        config_yaml: the resolved configuration, as text.
        versions: of the program and its libraries; None where one is not installed.
    """

    title: str
    subtitle: str
    headline: tuple[str, ...]
    tables: tuple[TextTable, ...] = ()
    figures: tuple[Figure, ...] = ()
    pictures: tuple[Picture, ...] = ()
    series: tuple[str, ...] = ()
    undrawn: frozenset[str] = frozenset()
    failed: frozenset[str] = frozenset()
    has_truth: bool = False
    notes: tuple[str, ...] = ()
    remarks: tuple[str, ...] | None = None
    config_yaml: str = ""
    versions: Mapping[str, str | None] = field(default_factory=dict)
