"""One codec from dataclasses to ``.npz`` files and back, and the state of a run's parts on it.

A file holds plain arrays and one JSON text ``tree`` with the structure and all single numbers; no
pickle. The same value gives the same bytes. What is read back is what the reader's type hints say,
and of a union only its own members. Lists are stacked by column: 10,000 poses are one array, a list
of dataclasses one column a field.

Logs, maps and features name their arrays themselves, as tables in the documents have them: they
share reading, writing and the checks of what is read (:class:`ArrayFile`).

A class that changes during a run marks what it keeps: ``_pose: Kept[FloatArray]``. That is its
state; what is made of it (caches) or given to it (settings, cameras) is not. :func:`state_of` takes
a snapshot, :func:`restore` puts it back into a part made with the same settings.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import tokenize
import types
import typing
import zipfile
import zlib
from collections import abc, deque
from collections.abc import Mapping, Sequence
from enum import Enum
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Protocol, Self, TypeAlias, TypeVar, get_args, get_origin

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray, StateArrays
from fgslam.core.errors import FgslamError, MeasurementLogError
from fgslam.core.files import replacing, require_file
from fgslam.core.geometry import is_rigid

T = TypeVar("T")
_KEPT = "kept"
Kept: TypeAlias = Annotated[T, _KEPT]
"""Marks an attribute as a part of its class's state."""

TREE = "tree"
"""Name of the array with the structure."""

UNFIT = (KeyError, ValueError, TypeError, IndexError, AttributeError)
"""What :func:`unpack` and :func:`restore` raise for arrays of another value."""

_SINGLE = 16
"""Numbers of a list that stand in the structure; more of them are an array."""


@typing.runtime_checkable
class Compact(Protocol):
    """A value with room or caches that are no state: it is stored as what :meth:`packed` gives."""

    def packed(self) -> Any:
        """An array or a mapping of arrays that tells all."""
        ...

    @classmethod
    def unpacked(cls, packed: Any) -> Self:
        """The value back."""
        ...


@typing.runtime_checkable
class Resumable(Protocol):
    """A part that keeps its state in its own way: one that holds a solver, or a user's own."""

    def state(self) -> StateArrays:
        """Everything needed to continue, as plain arrays; later updates leave them alone."""
        ...

    def restore(self, state: StateArrays) -> None:
        """Continues from what :meth:`state` gave; on a new part with the same settings."""
        ...


# --------------------------------------------------------------------------------------------
# Values


def pack(value: Any) -> StateArrays:
    """A value as arrays. Raises TypeError for what is neither data nor made of it."""
    packing = _Packing()
    tree = packing.node(value, "")
    return packing.arrays | {TREE: np.array(json.dumps(tree))}


def unpack(arrays: StateArrays, kind: Any) -> Any:
    """The value of :func:`pack`, as the type ``kind``: a dataclass, a container or a union.

    Raises:
        Exception: one of ``UNFIT``; they are not those of such a value.
    """
    return _Unpacking(arrays).value(json.loads(str(arrays[TREE])), kind)


