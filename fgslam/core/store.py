"""One codec from dataclasses to ``.npz`` files and back, and the state of a run's parts on it.

A value becomes plain arrays and one JSON text with the structure and all single numbers; no pickle.
Values are packed by column: of 10,000 poses the matrices are one array, of a list of dataclasses
each field is one column. What is read back is what the reader's type hints name, of a union only
its own members. The same value gives the same bytes.

A :class:`FileKind` writes a value with a checksum, and refuses files that are damaged or foreign.

A class that changes during a run marks what it keeps: ``_pose: Kept[FloatArray]``. That is its
state; what is made of it (caches) or given to it (settings, cameras) is not. :func:`state_of` takes
a snapshot, :func:`restore` puts it back into a part made with the same settings.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import sys
import tokenize
import types
import typing
import zipfile
import zlib
from collections import abc, deque
from collections.abc import Callable, Iterable, Sequence
from enum import Enum
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Generic, Protocol, TypeAlias, TypeVar, get_args, get_origin

import numpy as np

from fgslam.core.arrays import FloatArray, StateArrays
from fgslam.core.errors import FgslamError, MeasurementLogError
from fgslam.core.files import as_path, replacing, require_file

T = TypeVar("T")
Kept: TypeAlias = Annotated[T, "kept"]
"""Marks an attribute as a part of its class's state."""

TREE = "tree"
"""Name of the array with the structure."""

UNFIT = (KeyError, ValueError, TypeError, IndexError, AttributeError)
"""What :func:`unpack` and :func:`restore` raise for arrays of another value."""

_SINGLE = 16
"""Numbers of a list that stand in the structure; more of them are an array."""


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
    tree = packing.column([value], "")
    return packing.arrays | {TREE: np.array(json.dumps(tree))}


def unpack(arrays: StateArrays, kind: Any) -> Any:
    """The value of :func:`pack`, as the type ``kind``: a dataclass, a container or a union.

    Raises:
        Exception: one of ``UNFIT``; they are not those of such a value.
    """
    return _Unpacking(arrays).column(json.loads(str(arrays[TREE])), kind)[0]


