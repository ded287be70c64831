"""Values of dataclasses as plain arrays and back, exactly: what a run keeps of its finished units.

No pickle: the type that is read back is the one that the reader asks for, and of a union only its
own members. Numbers, text and the structure stand in one JSON array, arrays beside it.
"""

from __future__ import annotations

import dataclasses
import json
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, get_args, get_origin

import numpy as np

from fgslam.core.array_files import load_arrays, write_arrays
from fgslam.core.arrays import StateArrays
from fgslam.core.errors import MeasurementLogError, OutputError

_TREE = "tree"
_CLASS, _ARRAY, _BYTES, _MAP = "class", "array", "bytes", "map"


def save_value(path: Path, value: Any) -> None:
    """Writes a value atomically. Raises OutputError where it cannot be written."""
    arrays: list[np.ndarray] = []
    tree = _pack(value, arrays)
    stored: StateArrays = {f"a{k}": array for k, array in enumerate(arrays)}
    stored[_TREE] = np.array(json.dumps(tree))
    write_arrays(path, stored)


def load_value(path: Path, kind: Any) -> Any:
    """The value of a file, as the type that was stored: a dataclass, a container or a union.

    Raises:
        OutputError: the file is not such a value.
    """
    try:
        arrays = load_arrays(path)
        return _unpack(json.loads(str(arrays[_TREE])), kind, arrays)
    except (MeasurementLogError, KeyError, ValueError, TypeError, AttributeError) as error:
        raise OutputError(
            f"{path}: not a unit that this fgslam wrote ({error}); start again with --overwrite"
        ) from None


# --------------------------------------------------------------------------------------------


def _pack(value: Any, arrays: list[np.ndarray]) -> Any:  # noqa: PLR0911 - one a sort of value
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Enum):
        return value.value
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return {_ARRAY: len(arrays) - 1}
    if isinstance(value, bytes):
        arrays.append(np.frombuffer(value, np.uint8))
        return {_BYTES: len(arrays) - 1}
    if dataclasses.is_dataclass(value) or hasattr(value, "_fields"):
        parts = {name: _pack(getattr(value, name), arrays) for name in _names(type(value))}
        return {_CLASS: type(value).__name__, **parts}
    if isinstance(value, Mapping):
        return {_MAP: [[_pack(k, arrays), _pack(v, arrays)] for k, v in value.items()]}
    if isinstance(value, Sequence):
        return [_pack(item, arrays) for item in value]
    raise TypeError(f"{type(value).__name__} cannot be stored")


def _names(kind: type) -> list[str]:
    if dataclasses.is_dataclass(kind):
        return [field.name for field in dataclasses.fields(kind)]
    names: tuple[str, ...] = getattr(kind, "_fields", ())
    return list(names)


def _unpack(tree: Any, kind: Any, arrays: StateArrays) -> Any:  # noqa: PLR0911 - one a sort
    if isinstance(tree, dict) and _ARRAY in tree:
        return arrays[f"a{tree[_ARRAY]}"]
    if isinstance(tree, dict) and _BYTES in tree:
        return arrays[f"a{tree[_BYTES]}"].tobytes()
    members = _members(kind)
    if tree is None:
        return None
    if isinstance(tree, dict) and _CLASS in tree:
        return _made(tree, members, arrays)
    if isinstance(tree, dict):
        key, value = (*get_args(_first(members, (dict, Mapping))), Any, Any)[:2]
        return {_unpack(k, key, arrays): _unpack(v, value, arrays) for k, v in tree[_MAP]}
    if isinstance(tree, list):
        return _container(tree, _first(members, (list, tuple, Sequence)), arrays)
    enums = [member for member in members if isinstance(member, type) and issubclass(member, Enum)]
    if enums:
        return enums[0](tree)
    return (
        float(tree) if float in members and isinstance(tree, int) and int not in members else tree
    )


def _members(kind: Any) -> tuple[Any, ...]:
    """The types that a hint stands for."""
    if get_origin(kind) is typing.Annotated:
        return _members(get_args(kind)[0])
    if get_origin(kind) in (typing.Union, types.UnionType):
        return tuple(part for member in get_args(kind) for part in _members(member))
    return (kind,)


def _first(members: tuple[Any, ...], origins: tuple[Any, ...]) -> Any:
    from collections import abc

    known = (*origins, abc.Sequence, abc.Mapping)
    return next((m for m in members if get_origin(m) in known or m in known), Any)


def _made(tree: dict[str, Any], members: tuple[Any, ...], arrays: StateArrays) -> Any:
    """A dataclass or named tuple of one of the types that are asked for."""
    kind: Callable[..., Any] | None = next(
        (m for m in members if getattr(m, "__name__", "") == tree[_CLASS]), None
    )
    if kind is None:
        raise ValueError(f"holds a {tree[_CLASS]}")
    hints = typing.get_type_hints(kind)
    parts = {name: node for name, node in tree.items() if name != _CLASS}
    return kind(**{name: _unpack(node, hints[name], arrays) for name, node in parts.items()})


def _container(tree: list[Any], kind: Any, arrays: StateArrays) -> Any:
    inner = get_args(kind)
    if get_origin(kind) is tuple and not (len(inner) == 2 and inner[1] is Ellipsis):
        return tuple(_unpack(t, k, arrays) for t, k in zip(tree, inner, strict=True))
    item = inner[0] if inner else Any
    found = [_unpack(node, item, arrays) for node in tree]
    return tuple(found) if get_origin(kind) is tuple or kind is tuple else found
