"""Stored measurements, and the numbers that pages compute from them.

`python -m benchmarks keep PATH` stores the numbers of a run folder's metrics.json, or of a JSON
file that a benchmark wrote with `--out`, as benchmarks/measured/NAME.json.
"""

from __future__ import annotations

import datetime
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fgslam.core import __version__
from fgslam.core.errors import DatasetError

MEASURED = Path(__file__).parent / "measured"
"""Folder of the stored measurements."""

# Of metrics.json: what differs from one execution to the next, and reasons in words.
_NOT_KEPT = ("_ms", "memory", "update_growth", "problems", "seeds", "notes", "remarks")


@dataclass(frozen=True)
class Stored:
    """A stored measurement: its numbers by name, the version that was measured, and when."""

    version: str
    date: str
    numbers: dict[str, Any]


def keep(path: Path) -> Path:
    """Stores the numbers of a run folder or of a benchmark's JSON file; the file written.

    Raises:
        DatasetError: neither is there, or it is no JSON document.
    """
    source = path / "metrics.json" if path.is_dir() else path
    try:
        given = json.loads(source.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DatasetError(f"{source}: {error}; give a run folder, or a file of --out") from error
    numbers = _numbers(given) if path.is_dir() else given
    date = datetime.date.fromtimestamp(source.stat().st_mtime).isoformat()
    out = MEASURED / f"{path.stem}.json"
    document = {"version": __version__, "date": date, "numbers": numbers}
    out.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    return out


def _numbers(values: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers of a document that the same recording gives again, in the groups of the document."""
    found: dict[str, Any] = {}
    for name, value in values.items():
        if any(part in name for part in _NOT_KEPT):
            continue
        inner = _numbers(value) if isinstance(value, dict) else value
        if isinstance(inner, (int, float)) or (isinstance(inner, dict) and inner):
            found[name] = inner
    return found


def stored(name: str) -> Stored:
    """The stored measurement of this name. Raises ValueError where there is none."""
    path = MEASURED / f"{name}.json"
    if not path.exists():
        raise ValueError(f"no measurement {path}; `python -m benchmarks keep` stores one")
    return Stored(**json.loads(path.read_text(encoding="utf-8")))


def value_at(path: str) -> Any:
    """What is stored under `measurement/name/name`; the last name may be a row's number."""
    name, *keys = path.split("/")
    found: Any = stored(name).numbers
    for key in keys:
        try:
            found = found[int(key)] if isinstance(found, list) else found[key]
        except (KeyError, IndexError, TypeError, ValueError):
            raise ValueError(f"{path}: the measurement has no '{key}'") from None
    return found


def computed(given: Mapping[str, Any]) -> float | int:
    """The number that a page asks for.

    Args:
        given: `from`, the path of a number; `over`, another one, by which it is divided; `times`,
            a factor; `size`, true for its absolute value.

    Raises:
        ValueError: nothing is stored there, or no number.
    """
    value: float | int = value_at(given["from"])
    if not isinstance(value, (int, float)):
        raise ValueError(f"{given['from']}: {value!r} is not a number")
    if "over" in given:
        value = value / value_at(given["over"])
    value *= given.get("times", 1)
    return abs(value) if given.get("size") else value


FORMULA = frozenset({"from", "over", "times", "size"})
"""Keys of :func:`computed`."""
