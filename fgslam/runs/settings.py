"""Settings of a run itself: what it writes, and what is asked of a saved map."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, Count, Degrees, Index, NonNegative, Positive
from fgslam.slam.map_settings import FirstDriveSettings


@dataclass(frozen=True, config=STRICT)
class OutputSettings:
    """Pictures, the page and checkpoints."""

    pictures: bool = Field(default=True, description="draw the pictures of the run folder")
    report: bool = Field(default=True, description="write report.html")
    checkpoint_seconds: NonNegative = Field(
        default=2.0, description="interval of checkpoints for --resume; 0: each frame"
    )


@dataclass(frozen=True, config=STRICT)
class HomingOutputSettings:
    """Pictures, the page and bearing logs."""

    pictures: Index = Field(
        default=8, description="at most so many pictures of pairs, links or frames"
    )
    report: bool = Field(default=True, description="write report.html")
    logs: Index = Field(default=4, description="bearing logs kept of the first trials or runs")


@dataclass(frozen=True, config=STRICT)
class KnownMapSettings:
    """The map in which frames are sought: a file, or one that is made first."""

    load: str | None = Field(default=None, description="map file")
    made_from: FirstDriveSettings | None = Field(
        default=None, description="drive this first, into RUN/first, with the same settings"
    )


@dataclass(frozen=True, config=STRICT)
class QuerySettings:
    """What is asked of the map, and when an answer is right."""

    frames: tuple[Annotated[int, Field(ge=1, le=100)], ...] = Field(
        default=(1,), min_length=1, description="frames of a query: 1, or a submap of so many"
    )
    every: Count = Field(
        default=1, description="frames from query to query; of bursts their length"
    )
    within_m: Positive = Field(
        default=0.05, description="largest error of a right position, metres"
    )
    within_deg: Degrees = Field(
        default=1.0, description="largest error of a right rotation, degrees"
    )