class _Packing:
    """The structure of values; their arrays by their place in it."""

    def __init__(self) -> None:
        self.arrays: StateArrays = {}

    def column(self, values: Iterable[Any], at: str) -> Any:
        """Some values as JSON; their arrays are stored under names that begin with ``at``."""
        values = [_plain(value) for value in values]
        kinds = {type(value) for value in values}
        scalar = kinds <= {type(None), bool, int, float, str}
        if type(None) in kinds and len(kinds) > 1 and (len(values) > _SINGLE or not scalar):
            known = self.column([value is not None for value in values], _below(at, "known"))
            return {"known": known, "some": self.column([v for v in values if v is not None], at)}
        if len(values) > _SINGLE and len(kinds) == 1 and kinds <= {bool, int, float}:
            numbers = np.array(values)
            if numbers.dtype.kind in "bif":  # integers beyond 64 bits are none
                return {"numbers": self.stored(numbers, at)}
        if scalar:
            return values
        found = self.alike(values, kinds.pop(), at) if len(kinds) == 1 else None
        if found is None:
            found = {"each": [self.column([v], _below(at, str(k))) for k, v in enumerate(values)]}
        return found

    def alike(self, values: list[Any], kind: Any, at: str) -> Any:
        """Values of one type; None for arrays that do not fit together."""
        if kind is np.ndarray:
            return self.stacked(values, at)
        if kind is bytes:
            return {"bytes": self.column([np.frombuffer(v, np.uint8) for v in values], at)}
        if kind in (list, tuple, deque) or issubclass(kind, abc.Mapping):
            return self.containers(values, kind, at)
        if hasattr(kind, "packed"):  # it has room or caches that are no state
            return {"compact": self.column([value.packed() for value in values], at)}
        if _has_members(kind, Resumable):
            states = [value.state().items() for value in values]
            return {
                "own": [
                    {n: self.stored(a.copy(), _below(at or "own", n)) for n, a in state}
                    for state in states
                ]
            }
        kept = tuple(kept_hints(kind))
        names = kept or _field_names(kind)
        if not names:
            raise TypeError(f"{kind.__name__} cannot be stored")
        given = (n for n in names if n not in _sparse(kind) or any(getattr(v, n) for v in values))
        columns = {n: self.column([getattr(v, n) for v in values], _below(at, n)) for n in given}
        return {"part": columns} if kept else {"class": kind.__name__, "columns": columns}

    def containers(self, values: list[Any], kind: Any, at: str) -> Any:
        """Tuples, lists, queues or mappings, by their items."""
        if issubclass(kind, abc.Mapping):
            if len(values) == 1 and all(isinstance(key, str) for key in values[0]):
                named = values[0].items()
                return {"named": {n: self.column([one], _below(at, n)) for n, one in named}}
            keys = self.column([key for value in values for key in value], _below(at, "keys"))
            items = self.column([one for value in values for one in value.values()], at)
            return {"keys": keys, "values": items, "sizes": self.sizes(values, at)}
        if kind is tuple:
            lengths = {len(value) for value in values}
            of = {type(one) for value in values for one in value}
            records = len(of) == 1 and bool(_field_names(min(of, key=str)))
            if len(lengths) == 1 and 0 < max(lengths) <= _SINGLE and not records:
                slots = enumerate(zip(*values, strict=True))  # they may be of all types
                return {"tuple": [self.column(one, _below(at, str(k))) for k, one in slots]}
        items = self.column([one for value in values for one in value], at)
        most = {"most": [value.maxlen for value in values]} if kind is deque else {}
        return {"items": items, "sizes": self.sizes(values, at)} | most

    def stacked(self, values: list[Any], at: str) -> Any:
        """Arrays as one; None where their rows differ."""
        if len(values) == 1:
            return {"array": self.stored(values[0].copy(), at)}
        if len({(v.dtype, v.shape) for v in values}) == 1:
            return {"stack": self.stored(np.array(values), at)}
        if min(v.ndim for v in values) and len({(v.dtype, v.shape[1:]) for v in values}) == 1:
            rows = self.stored(np.concatenate(values), at)
            return {"joined": rows, "sizes": self.sizes(values, at)}
        return None

    def sizes(self, values: list[Any], at: str) -> Any:
        """How many items each of the values has."""
        return self.column([len(value) for value in values], _below(at, "sizes"))

    def stored(self, array: np.ndarray[Any, Any], at: str) -> Any:
        """The array's name; with their size, of matrices that are kept as their upper triangles."""
        if array.dtype.hasobject:
            raise TypeError("an array of objects cannot be stored")
        name = at or "value"
        while name in self.arrays or name == TREE:
            name += "+"
        self.arrays[name] = array
        if array.ndim != 3 or not 1 < array.shape[1] == array.shape[2] or not len(array):
            return name
        if array.tobytes() != array.swapaxes(1, 2).tobytes():  # signs of zeros included
            return name
        rows, columns = np.triu_indices(array.shape[1])
        self.arrays[name] = array[:, rows, columns]
        return [name, array.shape[1]]


