"""Files that are written: the gate of outputs, and what is never replaced."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from fgslam.core.errors import OutputError
from fgslam.core.files import require_output, write_text


def make_link(path: Path) -> None:
    target = path.with_name("target")
    target.write_text("kept")
    path.symlink_to(target)


NO_FILES: dict[str, Callable[[Path], None]] = {
    "a link": make_link,
    "a pipe": os.mkfifo,
    "a folder": Path.mkdir,
    "a device": lambda path: path.symlink_to("/dev"),
}


@pytest.mark.parametrize("kind", NO_FILES)
def test_nothing_but_a_regular_file_is_replaced(kind: str, tmp_path: Path) -> None:
    path = tmp_path / "null"
    NO_FILES[kind](path)
    if kind == "a device":
        path = path / "null"
    before = path.lstat()
    words = f"cannot write {path}: it is {kind}; choose another name"
    with pytest.raises(OutputError, match=words):
        require_output(path, overwrite=True)
    with pytest.raises(OutputError, match=words):
        write_text(path, "lost")
    assert path.lstat() == before
    assert kind != "a link" or path.read_text() == "kept"


def test_a_file_that_is_there_is_replaced_if_asked_for(tmp_path: Path) -> None:
    path = tmp_path / "a.ply"
    require_output(path, overwrite=False)
    path.write_text("earlier")
    with pytest.raises(OutputError, match=r"is there already; choose another name, or add --over"):
        require_output(path, overwrite=False)
    require_output(path, overwrite=True)
    assert [found.name for found in tmp_path.iterdir()] == ["a.ply"]


def test_inputs_and_their_parts_are_never_replaced(tmp_path: Path) -> None:
    recording, outside = tmp_path / "recording", tmp_path / "outside"
    (recording / "left").mkdir(parents=True)
    outside.symlink_to(recording)
    calibration = recording / "calib.json"
    calibration.write_text("{}")
    for path in (calibration, outside / "calib.json", recording / "left" / ".." / "calib.json"):
        with pytest.raises(OutputError, match=f"part of {recording}, which is read"):
            require_output(path, True, [recording])
        with pytest.raises(OutputError, match="it is read; choose another name"):
            require_output(path, True, [calibration])
    require_output(recording / "new.json", False, [recording])


def test_a_folder_of_outputs_is_new_or_empty_unless_asked_for(tmp_path: Path) -> None:
    folder = tmp_path / "model"
    require_output(folder, False, folder=True)
    folder.mkdir()
    require_output(folder, False, [folder], folder=True)
    (folder / "a.png").write_text("an image")
    with pytest.raises(OutputError, match="is there already"):
        require_output(folder, False, folder=True)
    with pytest.raises(OutputError, match="it is read"):
        require_output(folder, True, [folder], folder=True)
    require_output(folder, True, folder=True)
    with pytest.raises(OutputError, match="not a folder"):
        require_output(folder / "a.png", True, folder=True)


def test_a_folder_that_is_not_there_is_said_before_the_work(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="its folder does not exist; choose another folder"):
        require_output(tmp_path / "absent" / "a.ply", False)
