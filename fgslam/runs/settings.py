"""Settings of a run itself: what it writes, and what is asked of a saved map."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT
from fgslam.slam.map_settings import FirstDriveSettings


@dataclass(frozen=True, config=STRICT)
class OutputSettings:
    """Pictures, the page and checkpoints."""

    pictures: Annotated[bool, Field(description="draw the pictures of the run folder")] = True
    report: Annotated[bool, Field(description="write report.html")] = True
    checkpoint_seconds: Annotated[
        float,
        Field(
            ge=0.0,
            description="interval of checkpoints for --resume; 0: each frame",
        ),
    ] = 2.0


@dataclass(frozen=True, config=STRICT)
class HomingOutputSettings:
    """Pictures, the page and bearing logs."""

    pictures: Annotated[
        int, Field(ge=0, description="at most so many pictures of pairs, links or frames")
    ] = 8
    report: Annotated[bool, Field(description="write report.html")] = True
    logs: Annotated[
        int,
        Field(
            ge=0,
            description="bearing logs kept of the first trials or runs",
        ),
    ] = 4


@dataclass(frozen=True, config=STRICT)
class KnownMapSettings:
    """The map in which frames are sought: a file, or one that is made first."""

    load: Annotated[str | None, Field(description="map file")] = None
    made_from: Annotated[
        FirstDriveSettings | None,
        Field(description="drive this first, into RUN/first, with the same settings"),
    ] = None


@dataclass(frozen=True, config=STRICT)
class QuerySettings:
    """What is asked of the map, and when an answer is right."""

    frames: Annotated[
        tuple[Annotated[int, Field(ge=1, le=100)], ...],
        Field(
            min_length=1,
            description="frames of a query: 1, or a submap of so many",
        ),
    ] = (1,)
    every: Annotated[
        int,
        Field(
            ge=1,
            description="frames from query to query; of bursts their length",
        ),
    ] = 1
    within_m: Annotated[
        float, Field(gt=0.0, description="largest error of a right position, metres")
    ] = 0.05
    within_deg: Annotated[
        float, Field(gt=0.0, le=180.0, description="largest error of a right rotation, degrees")
    ] = 1.0
