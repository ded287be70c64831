"""Rows of the arrays of an uncompressed archive, read from where they lie in the file."""

from __future__ import annotations

import math
import weakref
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

_LOCAL_HEADER = 30  # bytes before the name, which has its length, and the extra field's, at the end
_ENDING = ".npy"


@dataclass(frozen=True, slots=True)
class _Stored:
    """One array of the archive.

    Attributes:
        dtype: of its elements.
        shape: of the whole.
        begins: its first byte in the file.
    """

    dtype: np.dtype[Any]
    shape: tuple[int, ...]
    begins: int


class StoredRows:
    """Arrays of an ``.npz``; the file stays open, so that another of its name changes nothing."""

    def __init__(self, path: Path) -> None:
        """Reads all of the file once, to know that it is sound.

        Raises:
            OSError, ValueError, zipfile.BadZipFile: it is not, or its rows cannot be read apart.
        """
        self._file = path.open("rb")
        weakref.finalize(self, self._file.close)
        with zipfile.ZipFile(self._file) as archive:
            if damaged := archive.testzip():
                raise ValueError(f"array {damaged} is damaged")
            members = archive.infolist()
        self._arrays = {
            one.filename.removesuffix(_ENDING): _stored(self._file, one) for one in members
        }
        if len(self._arrays) < len(members):
            raise ValueError("holds an array twice")

    def __contains__(self, name: str) -> bool:
        return name in self._arrays

    def shape(self, name: str) -> tuple[int, ...]:
        """Of the whole array. Raises KeyError where there is none of the name."""
        return self._arrays[name].shape

    def whole(self, name: str) -> np.ndarray[Any, Any]:
        """An array. Raises as :meth:`rows` does."""
        one = self._arrays[name]
        return self._read(one, one.shape, 0)

    def rows(self, name: str, start: int, stop: int) -> np.ndarray[Any, Any]:
        """Rows ``start`` to before ``stop`` of an array.

        Raises:
            KeyError: there is none of the name.
            ValueError: it does not have these rows.
            OSError: they cannot be read.
        """
        one = self._arrays[name]
        if not one.shape or not 0 <= start <= stop <= one.shape[0]:
            raise ValueError(f"array {name} has no rows {start} to {stop}")
        row = one.shape[1:]
        return self._read(one, (stop - start, *row), start * math.prod(row))

    def _read(self, one: _Stored, shape: tuple[int, ...], first: int) -> np.ndarray[Any, Any]:
        out = np.empty(shape, one.dtype)
        self._file.seek(one.begins + first * one.dtype.itemsize)
        if out.nbytes and self._file.readinto(out.reshape(-1).view(np.uint8).data) < out.nbytes:
            raise ValueError("the file has become shorter")
        return out


def _stored(file: IO[bytes], member: zipfile.ZipInfo) -> _Stored:
    """Where an array of the archive lies."""
    if member.compress_type != zipfile.ZIP_STORED or not member.filename.endswith(_ENDING):
        raise ValueError(f"{member.filename} is compressed, or no array")
    file.seek(member.header_offset + _LOCAL_HEADER - 4)
    lengths = np.frombuffer(file.read(4), "<u2")
    file.seek(int(lengths.sum()), 1)
    version = np.lib.format.read_magic(file)
    if version != (1, 0):
        raise ValueError(f"array {member.filename} is of version {version}")
    shape, by_columns, dtype = np.lib.format.read_array_header_1_0(file)
    if (by_columns and len(shape) > 1) or dtype.hasobject:
        raise ValueError(f"array {member.filename} has no rows that lie together")
    return _Stored(dtype, shape, file.tell())
