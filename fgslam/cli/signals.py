"""Ctrl-C and SIGTERM: every command ends within two seconds, from its first moment on.

The first signal asks what is under way to end by itself, which keeps all that was done. What has
not ended after :data:`WITHIN_S` is ended from outside: every file is written whole or not at all,
and a run goes on from its last save. The exit status is 128 and the signal's number, as a shell
reports a process that the signal ended.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

WITHIN_S = 1.3
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_SHOW_CURSOR = b"\x1b[?25h"  # a progress bar hides it

_NOTHING_TO_SAVE = ("rendering", "reading", "matching")

Tell = Callable[[str, int, int], None]
"""Told what is under way, how much is done, and of how much."""

_received: list[int] = []
"""Numbers of the signals of this command, in their order."""


def status() -> int:
    """Exit status of a command that was asked to end."""
    return 128 + (_received[0] if _received else signal.SIGINT)


def was_asked() -> bool:
    """Whether the command was asked to end."""
    return bool(_received)


def forget() -> None:
    """A new command begins."""
    _received.clear()


def watch() -> None:
    """Answers signals from now on, for the process of one command."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    # Written to at once, whatever the main thread is at: handlers in Python wait for its next step.
    signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    for number in _answered():
        signal.signal(number, _end_now)
    threading.Thread(target=_end_late, args=(reader,), daemon=True).start()


def _answered() -> list[signal.Signals]:
    """Those that the process does not ignore: who starts it under nohup wants it to go on."""
    return [number for number in _SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]


def _end_now(number: int, frame: FrameType | None) -> None:
    """While nothing is under way there is nothing to keep."""
    _received.append(number)
    _ignore_further()
    raise KeyboardInterrupt


def nothing_to_end() -> None:
    """The command has ended: a signal changes nothing, but for who does not end by himself."""
    for number in _answered():
        signal.signal(number, _pass_over)


def _pass_over(number: int, frame: FrameType | None) -> None:
    """A handler, so that the watching thread still hears of the signal."""


class OtherErrors:
    """What a library makes of an interruption is one: pydantic a wrong schema of the settings.

    Around the whole command line, which has answered its own errors before.
    """

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, *error: object) -> None:
        if kind is not None and issubclass(kind, Exception) and was_asked():
            raise KeyboardInterrupt from None


def _ignore_further() -> None:
    """A further signal would cut short the end of the threads, which aborts the process."""
    for each in _SIGNALS:
        signal.signal(each, signal.SIG_IGN)


def _end_late(reader: int) -> None:
    """In a thread: ends the process with its workers when it has not ended by itself."""
    while (number := os.read(reader, 1)[0]) not in _SIGNALS:
        pass
    time.sleep(WITHIN_S)
    cursor = _SHOW_CURSOR if os.isatty(2) else b""
    os.write(2, cursor + b"fgslam: interrupted; what was saved until then is in valid files\n")
    _leave(128 + number)


def end() -> None:
    """Ends the process that was asked to, all that was to be kept being kept.

    By itself the interpreter might report SIGINT whatever the signal was, and waits for threads.
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    _leave(status())


def _leave(code: int) -> None:
    workers = sys.modules.get("multiprocessing.process")
    for process in workers.active_children() if workers else ():
        process.kill()
    os._exit(code)


@contextmanager
def stop_flag() -> Iterator[Callable[[], bool]]:
    """Turns the first Ctrl-C or TERM into a flag; the second one ends at once."""
    forget()
    ending = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal ending
        _received.append(number)
        if len(_received) > 1:
            ending = True
            _ignore_further()
            raise KeyboardInterrupt

    before = {n: signal.signal(n, handle) for n in _answered()}
    try:
        yield was_asked
    finally:
        if not ending:
            for number, handler in before.items():
                signal.signal(number, handler)


def stoppable(progress: Tell, stopped: Callable[[], bool]) -> Tell:
    """While frames are rendered there is nothing to save yet: stopping just ends it."""

    def tell(what: str, done: int, total: int) -> None:
        if what in _NOTHING_TO_SAVE and stopped():
            raise KeyboardInterrupt
        progress(what, done, total)

    return tell
