"""What the page of a homing run shows: plain values, whoever computed them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from fgslam.report.page.data import Column, Picture
from fgslam.report.page.traces import Figure


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
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, tuple[str, ...]], ...]

    def __post_init__(self) -> None:
        for title, values in self.rows:
            if len(values) != len(self.columns):
                raise ValueError(
                    f"{title}: {len(values)} values in a table of {len(self.columns)} columns"
                )


@dataclass(frozen=True, slots=True, eq=False)
class HomingPage:
    """All that one page shows.

    Attributes:
        title, subtitle: headings.
        verdict: the sentences that say it in short.
        tables, figures, pictures: in the order of the page.
        series: what a figure's lines belong to (estimators, legs); each can be switched off, and
            the i-th has the i-th colour.
        notes: what was tolerated, warnings, in words.
        config_yaml: the resolved configuration, as text.
        versions: of the program and its libraries; None where one is not installed.
    """

    title: str
    subtitle: str
    verdict: tuple[str, ...]
    tables: tuple[TextTable, ...] = ()
    figures: tuple[Figure, ...] = ()
    pictures: tuple[Picture, ...] = ()
    series: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    config_yaml: str = ""
    versions: Mapping[str, str | None] = field(default_factory=dict)