class _Packing:
    """Nodes of the structure; arrays by their place in it."""

    def __init__(self) -> None:
        self.arrays: StateArrays = {}

    def node(self, value: Any, at: str) -> Any:
        """A value as JSON; its arrays are stored beside, under names that begin with ``at``."""
        value = _plain(value)
        if value is None or isinstance(value, bool | int | float | str):
            return value
        if isinstance(value, np.ndarray):
            return {"array": self._stored(value, at)}
        if isinstance(value, bytes):
            return {"bytes": self._stored(np.frombuffer(value, np.uint8), at)}
        if isinstance(value, tuple | list | deque) and not _field_names(type(value)):
            return self._sequence(value, at)
        return self._composed(value, at)

    def _sequence(self, value: Sequence[Any], at: str) -> Any:
        if isinstance(value, deque):
            return {"deque": self.column(list(value), at), "most": value.maxlen}
        if isinstance(value, tuple) and len(value) <= _SINGLE:  # its items may be of all types
            return [self.node(one, _below(at, str(k))) for k, one in enumerate(value)]
        return self.column(list(value), at)

    def _composed(self, value: Any, at: str) -> Any:
        if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
            return {"named": {n: self.node(one, _below(at, n)) for n, one in value.items()}}
        if isinstance(value, Mapping):
            keys = self.column(list(value), _below(at, "keys"))
            return {"keys": keys, "values": self.column(list(value.values()), at)}
        if _offers(value, Compact):
            return {"compact": self.node(value.packed(), at)}
        if _offers(value, Resumable):
            own = value.state().items()
            return {"own": {n: self._stored(a, _below(at or "own", n)) for n, a in own}}
        kind: Any = type(value)
        kept = kept_hints(kind)
        if names := kept or _field_names(kind):
            parts = {n: self.node(getattr(value, n), _below(at, n)) for n in names}
            return {"part": parts} if kept else {"class": kind.__name__, "fields": parts}
        raise TypeError(f"{type(value).__name__} cannot be stored")

    def column(self, values: list[Any], at: str) -> Any:
        """A list; its items in one array, or one column a field, where they are alike."""
        values = [_plain(value) for value in values]
        types_of = {type(value) for value in values}
        if types_of <= {bool} or types_of <= {int} or types_of <= {float}:
            numbers = np.array(values) if len(values) > _SINGLE else np.empty(0, np.object_)
            several = numbers.dtype.kind in "bif"  # integers beyond 64 bits are none
            return {"numbers": self._stored(numbers, at)} if several else values
        stacked: Any = None
        if type(None) in types_of:
            known = [value is not None for value in values]
            some = [value for value in values if value is not None]
            if some and len(values) > _SINGLE:
                known_at = _below(at, "known")
                return {"known": self.column(known, known_at), "some": self.column(some, at)}
        elif len(types_of) == 1:
            stacked = self._stacked(values, types_of.pop(), at)
        if stacked is None:
            stacked = [self.node(value, _below(at, str(k))) for k, value in enumerate(values)]
        return stacked

    def _stacked(self, values: list[Any], kind: type, at: str) -> Any:
        """Values of one type by column; None where they are not alike."""
        if kind is np.ndarray:
            if len({(v.dtype, v.shape) for v in values}) == 1:
                return {"stack": self._stored(np.array(values), at)}
            if min(v.ndim for v in values) and len({(v.dtype, v.shape[1:]) for v in values}) == 1:
                sizes = self.column([len(v) for v in values], _below(at, "sizes"))
                return {"joined": self._stored(np.concatenate(values), at), "sizes": sizes}
        elif kind is tuple and len({len(v) for v in values}) == 1:
            turned = [list(column) for column in zip(*values, strict=True)]
            parts = [self.column(column, _below(at, str(k))) for k, column in enumerate(turned)]
            return {"tuples": parts, "count": len(values)}
        elif kind in (list, tuple):
            sizes = self.column([len(v) for v in values], _below(at, "sizes"))
            return {"of": self.column([one for v in values for one in v], at), "sizes": sizes}
        elif (names := _field_names(kind)) and not kept_hints(kind):
            columns = {
                n: self.column([getattr(v, n) for v in values], _below(at, n)) for n in names
            }
            return {"class": kind.__name__, "columns": columns, "count": len(values)}
        return None

    def _stored(self, array: np.ndarray[Any, Any], at: str) -> str:
        if array.dtype.hasobject:
            raise TypeError("an array of objects cannot be stored")
        name = at or "value"
        if name in self.arrays or name == TREE:
            raise ValueError(f"two arrays of the name {name}")
        self.arrays[name] = array.copy()
        return name


