"""Who does the pieces of work of a run: one seam over this process and workers anywhere."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeVar

from fgslam.runs.processes import WorkerEnded

Argument = TypeVar("Argument")
Result = TypeVar("Result")

NOT_BEGUN = "interrupted before it began"


@dataclass(frozen=True, slots=True)
class Failed:
    """Returned by a piece of work that failed and may succeed on another worker.

    Attributes:
        why: in words.
        worker: address of the worker it failed on; empty where there is only this process.
    """

    why: str
    worker: str = ""


class Crew(Protocol):
    """Calls a function on arguments, wherever."""

    @property
    def lost(self) -> bool:
        """Whether all its workers have gone for good, and with them what was under way."""
        ...

    def do(
        self,
        function: Callable[[Argument], Result],
        arguments: Sequence[Argument],
        stopped: Callable[[], bool],
    ) -> Iterator[tuple[int, Result | WorkerEnded[Argument]]]:
        """Index of each argument and its result, as they come; each index once.

        Args:
            function: of a module's top level.
            arguments: read one at a time, some ahead of the results.
            stopped: asked every moment; True ends what is under way and begins no more.

        Raises:
            FgslamError: what the function raised.
        """
        ...


class Here:
    """A crew of this process alone: one argument after the other."""

    lost = False

    def do(
        self,
        function: Callable[[Argument], Result],
        arguments: Sequence[Argument],
        stopped: Callable[[], bool],
    ) -> Iterator[tuple[int, Result | WorkerEnded[Argument]]]:
        """As :meth:`Crew.do`; a piece that has begun is finished."""
        for index in range(len(arguments)):
            argument = arguments[index]
            yield index, WorkerEnded(argument, NOT_BEGUN) if stopped() else function(argument)