class _Unpacking:
    """Values of a structure, by the types that are asked for."""

    def __init__(self, arrays: StateArrays) -> None:
        self.arrays = arrays

    def column(self, node: Any, kind: Any, now: Sequence[Any] = ()) -> list[Any]:
        """The values; ``now``: the parts that are there, whose given things stay."""
        members = _members(kind)
        out: list[Any]
        before: Sequence[Any]
        match node:
            case {"known": known, "some": some}:
                there = self.column(known, bool)
                before = [was for was, so in zip(now, there, strict=False) if so]
                found = iter(self.column(some, kind, before))
                out = [next(found) if so else None for so in there]
            case {"each": nodes}:
                before = now if len(now) == len(nodes) else [None] * len(nodes)
                pairs = zip(nodes, before, strict=True)
                out = [self.column(one, kind, [was])[0] for one, was in pairs]
            case {"part": _} | {"own": _} | {"class": _}:
                out = self.composed(node, members, now)
            case list():
                if stateful := [type(was).__name__ for was in now if has_state(was)]:
                    raise ValueError(f"no state of {stateful[0]}")
                out = [_scalar(one, members) for one in node]
            case {"numbers": name}:
                out = [_scalar(one, members) for one in self.array(name, ()).tolist()]
            case {"array": name}:
                out = [self.array(name, members)]
            case {"stack": name}:
                out = [np.asarray(one) for one in self.array(name, members)]
            case {"joined": name, "sizes": sizes}:
                ends = np.cumsum(self.column(sizes, int))
                out = np.split(self.array(name, members), ends[:-1])
            case {"bytes": inner}:
                out = [one.tobytes() for one in self.column(inner, Any)]
            case {"compact": inner}:
                made: Any = next(m for m in members if hasattr(m, "unpacked"))
                out = [made.unpacked(one) for one in self.column(inner, Any)]
            case _:
                out = self.containers(node, members, now)
        return out

    def containers(self, node: Any, members: tuple[Any, ...], now: Sequence[Any]) -> list[Any]:
        """Tuples, lists, queues and mappings."""
        container = _first(members, abc.Mapping if "items" not in node else abc.Sequence)
        of = get_args(container)
        if "tuple" in node:
            container = _first(members, tuple)
            of, columns = get_args(container), node["tuple"]
            fixed = len(of) == len(columns) and of[-1] is not Ellipsis
            kinds = of if fixed else [(*of, Any)[0]] * len(columns)
            before = [[was[k] for was in now if isinstance(was, tuple)] for k in range(len(kinds))]
            slots = [self.column(*one) for one in zip(columns, kinds, before, strict=True)]
            return list(zip(*slots, strict=True))
        if "named" in node:
            item = (*of, Any, Any)[1]
            return [{n: self.column(one, item)[0] for n, one in node["named"].items()}]
        ends = [0, *np.cumsum(self.column(node["sizes"], int)).tolist()]
        if "keys" in node:
            keys = self.column(node["keys"], (*of, Any, Any)[0])
            items = self.column(node["values"], (*of, Any, Any)[1])
            both = list(zip(keys, items, strict=True))
            return [dict(both[a:b]) for a, b in pairwise(ends)]
        before = [one for was in now if isinstance(was, list) for one in was]
        items = self.column(node["items"], (*of, Any)[0], before if len(before) == ends[-1] else ())
        if "most" in node:
            most = zip(pairwise(ends), node["most"], strict=True)
            return [deque(items[a:b], room) for (a, b), room in most]
        made = tuple if (get_origin(container) or container) is tuple else list
        return [made(items[a:b]) for a, b in pairwise(ends)]

    def composed(self, node: Any, members: tuple[Any, ...], now: Sequence[Any]) -> list[Any]:
        """Dataclasses and named tuples, made; parts with their state put back."""
        if "class" in node:
            made = next((m for m in members if getattr(m, "__name__", "") == node["class"]), None)
            if made is None:
                raise ValueError(f"holds a {node['class']}")
            hints = typing.get_type_hints(made)
            columns = {n: self.column(one, hints[n]) for n, one in node["columns"].items()}
            rows = zip(*columns.values(), strict=True)
            return [made(**dict(zip(columns, row, strict=True))) for row in rows]
        if not now:
            raise ValueError("holds the state of a part")
        if "own" in node:
            for part, stored in zip(now, node["own"], strict=True):
                part.restore({n: self.array(name, ()) for n, name in stored.items()})
            return list(now)
        kind: Any = type(now[0])
        hints = kept_hints(kind)
        if set(hints) != set(node["part"]):
            raise ValueError(f"no state of {kind.__name__}")
        before = {n: [getattr(was, n) for was in now] for n in hints}
        columns = {n: self.column(node["part"][n], hints[n], before[n]) for n in hints}
        rows = zip(*columns.values(), strict=True)
        states = [dict(zip(columns, row, strict=True)) for row in rows]
        if _is_frozen(kind):
            return [dataclasses.replace(was, **s) for was, s in zip(now, states, strict=True)]
        for part, state in zip(now, states, strict=True):
            for name, value in state.items():
                setattr(part, name, value)
            if hasattr(part, "remake"):
                part.remake()
        return list(now)

    def array(self, stored: Any, members: Any) -> np.ndarray[Any, Any]:
        """A copy of an array, whole again; of the type that is asked for."""
        name, size = stored if isinstance(stored, list) else (stored, 0)
        array = from_upper(self.arrays[name], size) if size else self.arrays[name].copy()
        kinds = {kind for member in members for kind in _array_kinds(member)}
        if kinds and array.dtype.kind not in kinds:
            raise ValueError(f"{name} is an array of another type")
        return array