class _Unpacking:
    """Values from nodes of the structure, by the types that are asked for."""

    def __init__(self, arrays: StateArrays) -> None:
        self.arrays = arrays

    def value(self, node: Any, kind: Any, now: Any = None) -> Any:
        """The value of a node; ``now``: what a part holds there, whose given things stay."""
        members = _members(kind)
        out: Any
        if not isinstance(node, dict | list):
            if has_state(now):
                raise ValueError(f"no state of {type(now).__name__}")
            return _scalar(node, members)
        match node:
            case {"array": name}:
                out = self.arrays[name].copy()
            case {"bytes": name}:
                out = self.arrays[name].tobytes()
            case {"compact": inner}:
                compact = next(m for m in members if isinstance(m, type) and issubclass(m, Compact))
                out = compact.unpacked(self.value(inner, Any))
            case {"part": parts}:
                out = self._part(parts, now)
            case {"own": names}:
                now.restore({name: self.arrays[stored] for name, stored in names.items()})
                out = now
            case {"class": name, "fields": parts}:
                made = _named(name, members)
                hints = _hints(made)
                out = made(**{n: self.value(part, hints[n]) for n, part in parts.items()})
            case {"named": named}:
                item = (*get_args(_first(members, abc.Mapping)), Any, Any)[1]
                out = {n: self.value(one, item) for n, one in named.items()}
            case {"keys": keys, "values": values}:
                key, item = (*get_args(_first(members, abc.Mapping)), Any, Any)[:2]
                out = dict(zip(self.column(keys, key), self.column(values, item), strict=True))
            case {"deque": items, "most": most}:
                out = deque(self.column(items, _item_kind(_first(members, deque))), most)
            case _:
                out = self._sequence(node, _first(members, abc.Sequence), now)
        return out

    def _sequence(self, node: Any, kind: Any, now: Any) -> Any:
        items = get_args(kind)
        if isinstance(node, list) and get_origin(kind) is tuple and items[-1:] != (Ellipsis,):
            return tuple(self.value(one, of) for one, of in zip(node, items, strict=True))
        return _made_of(self.column(node, _item_kind(kind), now), kind)

    def column(self, node: Any, kind: Any, now: Any = None) -> list[Any]:
        """The items of a list, each of the type."""
        out: list[Any]
        match node:
            case list():
                before = (
                    now if isinstance(now, list) and len(now) == len(node) else [None] * len(node)
                )
                out = [self.value(one, kind, was) for one, was in zip(node, before, strict=True)]
            case {"numbers": name}:
                members = _members(kind)
                out = [_scalar(number, members) for number in self.arrays[name].tolist()]
            case {"stack": name}:
                array = self.arrays[name].copy()
                out = list(array) if array.ndim > 1 else [np.array(one) for one in array]
            case {"joined": name, "sizes": sizes}:
                out = np.split(self.arrays[name].copy(), np.cumsum(self.column(sizes, int))[:-1])
            case {"known": known, "some": some}:
                found = iter(self.column(some, kind))
                out = [next(found) if so else None for so in self.column(known, bool)]
            case {"tuples": parts, "count": count}:
                of = _item_kinds(_first(_members(kind), tuple), len(parts))
                columns = [self.column(part, one) for part, one in zip(parts, of, strict=True)]
                out = list(zip(*columns, strict=True)) if parts else [()] * count
            case {"of": items, "sizes": sizes}:
                inner = _first(_members(kind), abc.Sequence)
                every = self.column(items, _item_kind(inner))
                ends = [0, *np.cumsum(self.column(sizes, int)).tolist()]
                out = [_made_of(every[a:b], inner) for a, b in pairwise(ends)]
            case {"class": name, "columns": columns, "count": count}:
                made = _named(name, _members(kind))
                hints = _hints(made)
                fields = {n: self.column(column, hints[n]) for n, column in columns.items()}
                out = [made(**{n: items[k] for n, items in fields.items()}) for k in range(count)]
            case _:
                raise ValueError(f"holds no list, but {node}")
        return out

    def _part(self, parts: dict[str, Any], now: Any) -> Any:
        """A part with its state put back; one that is frozen is replaced."""
        kind: Any = type(now)
        hints = kept_hints(kind)
        if set(hints) != set(parts):
            raise ValueError(f"no state of {type(now).__name__}")
        values = {n: self.value(parts[n], hints[n], getattr(now, n)) for n in parts}
        if _is_frozen(kind):
            return dataclasses.replace(now, **values)
        for name, value in values.items():
            setattr(now, name, value)
        if isinstance(now, Remade):
            now.remake()
        return now


