"""Work in processes of its own: memory is each one's own, and a crash takes nothing else along."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import types
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Generic, TypeVar

from fgslam.core.errors import FgslamError

Argument = TypeVar("Argument")
Result = TypeVar("Result")

_POLL_S = 0.2
_GRACE_S = 3.0
_THREADS = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)


@dataclass(frozen=True, slots=True)
class WorkerEnded(Generic[Argument]):
    """A process that ended without a result.

    Attributes:
        argument: what it was given.
        why: in words.
    """

    argument: Argument
    why: str


@dataclass(slots=True)
class _Worker:
    index: int
    process: SpawnProcess
    connection: Connection


def run_apart(
    function: Callable[[Argument], Result],
    arguments: Sequence[Argument],
    jobs: int = 1,
    stopped: Callable[[], bool] = lambda: False,
    single_threaded: bool = False,
) -> Iterator[tuple[int, Result | WorkerEnded[Argument]]]:
    """Calls a function on each argument, each time in a new process.

    Args:
        function: of a module's top level; result and argument are handed over by multiprocessing.
        arguments: one a process.
        jobs: how many at a time.
        stopped: asked every moment; True ends the processes that run and starts no more.
        single_threaded: linear algebra on one thread a process.

    Yields:
        Index of the argument and its result, as they come.

    Raises:
        FgslamError: what the function raised in its process.
    """
    waiting = list(enumerate(arguments))[::-1]
    running: list[_Worker] = []
    try:
        while waiting or running:
            if stopped():
                break
            while waiting and len(running) < jobs:
                index, argument = waiting.pop()
                with _threads_limited(single_threaded):
                    running.append(_start(index, function, argument))
            ready = wait([worker.connection for worker in running], _POLL_S)
            for worker in [w for w in running if w.connection in ready]:
                running.remove(worker)
                yield worker.index, _collect(worker, arguments[worker.index])
    finally:
        for worker in running:
            worker.process.terminate()
        for worker in running:
            _see_off(worker.process)
    for worker in running:
        yield worker.index, WorkerEnded(arguments[worker.index], "interrupted")
    for index, argument in waiting[::-1]:
        yield index, WorkerEnded(argument, "interrupted before it began")


def _start(index: int, function: Callable[[Argument], Result], argument: Argument) -> _Worker:
    """The work is sent once the process runs: one that ends before it has read it breaks the pipe.

    Handed over as arguments of the process, work larger than the pipe's buffer would be waited for
    without end: multiprocessing keeps the reading end open while it writes.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs,), daemon=True)
    with _without_main():
        process.start()
    theirs.close()  # so that the end of the process is the end of the pipe
    try:
        with suppress(BrokenPipeError, ConnectionResetError):  # _collect says how it ended
            ours.send((function, argument))
    except BaseException:  # what cannot be handed over is the caller's mistake
        process.kill()
        process.join()
        raise
    return _Worker(index, process, ours)


@contextmanager
def _without_main() -> Iterator[None]:
    """A worker runs functions of this package only: the caller's script is not run again in it.

    multiprocessing would, and a script without a guard on its name would begin its run anew there.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def _work(connection: Connection) -> None:
    """In the worker: Ctrl-C is the parent's to answer; asked to end, it clears up first."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    function, argument = connection.recv()
    try:
        connection.send(function(argument))
    except FgslamError as error:
        connection.send(error)


def _end_with_parent() -> None:
    """In the worker: a parent that was killed cannot ask it to end, and nobody else would.

    A worker that went on would write into the run folder beside the run that was resumed there.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)


def _see_off(process: SpawnProcess) -> None:
    """Waits for a process that was asked to end; one that is deep in a solver is killed."""
    process.join(_GRACE_S)
    if process.is_alive():
        process.kill()
        process.join()


def _collect(worker: _Worker, argument: Argument) -> Result | WorkerEnded[Argument]:
    try:
        result: Result | FgslamError = worker.connection.recv()
    except (EOFError, ConnectionResetError):
        worker.process.join()
        return WorkerEnded(argument, _ending(worker.process.exitcode))
    worker.process.join()
    if isinstance(result, FgslamError):
        raise result
    return result


def _ending(code: int | None) -> str:
    if code is None or code >= 0:
        return f"its process ended with status {code}, see above"
    name = signal.Signals(-code).name
    hint = ", perhaps for lack of memory" if name == "SIGKILL" else ""
    return f"its process was ended by {name}{hint}"


@contextmanager
def _threads_limited(limited: bool) -> Iterator[None]:
    """The environment for a child's start: its libraries read it when they are loaded."""
    if not limited:
        yield
        return
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
