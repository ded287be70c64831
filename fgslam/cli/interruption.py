"""Ends what is under way when the user says so, with everything saved that can be."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

Tell = Callable[[str, int, int], None]

_NOTHING_TO_SAVE = ("rendering", "reading", "matching")


@contextmanager
def stop_flag() -> Iterator[Callable[[], bool]]:
    """Turns the first Ctrl-C or TERM into a flag; the second Ctrl-C ends at once."""
    raised = ending = False

    def handle(number: int, frame: FrameType | None) -> None:
        nonlocal raised, ending
        if raised:
            ending = True
            # A third one would cut short the end of the threads, which aborts the process.
            for each in (signal.SIGINT, signal.SIGTERM):
                signal.signal(each, signal.SIG_IGN)
            raise KeyboardInterrupt
        raised = True

    before = {n: signal.signal(n, handle) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: raised
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
