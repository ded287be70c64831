"""The units of a run: finished ones are kept in the run folder, so that a resumed run skips them.

A unit is what need not be done twice: a pair of views, a drive, a trial, an estimator's replay.
Blocks of units are done in processes of their own; each block's results are one file of
``RUN/units``, written whole or not at all. What a run goes on with is always what was read back
from there: so a resumed run goes on with the same values to the bit.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

from fgslam.core.files import clear_output_errors, make_subfolder
from fgslam.runs.processes import WorkerEnded, run_apart
from fgslam.runs.stored import load_value, save_value

Argument = TypeVar("Argument")
Result = TypeVar("Result")
Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with what is under way, how much is done, and of how much."""
Stopped: TypeAlias = Callable[[], bool]
"""Asked every moment; True ends a run early, with all files valid and resumable."""

UNITS_FOLDER = "units"


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
    """

    name: str
    label: str
    count: int
    work: Callable[[Argument], Sequence[Result]]
    argument: Callable[[tuple[int, ...]], Argument]
    kind: Any
    blocks: Callable[[Sequence[int]], Sequence[Sequence[int]]]


@dataclass(frozen=True, slots=True, eq=False)
class Done(Generic[Result]):
    """What became of a stage.

    Attributes:
        results: by number of the unit, ascending; some are missing where the run was stopped.
        ended: blocks whose process ended without a result, and why.
    """

    results: dict[int, Result]
    ended: list[tuple[tuple[int, ...], str]] = field(default_factory=list)


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
        """Drops everything once the run has finished."""
        folder = None if self._run is None else self._run / UNITS_FOLDER
        if folder is not None and folder.is_dir():
            with clear_output_errors(folder):
                for path in folder.iterdir():
                    path.unlink()
                folder.rmdir()


def perform(
    stage: Stage[Argument, Result],
    store: UnitStore,
    jobs: int,
    progress: Progress,
    stopped: Stopped,
    single_threaded: bool = True,
) -> Done[Result]:
    """Does what is missing of a stage, in processes.

    Args:
        stage: which units.
        store: where finished ones are.
        jobs: processes at a time.
        progress: called after each block that is done.
        stopped: True ends it; what was done until then is kept.
        single_threaded: linear algebra on one thread a process.

    Raises:
        FgslamError: what a unit raised, or a unit's file cannot be written or read.
    """
    found: dict[int, Result] = store.load(stage.name, stage.kind)
    missing = [k for k in range(stage.count) if k not in found]
    blocks = [tuple(block) for block in stage.blocks(missing)]
    ended: list[tuple[tuple[int, ...], str]] = []
    progress(stage.label, len(found), stage.count)
    arguments = [stage.argument(block) for block in blocks]
    for index, result in run_apart(stage.work, arguments, jobs, stopped, single_threaded):
        block = blocks[index]
        if isinstance(result, WorkerEnded):
            ended.append((block, result.why))
        else:
            found |= store.add(stage.name, dict(zip(block, result, strict=True)), stage.kind)
        lost = sum(len(block) for block, _ in ended)
        progress(stage.label, len(found) + lost, stage.count)
    return Done({k: found[k] for k in sorted(found)}, sorted(ended))


def one_by_one(units: Sequence[int]) -> list[Sequence[int]]:
    """Each unit in a process of its own."""
    return in_blocks(1)(units)


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
