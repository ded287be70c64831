"""Paths at the command line, and in the library: what is none is called what it is."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from fgslam.cli.options import saved_map
from fgslam.core.errors import DatasetError, MapError
from fgslam.core.files import as_path


class PathOf:
    """A path-like object of whatever it is given."""

    def __init__(self, what: object) -> None:
        self._what = what

    def __fspath__(self) -> object:
        return self._what


def test_a_pipe_or_a_folder_in_the_place_of_a_map_is_called_one(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe.fgmap"
    os.mkfifo(pipe)
    for path, what in ((pipe, "it is a pipe"), (tmp_path, "it is a folder")):
        with pytest.raises(
            DatasetError, match=f"{what}; give a file that fgslam run --map-out wrote"
        ):
            saved_map(str(path))
    with pytest.raises(DatasetError, match="no such file"):
        saved_map(str(tmp_path / "absent.fgmap"))


@pytest.mark.parametrize(
    ("given", "what"),
    [(3, "a int"), (None, "a NoneType"), (b"x", "a bytes"), (["x"], "a list"),
     (PathOf(b"x"), "the path of a PathOf is of bytes"), (PathOf(3), "PathOf"),
     ("\0", "null byte"), ("x" * 5000, "the name is too long")],
    ids=["number", "none", "bytes", "list", "of bytes", "of number", "nul", "long"],
)  # fmt: skip
def test_what_is_no_path_is_refused_in_one_line(given: object, what: str) -> None:
    with pytest.raises(MapError, match=what) as caught:
        as_path(given, MapError)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def test_a_path_that_does_not_exist_is_a_path() -> None:
    assert as_path("absent/file", MapError) == Path("absent/file")
    assert as_path(Path("absent"), MapError) == Path("absent")
