"""What a sweep goes over: `--set seed=0:100 --set a.b=2,3,4`, and the cases that come of it."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, overload

import numpy as np
import yaml

from fgslam.core.errors import ConfigError
from fgslam.core.yaml_text import plain_values
from fgslam.runs.bare import bare_experiment
from fgslam.runs.config import make_experiment, read_mapping
from fgslam.runs.named_experiments import find_experiment, suggestion
from fgslam.runs.session import override_texts

Setting: TypeAlias = int | float | bool | str
"""A value of an axis as the table has it."""

SEED = "seed"
MOST_CASES = 1_000_000
_RANGE = re.compile(r"\s*(\d+):(\d+)(?::(\d+))?\s*")
_PATHS = ("path", "camera_file", "odometry_file", "load")
_OPENING, _CLOSING, _QUOTES = "[{", "]}", "'\""


@dataclass(frozen=True, slots=True)
class Axis:
    """A key of the experiment and the values it takes, as typed."""

    key: str
    values: Sequence[str]

    @property
    def settings(self) -> list[Setting]:
        """The values as the table has them: numbers or booleans where all are, else text."""
        found = [_plain(text) for text in self.values]
        for kinds in ((bool,), (int,), (int, float)):
            if all(type(value) in kinds for value in found):
                return [float(value) for value in found] if float in map(type, found) else found
        return list(self.values)


def read_axes(sets: Iterable[str]) -> tuple[Axis, ...]:
    """The axes of `KEY=VALUES`: one value, several with commas, or a range `FIRST:END[:STEP]`.

    A comma in brackets or quotes belongs to its value. END is left out, as in Python.

    Raises:
        ConfigError: one is malformed, empty, or of a key that was given before.
    """
    axes: list[Axis] = []
    for given in sets:
        key, separator, text = given.partition("=")
        if not separator or not key.strip():
            raise ConfigError(f"--set {given}: not of the form KEY=VALUES; e.g. --set seed=0:100")
        axis = Axis(key.strip(), _values(given, text))
        if axis.key in (one.key for one in axes):
            raise ConfigError(f"--set {given}: {axis.key} is given twice; write {axis.key}=A,B")
        axes.append(axis)
    return tuple(axes)


def make_axes(settings: Mapping[str, Any]) -> tuple[Axis, ...]:
    """The axes of values by key: one, or several in a list, a range or an array.

    Raises:
        ConfigError: a value is not plain, or there is none.
    """
    return tuple(_axis(key, value) for key, value in settings.items())


def _axis(key: str, value: Any) -> Axis:
    several = isinstance(value, (list, tuple, range, np.ndarray))
    values = list(value) if several else [value]
    texts = [override_texts({key: one})[0].partition("=")[2] for one in values]
    if not texts or len(set(texts)) < len(texts):
        what = "one of its values is given twice" if texts else "it has no value"
        raise ConfigError(f"settings: {key}: {what}; give some that differ")
    return Axis(key, texts)


def _values(given: str, text: str) -> Sequence[str]:
    found = _RANGE.fullmatch(text)
    if found is None:
        values = _split(text)
        if any(not value for value in values) and len(values) > 1:
            raise ConfigError(f"--set {given}: a value is empty; remove a comma")
        if len(set(values)) < len(values):
            raise ConfigError(f"--set {given}: a value is given twice; remove one")
        return values
    first, end, step = (int(part) for part in (found[1], found[2], found[3] or "1"))
    count = len(range(first, end, step)) if step else 0
    if not 1 <= count <= MOST_CASES:
        raise ConfigError(
            f"--set {given}: {count:,} values; give FIRST:END[:STEP] of 1 to {MOST_CASES:,}, END "
            "not among them"
        )
    return [str(value) for value in range(first, end, step)]


def _split(text: str) -> list[str]:
    """At the commas outside brackets and quotes."""
    parts, depth, quote = [""], 0, ""
    for letter in text:
        if quote:
            quote = "" if letter == quote else quote
        elif letter in _QUOTES and not parts[-1].strip():
            quote = letter
        depth += not quote and (letter in _OPENING) - (letter in _CLOSING)
        if letter == "," and depth <= 0 and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


def _plain(text: str) -> Any:
    try:
        return plain_values(text)
    except yaml.YAMLError:
        return text


# --------------------------------------------------------------------------------------------
# Cases


@dataclass(frozen=True, slots=True, eq=False)
class Source:
    """An experiment or a recording that a sweep goes over.

    Attributes:
        name: what the table calls it.
        values: its configuration as a file has it.
        where: of its messages.
    """

    name: str
    values: Mapping[str, Any]
    where: str


def read_source(path: Path) -> Source:
    """An experiment's file, the name of a shipped one, or a recording's folder.

    Raises:
        FgslamError: it is none of these, or cannot be used.
    """
    found = find_experiment(path)
    if found.is_dir():
        values: Mapping[str, Any] = bare_experiment(found).values
    elif found.exists():
        values = read_mapping(found)
    else:
        raise ConfigError(f"{found}: no such file or folder; {suggestion(found)}")
    return Source(make_experiment(values, str(found)).name, _found_anywhere(values), str(found))


def _found_anywhere(values: Any, key: str = "") -> Any:
    """The values with paths of what exists made absolute: workers start in folders of their own."""
    if isinstance(values, Mapping):
        return {name: _found_anywhere(value, str(name)) for name, value in values.items()}
    if key in _PATHS and isinstance(values, str) and values and Path(values).exists():
        return str(Path(values).resolve())
    return values


@dataclass(frozen=True, slots=True)
class Case:
    """One combination.

    Attributes:
        number: in the grid.
        source: number of the experiment.
        place: number of the value on each axis.
        overrides: `key=value` of each axis.
    """

    number: int
    source: int
    place: tuple[int, ...]
    overrides: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Grid(Sequence[Case]):
    """All combinations, made when they are asked for; the last axis turns fastest."""

    sources: tuple[Source, ...]
    axes: tuple[Axis, ...]

    def __post_init__(self) -> None:
        names = [source.name for source in self.sources]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ConfigError(f"two experiments are called {twice[0]}; give one another name")
        if len(self) > MOST_CASES:
            raise ConfigError(f"{len(self):,} cases; a sweep has at most {MOST_CASES:,}")

    def __len__(self) -> int:
        return len(self.sources) * math.prod(len(axis.values) for axis in self.axes)

    @overload
    def __getitem__(self, index: int) -> Case: ...
    @overload
    def __getitem__(self, index: slice) -> list[Case]: ...
    def __getitem__(self, index: int | slice) -> Case | list[Case]:
        if isinstance(index, slice):
            return [self[k] for k in range(*index.indices(len(self)))]
        number = range(len(self))[index]
        rest, place = number, list[int]()
        for axis in self.axes[::-1]:
            rest, at = divmod(rest, len(axis.values))
            place.insert(0, at)
        chosen = ((axis.key, axis.values[k]) for axis, k in zip(self.axes, place, strict=True))
        texts = (f"{key}={_found_anywhere(text, key.split('.')[-1])}" for key, text in chosen)
        return Case(number, rest, tuple(place), tuple(texts))
