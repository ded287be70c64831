"""The decorator that every group of settings shares."""

from __future__ import annotations

from typing import Annotated

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)
"""Unknown keys, NaN and infinity are refused."""


@dataclass(frozen=True, config=STRICT)
class MeasurementSelection:
    """What every recording of measurements has: which of its frames are used."""

    start: Annotated[int, Field(ge=0, description="first frame used, counted from 0")] = 0
    stop: Annotated[
        int | None, Field(ge=1, description="frame before which to stop; null: to the end")
    ] = None
    stride: Annotated[int, Field(ge=1, description="use every n-th frame")] = 1
