"""Executors: units of work in this process, on workers of this machine, or of any Dask scheduler.

Dask hands units out, notices workers that come and go, and gives what a lost one had to another.
What is decided here: how many units are pending, what is tried again and where, and how all of it
ends within a moment.
"""

from __future__ import annotations

import json
import logging
import os
import queue
import signal
import sys
import tempfile
import time
import types
import uuid
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from fgslam.core.errors import ConfigError, FgslamError, OutputError
from fgslam.core.memory import ShortageTold

if TYPE_CHECKING:
    from distributed import Client, Future, LocalCluster

Argument = TypeVar("Argument")
Result = TypeVar("Result")

NOT_BEGUN = "interrupted before it began"

_POLL_S = 0.1
_WORKERS_ASKED_S = 1.0
_RESULT_S = 2.0  # a result whose worker has just gone is computed again: not waited for
_CONNECT_S = 10.0
_START_S = 120.0  # a worker of this machine needs a few seconds, where there is memory for it
_LEAST_PENDING = 64  # so that a scheduler without workers sees that some are wanted
_PENDING_A_THREAD = 4
_HOST = "127.0.0.1"
_SILENT = logging.CRITICAL + 1
_LOST = object()
"""In place of an outcome: there is none, and the unit is submitted again."""


@dataclass(frozen=True, slots=True)
class Failed:
    """In place of a result: why there is none, in words.

    A function that returns it is tried once more on another worker, if there is one.
    """

    why: str


class Executor:
    """Calls a function on arguments, here in this process; one that has begun is done.

    Attributes:
        lost: whether all workers have gone for good, and with them what was pending.
    """

    lost = False

    def run(
        self,
        function: Callable[[Argument], Result],
        arguments: Sequence[Argument],
        stopped: Callable[[], bool],
        fresh: bool = False,
    ) -> Iterator[tuple[int, Result | Failed]]:
        """Index of each argument and its result, as they come; each index once.

        Args:
            function: of a module's top level.
            arguments: read one at a time, some ahead of the results.
            stopped: asked every moment; True ends what is pending and begins no more.
            fresh: each in a process that has done nothing before, of which memory is measured;
                means nothing where there are no workers.

        Raises:
            FgslamError: what the function raised.
        """
        del fresh
        for index, argument in enumerate(arguments):
            yield index, Failed(NOT_BEGUN) if stopped() else function(argument)


class Pool(Executor):
    """Workers of Dask, while its context lasts.

    Those of this machine are processes of one thread each, which begin with the first work and end
    with this process; one that crashes is replaced, and no Ctrl-C reaches them.
    """

    def __init__(self, jobs: int | None = None, scheduler: str | None = None) -> None:
        """Workers of a scheduler, or so many of this machine.

        Args:
            jobs: most workers of this machine; None: one a core. There are never more than units,
                or than four a core: those would cost memory alone.
            scheduler: its address, `tcp://host:8786` or `tls://...`; or the file that
                `dask scheduler --scheduler-file` wrote.

        Raises:
            ConfigError: both are given, or there would be no worker.
        """
        if jobs is not None and jobs < 1:
            raise ConfigError(f"jobs is {jobs}; give at least 1, or none for one a core")
        if jobs is not None and scheduler is not None:
            raise ConfigError(
                "--jobs is for workers of this machine; leave it out with --scheduler"
            )
        self._jobs, self._scheduler = jobs, scheduler
        self._stack = ExitStack()
        self._client: Client | None = None
        self._cluster: LocalCluster | None = None

    def __enter__(self) -> Pool:
        """Raises ConfigError where no such scheduler answers."""
        if self._scheduler is not None:
            self._stack.enter_context(_quiet())
            self._client = _client_at(self._scheduler)
            self._stack.callback(_close, self._client)
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()
        self._client = self._cluster = None

    def run(
        self,
        function: Callable[[Argument], Result],
        arguments: Sequence[Argument],
        stopped: Callable[[], bool],
        fresh: bool = False,
    ) -> Iterator[tuple[int, Result | Failed]]:
        """As :meth:`Executor.run`; the context has been entered.

        What raises another error than a FgslamError, or ends its worker, is tried once more.
        """
        if not len(arguments):
            return
        client = self._client_for(len(arguments))
        if fresh:
            client.restart_workers(list(client.nthreads()), raise_for_error=False)
        units, seen = _Units(client, function, arguments, fresh), time.monotonic()
        try:
            while units.left and not stopped():
                if client.status in ("closing", "closed"):
                    self.lost = True
                    break
                units.submit()
                yield from units.completed()
                if units.workers or self._cluster is None:
                    seen = time.monotonic()
                elif time.monotonic() - seen > _START_S:
                    raise OutputError("no worker can be started; free some memory")
        finally:
            units.cancel()
        for index in units.left:
            yield index, Failed(NOT_BEGUN)

    def _client_for(self, count: int) -> Client:
        """The client; of this machine, with workers for so many units."""
        if self._scheduler is None:
            if self._cluster is None:
                self._cluster = self._stack.enter_context(_local_cluster())
                self._client = self._cluster.get_client()
                self._stack.callback(_close, self._client)
            cores = os.cpu_count() or 1
            wanted = max(1, min(self._jobs or cores, count, 4 * cores))
            self._cluster.scale(max(wanted, len(self._cluster.worker_spec)))
        assert self._client is not None  # noqa: S101 - the context has been entered
        return self._client


