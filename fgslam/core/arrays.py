"""Names for arrays, and values made of them: a brief ``repr``, rows, columns that grow."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from typing import Any, ClassVar, Self, TypeAlias

import numpy as np
import numpy.typing as npt
from numpy.typing import ArrayLike

FloatArray: TypeAlias = npt.NDArray[np.float64]
Float32: TypeAlias = npt.NDArray[np.float32]
IntArray: TypeAlias = npt.NDArray[np.int64]
BoolArray: TypeAlias = npt.NDArray[np.bool_]
ByteArray: TypeAlias = npt.NDArray[np.uint8]
Image: TypeAlias = npt.NDArray[np.uint8]
StateArrays: TypeAlias = dict[str, npt.NDArray[Any]]


# --------------------------------------------------------------------------------------------
# Short texts for values that hold large arrays


_LONGEST = 60


class Brief:
    """A ``repr`` of one line for a dataclass: shapes for arrays, lengths for long lists."""

    __slots__ = ()

    def __repr__(self) -> str:
        owner: Any = self
        parts = (
            f"{f.name}={_brief(getattr(owner, f.name))}"
            for f in dataclasses.fields(owner)
            if f.repr
        )
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


# --------------------------------------------------------------------------------------------
# Values whose arrays all have one row an item: features, matches, landmarks


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


# --------------------------------------------------------------------------------------------
# Arrays of equal length that grow and shrink together, without being copied whole each time


_GROWTH = 1.5
_LEAST = 64


class GrowingColumns:
    """Named arrays (n, ...) of fixed types; rows are appended at the end and dropped anywhere.

    Appending costs what is appended (the buffers grow by a factor), dropping what lies behind the
    first row dropped. ``columns[name]`` is a view of the present rows: it may be written to, and
    is good until the next change of length. A child that annotates its columns has them as
    attributes, too.
    """

    def __init__(self, **like: npt.NDArray[Any]) -> None:
        """Starts empty; each column has the type and the trailing shape of the array given."""
        self._length = 0
        self._buffers = {
            name: np.zeros((_LEAST, *array.shape[1:]), array.dtype) for name, array in like.items()
        }

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        return self._buffers[name][: self._length]

    def __getattr__(self, name: str) -> npt.NDArray[Any]:
        if name not in self.__dict__.get("_buffers", ()):
            raise AttributeError(f"{type(self).__name__} has no column {name}")
        return self[name]

    def append(self, values: Mapping[str, npt.NDArray[Any]]) -> None:
        """Adds rows (k, ...): one array for every column."""
        count = len(next(iter(values.values())))
        self._reserve(self._length + count)
        for name, buffer in self._buffers.items():
            buffer[self._length : self._length + count] = values[name]
        self._length += count

    def drop(self, gone: BoolArray) -> None:
        """Removes the rows that are marked (n,); the others keep their order."""
        if not gone.any():
            return
        first = int(np.argmax(gone))
        self.take(first, np.flatnonzero(~gone[first:]) + first)

    def take(self, start: int, rows: IntArray) -> None:
        """Puts these rows, in this order, from row ``start`` on; they are the last ones then."""
        stop = start + len(rows)
        for buffer in self._buffers.values():
            buffer[start:stop] = buffer[rows]
        self._length = stop

    def keep_ascending(self, name: str, since: int) -> None:
        """Orders the rows by a column; those before row ``since`` are in order already."""
        if not (np.diff(self[name][max(since - 1, 0) :]) > 0).all():
            self.take(0, np.argsort(self[name], kind="stable"))

    def packed(self) -> StateArrays:
        """All columns as views, by name, without the room for more."""
        return {name: self[name] for name in self._buffers}

    @classmethod
    def unpacked(cls, packed: StateArrays) -> Self:
        """Back from :meth:`packed`."""
        out = cls.__new__(cls)
        GrowingColumns.__init__(out, **packed)
        out.append(packed)
        return out

    def _reserve(self, rows: int) -> None:
        have = len(next(iter(self._buffers.values())))
        if rows <= have:
            return
        room = max(rows, int(_GROWTH * have))
        for name, buffer in self._buffers.items():
            larger = np.zeros((room, *buffer.shape[1:]), buffer.dtype)
            larger[: self._length] = buffer[: self._length]
            self._buffers[name] = larger


# ------------------------------------------------------------------------------------------
# Quantiles of the distributions that bounds and gates come from


def thinned(count: int, limit: int) -> IntArray:
    """At most ``limit`` of ``count`` rows, evenly spread, with the first and the last."""
    if count <= limit:
        return np.arange(count)
    return np.unique(np.linspace(0, count - 1, limit).round().astype(np.int64))


def nearest_rows(stamps: npt.NDArray[Any], at: npt.NDArray[Any]) -> IntArray:
    """Row of the increasing stamps (n,), n >= 1, nearest to each of ``at`` (m,)."""
    after = np.clip(np.searchsorted(stamps, at), 0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    closer = np.abs(stamps[before] - at) <= np.abs(stamps[after] - at)
    return np.asarray(np.where(closer, before, after), np.int64)


def chi_square_quantile(probability: ArrayLike, dof: ArrayLike) -> FloatArray:
    """Values that a chi-square variable of ``dof`` degrees stays below with that probability."""
    from scipy.special import gammaincinv  # light modules do not load SciPy

    return np.asarray(2.0 * gammaincinv(np.asarray(dof) / 2.0, probability))


def middle(values: FloatArray) -> float:
    """The median of some numbers (n,), to the bit that of NumPy in a fifth of its time."""
    n = len(values)
    if not n:
        return math.nan
    ordered = np.partition(values, ((n - 1) // 2, n // 2, n - 1))
    if math.isnan(ordered[-1]):
        return math.nan
    return float((ordered[(n - 1) // 2] + ordered[n // 2]) / 2.0)


def robust_spread(values: FloatArray) -> float:
    """Median absolute deviation (n,) scaled to a normal distribution's standard deviation."""
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def student_quantile(probability: ArrayLike, dof: ArrayLike) -> FloatArray:
    """Values that a Student's t variable of ``dof`` degrees stays below with that probability."""
    from scipy.special import stdtrit

    return np.asarray(stdtrit(dof, probability))
