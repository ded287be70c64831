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
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any, Generic, TypeVar

from fgslam.core.errors import FgslamError
from fgslam.core.memory import ShortageTold

Argument = TypeVar("Argument")
Result = TypeVar("Result")

_POLL_S = 0.2
_GRACE_S = 0.7  # a command ends within two seconds, its workers before it
ONE_THREAD = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)
"""Variables that keep linear algebra on one thread in a process that is started with them at 1."""


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
    process: SpawnProcess
    connection: Connection
    single_threaded: bool
    index: int = -1  # of its argument


def worker_count(wanted: int | None, pieces: int) -> int:
    """How many workers this machine starts for so many pieces of work; None: one a core.

    Never more than there are pieces, or than four a core: those would cost memory alone.
    """
    cores = os.cpu_count() or 1
    return max(1, min(wanted or cores, pieces, 4 * cores))


class Workers:
    """Processes that wait for more work once theirs is done, until they are closed.

    Starting one takes a second of imports, as long as dozens of small units. One that crashes takes
    nothing along but its own work: the next piece gets a new process.
    """

    def __init__(self) -> None:
        """None yet."""
        self._idle: list[_Worker] = []

    def __enter__(self) -> Workers:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends those that wait."""
        idle, self._idle = self._idle, []
        for worker in idle:
            worker.connection.close()
        for worker in idle:
            _see_off(worker.process)

    def take(self, single_threaded: bool) -> _Worker:
        """One that waits with as many threads, else a new one."""
        for worker in self._idle:
            if worker.single_threaded == single_threaded and worker.process.is_alive():
                self._idle.remove(worker)
                return worker
        with _threads_limited(single_threaded):
            return _new_worker(single_threaded)

    def keep(self, worker: _Worker) -> None:
        """Takes one back whose result has been collected."""
        self._idle.append(worker)


def run_apart(
    function: Callable[[Argument], Result],
    arguments: Sequence[Argument],
    jobs: int = 1,
    stopped: Callable[[], bool] = lambda: False,
    single_threaded: bool = False,
    workers: Workers | None = None,
) -> Iterator[tuple[int, Result | WorkerEnded[Argument]]]:
    """Calls a function on each argument in another process.

    Args:
        function: of a module's top level; result and argument are handed over by multiprocessing.
        arguments: one at a time for a process.
        jobs: how many at a time, at most; see :func:`worker_count`.
        stopped: asked every moment; True ends the processes that run and starts no more.
        single_threaded: linear algebra on one thread a process.
        workers: processes to use and to leave behind; None: a new one for each argument.

    Yields:
        Index of the argument and its result, as they come.

    Raises:
        FgslamError: what the function raised in its process.
        MemoryShortageError: it ran out of memory there.
    """
    jobs = worker_count(jobs, len(arguments))
    waiting = list(enumerate(arguments))[::-1]
    source = workers or Workers()
    running: list[_Worker] = []
    try:
        while waiting or running:
            if stopped():
                break
            while waiting and len(running) < jobs:
                worker = source.take(single_threaded)
                running.append(worker)
                worker.index, argument = waiting.pop()
                _send(worker, function, argument)
            ready = wait([worker.connection for worker in running], _POLL_S)
            for worker in [w for w in running if w.connection in ready]:
                running.remove(worker)
                yield worker.index, _collect(worker, arguments[worker.index], workers)
    finally:
        for worker in running:
            worker.process.terminate()
        for worker in running:
            _see_off(worker.process)
    for worker in running:
        yield worker.index, WorkerEnded(arguments[worker.index], "interrupted")
    for index, argument in waiting[::-1]:
        yield index, WorkerEnded(argument, "interrupted before it began")


def _new_worker(single_threaded: bool) -> _Worker:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs,), daemon=True)
    with _without_main(), _deaf_to_ctrl_c():
        process.start()
    theirs.close()  # so that the end of the process is the end of the pipe
    return _Worker(process, ours, single_threaded)


def _send(worker: _Worker, function: Callable[[Argument], Result], argument: Argument) -> None:
    """The work is sent once the process runs: one that ends before it has read it breaks the pipe.

    Handed over as arguments of the process, work larger than the pipe's buffer would be waited for
    without end: multiprocessing keeps the reading end open while it writes.
    """

    def send() -> None:
        with suppress(OSError):  # _collect says how it ended
            worker.connection.send_bytes(work)

    work = ForkingPickler.dumps((function, argument))
    # In a thread, since a worker reads after its imports only and work may exceed the pipe's
    # buffer: who waited here would hear of no signal.
    threading.Thread(target=send, daemon=True).start()


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


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """A process that is started inside never hears Ctrl-C, which is the parent's to answer.

    Ignored by the worker itself it would be after its imports only. One that arrives inside reaches
    this process afterwards.
    """
    resource_tracker.ensure_running()  # its start would take the block away
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(connection: Connection) -> None:
    """In the worker: asked to end, it clears up first."""
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while (work := _received(connection)) is not None:
        function, argument = work
        try:
            with ShortageTold():
                connection.send(function(argument))
        except FgslamError as error:
            connection.send(error)


def _received(connection: Connection) -> tuple[Callable[[Any], Any], Any] | None:
    """The next piece of work; None where there will be none."""
    try:
        work: tuple[Callable[[Any], Any], Any] = connection.recv()
    except (EOFError, ConnectionResetError):
        return None
    return work


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


def _collect(
    worker: _Worker, argument: Argument, workers: Workers | None
) -> Result | WorkerEnded[Argument]:
    try:
        result: Result | FgslamError = worker.connection.recv()
    except (EOFError, ConnectionResetError):
        worker.process.join()
        return WorkerEnded(argument, _ending(worker.process.exitcode))
    if workers is not None:
        workers.keep(worker)
    else:
        worker.connection.close()
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
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
