"""The units of a run: finished ones are kept in the run folder, so that a resumed run skips them.

A unit is what need not be done twice: a pair of views, a drive, a trial, an estimator's replay.
Blocks of units are done in processes of their own; each block's results are one file of
``RUN/units``, written whole or not at all. What a run goes on with is always what was read back
from there: so a resumed run goes on with the same values to the bit.
"""

from __future__ import annotations

import dataclasses
import json
import re
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar, get_args, get_origin

import numpy as np

from fgslam.core.array_files import load_arrays, write_arrays
from fgslam.core.arrays import StateArrays
from fgslam.core.errors import MeasurementLogError, OutputError
from fgslam.core.files import clear_output_errors, is_unfinished_file, make_subfolder
from fgslam.runs.crews import Crew
from fgslam.runs.processes import WorkerEnded, Workers, run_apart

Argument = TypeVar("Argument")
Result = TypeVar("Result")
Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with what is under way, how much is done, and of how much."""
Stopped: TypeAlias = Callable[[], bool]
"""Asked every moment; True ends a run early, with all files valid and resumable."""

UNITS_FOLDER = "units"
_UNIT_FILE = re.compile(r"\w+_\d{6,}\.npz")


@dataclass(frozen=True, slots=True)
class Stage(Generic[Argument, Result]):
    """Units of one sort.

    Attributes:
        name: unique in the run; of the files.
        label: of their progress.
        count: units, numbered from 0.
        work: of a module's top level; the results of a block's units, in their order.
        argument: what a process is given for a block of units.
        kind: type of one unit's result.
        blocks: divides the units that are missing into blocks.
        small: a process does several blocks, one after the other: starting one takes as long as
            some units. Not where a process's own memory is measured.
    """

    name: str
    label: str
    count: int
    work: Callable[[Argument], Sequence[Result]]
    argument: Callable[[tuple[int, ...]], Argument]
    kind: Any
    blocks: Callable[[Sequence[int]], Sequence[Sequence[int]]]
    small: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Done(Generic[Result]):
    """What became of a stage.

    Attributes:
        results: by number of the unit, ascending; some are missing where the run was stopped.
        ended: blocks whose process ended without a result, and why.
    """

    results: dict[int, Result]
    ended: list[tuple[tuple[int, ...], str]] = field(default_factory=list)

    def all(self, ended: Callable[[int, str], Result]) -> list[Result]:
        """Results of all units; ``ended`` makes those of a block that gave none, and why."""
        lost = {k: ended(k, why) for block, why in self.ended for k in block}
        found = self.results | lost
        return [found[k] for k in sorted(found)]


@dataclass(frozen=True, slots=True)
class _Each(Generic[Argument, Result]):
    """Calls a function on each argument of a block; handed over to the process that does so."""

    function: Callable[[Argument], Result]

    def __call__(self, arguments: Sequence[Argument]) -> list[Result]:
        return [self.function(argument) for argument in arguments]


def each_apart(
    names: tuple[str, str],
    function: Callable[[Argument], Result],
    arguments: Sequence[Argument],
    kind: Any,
    block: int = 1,
) -> Stage[list[Argument], Result]:
    """A stage with a unit for each argument.

    Args:
        names: of the stage, and of its progress.
        function: of a module's top level; makes the result of one unit.
        arguments: one a unit.
        kind: type of one unit's result.
        block: units that share a process: starting one takes as long as some units.
    """

    def those(units: tuple[int, ...]) -> list[Argument]:
        return [arguments[k] for k in units]

    name, label = names
    return Stage(name, label, len(arguments), _Each(function), those, kind, in_blocks(block))


class UnitStore:
    """Finished units in a run folder; without a folder nothing is kept."""

    def __init__(self, run: Path | None) -> None:
        self._run = run

    def load(self, stage: str, kind: Any) -> dict[int, Any]:
        """Results of a stage's finished units, by number. Raises OutputError."""
        found: dict[int, Any] = {}
        if self._run is not None:
            pattern = re.compile(rf"{re.escape(stage)}_\d+\.npz")
            for path in sorted((self._run / UNITS_FOLDER).glob(f"{stage}_*.npz")):
                if pattern.fullmatch(path.name):
                    found |= load_value(path, dict[int, kind])
        return found

    def add(self, stage: str, results: Mapping[int, Result], kind: Any) -> dict[int, Result]:
        """Keeps a block's results; returns them as they will be read back. Raises OutputError."""
        if self._run is None or not results:
            return dict(results)
        path = make_subfolder(self._run, UNITS_FOLDER) / f"{stage}_{min(results):06d}.npz"
        save_value(path, dict(results))
        found: dict[int, Result] = load_value(path, dict[int, kind])
        return found

    def remove(self) -> None:
        """Drops all units once the run has finished; files of others and their folder stay."""
        folder = None if self._run is None else self._run / UNITS_FOLDER
        if folder is not None and folder.is_dir():
            with clear_output_errors(folder):
                for path in filter(_is_own, folder.iterdir()):
                    path.unlink()
                if not any(folder.iterdir()):
                    folder.rmdir()


