"""Workers of Dask distributed: on this machine, or those of any scheduler.

Dask hands pieces of work out, notices workers that come and go, and gives what a lost one had to
another. What is decided here: how many pieces are under way, what is tried again and where, and
how all of it ends within a moment.
"""

from __future__ import annotations

import json
import logging
import os
import queue
import subprocess
import sys
import tempfile
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from fgslam.core.errors import ConfigError, FgslamError, OutputError
from fgslam.runs.crews import NOT_BEGUN, Failed
from fgslam.runs.processes import ONE_THREAD, WorkerEnded

if TYPE_CHECKING:
    from distributed import Client, Future

Argument = TypeVar("Argument")
Result = TypeVar("Result")

_POLL_S = 0.1
_WORKERS_ASKED_S = 1.0
_RESULT_S = 2.0  # a result whose worker has just gone is computed again: not waited for
_CONNECT_S = 10.0
_LEAST_UNDER_WAY = 64  # so that a scheduler without workers sees that some are wanted
_UNDER_WAY_A_THREAD = 4
_HOST = "127.0.0.1"
_SHORT_LIFE_S = 5.0
_SHORT_LIVES = 5
_NOTHING = object()
"""In place of a result: there is none."""


class DaskCrew:
    """Workers of a scheduler that a client is connected to.

    Attributes:
        lost: the scheduler has gone, and with it what was under way.
    """

    def __init__(self, client: Client, keep: Callable[[], None] = lambda: None) -> None:
        """``keep`` is called every moment."""
        self._client, self._keep = client, keep
        self.lost = False

    def do(
        self,
        function: Callable[[Argument], Result],
        arguments: Sequence[Argument],
        stopped: Callable[[], bool],
    ) -> Iterator[tuple[int, Result | WorkerEnded[Argument]]]:
        """As :meth:`fgslam.runs.crews.Crew.do`.

        What returns :class:`~fgslam.runs.crews.Failed` is tried once more, on another worker, where
        there is one; what raises another error than a FgslamError, or ends its worker, once more
        anywhere.
        """
        flight = _Flight(self._client, function, arguments)
        try:
            while flight.under_way and not stopped():
                self._keep()
                if self._client.status in ("closing", "closed"):
                    self.lost = True
                    break
                flight.fill()
                for index, result in flight.landed():
                    yield index, result
        finally:
            flight.cancel()
        for index in flight.left:
            yield index, WorkerEnded(arguments[index], NOT_BEGUN)


class _Flight:
    """Pieces of work that wait, that are under way, and that have landed."""

    def __init__(
        self, client: Client, function: Callable[[Any], Any], arguments: Sequence[Any]
    ) -> None:
        self._client, self._function, self._arguments = client, function, arguments
        self._waiting = deque((index, "") for index in range(len(arguments)))
        self._flying: dict[str, tuple[Future, int]] = {}
        self._done: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._again: set[int] = set()
        self._workers: dict[str, int] = {}
        self._asked = -_WORKERS_ASKED_S

    @property
    def under_way(self) -> bool:
        """Whether anything is left to come."""
        return bool(self._waiting or self._flying)

    @property
    def left(self) -> list[int]:
        """Indices of what has not landed."""
        return sorted([*(i for i, _ in self._waiting), *(i for _, i in self._flying.values())])

    def fill(self) -> None:
        """Hands out as much as keeps all workers busy."""
        if self._client.status != "running":  # it reconnects, or gives up
            return
        if time.monotonic() - self._asked > _WORKERS_ASKED_S:
            with suppress(OSError, TimeoutError):
                self._workers = self._client.nthreads()
            self._asked = time.monotonic()
        room = max(_LEAST_UNDER_WAY, _UNDER_WAY_A_THREAD * sum(self._workers.values()))
        while self._waiting and len(self._flying) < room:
            self._submit(*self._waiting.popleft())

    def _submit(self, index: int, avoided: str) -> None:
        others = [worker for worker in self._workers if worker != avoided] if avoided else []
        future = self._client.submit(
            self._function,
            self._arguments[index],
            key=f"fgslam-{uuid.uuid4().hex}",
            pure=False,
            retries=1,
            workers=others or None,
            allow_other_workers=bool(others),
        )
        self._flying[future.key] = future, index
        future.add_done_callback(self._done.put)

    def landed(self) -> Iterator[tuple[int, Any]]:
        """What has come in, after a moment's wait where nothing has."""
        with suppress(queue.Empty):
            found = self._taken(self._done.get(timeout=_POLL_S))
            if found is not None:
                yield found

    def _taken(self, future: Future) -> tuple[int, Any] | None:
        """Index and result; None where it is tried again."""
        _, index = self._flying[future.key]
        result: Any = _NOTHING  # cancelled: by a scheduler that has gone, or began anew
        if future.status == "error":
            result = _ended(self._arguments[index], future.exception())
        elif future.status == "finished":
            try:
                result = future.result(timeout=_RESULT_S)
            except (TimeoutError, OSError):  # its worker has gone with it
                future.add_done_callback(self._done.put)
                return None
        del self._flying[future.key]
        if result is _NOTHING:
            self._waiting.append((index, ""))
            return None
        if self._deserves_another(index, result):
            self._again.add(index)
            self._waiting.appendleft((index, result.worker))
            return None
        return index, result

    def _deserves_another(self, index: int, result: Any) -> bool:
        if not isinstance(result, Failed) or index in self._again:
            return False
        return any(worker != result.worker for worker in self._workers)

    def cancel(self) -> None:
        """Ends what is under way."""
        with suppress(OSError, RuntimeError):
            if self._client.status == "running" and self._flying:
                self._client.cancel([future for future, _ in self._flying.values()])


