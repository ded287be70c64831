"""Files of plain arrays with a JSON header: one codec for logs, maps, features and checkpoints.

A file is an ``.npz`` without pickle whose array ``header`` is a JSON text with ``format`` and
``version``. The same arrays give the same bytes, and a file is written whole or not at all. Ragged
rows are stored flat with offsets: the rows of part ``k`` are ``start[k]:start[k + 1]``.
"""

from __future__ import annotations

import json
import tokenize
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from fgslam.core.arrays import IntArray, StateArrays
from fgslam.core.errors import FgslamError, MeasurementLogError
from fgslam.core.files import replacing, require_file

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


@dataclass(frozen=True)
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


def load_arrays(path: Path, names: Sequence[str] | None = None) -> StateArrays:
    """All arrays of a file of a run folder, or those of the names.

    Raises MeasurementLogError for what cannot be read.
    """
    return _OF_RUNS.load(path, names)


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
    return {f"{prefix}{field.name}": getattr(value, field.name) for field in fields(value)}


def fields_from(kind: type, arrays: StateArrays, prefix: str) -> dict[str, Any]:
    """The arrays of :func:`by_field` by field name, to make the dataclass ``kind`` of."""
    return {field.name: arrays[f"{prefix}{field.name}"] for field in fields(kind)}


def from_upper(upper: np.ndarray[Any, Any], size: int) -> np.ndarray[Any, Any]:
    """Symmetric matrices (n, size, size) of their upper triangles (n, m), row by row."""
    rows, columns = np.triu_indices(size)
    out = np.empty((len(upper), size, size), upper.dtype)
    out[:, rows, columns] = out[:, columns, rows] = upper
    return out