def _plain(value: Any) -> Any:
    """Numbers of NumPy and members of enumerations as what they are in JSON."""
    if isinstance(value, np.generic):
        return value.item()
    return value.value if isinstance(value, Enum) else value


def _below(at: str, name: str) -> str:
    return f"{at}/{name.strip('_')}" if at else name.strip("_")


def _is_frozen(kind: Any) -> bool:
    return bool(getattr(getattr(kind, "__dataclass_params__", None), "frozen", False))


def _offers(value: Any, protocol: Any) -> bool:
    """Whether a value has a protocol's members: asked once a type, much faster than of each."""
    kind: Any = type(value)
    return _has_members(kind, protocol)


@cache
def _has_members(kind: Any, protocol: Any) -> bool:
    return issubclass(kind, protocol)


def _field_names(kind: Any) -> tuple[str, ...]:
    """Of a dataclass or a named tuple; empty of any other type."""
    if dataclasses.is_dataclass(kind):
        return tuple(field.name for field in dataclasses.fields(kind) if field.init)
    return tuple(getattr(kind, "_fields", ()))


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return typing.get_type_hints(kind)


def _members(kind: Any) -> tuple[Any, ...]:
    """The types that a hint stands for."""
    if get_origin(kind) is Annotated:
        return _members(get_args(kind)[0])
    if get_origin(kind) in (typing.Union, types.UnionType):
        return tuple(part for member in get_args(kind) for part in _members(member))
    return (kind,)


def _first(members: tuple[Any, ...], container: type) -> Any:
    """The member that is such a container."""
    for member in members:
        made = get_origin(member) or member
        if isinstance(made, type) and issubclass(made, container) and not issubclass(made, str):
            return member
    return Any


def _named(name: str, members: tuple[Any, ...]) -> Any:
    for member in members:
        if getattr(member, "__name__", "") == name:
            return member
    raise ValueError(f"holds a {name}")


def _item_kind(kind: Any) -> Any:
    """Of a list or a tuple of one type of items, or a deque."""
    return (*get_args(kind), Any)[0]


def _item_kinds(kind: Any, count: int) -> Sequence[Any]:
    given = get_args(kind)
    if len(given) == 2 and given[1] is Ellipsis:
        return [given[0]] * count
    return given if len(given) == count else [Any] * count


def _made_of(items: list[Any], kind: Any) -> Any:
    return tuple(items) if (get_origin(kind) or kind) is tuple else items


def _scalar(node: Any, members: tuple[Any, ...]) -> Any:
    enums = [member for member in members if isinstance(member, type) and issubclass(member, Enum)]
    if enums and node is not None:
        return enums[0](node)
    real = float in members and int not in members and bool not in members
    return float(node) if real and isinstance(node, int) else node


# --------------------------------------------------------------------------------------------
# State of parts


@typing.runtime_checkable
class Remade(Protocol):
    """A part that makes something anew of its state when this is put back."""

    def remake(self) -> None:
        """Makes it."""
        ...


@cache
def kept_hints(kind: Any) -> dict[str, Any]:
    """What a class marks as its state, and the types of that; empty of one that has none."""
    found: dict[str, Any] = {}
    for one in reversed(kind.__mro__):
        stated = vars(one).get("__annotations__", {})
        marked = {n: hint for n, hint in stated.items() if str(hint).startswith("Kept[")}
        if marked:  # the others may name what is imported for the type checker alone
            own = types.SimpleNamespace(__annotations__=marked)
            found |= typing.get_type_hints(own, vars(sys.modules[one.__module__]))
    return found


def has_state(part: Any) -> bool:
    """Whether the state of a part can be taken."""
    kind: Any = type(part)
    return bool(kept_hints(kind)) or _offers(part, Resumable)


def state_of(part: Any) -> StateArrays:
    """A snapshot of a part, which later changes leave alone."""
    return pack(part)


def restore(part: Any, state: StateArrays) -> None:
    """Continues from :func:`state_of`, in a part made with the same settings.

    Raises:
        Exception: one of ``UNFIT``; the state is another's.
    """
    _Unpacking(state).value(json.loads(str(state[TREE])), type(part), part)


