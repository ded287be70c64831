"""Executors: results, errors, what is tried again and where, workers and schedulers that go."""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import pytest

from fgslam.core.errors import ConfigError, MemoryShortageError
from fgslam.runs.workers import Executor, Failed, Pool


def never() -> bool:
    return False


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """Two workers, both threads of this process."""
    import distributed

    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        processes=False,
        protocol="tcp://",
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    ) as found:
        yield found


@pytest.fixture
def pool(cluster: Any) -> Iterator[Pool]:
    with Pool(scheduler=cluster.scheduler_address) as found:
        yield found


def doubled(value: int) -> int:
    return 2 * value


def test_every_argument_has_one_result_whoever_does_it(pool: Pool) -> None:
    found = list(pool.run(doubled, range(200), never))
    assert sorted(found) == [(k, 2 * k) for k in range(200)]
    assert list(Executor().run(doubled, range(3), never)) == [(0, 0), (1, 2), (2, 4)]


def nothing(value: int) -> None:
    del value


def test_none_is_a_result(pool: Pool) -> None:
    assert list(pool.run(nothing, [1], never)) == [(0, None)]


def mistaken(value: int) -> int:
    raise ConfigError(f"a user's mistake {value}")


def broken(value: int) -> int:
    raise ZeroDivisionError(f"dividing  {value}\nby nothing")


def test_a_users_mistake_is_raised_and_a_fault_is_told_in_one_line(pool: Pool) -> None:
    with pytest.raises(ConfigError, match="a user's mistake 1"):
        list(pool.run(mistaken, [1], never))
    ((_, ended),) = pool.run(broken, [5], never)
    assert ended == Failed("ZeroDivisionError: dividing 5 by nothing")


def failing(path: str) -> str | Failed:
    """Fails once for each path, and says where it was."""
    import distributed

    here = distributed.get_worker().address
    try:
        Path(path).write_text(here) if not Path(path).exists() else None
        first = Path(path).read_text() == here
    except OSError as error:
        return Failed(str(error))
    return Failed("not here") if first else here


def test_what_failed_is_tried_on_another_worker(pool: Pool, tmp_path: Path) -> None:
    path = tmp_path / "where"
    ((_, found),) = pool.run(failing, [str(path)], never)
    assert isinstance(found, str)
    assert found != path.read_text()


def always_failing(value: int) -> Failed:
    return Failed(f"no {value}")


def test_what_fails_everywhere_is_handed_back_with_its_reason(pool: Pool) -> None:
    found = sorted(pool.run(always_failing, [1, 2], never), key=lambda one: one[0])
    assert [(k, one.why) for k, one in found] == [(0, "no 1"), (1, "no 2")]


GO = threading.Event()


def waits(value: int) -> int:
    GO.wait(60.0)
    return value


@pytest.mark.parametrize("which", ["here", "dask"])
def test_what_had_not_come_in_when_it_was_stopped_is_named(which: str, pool: Pool) -> None:
    GO.clear()
    asked: list[float] = []

    def stopped() -> bool:
        asked.append(time.monotonic())
        return len(asked) > (0 if which == "here" else 3)

    executor = Executor() if which == "here" else pool
    begun = time.monotonic()
    found = list(executor.run(waits, [1, 2, 3], stopped))
    GO.set()
    assert time.monotonic() - begun < 10.0
    assert found == [(k, Failed("interrupted before it began")) for k in range(3)]


@pytest.mark.parametrize("given", ["nowhere:x", "nowhere", "absent.json", "list.json"])
def test_no_scheduler_is_one_line(
    given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "list.json").write_text("[]")
    words = f"--scheduler {given}: no Dask scheduler answers there"
    with pytest.raises(ConfigError, match=words), Pool(scheduler=given):
        pass


# --------------------------------------------------------------------------------------------
# Processes


