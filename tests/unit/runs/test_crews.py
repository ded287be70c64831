"""Crews: results, errors, what is tried again and where, workers and schedulers that go."""

from __future__ import annotations

import logging
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from fgslam.core.errors import ConfigError
from fgslam.runs.crews import Failed, Here
from fgslam.runs.dask_crew import DaskCrew, LocalCrew, crew_at
from fgslam.runs.processes import WorkerEnded


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
        dashboard_address="127.0.0.1:0",
        silence_logs=logging.CRITICAL,
    ) as found:
        yield found


@pytest.fixture
def crew(cluster: Any) -> Iterator[DaskCrew]:
    import distributed

    with distributed.Client(cluster, set_as_default=False) as client:
        yield DaskCrew(client)


def doubled(value: int) -> int:
    return 2 * value


def test_every_argument_has_one_result_whoever_does_it(crew: DaskCrew) -> None:
    found = list(crew.do(doubled, range(200), never))
    assert sorted(found) == [(k, 2 * k) for k in range(200)]
    assert list(Here().do(doubled, range(3), never)) == [(0, 0), (1, 2), (2, 4)]


def nothing(value: int) -> None:
    del value


def test_none_is_a_result(crew: DaskCrew) -> None:
    assert list(crew.do(nothing, [1], never)) == [(0, None)]


def mistaken(value: int) -> int:
    raise ConfigError(f"a user's mistake {value}")


def broken(value: int) -> int:
    raise ZeroDivisionError(f"dividing  {value}\nby nothing")


def test_a_users_mistake_is_raised_and_a_fault_is_told_in_one_line(crew: DaskCrew) -> None:
    with pytest.raises(ConfigError, match="a user's mistake 1"):
        list(crew.do(mistaken, [1], never))
    ((_, ended),) = crew.do(broken, [5], never)
    assert ended == WorkerEnded(5, "ZeroDivisionError: dividing 5 by nothing")


def failing(path: str) -> str | Failed:
    """Fails once for each path, and says where it was."""
    import distributed

    here = distributed.get_worker().address
    try:
        Path(path).write_text(here) if not Path(path).exists() else None
        first = Path(path).read_text() == here
    except OSError as error:
        return Failed(str(error), here)
    return Failed("not here", here) if first else here


def test_what_failed_is_tried_on_another_worker(crew: DaskCrew, tmp_path: Path) -> None:
    path = tmp_path / "where"
    ((_, found),) = crew.do(failing, [str(path)], never)
    assert isinstance(found, str)
    assert found != path.read_text()


def always_failing(value: int) -> Failed:
    import distributed

    return Failed(f"no {value}", distributed.get_worker().address)


def test_what_fails_everywhere_is_handed_back_with_its_reason(crew: DaskCrew) -> None:
    found = sorted(crew.do(always_failing, [1, 2], never), key=lambda one: one[0])
    assert [(k, one.why) for k, one in found] == [(0, "no 1"), (1, "no 2")]


GO = threading.Event()


def waits(value: int) -> int:
    GO.wait(60.0)
    return value


@pytest.mark.parametrize("which", ["here", "dask"])
def test_what_had_not_come_in_when_it_was_stopped_is_named(which: str, crew: DaskCrew) -> None:
    GO.clear()
    asked: list[float] = []

    def stopped() -> bool:
        asked.append(time.monotonic())
        return len(asked) > (0 if which == "here" else 3)

    someone = Here() if which == "here" else crew
    begun = time.monotonic()
    found = list(someone.do(waits, [1, 2, 3], stopped))
    GO.set()
    assert time.monotonic() - begun < 10.0
    assert found == [(k, WorkerEnded(k + 1, "interrupted before it began")) for k in range(3)]


@pytest.mark.parametrize("given", ["nowhere:x", "nowhere", "absent.json", "list.json"])
def test_no_scheduler_is_one_line(
    given: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "list.json").write_text("[]")
    words = f"--scheduler {given}: no Dask scheduler answers there"
    with pytest.raises(ConfigError, match=words), crew_at(given):
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
    with LocalCrew(1) as crew:
        assert list(crew.do(ending, [str(tmp_path / "mark")], never)) == [(0, "1")]
        ((_, ended),) = crew.do(fatal, [""], never)
    assert isinstance(ended, WorkerEnded)
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


def test_workers_of_this_machine_are_reached_from_nowhere_else() -> None:
    before = listening(0)
    with LocalCrew(1) as crew:
        ((_, of_worker),) = crew.do(listening, [1], never)
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


@pytest.mark.slow
def test_workers_load_what_cases_need_before_there_is_work_and_end_without_any() -> None:
    end = time.monotonic() + 60.0
    with LocalCrew(1):
        while not (ready := [one for one in workers_of_this_process() if has_loaded(one, "cv2")]):
            assert time.monotonic() < end, "no worker gets ready"
            time.sleep(0.02)
    assert not ready[0].exists()


def has_loaded(process: Path, library: str) -> bool:
    return library in (process / "maps").read_text(encoding="utf-8")


def workers_of_this_process() -> list[Path]:
    own = Path("/proc", str(os.getpid()), "task", str(os.getpid()), "children")
    children = [Path("/proc", pid) for pid in own.read_text(encoding="utf-8").split()]
    return [child for child in children if b"dask_worker" in (child / "cmdline").read_bytes()]


@pytest.mark.slow
def test_a_stopped_crew_leaves_no_process_and_takes_no_time() -> None:
    until: list[float] = []

    def stopped() -> bool:
        return bool(until) and time.monotonic() > until[0]

    with LocalCrew(2) as crew:
        pids = {found for _, found in crew.do(napping, [0.5, 0.5], never)}
        until.append(time.monotonic() + 0.5)
        assert all(isinstance(one, WorkerEnded) for _, one in crew.do(napping, [60.0] * 4, stopped))
        begun = time.monotonic()
    assert time.monotonic() - begun < 1.5
    assert not any(alive(pid) for pid in pids)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True