def holds_units(run: Path) -> bool:
    """Whether a run has left units, or was killed just before it removed their empty folder."""
    folder = run / UNITS_FOLDER
    inside = list(folder.iterdir()) if folder.is_dir() else None
    return inside is not None and (not inside or any(map(_is_own, inside)))


def _is_own(path: Path) -> bool:
    return path.is_file() and bool(_UNIT_FILE.fullmatch(path.name) or is_unfinished_file(path))


def perform(
    stage: Stage[Argument, Result],
    store: UnitStore,
    jobs: int,
    progress: Progress,
    stopped: Stopped,
    single_threaded: bool = True,
    workers: Workers | None = None,
    crew: Crew | None = None,
) -> Done[Result]:
    """Does what is missing of a stage, in processes.

    Args:
        stage: which units.
        store: where finished ones are.
        jobs: processes at a time.
        progress: called after each block that is done.
        stopped: True ends it; what was done until then is kept.
        single_threaded: linear algebra on one thread a process.
        workers: processes for the blocks of small units; None: each block has one of its own.
        crew: does the blocks in place of processes of this machine; None: these do.

    Raises:
        FgslamError: what a unit raised, or a unit's file cannot be written or read.
    """
    found: dict[int, Result] = store.load(stage.name, stage.kind)
    missing = [k for k in range(stage.count) if k not in found]
    blocks = [tuple(block) for block in stage.blocks(missing)]
    ended: list[tuple[tuple[int, ...], str]] = []
    progress(stage.label, len(found), stage.count)
    arguments = [stage.argument(block) for block in blocks]
    kept = workers if stage.small else None
    if crew is not None:
        pieces = crew.do(stage.work, arguments, stopped)
    else:
        pieces = run_apart(stage.work, arguments, jobs, stopped, single_threaded, kept)
    for index, result in pieces:
        block = blocks[index]
        if isinstance(result, WorkerEnded):
            ended.append((block, result.why))
        else:
            found |= store.add(stage.name, dict(zip(block, result, strict=True)), stage.kind)
        lost = sum(len(block) for block, _ in ended)
        progress(stage.label, len(found) + lost, stage.count)
    return Done({k: found[k] for k in sorted(found)}, sorted(ended))


def in_blocks(size: int) -> Callable[[Sequence[int]], list[Sequence[int]]]:
    """Neighbours in blocks of at most so many: starting a process takes as long as some units."""

    def divided(units: Sequence[int]) -> list[Sequence[int]]:
        return [units[k : k + size] for k in range(0, len(units), size)]

    return divided


def interleaved(blocks: int) -> Callable[[Sequence[int]], list[Sequence[int]]]:
    """At most so many blocks; neighbours in different ones, as their work is alike."""

    def divided(units: Sequence[int]) -> list[Sequence[int]]:
        return [units[k::blocks] for k in range(blocks) if units[k::blocks]]

    return divided


# --------------------------------------------------------------------------------------------
# Values of dataclasses as plain arrays and back, exactly
#
# No pickle: the type that is read back is the one that the reader asks for, and of a union only its
# own members. Numbers, text and the structure stand in one JSON array, arrays beside it.

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


def _pack(value: Any, arrays: list[np.ndarray]) -> Any:
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


def _unpack(tree: Any, kind: Any, arrays: StateArrays) -> Any:
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
