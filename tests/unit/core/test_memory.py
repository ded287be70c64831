"""Lack of memory, as each library says it, is one line that names the limit."""

from __future__ import annotations

import errno
import os
import platform
import resource
import subprocess
import sys

import cv2
import pytest

from fgslam.cli import main as cli
from fgslam.core import memory
from fgslam.core.errors import DatasetError

SHORT = (
    MemoryError(),
    OSError(errno.ENOMEM, "Cannot allocate memory"),
    OSError("libOpen3D.so.0.20: failed to map segment from shared object"),
    ImportError("/lib/gtsam.so: cannot allocate memory in static TLS block"),
    RuntimeError("can't start new thread"),
    RuntimeError("std::bad_alloc"),
    cv2.error("alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate 453620 bytes"),
)
OTHER = (
    OSError(errno.ENOSPC, "No space left on device"),
    OSError("libGL.so.1: cannot open shared object file: No such file"),
    ImportError("No module named cv2"),
    RuntimeError("indeterminate linear system"),
    DatasetError("bad_alloc.bag: no such file"),
    KeyboardInterrupt(),
)


@pytest.mark.parametrize("error", SHORT, ids=repr)
def test_what_libraries_say_without_memory_is_recognised(error: Exception) -> None:
    assert memory.is_shortage(error)


@pytest.mark.parametrize("error", OTHER, ids=repr)
def test_other_faults_are_no_lack_of_memory(error: BaseException) -> None:
    assert not memory.is_shortage(error)


def test_a_command_without_memory_ends_with_one_line_that_names_the_limit(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def perform(arguments: list[str], **options: object) -> int:
        raise MemoryError

    monkeypatch.setattr(cli, "app", perform)
    monkeypatch.setattr(resource, "getrlimit", lambda which: (3_000_000_000, -1))
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "not enough memory: the limit is 3000 MB (ulimit -v); raise it" in line


def test_without_a_limit_the_machine_has_no_memory_left(monkeypatch: pytest.MonkeyPatch) -> None:
    infinite = (resource.RLIM_INFINITY, resource.RLIM_INFINITY)
    monkeypatch.setattr(resource, "getrlimit", lambda which: infinite)
    assert memory.limit_bytes() is None
    assert memory.room_bytes() is None
    assert "limit" not in memory.shortage()


def test_room_is_the_limit_less_what_the_process_has_mapped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(resource, "getrlimit", lambda which: (10**12, -1))
    room = memory.room_bytes()
    assert room is not None
    assert 10**12 - 10**11 < room < 10**12 - 10**7


FREED = """
import resource
import numpy as np
from fgslam.core.memory import keep_freed_memory

keep_freed_memory()
for _ in range(3):
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    every = [np.ones(400_000) for _ in range(40)]  # too small for large pages
    del every
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other libraries do as they do")
def test_freed_memory_is_kept_for_the_next_arrays() -> None:
    """128 MB, all in use at a time, would be given back and cost 31,000 pages again.

    In a process of its own: what others have freed before, and their threads, count too.
    """
    own = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    command = [sys.executable, "-c", FREED]
    told = subprocess.run(command, env=own, capture_output=True, check=True)  # noqa: S603
    assert int(told.stdout) < 6_000