class _Units:
    """Units that wait, that are pending at the scheduler, and that have come back."""

    def __init__(
        self, client: Client, function: Callable[[Any], Any], arguments: Sequence[Any], fresh: bool
    ) -> None:
        self._client, self._function, self._arguments = client, function, arguments
        self._fresh = fresh
        self._waiting = deque(range(len(arguments)))
        self._pending: dict[str, tuple[Future, int, list[str]]] = {}
        self._done: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self._failed_at: dict[int, str] = {}
        self._asked = -_WORKERS_ASKED_S
        self.workers: dict[str, int] = {}
        """Threads of each worker by its address, as last heard."""

    @property
    def left(self) -> list[int]:
        """Indices of what has not come back."""
        return sorted([*self._waiting, *(index for _, index, _ in self._pending.values())])

    def submit(self) -> None:
        """Hands out as much as keeps all workers busy; of fresh units one a worker."""
        if self._client.status != "running":  # it reconnects, or is closed soon
            return
        if time.monotonic() - self._asked > _WORKERS_ASKED_S:
            with suppress(OSError, TimeoutError):
                self.workers = self._client.nthreads()
            self._asked = time.monotonic()
        most = max(_LEAST_PENDING, _PENDING_A_THREAD * sum(self.workers.values()))
        while self._waiting and len(self._pending) < (len(self.workers) if self._fresh else most):
            index = self._waiting.popleft()
            wanted: list[str] = []
            if self._fresh:
                taken = {address for _, _, own in self._pending.values() for address in own}
                wanted = [address for address in self.workers if address not in taken][:1]
            elif index in self._failed_at:
                wanted = [one for one in self.workers if one != self._failed_at[index]]
            future = self._client.submit(
                _call,
                self._function,
                self._arguments[index],
                key=f"fgslam-{uuid.uuid4().hex}",
                pure=False,
                retries=1,
                workers=wanted or None,
                allow_other_workers=bool(wanted),
            )
            self._pending[future.key] = future, index, wanted
            future.add_done_callback(self._done.put)

    def completed(self) -> Iterator[tuple[int, Any]]:
        """What has come back, after a moment's wait if nothing has."""
        try:
            future = self._done.get(timeout=_POLL_S)
        except queue.Empty:
            return
        address, outcome = "", _LOST  # cancelled: by a scheduler that has gone, or began again
        if future.status == "error":
            outcome = _ended(future.exception())
        elif future.status == "finished":
            try:
                address, outcome = future.result(timeout=_RESULT_S)
            except (TimeoutError, OSError):  # its worker has gone with it
                future.add_done_callback(self._done.put)
                return
        _, index, _ = self._pending.pop(future.key)
        if outcome is _LOST:
            self._waiting.append(index)
            return
        others = any(one != address for one in self.workers)
        if isinstance(outcome, Failed) and address and others and index not in self._failed_at:
            self._failed_at[index] = address
            self._waiting.appendleft(index)
            return
        if self._fresh and self._waiting and address:
            self._client.restart_workers([address], raise_for_error=False)
            self._asked = -_WORKERS_ASKED_S
        yield index, outcome

    def cancel(self) -> None:
        """Ends what is pending."""
        with suppress(OSError, RuntimeError):
            if self._client.status == "running" and self._pending:
                self._client.cancel([future for future, _, _ in self._pending.values()])