def _ended(argument: Any, error: BaseException | None) -> WorkerEnded[Any]:
    """Why a piece gave no result. Raises what the function raised of FgslamError."""
    from distributed.scheduler import KilledWorker

    if isinstance(error, FgslamError):
        raise error
    if isinstance(error, KilledWorker):
        return WorkerEnded(argument, "it ended its workers, perhaps for lack of memory")
    words = " ".join(str(error).split())
    return WorkerEnded(argument, f"{type(error).__name__}: {words}")


# --------------------------------------------------------------------------------------------
# Where the workers are


@contextmanager
def crew_at(scheduler: str) -> Iterator[DaskCrew]:
    """The workers of a scheduler that runs already.

    Args:
        scheduler: its address, `tcp://host:8786` or `tls://...`; or the file that
            `dask scheduler --scheduler-file` wrote.

    Raises:
        ConfigError: there is none.
    """
    from distributed import Client

    with ExitStack() as stack:
        stack.enter_context(_quiet())
        try:
            client = Client(_address(scheduler), timeout=_CONNECT_S, set_as_default=False)
        except (OSError, TimeoutError, ValueError, TypeError, KeyError) as error:
            words = " ".join(str(error).split())[:200]
            raise ConfigError(
                f"--scheduler {scheduler}: no Dask scheduler answers there ({words}); start one by "
                "`dask scheduler`, and give the address that it prints"
            ) from None
        stack.callback(_close, client)
        yield DaskCrew(client)


def _address(scheduler: str) -> str:
    """An address with a port. Raises OSError, ValueError, TypeError or KeyError for none."""
    from distributed.comm import get_address_host_port

    if scheduler.endswith(".json"):
        scheduler = str(json.loads(Path(scheduler).read_text(encoding="utf-8"))["address"])
    get_address_host_port(scheduler)
    return scheduler


class LocalCrew:
    """Processes of this machine with one thread each, which end with this process.

    They start when the crew is entered, so that they load what they need while the work is laid
    out; the scheduler, which listens on this machine's own address only, with the first work. A
    worker that crashes is replaced. Workers get no Ctrl-C.
    """

    lost = False

    def __init__(self, jobs: int) -> None:
        self._jobs, self._workers = jobs, _LocalWorkers()
        self._stack = ExitStack()
        self._crew: DaskCrew | None = None

    def __enter__(self) -> LocalCrew:
        with ExitStack() as stack:
            folder = stack.enter_context(
                tempfile.TemporaryDirectory(prefix="fgslam-workers-", ignore_cleanup_errors=True)
            )
            stack.callback(self._workers.close)
            self._workers.start(self._jobs, folder)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def do(
        self,
        function: Callable[[Argument], Result],
        arguments: Sequence[Argument],
        stopped: Callable[[], bool],
    ) -> Iterator[tuple[int, Result | WorkerEnded[Argument]]]:
        """As :meth:`DaskCrew.do`; the crew has been entered."""
        if self._crew is None:
            self._crew = self._stack.enter_context(_local_crew(self._workers))
        return self._crew.do(function, arguments, stopped)


