"""What a sweep is of, and the folder of its results."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from fgslam.core.errors import ConfigError, OutputError
from fgslam.core.files import clear_output_errors, is_unfinished_file, require_writable, write_text
from fgslam.runs.folder import OWNER_NAME, REPORT_FILE, ExistingFolder, Owner, versions
from fgslam.runs.sweeps.grid import Grid
from fgslam.runs.sweeps.table import TABLE_FILE, TIMES_FILE

MARKER = "sweep.yaml"
JOURNAL_FILE = "cases.jsonl"
_FILES = (JOURNAL_FILE, TABLE_FILE, TIMES_FILE, REPORT_FILE, MARKER)  # the marker goes last
_VALUES_NAMED = 20


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """What is swept.

    Attributes:
        grid: experiments and axes.
        names: estimators; None: those of each configuration.
    """

    grid: Grid
    names: tuple[str, ...] | None = None

    @property
    def default_folder(self) -> Path:
        """Where the results go unless another folder is named."""
        return Path("runs") / f"{self.grid.sources[0].name}_sweep"


def begin_sweep(
    folder: Path, existing: ExistingFolder, plan: Plan, owner: Owner | None = None
) -> None:
    """Makes the folder the owner's, or finds what it holds; without an owner only looks.

    Raises:
        OutputError: what it holds is in the way, or another process writes there.
    """
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"cannot write {folder}: it is not a folder; choose another name")
    held = (folder / MARKER).is_file()
    if existing == "resume" and not held:
        raise OutputError(
            f"cannot resume {folder}: it holds no sweep (no {MARKER}); name the folder of one, or "
            "start without --resume"
        )
    if existing == "resume":
        _require_same_experiments(folder, plan)
    elif held and existing == "refuse":
        raise OutputError(
            f"{folder} holds a sweep already; choose another --out, or add --overwrite or --resume"
        )
    elif not held and folder.exists() and any(map(_is_whole, folder.iterdir())):
        raise OutputError(
            f"{folder} exists and holds something else than a sweep; choose another folder"
        )
    if owner is None:
        return
    with clear_output_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
        owner.take()
        require_writable(folder)
        for name in _FILES if existing == "overwrite" else ():
            (folder / name).unlink(missing_ok=True)
    write_text(folder / MARKER, yaml.safe_dump(_description(plan), sort_keys=False))


def _is_whole(path: Path) -> bool:
    return path.name != OWNER_NAME and not is_unfinished_file(path)


def _description(plan: Plan) -> dict[str, Any]:
    """What sweep.yaml says."""
    return {
        "experiments": {source.name: dict(source.values) for source in plan.grid.sources},
        "axes": {axis.key: _short(axis.values) for axis in plan.grid.axes},
        "estimators": None if plan.names is None else list(plan.names),
        "versions": versions(),
    }


def _short(values: Sequence[str]) -> str:
    """As typed; of many values the first and the last."""
    if len(values) <= _VALUES_NAMED:
        return ",".join(values)
    return f"{values[0]}, ..., {values[-1]} ({len(values)})"


def _require_same_experiments(folder: Path, plan: Plan) -> None:
    path = folder / MARKER
    try:
        held = yaml.safe_load(path.read_text(encoding="utf-8"))
        names = sorted(held["experiments"])
    except (OSError, ValueError, TypeError, KeyError, yaml.YAMLError):
        raise OutputError(f"{path}: cannot be read; start again with --overwrite") from None
    own = sorted(source.name for source in plan.grid.sources)
    if not set(names) <= set(own):
        raise ConfigError(
            f"{path}: is a sweep of {', '.join(names)}, not of {', '.join(own)}; resume with the "
            "same experiments, or choose another --out"
        )