def snapshot(part: Any) -> Any:
    """What a part keeps, for :func:`put_back` within a frame: a fifth of a millisecond at most.

    Containers are copied, arrays are not: for parts that replace theirs and write into none.
    """
    if isinstance(part, np.ndarray):
        return part
    if isinstance(part, list):
        return [snapshot(one) for one in part]
    if isinstance(part, tuple) and not _field_names(type(part)):
        return tuple(snapshot(one) for one in part)
    if isinstance(part, dict | deque):
        return part.copy()
    kind: Any = type(part)
    if _offers(part, Resumable):
        return part.state()
    names = () if _is_frozen(kind) else kept_hints(kind)
    return {name: snapshot(getattr(part, name)) for name in names} if names else part


def put_back(part: Any, kept: Any) -> None:
    """Makes a part what it was at its :func:`snapshot`."""
    if _offers(part, Resumable):
        part.restore(kept)
        return
    for name, value in kept.items():
        now = getattr(part, name)
        if isinstance(now, list) and now and has_state(now[0]):
            for one, was in zip(now, value, strict=True):
                put_back(one, was)
        elif has_state(now) and not _is_frozen(type(now)):
            put_back(now, value)
        else:
            setattr(part, name, value)


# --------------------------------------------------------------------------------------------
# Files of arrays

Items: TypeAlias = Mapping[str, tuple[str, tuple[int, ...]]]
"""Arrays by name: their kind (of ``numpy.dtype.kind``) and the shape of one row."""

UNREADABLE = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    TypeError,
    RuntimeError,  # encrypted; NotImplementedError is one, too
    MemoryError,
    SyntaxError,
    tokenize.TokenError,
    zipfile.BadZipFile,
    zlib.error,
)
"""What NumPy and zipfile raise on truncated, damaged and foreign files."""
_UNPACKED_FREELY = 100_000_000
_MOST_PACKED = 50
"""Bytes out of one: maps are packed by two, their emptiest arrays by thirty."""


@dataclasses.dataclass(frozen=True)
class ArrayFile:
    """A kind of file, and how a file that is not one is refused.

    Attributes:
        name: what it holds, as in "fgslam measurement log".
        versions: that are read, the newest last.
        error: what is raised.
        give: what to do where it is another file, or none: "give measurements.npz".
        again: what to do where it is damaged: "run again".
    """

    name: str
    versions: tuple[int, ...]
    error: type[FgslamError]
    give: str
    again: str

    @property
    def short(self) -> str:
        """The name without the leading `fgslam`."""
        return self.name.removeprefix("fgslam ")

    def header(self, version: int | None = None, **values: Any) -> StateArrays:
        """The array ``header`` with plain JSON values; by default of the newest version."""
        chosen = self.versions[-1] if version is None else version
        text = json.dumps({"format": self.name, "version": chosen, **values}, sort_keys=True)
        return {"header": np.array(text)}

    def load(self, path: Path, names: Sequence[str] | None = None) -> StateArrays:
        """The arrays of a file of these names, or all; never unpickled.

        Raises:
            FgslamError: :attr:`error`, for what cannot be read.
        """
        if path.exists() and not path.is_file() and not path.is_dir():
            require_file(path, self.error, self.give)  # who opens a pipe waits for its other end
        try:
            path.open("rb").close()
        except FileNotFoundError:
            raise self.error(f"{path}: no such file; {self.give}") from None
        except IsADirectoryError:
            raise self.error(f"{path}: is a folder; give the file itself") from None
        except OSError as error:
            raise self.error(f"{path}: cannot be read ({error.strerror}); {self.give}") from None
        try:
            with np.load(path, allow_pickle=False) as file:
                require_plain(file)
                return {name: file[name] for name in (file.files if names is None else names)}
        except UNREADABLE as error:
            cause = " ".join(str(error).split()) or type(error).__name__
            if "pickle" in cause:  # NumPy advises to unpickle, which would run what the file says
                cause = "neither arrays nor an archive of them"
            raise self.error(
                f"{path}: not a readable {self.short} ({cause}); it may be truncated, {self.again}"
            ) from None

    def read_header(self, arrays: StateArrays, where: str) -> dict[str, Any]:
        """The header's values. Raises :attr:`error` for a foreign file and another version."""
        try:
            header = json.loads(str(arrays["header"]))
        except (KeyError, json.JSONDecodeError):
            header = None
        if not isinstance(header, dict) or header.get("format") != self.name:
            raise self.error(f"{where}: not an {self.name}; {self.give}")
        if header.get("version") not in self.versions:
            raise self.error(f"{where}: {self.short} made by another version; {self.again}")
        return header

    def damaged(self, name: str, where: str) -> FgslamError:
        """The error for an array that is absent, of a wrong type or size, or out of order."""
        return self.error(f"{where}: array {name} is absent or damaged; {self.again}")

    def require(self, arrays: Mapping[str, Any], items: Items, where: str) -> None:
        """Raises :attr:`error` unless arrays of these kinds and whole shapes are there."""
        for name, (kind, shape) in items.items():
            array = arrays.get(name)
            if not isinstance(array, np.ndarray) or (array.dtype.kind, array.shape) != (
                kind,
                shape,
            ):
                raise self.damaged(name, where)

    def require_offsets(
        self, arrays: Mapping[str, Any], name: str, parts: int | None, where: str
    ) -> int:
        """Rows that offsets run to, from 0 and without a step back.

        Raises:
            FgslamError: they do not, or are not those of so many ``parts`` (None: of any).
        """
        start = arrays.get(name)
        if not isinstance(start, np.ndarray) or start.dtype.kind != "i" or start.ndim != 1:
            raise self.damaged(name, where)
        if len(start) != (max(len(start), 1) if parts is None else parts + 1):
            raise self.damaged(name, where)
        if start[0] != 0 or (np.diff(start) < 0).any():
            raise self.damaged(name, where)
        return int(start[-1])


