"""Two processes and one folder: one owner at a time, and no file of one in the other's hands."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from fgslam.core.errors import OutputError
from fgslam.core.files import remove_unfinished_files, replacing, write_bytes
from fgslam.runs.folder import OWNER_NAME, Owner, create_folder


def in_another_process(do: Callable[[], object]) -> int:
    """Number of a process that has done so and waits to be killed."""
    reader, writer = os.pipe()
    number = os.fork()
    if not number:
        do()
        os.write(writer, b"done")
        signal.pause()
    os.close(writer)
    assert os.read(reader, 4) == b"done"
    os.close(reader)
    return number


def kill(number: int) -> None:
    os.kill(number, signal.SIGKILL)
    os.waitpid(number, 0)


def test_a_folder_has_one_owner_until_that_one_has_left(tmp_path: Path) -> None:
    with Owner(tmp_path) as owner:
        owner.take()
        with pytest.raises(OutputError, match=f"process {os.getpid()} on .* is writing there"):
            Owner(tmp_path).take()
    assert not (tmp_path / OWNER_NAME).exists()
    with Owner(tmp_path) as owner:
        owner.take()
        assert owner.before == ""


def test_a_dead_owner_s_folder_is_taken_over_with_a_word(tmp_path: Path) -> None:
    other = in_another_process(lambda: Owner(tmp_path).take())
    with pytest.raises(OutputError, match=f"process {other} on .* is writing there; wait"):
        Owner(tmp_path).take()
    kill(other)
    with Owner(tmp_path) as owner:
        owner.take()
        assert owner.before.startswith(f"process {other} on ")


def test_what_a_killed_owner_left_makes_no_folder_a_run(tmp_path: Path) -> None:
    kill(in_another_process(lambda: Owner(tmp_path).take()))
    assert create_folder(tmp_path) == tmp_path


def test_two_processes_that_write_one_file_tear_nothing(tmp_path: Path) -> None:
    path = tmp_path / "metrics.json"
    first, second = b"a" * 300_000, b"b" * 300_000

    def write_on(content: bytes) -> None:
        while True:
            write_bytes(path, content)

    write_bytes(path, first)
    others = []
    for content in (first, second):
        number = os.fork()
        if not number:
            write_on(content)
        others.append(number)
    try:
        assert {path.read_bytes() for _ in range(300)} <= {first, second}
    finally:
        for number in others:
            kill(number)
    assert path.read_bytes() in (first, second)
    remove_unfinished_files(tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["metrics.json"]


def test_what_another_process_is_writing_stays(tmp_path: Path) -> None:
    def write_half() -> None:
        beside = replacing(tmp_path / "log.npz").__enter__()
        beside.write_bytes(b"half")

    other = in_another_process(write_half)
    remove_unfinished_files(tmp_path)
    assert len(list(tmp_path.iterdir())) == 1
    kill(other)
    remove_unfinished_files(tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_name_as_long_as_the_system_allows_is_written(tmp_path: Path) -> None:
    path = tmp_path / ("n" * 251 + ".txt")
    write_bytes(path, b"x")
    assert path.read_bytes() == b"x"
