"""Settings of what a homing run writes."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT


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
            description="bearing logs kept, of the first trials or runs, which `fgslam compare` "
            "replays",
        ),
    ] = 4
