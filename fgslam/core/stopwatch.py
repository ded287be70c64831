"""How long the stages of a frame take."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar, cast


class Stopwatch:
    """Milliseconds by stage, within one frame."""

    def __init__(self) -> None:
        """No stage yet."""
        self.ms: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the time that the block takes to a stage."""
        start = time.perf_counter()
        yield
        self.ms[name] = self.ms.get(name, 0.0) + 1e3 * (time.perf_counter() - start)


Method = TypeVar("Method", bound=Callable[..., Any])


def timed(stage: str) -> Callable[[Method], Method]:
    """Decorator of a method, whose time it adds to a stage of the object's ``watch_of_frame``."""

    def decorate(method: Method) -> Method:
        @functools.wraps(method)
        def run(self: Any, *arguments: Any) -> Any:
            with self.watch_of_frame.stage(stage):
                return method(self, *arguments)

        return cast("Method", run)

    return decorate
