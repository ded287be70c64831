"""Short texts for values that hold large arrays."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

_LONGEST = 60


class Brief:
    """A ``repr`` of one line for a dataclass: shapes for arrays, lengths for long lists."""

    __slots__ = ()

    def __repr__(self) -> str:
        owner: Any = self
        parts = (f"{f.name}={_brief(getattr(owner, f.name))}" for f in dataclasses.fields(owner))
        return f"{type(self).__name__}({', '.join(parts)})"


def _brief(value: object) -> str:
    if isinstance(value, np.ndarray) and value.size > 1:
        return f"array{value.shape}".replace(",)", ")")
    if isinstance(value, list | tuple | dict) and len(repr(value)) > _LONGEST:
        return f"{type(value).__name__} of {len(value)}"
    text = repr(value)
    return (
        text if len(text) <= _LONGEST or isinstance(value, Brief) else f"{text[: _LONGEST - 3]}..."
    )
