"""Atomic files and the run folder: whole or absent, and one clear line when it cannot be."""

from __future__ import annotations

import errno
import importlib
import os
import pkgutil
import resource
from pathlib import Path

import numpy as np
import pytest

import fgslam.report
import fgslam.runs
from fgslam.core import files as whole_files
from fgslam.core.errors import OutputError
from fgslam.core.files import make_subfolder, remove_files, replacing, write_bytes, write_text
from fgslam.runs.engine import is_finished
from fgslam.runs.folder import create_folder
from fgslam.runs.units import UnitStore


def leftovers(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if "partial" in path.name]


def test_failure_keeps_the_previous_version(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    write_text(target, "old")

    def interrupted(partial: Path) -> None:
        partial.write_text("half of the n")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), replacing(target) as beside:
        interrupted(beside)
    assert target.read_text() == "old"
    assert not leftovers(tmp_path)


def test_a_folder_that_cannot_be_removed_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    write_text(Path("a.txt"), "one")
    with pytest.raises(OutputError, match=r"^cannot write \.: .*; choose another folder$"):
        remove_files(Path(), "*.txt")  # a folder has no other name than this one for itself
    assert not list(tmp_path.iterdir())


def test_library_writers_see_their_suffix(tmp_path: Path) -> None:
    target = tmp_path / "log.npz"
    with replacing(target) as path:
        np.savez(path, a=np.arange(3))
    with np.load(target) as log:
        np.testing.assert_array_equal(log["a"], [0, 1, 2])
    assert [path.name for path in tmp_path.iterdir()] == ["log.npz"]


@pytest.mark.parametrize(
    ("code", "words"),
    [
        (errno.ENOSPC, "disk is full"),
        (errno.EDQUOT, "quota"),
        (errno.EACCES, "permission denied"),
        (errno.EROFS, "read-only"),
    ],
)
def test_system_errors_become_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, words: str
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(whole_files.os, "replace", refuse)
    with pytest.raises(OutputError, match=words) as caught:
        write_bytes(tmp_path / "a.bin", b"content")
    assert "\n" not in str(caught.value)
    assert str(tmp_path / "a.bin") in str(caught.value)
    assert not leftovers(tmp_path)


def test_file_that_outgrows_what_the_system_allows(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4096, hard))
    try:
        with pytest.raises(OutputError, match="cannot write"):
            write_bytes(tmp_path / "big.bin", b"x" * 100_000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert list(tmp_path.iterdir()) == []


def test_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="does not exist"):
        write_text(tmp_path / "absent" / "a.txt", "x")


# --------------------------------------------------------------------------------------------
# The run folder


def a_run(folder: Path) -> Path:
    create_folder(folder)
    write_text(folder / "config.yaml", "name: demo\n")
    write_text(make_subfolder(folder, "landmark_kalman") / "final.tum", "")
    write_text(make_subfolder(folder, "pictures") / "map.png", "")
    return folder


def test_folder_with_a_run_is_refused_and_untouched(tmp_path: Path) -> None:
    folder = a_run(tmp_path / "run")
    before = sorted(folder.rglob("*"))
    with pytest.raises(OutputError, match="holds a run already"):
        create_folder(folder)
    assert sorted(folder.rglob("*")) == before


@pytest.mark.parametrize("existing", ["refuse", "overwrite"])
def test_folder_of_something_else_is_never_touched(tmp_path: Path, existing: str) -> None:
    write_text(tmp_path / "thesis.tex", "years of work")
    with pytest.raises(OutputError, match="something else"):
        create_folder(tmp_path, existing)  # type: ignore[arg-type]
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_overwriting_deletes_the_run_and_nothing_else(tmp_path: Path) -> None:
    folder = a_run(tmp_path / "run")
    write_text(folder / "notes.txt", "mine")
    write_text(folder / "landmark_kalman" / "plot.svg", "mine too")
    write_text(folder / ".final.tum.partial.tum", "left by a killed run")
    create_folder(folder, "overwrite")
    left = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    assert left == ["landmark_kalman/plot.svg", "notes.txt"]
    assert not (folder / "pictures").exists()


def names_of_files() -> list[str]:
    """Every name of a file that a module states which writes run folders."""
    modules = [
        importlib.import_module(found.name)
        for package in (fgslam.runs, fgslam.report)
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        if found.name != "fgslam.runs.sweep"  # these have folders of their own
    ]
    stated = [item for module in modules for item in vars(module).items()]
    return sorted({v for k, v in stated if k.endswith(("_FILE", "_MARKER")) and isinstance(v, str)})


def test_overwriting_deletes_every_file_that_a_task_writes(tmp_path: Path) -> None:
    names = names_of_files()
    assert {"config.yaml", "loops.csv", "follow.csv", "map.fgmap"} <= set(names)
    for name in names:
        write_text(tmp_path / name, "")
    create_folder(tmp_path, "overwrite")
    assert [path.name for path in tmp_path.iterdir()] == []


def test_resume_keeps_everything(tmp_path: Path) -> None:
    folder = a_run(tmp_path / "run")
    before = sorted(folder.rglob("*"))
    create_folder(folder, "resume")
    assert sorted(folder.rglob("*")) == before


def test_unwritable_folder_is_found_out_before_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> int:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(Path, "write_bytes", refuse)
    with pytest.raises(OutputError, match="read-only"):
        create_folder(tmp_path / "run")


@pytest.mark.parametrize("left", [".config.yaml.partial.yaml", ".writable.partial"])
def test_a_run_killed_before_its_first_file_leaves_room_for_another(
    tmp_path: Path, left: str
) -> None:
    (tmp_path / left).write_text("ex")
    create_folder(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match="something else than a run"):
        create_folder(tmp_path)


# --------------------------------------------------------------------------------------------
# Units of a run


def test_removing_units_leaves_files_of_others(tmp_path: Path) -> None:
    write_text(tmp_path / "metrics.json", '{"estimators": {}}')
    store = UnitStore(tmp_path)
    store.add("replays", {0: 1.5, 1: 2.5}, float)
    units = tmp_path / "units"
    write_text(units / ".replays_000002.npz.partial.npz", "left by a killed run")
    write_text(units / "final.tum", "mine")
    assert not is_finished(tmp_path)
    store.remove()
    assert [path.name for path in units.iterdir()] == ["final.tum"]
    assert is_finished(tmp_path)


def test_what_is_kept_nowhere_and_what_is_nothing_are_handed_back(tmp_path: Path) -> None:
    assert UnitStore(None).add("replays", {0: 1.5}, float) == {0: 1.5}
    assert UnitStore(tmp_path).add("replays", {}, float) == {}
    assert list(tmp_path.iterdir()) == []


def test_removing_units_removes_their_folder(tmp_path: Path) -> None:
    store = UnitStore(tmp_path)
    store.add("replays", {0: 1.5}, float)
    store.remove()
    assert list(tmp_path.iterdir()) == []
