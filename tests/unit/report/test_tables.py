"""Plain tables and documents."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fgslam.core.errors import OutputError
from fgslam.report.content import write_csv, write_json


def test_cells_are_text_that_reads_back(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    rows = [
        [1, np.int64(2), 1.0 / 3.0, True],
        [None, float("nan"), np.float64("inf"), np.bool_(False)],
        ['a "b", c', -0.5, 1e-12, 12345678901],
    ]
    write_csv(path, ("a", "b", "c", "d"), rows)
    assert path.read_text(encoding="utf-8") == (
        'a,b,c,d\n1,2,0.3333333333,true\n,,,false\n"a ""b"", c",-0.5,1e-12,12345678901\n'
    )


def test_a_ragged_row_is_refused_and_nothing_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="1 cells in a table of 2 columns"):
        write_csv(tmp_path / "t.csv", ("a", "b"), [[1]])
    assert list(tmp_path.iterdir()) == []


def test_what_is_not_finite_is_null(tmp_path: Path) -> None:
    write_json(tmp_path / "m.json", {"a": float("nan"), "b": [np.float64(1.5), np.inf]})
    text = (tmp_path / "m.json").read_text(encoding="utf-8")
    assert json.loads(text) == {"a": None, "b": [1.5, None]}


def test_a_folder_that_is_not_there_is_reported(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="does not exist"):
        write_csv(tmp_path / "no" / "t.csv", ("a",), [])