def require_plain(file: Any) -> None:
    """Raises ValueError for what no open archive of arrays holds: other files, far more than it is.

    ValueError is one of :data:`UNREADABLE`, as is what reading the arrays may raise.
    """
    members = file.zip.infolist()
    foreign = [one.filename for one in members if not one.filename.endswith(".npy")]
    if foreign:
        raise ValueError(f"holds {foreign[0]}, which is no array")
    names = [one.filename for one in members]
    if len(set(names)) < len(names):
        raise ValueError("holds an array twice")
    size, packed = (sum(getattr(m, k) for m in members) for k in ("file_size", "compress_size"))
    if size > _UNPACKED_FREELY + _MOST_PACKED * packed:
        raise ValueError(f"would unpack to {size / 1e6:.0f} MB from {packed / 1e6:.0f}")


def write_arrays(path: Path, arrays: StateArrays, compressed: bool = False) -> int:
    """Writes an ``.npz`` whole or not at all; the same arrays give the same bytes.

    Returns:
        Size of the file in bytes.

    Raises:
        OutputError: it cannot be written.
    """
    save = np.savez_compressed if compressed else np.savez
    with replacing(path) as partial, partial.open("wb") as file:
        save(file, allow_pickle=False, **arrays)
        return file.tell()


def load_arrays(path: Path) -> StateArrays:
    """All arrays of a file of a run folder. Raises MeasurementLogError where it cannot be read."""
    return _OF_RUNS.load(path)


_OF_RUNS = ArrayFile(
    "file of arrays", (1,), MeasurementLogError, "give the run folder's own", "run again"
)


# --------------------------------------------------------------------------------------------
# Rows