@cache
def _members(kind: Any) -> tuple[Any, ...]:
    """The types that a hint stands for."""
    if get_origin(kind) is Annotated:
        return _members(get_args(kind)[0])
    if get_origin(kind) in (typing.Union, types.UnionType):
        return tuple(part for member in get_args(kind) for part in _members(member))
    return (kind,)


@cache
def _array_kinds(kind: Any) -> tuple[str, ...]:
    """Of ``numpy.dtype.kind``: what arrays of a hint hold; empty where they may hold anything."""
    of = get_args(get_args(kind)[1])[0] if get_origin(kind) is np.ndarray else Any
    return (np.dtype(of).kind,) if isinstance(of, type) and issubclass(of, np.generic) else ()


def _first(members: tuple[Any, ...], container: type) -> Any:
    """The member that is such a container."""
    for member in members:
        made = get_origin(member) or member
        if isinstance(made, type) and issubclass(made, container) and not issubclass(made, str):
            return member
    return Any


def _scalar(value: Any, members: tuple[Any, ...]) -> Any:
    enums = [member for member in members if isinstance(member, type) and issubclass(member, Enum)]
    if enums and value is not None:
        return enums[0](value)
    real = float in members and int not in members and bool not in members
    return float(value) if real and isinstance(value, int) else value


def _plain(value: Any) -> Any:
    """Numbers of NumPy and members of enumerations as what they are in JSON."""
    if isinstance(value, np.generic):
        return value.item()
    return value.value if isinstance(value, Enum) else value


def _below(at: str, name: str) -> str:
    return f"{at}/{name.strip('_')}" if at else name.strip("_")


def _is_frozen(kind: Any) -> bool:
    return bool(getattr(getattr(kind, "__dataclass_params__", None), "frozen", False))


@cache
def _has_members(kind: Any, protocol: Any) -> bool:
    """Whether values of a type have a protocol's members: much faster than asking each."""
    return issubclass(kind, protocol)


def _field_names(kind: Any) -> tuple[str, ...]:
    """Of a dataclass or a named tuple; empty of any other type."""
    if dataclasses.is_dataclass(kind):
        fields = dataclasses.fields(kind)
        return tuple(f.name for f in fields if f.init and f.metadata.get("stored", True))
    return tuple(getattr(kind, "_fields", ()))


@cache
def _sparse(kind: Any) -> frozenset[str]:
    """Fields that are stored only where one value has something in them."""
    fields = dataclasses.fields(kind) if dataclasses.is_dataclass(kind) else ()
    return frozenset(f.name for f in fields if f.metadata.get("sparse"))


def from_upper(upper: np.ndarray[Any, Any], size: int) -> np.ndarray[Any, Any]:
    """Symmetric matrices (n, size, size) of their upper triangles (n, m), row by row."""
    rows, columns = np.triu_indices(size)
    out = np.empty((len(upper), size, size), upper.dtype)
    out[:, rows, columns] = out[:, columns, rows] = upper
    return out


# --------------------------------------------------------------------------------------------
# State of parts


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
    return bool(kept_hints(kind)) or _has_members(kind, Resumable)


def state_of(part: Any) -> StateArrays:
    """A snapshot of a part, which later changes leave alone."""
    return pack(part)