def ending(path: str) -> str:
    """The first to come here kills its worker; threads of linear algebra in what the next says."""
    try:
        os.close(os.open(path, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return os.environ["OPENBLAS_NUM_THREADS"]
    os.kill(os.getpid(), signal.SIGKILL)
    return ""


def fatal(path: str) -> str:
    del path
    os._exit(3)


@pytest.mark.slow
def test_a_worker_that_crashes_is_replaced_and_its_work_done(tmp_path: Path) -> None:
    with Pool(1) as pool:
        assert list(pool.run(ending, [str(tmp_path / "mark")], never)) == [(0, "1")]
        ((_, ended),) = pool.run(fatal, [""], never)
    assert isinstance(ended, Failed)
    assert ended.why == "it ended its workers, perhaps for lack of memory"


def listening(value: int) -> list[tuple[str, int]]:
    """Address, in hexadecimal notation, and port of each socket at which this process listens."""
    del value
    own = set()
    for file in Path("/proc/self/fd").iterdir():
        with suppress(FileNotFoundError):
            own.add(os.readlink(file))
    found = []
    for name in ("tcp", "tcp6"):
        for line in Path("/proc/net", name).read_text(encoding="utf-8").splitlines()[1:]:
            _, local, _, state, *more = line.split()
            if state == "0A" and f"socket:[{more[5]}]" in own:
                found.append((local.split(":")[0], int(local.split(":")[1], 16)))
    return found


def outer_address() -> str:
    """An address of this machine that others reach it at; a datagram's route names it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
        except OSError:
            pytest.skip("this machine has no other address")
        return str(probe.getsockname()[0])


@pytest.fixture(scope="module")
def local() -> Iterator[tuple[Pool, list[tuple[str, int]]]]:
    """A worker that is a process, and where this one listened before it began."""
    before = listening(0)
    with Pool(1) as found:
        yield found, before


def test_workers_of_this_machine_are_reached_from_nowhere_else(
    local: tuple[Pool, list[tuple[str, int]]],
) -> None:
    pool, before = local
    ((_, of_worker),) = pool.run(listening, [1], never)
    assert isinstance(of_worker, list)
    opened = [*of_worker, *(one for one in listening(0) if one not in before)]
    assert len(of_worker) >= 1
    assert len(opened) > len(of_worker)
    assert {address for address, _ in opened} == {"0100007F"}
    for _, port in opened:
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection((outer_address(), port), timeout=5.0)


def napping(seconds: float) -> int:
    time.sleep(seconds)
    return os.getpid()


def own_number(value: int) -> int:
    del value
    return os.getpid()


def test_workers_are_used_again_except_for_what_wants_a_fresh_process(
    local: tuple[Pool, list[tuple[str, int]]],
) -> None:
    pool, _ = local
    first, second = dict(pool.run(own_number, [1, 2], never)).values()
    (third,) = dict(pool.run(own_number, [1], never)).values()
    fresh = set(dict(pool.run(own_number, [1, 2], never, fresh=True)).values())
    assert first == second == third
    assert len(fresh) == 2
    assert first not in fresh


def test_workers_are_no_more_than_units_and_four_a_core(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    monkeypatch.setattr("distributed.LocalCluster.scale", lambda _, count: asked.append(count))
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    for jobs, units in ((None, 1000), (1, 1000), (5, 1000), (500, 1000), (500, 3)):
        with Pool(jobs) as pool:
            list(pool.run(own_number, [0] * units, lambda: True))
    assert [count for count in asked if count] == [2, 1, 5, 8, 3]


def masked(value: int) -> set[int]:
    del value
    return set(signal.pthread_sigmask(signal.SIG_BLOCK, ()))


def test_no_ctrl_c_reaches_a_worker_and_this_process_is_as_before() -> None:
    """Ctrl-C reaches every process of a terminal; Dask leaves its workers' TMPDIR in this one."""
    before = dict(os.environ)
    with Pool(1) as pool:
        ((_, inherited),) = pool.run(masked, [1], never)
        assert isinstance(inherited, set)
        assert signal.SIGINT in inherited
        assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())
    assert dict(os.environ) == before


def short_of_memory(what: str) -> None:
    if what == "numpy":
        raise MemoryError
    raise cv2.error("alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate 9")


@pytest.mark.parametrize("what", ["numpy", "opencv"])
def test_lack_of_memory_in_a_worker_is_raised_here_in_one_line(what: str, pool: Pool) -> None:
    with pytest.raises(MemoryShortageError, match="not enough memory") as caught:
        list(pool.run(short_of_memory, [what], never))
    assert "\n" not in str(caught.value)


UNGUARDED = """
from test_workers import doubled, never
from fgslam.runs.workers import Pool
print("script starts")
with Pool(1) as pool:
    print(dict(pool.run(doubled, [4], never)))
"""


def test_a_script_without_a_guard_is_not_run_again_in_its_workers(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(UNGUARDED)
    paths = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    found = subprocess.run(  # noqa: S603 - a script of this test
        [sys.executable, str(script)],
        env=os.environ | {"PYTHONPATH": paths},
        capture_output=True,
        text=True,
        check=True,
    )
    assert found.stdout.count("script starts") == 1
    assert "{0: 8}" in found.stdout
    assert found.stderr == ""


def run_and_wait(path: str) -> None:
    """In a process that is killed: waits for a worker of its own."""
    with Pool(1) as pool:
        list(pool.run(leave_number, [path], never))


def leave_number(path: str) -> None:
    Path(path).write_text(str(os.getpid()))
    time.sleep(600.0)


def test_workers_end_with_a_process_that_is_killed(tmp_path: Path) -> None:
    number = tmp_path / "number"
    owner = multiprocessing.get_context("spawn").Process(target=run_and_wait, args=(str(number),))
    owner.start()
    end = time.monotonic() + 300.0
    while not (number.exists() and number.read_text()):
        assert time.monotonic() < end, "no worker gets ready"
        time.sleep(0.05)
    owner.kill()
    owner.join()
    while alive(int(number.read_text())):
        assert time.monotonic() < end, "the worker goes on"
        time.sleep(0.05)


@pytest.mark.slow
def test_a_stopped_pool_leaves_no_process_and_takes_no_time() -> None:
    until: list[float] = []

    def stopped() -> bool:
        return bool(until) and time.monotonic() > until[0]

    with Pool(2) as pool:
        pids = {found for _, found in pool.run(napping, [0.5, 0.5], never)}
        until.append(time.monotonic() + 0.5)
        assert all(isinstance(one, Failed) for _, one in pool.run(napping, [60.0] * 4, stopped))
        begun = time.monotonic()
    assert time.monotonic() - begun < 1.5
    assert not any(alive(pid) for pid in pids)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
