"""Work in processes of its own: results, errors, crashes and stops."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path

import cv2
import pytest

from fgslam.core.errors import ConfigError, MemoryShortageError
from fgslam.runs import processes
from fgslam.runs.processes import WorkerEnded, Workers, run_apart, worker_count


def work(what: str) -> str:
    """What the tests ask of a process."""
    match what:
        case "error":
            raise ConfigError("a user's mistake")
        case "killed":
            os.kill(os.getpid(), signal.SIGKILL)
        case "exit":
            os._exit(3)
        case "numpy":
            raise MemoryError
        case "opencv":
            raise cv2.error("alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate 9")
        case "sleep":
            time.sleep(60.0)
    return f"{what} {os.environ.get('OMP_NUM_THREADS', 'unset')}"


def test_results_come_with_the_index_of_their_argument() -> None:
    found = dict(run_apart(work, ["a", "b"], jobs=2, single_threaded=True))
    assert found == {0: "a 1", 1: "b 1"}


def test_workers_are_no_more_than_pieces_of_work_and_four_a_core(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    assert [worker_count(wanted, 1000) for wanted in (None, 1, 5, 500)] == [2, 1, 5, 8]
    assert [worker_count(500, pieces) for pieces in (0, 1, 3)] == [1, 1, 3]


def test_the_environment_is_given_back(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    assert dict(run_apart(work, ["a"], single_threaded=True)) == {0: "a 1"}
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "MKL_NUM_THREADS" not in os.environ


def test_a_crash_takes_nothing_else_along() -> None:
    found = dict(run_apart(work, ["killed", "exit", "fine"], jobs=1))
    first, second = found[0], found[1]
    assert isinstance(first, WorkerEnded)
    assert first.argument == "killed"
    assert first.why == "its process was ended by SIGKILL, perhaps for lack of memory"
    assert isinstance(second, WorkerEnded)
    assert "status 3" in second.why
    assert str(found[2]).startswith("fine")


def own_number(what: str) -> int:
    """Of the process; some end or fail."""
    work(what)
    return os.getpid()


def test_workers_are_used_again_until_they_are_closed() -> None:
    with Workers() as workers:
        first = dict(run_apart(own_number, ["a", "b"], workers=workers))
        second = dict(run_apart(own_number, ["c"], workers=workers))
        alone = dict(run_apart(own_number, ["d"]))
        assert first[0] == first[1] == second[0] != alone[0]
        assert len(multiprocessing.active_children()) == 1
    assert not multiprocessing.active_children()


def test_other_threads_need_another_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    with Workers() as workers:
        assert dict(run_apart(work, ["a"], single_threaded=True, workers=workers)) == {0: "a 1"}
        assert dict(run_apart(work, ["a"], workers=workers)) == {0: "a 2"}


def test_a_worker_that_crashed_is_replaced() -> None:
    with Workers() as workers:
        found = dict(run_apart(own_number, ["fine", "killed", "fine"], workers=workers))
    assert isinstance(found[1], WorkerEnded)
    assert isinstance(found[0], int)
    assert isinstance(found[2], int)
    assert found[0] != found[2]


def test_a_worker_serves_on_after_a_users_mistake() -> None:
    with Workers() as workers:
        before = dict(run_apart(own_number, ["fine"], workers=workers))
        with pytest.raises(ConfigError):
            list(run_apart(own_number, ["error"], workers=workers))
        assert dict(run_apart(own_number, ["fine"], workers=workers)) == before


def end_at_once(connection: Connection) -> None:
    """In place of what a process does: it ends before it has read its work."""
    del connection
    os._exit(5)


def test_a_process_that_ends_before_it_reads_its_work_is_not_waited_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(processes, "_work", end_at_once)
    ((_, ended),) = run_apart(work, ["x" * 10_000_000])  # more than any pipe holds
    assert isinstance(ended, WorkerEnded)
    assert "status 5" in ended.why


def test_what_cannot_be_handed_over_is_an_error_here() -> None:
    with pytest.raises((TypeError, pickle.PicklingError, AttributeError)):
        list(run_apart(work, [lambda: None]))  # type: ignore[list-item]
    assert not multiprocessing.active_children()


UNGUARDED = """
from test_processes import work
from fgslam.runs.processes import run_apart
print("script starts")
print(dict(run_apart(work, ["a"])))
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
    assert "'a " in found.stdout


def test_a_users_mistake_is_raised_here() -> None:
    with pytest.raises(ConfigError, match="a user's mistake"):
        list(run_apart(work, ["error"]))


@pytest.mark.parametrize("what", ["numpy", "opencv"])
def test_lack_of_memory_in_a_process_is_raised_here_in_one_line(what: str) -> None:
    with pytest.raises(MemoryShortageError, match="not enough memory") as caught:
        list(run_apart(work, [what]))
    assert "\n" not in str(caught.value)


def clear_up(path: str) -> None:
    """Leaves a mark when asked to end."""
    try:
        Path(path, "begun").touch()
        time.sleep(60.0)
    finally:
        Path(path, "cleared").touch()


def test_a_process_that_is_stopped_clears_up(tmp_path: Path) -> None:
    begun = tmp_path / "begun"
    ((_, ended),) = run_apart(clear_up, [str(tmp_path)], stopped=begun.exists)
    assert isinstance(ended, WorkerEnded)
    assert (tmp_path / "cleared").exists()


def test_stopping_ends_what_runs_and_starts_no_more() -> None:
    asked = 0

    def stopped() -> bool:
        nonlocal asked
        asked += 1
        return asked > 2

    found = dict(run_apart(work, ["sleep", "never"], jobs=1, stopped=stopped))
    running, waiting = found[0], found[1]
    assert isinstance(running, WorkerEnded)
    assert running.why == "interrupted"
    assert isinstance(waiting, WorkerEnded)
    assert waiting.why == "interrupted before it began"


def run_and_wait(path: str) -> None:
    """In a process that is killed: waits for a worker of its own."""
    list(run_apart(clear_up, [path]))


def test_a_process_ends_with_a_parent_that_is_killed(tmp_path: Path) -> None:
    parent = multiprocessing.get_context("spawn").Process(
        target=run_and_wait, args=(str(tmp_path),)
    )
    parent.start()
    assert appears(tmp_path / "begun")
    parent.kill()
    parent.join()
    assert appears(tmp_path / "cleared")


def appears(path: Path, within_s: float = 300.0) -> bool:
    """Whether the file is there in time."""
    end = time.monotonic() + within_s
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.05)
    return path.exists()
