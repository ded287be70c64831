"""The units of a run: finished ones are kept in the run folder, so that a resumed run skips them.

A unit is what need not be done twice: a pair of views, a drive, a trial, an estimator's replay.
Blocks of units are done by an executor; each block's results are one file of
``RUN/units``, written whole or not at all. What a run goes on with is always what was read back
from there: so a resumed run goes on with the same values to the bit.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, TypeAlias, TypeVar

from fgslam.core.errors import MeasurementLogError, OutputError
from fgslam.core.files import clear_output_errors, is_unfinished_file, make_subfolder
from fgslam.core.store import UNFIT, load_arrays, pack, unpack, write_arrays

Result = TypeVar("Result")
Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with what is under way, how much is done, and of how much."""
Stopped: TypeAlias = Callable[[], bool]
"""Asked every moment; True ends a run early, with all files valid and resumable."""

UNITS_FOLDER = "units"
_UNIT_FILE = re.compile(r"\w+_\d{6,}\.npz")


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
                    found |= _load(path, kind)
        return found

    def add(self, stage: str, results: Mapping[int, Result], kind: Any) -> dict[int, Result]:
        """Keeps a block's results; returns them as they will be read back. Raises OutputError."""
        if self._run is None or not results:
            return dict(results)
        path = make_subfolder(self._run, UNITS_FOLDER) / f"{stage}_{min(results):06d}.npz"
        write_arrays(path, pack(dict(results)))
        return _load(path, kind)

    def remove(self) -> None:
        """Drops all units once the run has finished; files of others and their folder stay."""
        folder = None if self._run is None else self._run / UNITS_FOLDER
        if folder is not None and folder.is_dir():
            with clear_output_errors(folder):
                for path in filter(_is_own, folder.iterdir()):
                    path.unlink()
                if not any(folder.iterdir()):
                    folder.rmdir()


def _load(path: Path, kind: Any) -> dict[int, Any]:
    """Results of the units of a file. Raises OutputError where it is none."""
    try:
        found: dict[int, Any] = unpack(load_arrays(path), dict[int, kind])
    except (MeasurementLogError, *UNFIT) as error:
        raise OutputError(
            f"{path}: not a unit that this fgslam wrote ({error}); start again with --overwrite"
        ) from None
    return found


def holds_units(run: Path) -> bool:
    """Whether a run has left units, or was killed just before it removed their empty folder."""
    folder = run / UNITS_FOLDER
    inside = list(folder.iterdir()) if folder.is_dir() else None
    return inside is not None and (not inside or any(map(_is_own, inside)))


def _is_own(path: Path) -> bool:
    return path.is_file() and bool(_UNIT_FILE.fullmatch(path.name) or is_unfinished_file(path))
