"""Following a path: a chain of homings, one target image after another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

from fgslam.core.arrays import ByteArray
from fgslam.core.errors import ConfigError
from fgslam.core.homing import OmniFeatures
from fgslam.homing.active_homing import EstimatorMaker
from fgslam.homing.command import Command, HomingState
from fgslam.homing.controller import HomingController
from fgslam.homing.front_end import HomingFrontEnd
from fgslam.homing.settings import HomingControlSettings

LegResult: TypeAlias = Literal["arrived", "skipped", "refused", "unfinished"]

_MAX_SKIPS = 1  # targets left out one after another, at most


@dataclass(frozen=True, slots=True)
class LegOutcome:
    """How one leg ended.

    Attributes:
        target: number of the target image.
        result: ``unfinished`` if the drive was ended from outside.
        began, ended: seconds.
        initialisations: 1 when nothing went wrong, 0 when the target was never matched.
        remaining: part of the leg that was left, as far as the robot knew.
        reason: one clause.
    """

    target: int
    result: LegResult
    began: float
    ended: float
    initialisations: int
    remaining: float
    reason: str


class HomingChain:
    """Homes to the targets in their order.

    A target that is reached hands over to the next one with the same image, so that the robot
    does not stop in between. One that ends in a refusal is left out, and the next one tried from
    where the robot stands: images are sparse, but often two are in reach.

    Attributes:
        outcomes: of the legs that ended.
        controller: of the present leg.
    """

    def __init__(
        self,
        front_end: HomingFrontEnd,
        path: Sequence[OmniFeatures],
        make_estimator: EstimatorMaker,
        control: HomingControlSettings,
    ) -> None:
        """Begins before the first target.

        Raises:
            ConfigError: the path is empty.
        """
        if not path:
            raise ConfigError("path: no target image; give at least one")
        self._front_end = front_end
        self._path = tuple(path)
        self._make_estimator = make_estimator
        self._control = control
        self._target = 0
        self._skipped: list[int] = []
        self._began: float | None = None
        self._ended: Command | None = None
        self.outcomes: list[LegOutcome] = []
        self.controller = self._new_controller()

    @property
    def finished(self) -> bool:
        """Whether the last target is reached, or the path given up."""
        return self._ended is not None

    def step(self, image: ByteArray, time: float) -> Command:
        """The command after one more image; see :meth:`HomingController.step`."""
        if self._ended is not None:
            return replace(self._ended, time=time)
        if self._began is None:
            self._began = time
        command = self._numbered(self.controller.step(image, time))
        # Each turn ends a leg, so that it ends with the path at the latest.
        while command.state in (HomingState.ARRIVED, HomingState.REFUSED):
            if not self._go_on(command):
                self._ended = command
                return command
            command = self._numbered(self.controller.step(image, time))
        return command

    @property
    def target(self) -> int:
        """Number of the target image that is aimed at, or was last."""
        return self._target

    @property
    def given_up(self) -> bool:
        """Whether the path ended in a refusal."""
        return self._ended is not None and self._ended.state is HomingState.REFUSED

    def aim(self, target: int, time: float, reason: str) -> None:
        """Goes on to another target, for the robot was found elsewhere; also after giving up."""
        if self._ended is None:
            self._note("skipped", time, self.controller.remaining, reason)
        self._ended, self._skipped = None, []
        self._target, self._began = target, time
        self.controller = self._new_controller()

    def held_up(self, seconds: float) -> None:
        """See :meth:`HomingController.held_up`."""
        self.controller.held_up(seconds)

    def interrupt(self, time: float, reason: str) -> None:
        """Notes the present leg as unfinished: the drive is ended from outside."""
        if self._ended is None:
            self._note("unfinished", time, self.controller.remaining, reason)

    def _go_on(self, command: Command) -> bool:
        """Notes how the leg ended and begins the next one; False at the path's end."""
        last = self._target + 1 == len(self._path)
        if command.state is HomingState.ARRIVED:
            self._note("arrived", command.time, command.remaining, command.reason)
            self._skipped = []
        elif last or len(self._skipped) >= _MAX_SKIPS:
            self._note("refused", command.time, command.remaining, command.reason)
            return False
        else:
            self._note("skipped", command.time, command.remaining, command.reason)
            self._skipped.append(self._target)
        if last:
            return False
        self._target += 1
        self._began = command.time
        self.controller = self._new_controller()
        return True

    def _new_controller(self) -> HomingController:
        return HomingController(
            self._front_end, self._path[self._target], self._make_estimator, self._control
        )

    def _numbered(self, command: Command) -> Command:
        final = self._target + 1 == len(self._path)
        return replace(command, target=self._target, final=final)

    def _note(self, result: LegResult, time: float, remaining: float, reason: str) -> None:
        began = time if self._began is None else self._began
        self.outcomes.append(
            LegOutcome(
                self._target, result, began, time, self.controller.initialisations, remaining,
                reason,
            )
        )  # fmt: skip