def _call(function: Callable[[Argument], Result], argument: Argument) -> tuple[str, Result]:
    """On a worker: its address, and the function's result. Raises what the function raises."""
    from distributed import get_worker

    with ShortageTold():
        return get_worker().address, function(argument)


def _ended(error: BaseException | None) -> Failed:
    """Why a unit gave no result. Raises what the function raised of FgslamError."""
    from distributed.scheduler import KilledWorker

    if isinstance(error, FgslamError):
        raise error
    if isinstance(error, KilledWorker):
        return Failed("it ended its workers, perhaps for lack of memory")
    return Failed(f"{type(error).__name__}: {' '.join(str(error).split())}")


# --------------------------------------------------------------------------------------------
# Where the workers are


def _client_at(scheduler: str) -> Client:
    """A client of a scheduler that runs already. Raises ConfigError where none answers."""
    from distributed import Client
    from distributed.comm import get_address_host_port

    try:
        address = scheduler
        if scheduler.endswith(".json"):
            address = str(json.loads(Path(scheduler).read_text(encoding="utf-8"))["address"])
        get_address_host_port(address)  # one without a port would be asked at a default one
        return Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError, TypeError, KeyError) as error:
        words = " ".join(str(error).split())[:200]
        raise ConfigError(
            f"--scheduler {scheduler}: no Dask scheduler answers there ({words}); start one by "
            "`dask scheduler`, and give the address that it prints"
        ) from None


@contextmanager
def _local_cluster() -> Iterator[LocalCluster]:
    """A scheduler of this machine alone, that starts processes as it is scaled up."""
    import dask
    from distributed import LocalCluster
    from distributed.security import Security

    main = sys.modules["__main__"]
    with ExitStack() as stack:
        stack.enter_context(_quiet())
        prefix = "fgslam-workers-"
        folder = stack.enter_context(
            tempfile.TemporaryDirectory(prefix=prefix, ignore_cleanup_errors=True)
        )
        threads = ("OMP", "OPENBLAS", "MKL", "NUMEXPR")
        environment = {"TMPDIR": folder} | {f"{library}_NUM_THREADS": 1 for library in threads}
        for name in environment:  # Dask sets them in this process, and leaves them there
            stack.callback(_set_variable, name, os.environ.get(name))
        rules = {
            "distributed.nanny.pre-spawn-environ": environment,
            # A unit waits at the scheduler, not behind one that may end the worker.
            "distributed.scheduler.worker-saturation": 1.0,
            "distributed.scheduler.allowed-failures": 1,
            # One that is restarted would be dropped if it was away 15 s after an earlier restart.
            "distributed.deploy.lost-worker-timeout": "1 day",
            "distributed.worker.profile.enabled": False,  # 100 samples a second
            "distributed.admin.large-graph-warning-threshold": "100GB",
        }
        stack.enter_context(dask.config.set(rules))
        # Workers run functions of this package only. multiprocessing would run the caller's script
        # again in them, and one without a guard on its name would begin again there.
        stack.callback(sys.modules.__setitem__, "__main__", main)
        sys.modules["__main__"] = types.ModuleType("__main__")
        # Who is started inside never hears Ctrl-C, which is this process's to answer; the thread
        # that starts workers hands that down. The tracker's own start would take it away.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            cluster = LocalCluster(
                n_workers=0,
                threads_per_worker=1,  # more would share memory and the limit of BLAS
                host=_HOST,
                security=Security.temporary(),  # other users of this machine reach it, too
                dashboard_address=f"{_HOST}:0",
                memory_limit=0,
                local_directory=folder,
                silence_logs=_SILENT,
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        stack.callback(cluster.close)
        stack.callback(_kill_workers, cluster)
        yield cluster


def _set_variable(name: str, value: str | None) -> None:
    os.environ.pop(name, None)
    if value is not None:
        os.environ[name] = value


def _kill_workers(cluster: LocalCluster) -> None:
    """At once: what they hold is kept elsewhere, or done again."""
    for nanny in list(cluster.workers.values()):
        nanny.auto_restart = False
        if nanny.pid is not None:
            with suppress(ProcessLookupError):
                os.kill(nanny.pid, signal.SIGKILL)


def _close(client: Client) -> None:
    with suppress(OSError, TimeoutError):
        client.close(timeout=1)


@contextmanager
def _quiet() -> Iterator[None]:
    """Dask reports every worker that comes and goes; what matters is in its results."""
    loggers = [logging.getLogger(name) for name in ("distributed", "asyncio", "tornado")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(_SILENT)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)
