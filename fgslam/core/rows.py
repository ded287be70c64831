"""A base for values whose arrays all have one row an item: features, matches, landmarks."""

from __future__ import annotations

from dataclasses import fields
from functools import cache
from typing import Any, ClassVar, Self

import numpy as np

from fgslam.core.arrays import BoolArray, IntArray
from fgslam.core.brief import Brief


class Rows(Brief):
    """Length, choice and concatenation of a frozen dataclass of arrays (n, ...).

    Fields may be rows themselves, or None where they are not known.
    """

    __slots__ = ()

    SHARED: ClassVar[frozenset[str]] = frozenset()
    """Names of the fields that are no rows but hold for all of them, such as a time."""

    def __len__(self) -> int:
        return len(getattr(self, self._columns()[0]))

    def select(self, keep: BoolArray | IntArray) -> Self:
        """The chosen rows, by mask (n,) or by index in the order given, as a new value."""
        chosen: dict[str, Any] = {}
        for name in self._columns():
            value = getattr(self, name)
            if value is not None:
                value = value.select(keep) if isinstance(value, Rows) else value[keep]
            chosen[name] = value
        return self._with(chosen)

    def join(self, other: Self) -> Self:
        """Both, one after the other; shared fields are those of the first."""
        joined: dict[str, Any] = {}
        for name in self._columns():
            a, b = getattr(self, name), getattr(other, name)
            if a is None or b is None:
                joined[name] = None
            else:
                joined[name] = a.join(b) if isinstance(a, Rows) else np.concatenate([a, b])
        return self._with(joined)

    def _columns(self) -> tuple[str, ...]:
        kind: Any = self.__class__
        return _row_fields(kind)

    def _with(self, rows: dict[str, Any]) -> Self:
        for name in self.SHARED:
            rows[name] = getattr(self, name)
        return type(self)(**rows)


@cache
def _row_fields(kind: Any) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind) if field.name not in kind.SHARED)
