"""Finished cases of a sweep: one line of JSON each, appended as they come."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from fgslam.core.errors import DatasetError
from fgslam.core.files import clear_output_errors
from fgslam.runs.sweeps.case import CaseResult, Row


class Journal:
    """Results by key, kept in a file; memory holds where each one is.

    A line that was cut off, because the process was killed or the disk was full, is dropped when
    the file is opened again: that case is done again, nothing else.
    """

    def __init__(self, path: Path) -> None:
        """Opens or begins it. Raises OutputError where it cannot be written."""
        self._path, self._places = path, dict[str, int]()
        with clear_output_errors(path):
            self._file: BinaryIO = path.open("a+b")
            self._read()

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def __contains__(self, key: str) -> bool:
        return key in self._places

    def __len__(self) -> int:
        return len(self._places)

    def add(self, key: str, result: CaseResult) -> None:
        """Keeps a result. Raises OutputError."""
        rows = [[row.estimator, row.numbers, row.times] for row in result.rows]
        line = json.dumps([key, result.seconds, rows], allow_nan=False).encode() + b"\n"
        with clear_output_errors(self._path):
            at = self._file.seek(0, os.SEEK_END)
            try:
                self._file.write(line)
                self._file.flush()
            except OSError:
                self._file.truncate(at)
                raise
        self._places[key] = at

    def result(self, key: str) -> CaseResult:
        """What was kept. Raises DatasetError where the file was changed meanwhile."""
        self._file.seek(self._places[key])
        found = _entry(self._file.readline())
        if found is None or found[0] != key:
            raise DatasetError(f"{self._path}: changed while it was in use; run with --resume")
        return found[1]

    def _read(self) -> None:
        """Where each result is; what is no whole line at the end goes."""
        for at, line in self._lines():
            found = _entry(line)
            if found is not None:
                self._places[found[0]] = at
            elif not line.endswith(b"\n"):
                self._file.truncate(at)

    def _lines(self) -> Iterator[tuple[int, bytes]]:
        self._file.seek(0)
        while True:
            at = self._file.tell()
            line = self._file.readline()
            if not line:
                return
            yield at, line


def _entry(line: bytes) -> tuple[str, CaseResult] | None:
    """Key and result of a line; None where it is not whole."""
    try:
        key, seconds, rows = json.loads(line)
        found = CaseResult(float(seconds), tuple(Row(str(t), dict(n), dict(x)) for t, n, x in rows))
    except (ValueError, TypeError):
        return None
    return (str(key), found) if line.endswith(b"\n") else None