@contextmanager
def _local_crew(workers: _LocalWorkers) -> Iterator[DaskCrew]:
    import dask
    from distributed import Client, LocalCluster

    # A piece waits at the scheduler, not behind one that may end the worker.
    rules = {
        "distributed.scheduler.worker-saturation": 1.0,
        "distributed.scheduler.allowed-failures": 1,
    }
    with ExitStack() as stack:
        stack.enter_context(_quiet())
        stack.enter_context(dask.config.set(rules))
        cluster = LocalCluster(n_workers=0, host=_HOST, dashboard_address=f"{_HOST}:0")
        stack.callback(cluster.close)
        client = Client(cluster, set_as_default=False)
        stack.callback(_close, client)
        stack.callback(workers.close)
        workers.work_for(cluster.scheduler_address)
        yield DaskCrew(client, workers.keep)


class _LocalWorkers:
    """Processes of :mod:`fgslam.runs.dask_worker`."""

    def __init__(self) -> None:
        self._folder, self._scheduler = "", ""
        self._workers: list[tuple[subprocess.Popen[bytes], float]] = []
        self._short_lives = 0

    def start(self, count: int, folder: str) -> None:
        """Starts so many, which load what they need and wait; ``folder`` is theirs."""
        self._folder = folder
        for _ in range(count):
            self._workers.append(self._new())

    def work_for(self, scheduler: str) -> None:
        """Tells them the address they have waited for, and those that will replace them."""
        self._scheduler = scheduler
        for process, _ in self._workers:
            self._tell(process)

    def _new(self) -> tuple[subprocess.Popen[bytes], float]:
        own = {
            "PYTHONPATH": os.pathsep.join(sys.path),
            "TMPDIR": self._folder,
            "DASK_LOGGING__DISTRIBUTED": "critical",
            "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "false",  # 100 looks a second
        }
        process = subprocess.Popen(  # noqa: S603 - a module of this package
            [sys.executable, "-m", "fgslam.runs.dask_worker", self._folder],
            env=os.environ | dict.fromkeys(ONE_THREAD, "1") | own,
            stdin=subprocess.PIPE,
            bufsize=0,  # what an ended worker did not read is not tried again
            start_new_session=True,  # Ctrl-C is this process's to answer
        )
        if self._scheduler:
            self._tell(process)
        return process, time.monotonic()

    def _tell(self, process: subprocess.Popen[bytes]) -> None:
        if process.stdin is not None:
            with suppress(BrokenPipeError):  # it has ended, and is replaced
                process.stdin.write(f"{self._scheduler}\n".encode())

    def keep(self) -> None:
        """Replaces those that have ended. Raises OutputError where none can be started."""
        for k, (process, born) in enumerate(self._workers):
            if process.poll() is None:
                continue
            short = time.monotonic() - born < _SHORT_LIFE_S
            self._short_lives = self._short_lives + 1 if short else 0
            if self._short_lives > _SHORT_LIVES * len(self._workers):
                raise OutputError(
                    f"workers cannot be started (the last one ended with status "
                    f"{process.returncode}, see above); try --jobs 1, or free some memory"
                )
            _drop(process)
            self._workers[k] = self._new()

    def close(self) -> None:
        """Ends all at once: what they hold is kept elsewhere, or done again."""
        for process, _ in self._workers:
            process.kill()
        while self._workers:
            _drop(self._workers.pop()[0])


def _drop(process: subprocess.Popen[bytes]) -> None:
    process.wait()
    if process.stdin is not None:
        process.stdin.close()


def _close(client: Client) -> None:
    with suppress(OSError, TimeoutError):
        client.close(timeout=1)


@contextmanager
def _quiet() -> Iterator[None]:
    """Dask tells of every worker that comes and goes; what matters is told by its results."""
    loggers = [logging.getLogger(name) for name in ("distributed", "asyncio", "tornado")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)
