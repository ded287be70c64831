"""Entry point of the program: signals are answered before anything else is imported."""

from __future__ import annotations

import signal

# Until they are answered Ctrl-C ends the process at once, without the interpreter's traceback;
# who ignores it, as a worker does, goes on to.
if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import atexit
import os
import sys

from fgslam.cli import signals
from fgslam.core.memory import limit_bytes

_LEAST_MEMORY = 1_200_000_000
"""Bytes of address space. Below it libraries crash at import, and OpenBLAS tries without end to get
the memory of its first call."""
_TIGHT_MEMORY = 8_000_000_000
_THREADS_OF_CORE = 120_000_000
"""Bytes of address space: the threads of one core take 40 MB in each of three libraries, so that
they crash on machines of many cores. A limit above 8 GB that leaves threads less than half of it
needs no such saving, and keeps the speed of all cores."""
_SINGLE = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")

_ended_with: list[int] = []
"""Status of the command, once it has one."""


def main() -> None:
    """The command line; as :func:`fgslam.cli.main.main`."""
    # Registered before any library is imported, it is called after all that these register.
    atexit.register(_leave)
    _open_closed_streams()
    try:
        with signals.OtherErrors():
            signals.watch()
            require_memory()
            _require_current_folder()
            from fgslam.cli.main import main as command

            command()
    except KeyboardInterrupt:
        print("fgslam: interrupted", file=sys.stderr)
        signals.end()
    except SystemExit as ended:
        if signals.was_asked() and ended.code == signals.status():
            signals.end()
        signals.nothing_to_end()
        _flush()
        if ended.code is None or isinstance(ended.code, int):
            _ended_with.append(ended.code or 0)
        raise


def _open_closed_streams() -> None:
    """Standard streams that were closed lead nowhere.

    A file that is opened would take their number, and get what libraries write to them.
    """
    for number, name, mode in ((0, "stdin", "r"), (1, "stdout", "w"), (2, "stderr", "w")):
        if getattr(sys, name) is None:
            file = os.open(os.devnull, os.O_RDWR)
            os.dup2(file, number)
            if file != number:
                os.close(file)
            setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115


def _leave() -> None:
    """Ends the process when all that was to be cleared up has been.

    The interpreter would free every object that it holds, for half a second in which no signal is
    answered.
    """
    if _ended_with:
        _flush()
        os._exit(_ended_with[0])


def require_memory() -> None:
    """Ends with a line where the system's limit is below what the libraries take by themselves."""
    limit = limit_bytes()
    if limit is None:
        return
    if limit < max(_TIGHT_MEMORY, 2 * _THREADS_OF_CORE * (os.cpu_count() or 1)):
        for name in _SINGLE:
            os.environ.setdefault(name, "1")
    if limit < _LEAST_MEMORY:
        print(
            f"fgslam: the memory limit of {limit / 1e6:.0f} MB (ulimit -v) is below the "
            f"{_LEAST_MEMORY / 1e6:.0f} MB that the libraries need; raise it",
            file=sys.stderr,
        )
        raise SystemExit(2)


def _require_current_folder() -> None:
    """Ends with a line where the folder that this was called in has been deleted."""
    try:
        os.getcwd()
    except FileNotFoundError:
        print(
            "fgslam: the current folder has been deleted, or made again; change to one that "
            "exists: cd FOLDER",
            file=sys.stderr,
        )
        raise SystemExit(2) from None


def _flush() -> None:
    """Says now what could not be written: the interpreter would with a traceback."""
    try:
        sys.stdout.flush()
    except OSError as error:
        if not isinstance(error, BrokenPipeError):
            print(f"fgslam: standard output: {error.strerror}", file=sys.stderr)
        os._exit(1)