def restore(part: Any, state: StateArrays) -> None:
    """Continues from :func:`state_of`, in a part made with the same settings.

    Raises:
        Exception: one of ``UNFIT``; the state is another's.
    """
    _Unpacking(state).column(json.loads(str(state[TREE])), type(part), [part])


def snapshot(part: Any) -> Any:
    """What a part keeps, for :func:`put_back` within a frame: a fifth of a millisecond at most.

    Containers are copied, arrays are not: for parts that replace theirs and write into none.
    """
    kind: Any = type(part)
    if kind is list or (kind is tuple and not _field_names(kind)):
        return kind(snapshot(one) for one in part)
    if isinstance(part, dict | deque):
        return part.copy()
    if _has_members(kind, Resumable):
        return part.state()
    names = () if _is_frozen(kind) else kept_hints(kind)
    return {name: snapshot(getattr(part, name)) for name in names} if names else part


def put_back(part: Any, kept: Any) -> None:
    """Makes a part what it was at its :func:`snapshot`."""
    kind: Any = type(part)
    if _has_members(kind, Resumable):
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
_LONG_AGO = (1980, 1, 1, 0, 0, 0)  # the zip format's first moment: equal values give equal bytes


def write_arrays(path: Path, arrays: StateArrays, packed: str = "") -> int:
    """Writes an ``.npz`` whole or not at all; the same arrays give the same bytes.

    Args:
        path: the file.
        arrays: by name.
        packed: kinds (of ``numpy.dtype.kind``) of the arrays that are compressed.

    Returns:
        Size of the file in bytes.

    Raises:
        OutputError: it cannot be written.
    """
    with replacing(path) as partial, partial.open("wb") as file:
        with zipfile.ZipFile(file, "w") as archive:
            for name, array in arrays.items():
                info = zipfile.ZipInfo(f"{name}.npy", _LONG_AGO)
                if array.dtype.kind in packed:
                    info.compress_type = zipfile.ZIP_DEFLATED
                with archive.open(info, "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, np.asarray(array), allow_pickle=False)
        return file.tell()


def load_arrays(path: Path) -> StateArrays:
    """All arrays of a file of a run folder. Raises MeasurementLogError where it cannot be read."""
    return _OF_RUNS.arrays(path)


def require_plain(file: Any) -> None:
    """Raises ValueError for what no open archive of arrays holds: other files, far more than it is.

    ValueError is one of :data:`UNREADABLE`, as is what reading the arrays may raise.
    """
    members = file.zip.infolist()
    names = [one.filename for one in members]
    foreign = [name for name in names if not name.endswith(".npy")]
    if foreign:
        raise ValueError(f"holds {foreign[0]}, which is no array")
    if len(set(names)) < len(names):
        raise ValueError("holds an array twice")
    size, packed = (sum(getattr(m, k) for m in members) for k in ("file_size", "compress_size"))
    if size > _UNPACKED_FREELY + _MOST_PACKED * packed:
        raise ValueError(f"would unpack to {size / 1e6:.0f} MB from {packed / 1e6:.0f}")


@dataclasses.dataclass(frozen=True)
class FileKind(Generic[T]):
    """A kind of file that holds one value, and how a file that is none is refused.

    Attributes:
        kind: the value's type.
        name: what it holds, as in "fgslam measurement log".
        version: of the value's type: it is raised with each change of a field.
        error: what is raised.
        give: what to do where it is another file, or none: "give measurements.npz".
        again: what to do where it is damaged: "run again".
        check: raises ValueError for a value that no run makes.
        packed: kinds of arrays that are compressed (:func:`write_arrays`).
    """

    kind: type[T]
    name: str
    version: int
    error: type[FgslamError]
    give: str
    again: str
    check: Callable[[T], None] = lambda _: None
    packed: str = ""

    def save(self, path: str | Path, value: T) -> int:
        """Writes the value, whole or not at all; returns the size in bytes. Raises OutputError."""
        arrays = pack(value)
        about = {"format": self.name, "version": self.version, "sha256": digest(arrays)}
        header = {"header": np.array(json.dumps(about))}
        return write_arrays(Path(path), header | arrays, self.packed)

    def load(self, path: str | Path) -> T:
        """The value of a file.

        Raises:
            FgslamError: :attr:`error`: it is missing, truncated, damaged, foreign, of another
                version, or holds what no run makes.
        """
        arrays = self.arrays(as_path(path, self.error))
        short = self.name.removeprefix("fgslam ")
        try:
            header = json.loads(str(arrays.pop("header")))
        except (KeyError, json.JSONDecodeError):
            header = None
        if not isinstance(header, dict) or header.get("format") != self.name:
            raise self.error(f"{path}: not an {self.name}; {self.give}")
        other = self.error(f"{path}: {short} made by another version; {self.again}")
        if header.get("version") != self.version:
            raise other
        if TREE not in arrays or header.get("sha256") != digest(arrays):
            raise self.error(
                f"{path}: damaged: its contents do not have the checksum that they were saved "
                f"with; restore the file or {self.again}"
            )
        try:
            value: T = unpack(arrays, self.kind)
        except UNFIT:
            raise other from None
        self.require_sound(value, str(path))
        return value

    def require_sound(self, value: T, where: str) -> None:
        """Raises :attr:`error` for a value that no run makes."""
        try:
            self.check(value)
        except ValueError as error:
            raise self.error(f"{where}: {error}; {self.again}") from None

    def arrays(self, path: Path) -> StateArrays:
        """All arrays of a file; never unpickled. Raises :attr:`error` where it cannot be read."""
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
                return {name: file[name] for name in file.files}
        except UNREADABLE as error:
            cause = " ".join(str(error).split()) or type(error).__name__
            name, mend = self.name.removeprefix("fgslam "), f"it may be truncated, {self.again}"
            if "pickle" in cause:  # NumPy advises to unpickle, which would run what the file holds
                cause, mend = "neither arrays nor an archive of them", self.give
            raise self.error(f"{path}: not a readable {name} ({cause}); {mend}") from None


_OF_RUNS = FileKind(
    dict, "file of arrays", 1, MeasurementLogError, "give the run folder's own", "run again"
)


def digest(arrays: StateArrays) -> str:
    """SHA-256 over all arrays: names, types, shapes and bytes."""
    whole = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        whole.update(f"{name} {array.dtype.str} {arrays[name].shape}".encode())
        whole.update(array.view(np.uint8).data if array.size else b"")
    return whole.hexdigest()


# --------------------------------------------------------------------------------------------
# Values that no run makes, although their types fit

_ROUNDED = 1e-9
"""Of a covariance's trace: what rounding may take from its smallest eigenvalue."""


def require_finite(name: str, values: np.ndarray[Any, Any]) -> None:
    """Raises ValueError where NaN or infinity is among some numbers."""
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: a number is not finite")


def require_ascending(name: str, values: np.ndarray[Any, Any]) -> None:
    """Raises ValueError unless each value is larger than the one before."""
    if not (values[1:] > values[:-1]).all():  # differences of digests may overflow
        raise ValueError(f"{name} is out of order")


def require_covariances(name: str, covariances: FloatArray, *, definite: bool = True) -> None:
    """Raises ValueError unless matrices (n, k, k) are finite, symmetric and positive.

    ``definite`` False: some direction may be without noise, as of a motion in the plane.
    """
    require_finite(name, covariances)
    if not len(covariances):
        return
    size = np.abs(covariances).max(axis=(1, 2))
    skew = np.abs(covariances - np.swapaxes(covariances, 1, 2)).max(axis=(1, 2))
    least = np.linalg.eigvalsh(covariances)[:, 0]
    wrong = (skew > _ROUNDED * size) | (least < -_ROUNDED * size)
    if definite:
        wrong |= least <= 0.0
    if wrong.any():
        raise ValueError(f"{name}: number {int(np.argmax(wrong))} is no covariance")
