"""Settings of what a run writes."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT


@dataclass(frozen=True, config=STRICT)
class OutputSettings:
    """Pictures, the page and checkpoints."""

    pictures: Annotated[bool, Field(description="draw the pictures of the run folder")] = True
    report: Annotated[bool, Field(description="write report.html")] = True
    checkpoint_seconds: Annotated[
        float,
        Field(
            ge=0.0,
            description="write all results so far this often, for --resume; 0: after each frame",
        ),
    ] = 2.0
