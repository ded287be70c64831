"""What every group of settings shares: strictness, and one line about a wrong value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from difflib import get_close_matches
from typing import Annotated, Any, Literal, TypeAlias, TypeVar

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from fgslam.core.errors import ConfigError

S = TypeVar("S")

STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)
"""Unknown keys, NaN and infinity are refused."""

Positive: TypeAlias = Annotated[float, Field(gt=0.0)]
NonNegative: TypeAlias = Annotated[float, Field(ge=0.0)]
Share: TypeAlias = Annotated[float, Field(ge=0.0, le=1.0)]
Degrees: TypeAlias = Annotated[float, Field(gt=0.0, le=180.0)]
Count: TypeAlias = Annotated[int, Field(ge=1)]
Index: TypeAlias = Annotated[int, Field(ge=0)]

RigPlaces: TypeAlias = Literal["all", "reference"]
"""The images that a measured column and row are of."""


def make_settings(kind: type[S], values: Mapping[str, Any], where: str) -> S:
    """Settings of one class from keys and values, as a caller of the library gives them.

    Args:
        kind: a dataclass of settings.
        values: its fields; those that are absent keep their defaults.
        where: what the values were given to, for the message.

    Raises:
        ConfigError: a key is unknown or a value is out of its bounds.
    """
    known = [f.name for f in fields(kind)]  # type: ignore[arg-type]  # a dataclass by contract
    for key in values:
        if key not in known:
            close = get_close_matches(key, known, n=1)
            hint = f"did you mean {close[0]}?" if close else f"use one of {', '.join(known)}"
            raise ConfigError(f"{where}: there is no setting {key}; {hint}")
    try:
        return TypeAdapter(kind).validate_python(dict(values))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "value"
        message = first["msg"].replace("Input should", "should")
        raise ConfigError(
            f"{where}: {key} is {first['input']!r}, but it {message}; correct it"
        ) from None


@dataclass(frozen=True, config=STRICT)
class FrameSelection:
    """Which frames of a recording are used, as a Python slice."""

    start: Index = Field(default=0, description="first frame used, counted from 0")
    stop: Count | None = Field(
        default=None, description="frame before which to stop; null: to the end"
    )
    stride: Count = Field(default=1, description="use every n-th frame")