def of_rows(count: int, items: Items) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Kinds and whole shapes of arrays of ``count`` rows."""
    return {name: (kind, (count, *item)) for name, (kind, item) in items.items()}


def rows_of(arrays: Mapping[str, Any], name: str) -> int:
    """Rows of an array; 0 where it is absent or a scalar."""
    array = arrays.get(name)
    return len(array) if isinstance(array, np.ndarray) and array.ndim else 0


def offsets(sizes: Sequence[int]) -> IntArray:
    """Offsets (n + 1,) of parts of these sizes."""
    return np.cumsum(np.array([0, *sizes], np.int64))


def joined(
    parts: Sequence[Any], item: tuple[int, ...] = (), dtype: Any = np.float64
) -> np.ndarray[Any, Any]:
    """Parts with rows of shape ``item`` one after the other; of ``dtype`` where there are none."""
    return np.concatenate([np.empty((0, *item), dtype), *parts])


def split(array: np.ndarray[Any, Any], start: IntArray) -> list[np.ndarray[Any, Any]]:
    """The parts between offsets."""
    return np.split(array, start[1:-1]) if len(start) > 1 else []


def by_field(value: Any, prefix: str) -> StateArrays:
    """The arrays of a dataclass by prefix and field name."""
    return {
        f"{prefix}{field.name}": getattr(value, field.name) for field in dataclasses.fields(value)
    }


def fields_from(kind: type, arrays: StateArrays, prefix: str) -> dict[str, Any]:
    """The arrays of :func:`by_field` by field name, to make the dataclass ``kind`` of."""
    return {field.name: arrays[f"{prefix}{field.name}"] for field in dataclasses.fields(kind)}


def from_upper(upper: np.ndarray[Any, Any], size: int) -> np.ndarray[Any, Any]:
    """Symmetric matrices (n, size, size) of their upper triangles (n, m), row by row."""
    rows, columns = np.triu_indices(size)
    out = np.empty((len(upper), size, size), upper.dtype)
    out[:, rows, columns] = out[:, columns, rows] = upper
    return out


# --------------------------------------------------------------------------------------------
# Values from a file: a file whose shapes fit may still hold what no run wrote

_ROUNDED = 1e-9
"""Of a covariance's trace: what rounding may take from its smallest eigenvalue."""


def require_finite(
    file: ArrayFile, arrays: Mapping[str, Any], names: Sequence[str], where: str
) -> None:
    """Raises the file's error for the first array that holds NaN or infinity."""
    for name in names:
        if not np.isfinite(arrays[name]).all():
            raise _refusal(file, where, f"array {name} is not finite")


def require_covariances(
    file: ArrayFile, name: str, covariances: FloatArray, where: str, *, definite: bool = True
) -> None:
    """Raises the file's error unless matrices (n, k, k) are finite, symmetric and positive.

    ``definite`` False: some direction may be without noise, as of a motion in the plane.
    """
    if not np.isfinite(covariances).all():
        raise _refusal(file, where, f"array {name} is not finite")
    if not len(covariances):
        return
    size = np.abs(covariances).max(axis=(1, 2))
    skew = np.abs(covariances - np.swapaxes(covariances, 1, 2)).max(axis=(1, 2))
    least = np.linalg.eigvalsh(covariances)[:, 0]
    wrong = (skew > _ROUNDED * size) | (least < -_ROUNDED * size)
    if definite:
        wrong |= least <= 0.0
    if wrong.any():
        row = int(np.argmax(wrong))
        raise _refusal(file, where, f"array {name}, row {row}, is no covariance")


def require_motions(file: ArrayFile, name: str, motions: FloatArray, where: str) -> None:
    """Raises the file's error unless all of (n, 4, 4) are rigid motions."""
    wrong = [not is_rigid(motion) for motion in motions]
    if any(wrong):
        raise _refusal(file, where, f"array {name}, row {wrong.index(True)}, is no rigid motion")


def require_single(file: ArrayFile, name: str, ids: IntArray, start: IntArray, where: str) -> None:
    """Raises the file's error where one part between offsets holds an identity twice."""
    part = np.repeat(np.arange(len(start) - 1), np.diff(start))
    order = np.lexsort((ids, part))
    twice = (np.diff(ids[order]) == 0) & (np.diff(part[order]) == 0)
    if twice.any():
        at = order[int(np.argmax(twice))]
        found = f"array {name} holds {ids[at]} twice in part {part[at]}"
        raise _refusal(file, where, found)


def _refusal(file: ArrayFile, where: str, what: str) -> Exception:
    return file.error(f"{where}: {what}, so it is damaged or no run wrote it; {file.again}")
