"""One homing as a state machine: initialise, drive and update, stop (sections II to IV).

The controller knows no metres. Lengths are parts of the leg, the distance to the target where the
robot set out for it. When the target is matched again on the way, the new homing's unit is what was
left then, so that the remaining part goes on from where it was; being a distance to the target, it
still ends at 0 however wrong that unit is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np

from fgslam.core.arrays import ByteArray
from fgslam.core.bearings import HomingStart, OmniFeatures, Refusal, RefusalReason, TwoViewVector
from fgslam.core.checks import later_time
from fgslam.core.errors import ConfigError, EstimatorError
from fgslam.core.geometry import wrap
from fgslam.homing.active import (
    CONTRADICTION_DEG,
    ActiveHoming,
    EstimatorMaker,
    Fault,
    Sighting,
    surely_left,
)
from fgslam.homing.front_end import ImageFrontEnd
from fgslam.homing.steering import Command, HomingState

SWITCH_FRACTION = 0.07  # of the leg left when the target counts as reached
RETRY_S = 0.5  # between two attempts to match the target again
BLIND_S = 1.0  # longest drive straight on, at reduced speed, without tracks
GIVE_UP_S = 3.0  # of refusals, standing: the robot tries from farther on, or ends the homing
WAIT_S = 60.0  # on one leg, on top of the time without progress, for a blocked way to clear
FARTHER_TRIES = 3  # drives farther on for one target
STALL_S = 15.0  # without progress for so long, the target is matched again
FARTHER_S = 2.5
"""Drive straight on, at reduced speed, to look for a refused target from elsewhere; 0.4 m with the
default steering."""

NEAR_FRACTION = 0.3
"""From this part of the leg on, another look must show the target where the estimate has it before
it counts as reached."""

MAX_STALLS = 3  # so often without progress, or with an estimate rejected, ends the homing
_BLIND_HEADING_DEG = 20.0  # without tracks the robot drives on only if home was so nearly ahead
_PASS_FRACTION = 0.25
"""A target nearer than this part of the leg that has fallen behind the robot counts as reached:
passed by."""

_PROGRESS = 0.02  # parts of a leg; less is noise of the distance


class HomingController:
    """Brings the robot to one target image.

    Attributes:
        active: the homing since the target was last matched; None while it is not.
        initialisations: how often it was matched so far, 1 when nothing went wrong.
        remaining: part of the leg that is left, as last known.
    """

    def __init__(
        self,
        front_end: ImageFrontEnd,
        target: OmniFeatures,
        make_estimator: EstimatorMaker,
    ) -> None:
        self._front_end = front_end
        self._target = target
        self._make_estimator = make_estimator
        self.active: ActiveHoming | None = None
        self.initialisations = 0
        self.remaining = 1.0
        self._time: float | None = None
        self._ended: Command | None = None
        self._heading = 0.0
        self._was_ahead = False
        # Where the leg begins, and where it went on by a vector that two images agree on.
        self._begun: list[HomingStart] = []
        # A stall: the robot is held up, or drives by a wrong estimate.
        self._stalls, self._patience = 0, WAIT_S
        self._nearest, self._nearer_at = np.inf, 0.0
        self._next_try = -np.inf
        self._blind_until = -np.inf
        self._search_until, self._searches = -np.inf, 0
        self._recognised = False
        self._next_look = -np.inf
        self._ambiguous = False
        self._standing_since: float | None = None
        self._pending: TwoViewVector | None = None
        self._obstacle = ""  # the last refusal's words, while there is nothing newer to say

    def step(self, image: ByteArray, time: float) -> Command:
        """The command after one more image.

        Args:
            image: (h, w, 3) uint8.
            time: seconds; must increase from step to step.

        Raises:
            EstimatorError: time does not increase; nothing has changed then.
        """
        self._time = later_time(time, self._time, "homing", EstimatorError)
        if self._ended is not None:
            return replace(self._ended, time=time)
        if self.active is None:
            return self._seek(image, time)
        return self._go_on(self.active, image, time)

    def held_up(self, seconds: float) -> None:
        """Excludes seconds in which avoidance decided, not homing, from the search for a stall."""
        self._nearer_at += min(seconds, self._patience)
        self._patience = max(self._patience - seconds, 0.0)

    # ----------------------------------------------------------------------------------------
    # Under way

    def _go_on(self, homing: ActiveHoming, image: ByteArray, time: float) -> Command:
        fault = homing.update(self._front_end.track(image, time))
        if fault is not None and not fault.usable:
            # The target is matched again at once; where that fails, the robot drives blind a while.
            ahead = abs(self._heading) <= np.deg2rad(_BLIND_HEADING_DEG)
            self._blind_until = time + BLIND_S if ahead else -np.inf
            self.active, self._next_try = None, time
            return self._seek(image, time, fault.reason)
        home = homing.home
        self.remaining, self._heading = home.distance, home.direction
        arrival = self._arrival(homing.unit)
        contradiction = self._recognise(homing, image, time, arrival)
        if contradiction is not None:
            return contradiction
        if arrival and homing.supported:
            return self._end(time, HomingState.ARRIVED, arrival)
        if arrival and fault is None:
            fault = Fault(f"no track confirms it: {arrival}", True)
        nearer = self.remaining < self._nearest - _PROGRESS
        late = not nearer and time - self._nearer_at > STALL_S
        if nearer or late:
            self._nearest, self._nearer_at = self.remaining, time
        if late:
            self._stalls += 1
            fault = Fault(f"no progress for {STALL_S:g} s", True)
            if self._stalls >= MAX_STALLS:
                return self._refuse(time, Refusal(RefusalReason.NO_PROGRESS, fault.reason))
        if fault is None:
            return self._drive(homing, time, f"{len(homing.tracked)} tracks")
        return self._renew(homing, image, time, fault.reason)

    def _arrival(self, unit: float) -> str:
        """Reason for which the target counts as reached; empty if it does not."""
        behind = abs(self._heading) > np.pi / 2
        if self.remaining <= SWITCH_FRACTION:
            return f"reached: {self.remaining:.2f} of the leg left"
        # A renewed homing's own distance counts, too: its unit may be wrong, not its zero.
        near = min(self.remaining, self.remaining / unit) <= _PASS_FRACTION
        if behind and near and self._was_ahead:
            return f"passed: target behind at {self.remaining:.2f} of the leg"
        self._was_ahead = self._was_ahead or not behind
        return ""

    def _recognise(
        self, homing: ActiveHoming, image: ByteArray, time: float, arrival: str
    ) -> Command | None:
        """Checks near the target that it is seen where the estimate has it; None to go on.

        A homing vector may be wrong and sure of itself: where things repeat, its tracks fit a
        target that is not there. So near, right matches are many: the look is a test of its own.
        """
        due = time >= self._next_look and self.remaining <= NEAR_FRACTION
        if self._recognised or not (due or arrival):
            return None
        self._next_look = time + RETRY_S
        answer = self._front_end.look(image, self._target)
        if isinstance(answer, Sighting):
            if homing.contradicts(answer.vector):
                return self._seen_elsewhere(homing, answer, time)
            # The first estimate is near when it claims so. Later ones took the place of one that
            # failed, with its distance or where its tracks ended.
            first = self.initialisations == 1
            self._recognised = first or self._surely_left(answer) <= NEAR_FRACTION
            if arrival and not self._recognised:
                return self._doubt(time, "target may not be so near", answer.vector)
        elif answer.reason is RefusalReason.AT_TARGET:
            return self._end(time, HomingState.ARRIVED, answer.details)
        elif arrival:
            return self._doubt(time, f"target not seen where it is believed: {answer.details}")
        return None

    def _surely_left(self, seen: Sighting) -> float:
        """Of the leg, at most.

        One of its starts may be wrong itself; by that one no place would ever be near.
        """
        return min(surely_left(begun, seen) for begun in self._begun)

    def _seen_elsewhere(self, homing: ActiveHoming, seen: Sighting, time: float) -> Command:
        """The target is seen in another direction than estimated: reached, passed, or an error.

        At the target itself directions mean little, so its distance decides, as far as it is
        certain; rotations that contradict mean that another place is seen.
        """
        if homing.turned_otherwise(seen.vector):
            return self._doubt(time, "near the target it is seen elsewhere", seen.vector)
        left = self._surely_left(seen)
        behind = abs(seen.vector.direction) > np.pi / 2 and self._was_ahead
        if left <= SWITCH_FRACTION or (behind and left <= _PASS_FRACTION):
            self.remaining = left
            return self._end(time, HomingState.ARRIVED, f"passed: seen at {left:.2f} of the leg")
        return self._doubt(time, "near the target it is seen elsewhere", seen.vector, left)

    def _doubt(
        self, time: float, why: str, vector: TwoViewVector | None = None, left: float = 1.0
    ) -> Command:
        """Rejects the estimate; homing begins again where the robot stands.

        Args:
            time: now.
            why: for the record.
            vector: what contradicts the estimate; it must be confirmed itself.
            left: part of the leg, as far as that is known.
        """
        self.active, self._pending, self._next_try = None, vector, time
        self.remaining, self._was_ahead, self._obstacle = left, False, why
        self._recognised = False
        self._nearest, self._nearer_at = np.inf, time
        self._stalls += 1
        if self._stalls >= MAX_STALLS:
            return self._refuse(time, Refusal(RefusalReason.LOST, why))
        return self._hold(time, why)

    def _renew(self, homing: ActiveHoming, image: ByteArray, time: float, why: str) -> Command:
        """Matches the target again while driving on by an estimate that is usable, but weak."""
        if time < self._next_try:
            return self._drive(homing, time, why)
        answer = self._begin(image, time)
        if isinstance(answer, Refusal):
            if answer.reason is RefusalReason.AT_TARGET:
                return self._end(time, HomingState.ARRIVED, answer.details)
            return self._drive(homing, time, f"{why}; not matched anew: {answer.details}")
        vector = answer.start.vector
        if homing.contradicts(vector):
            # The old tracks are gone with the new ones' start, and one of both must be wrong.
            return self._doubt(time, "new homing vector contradicts the estimate", vector)
        return self._accept(answer, f"matched anew: {why}")

    # ----------------------------------------------------------------------------------------
    # Matching the target, for the first time or again

    def _seek(self, image: ByteArray, time: float, why: str = "") -> Command:
        """Tries to match the target without an estimate; else stands, or drives blind.

        ``why`` is what went wrong just now; empty if nothing did.
        """
        if time < self._next_try:
            return self._hold(time, self._obstacle)
        answer = self._begin(image, time)
        if isinstance(answer, Refusal):
            self._ambiguous |= answer.reason is RefusalReason.AMBIGUOUS
            if why:
                answer = replace(answer, details=f"{why}; {answer.details}")
            return self._refused(time, answer)
        vector = answer.start.vector
        # It is accepted where the view was never ambiguous, or where two images agree.
        confirmed = not self._ambiguous
        if self._pending is not None:
            turn = float(np.abs(wrap(np.array(vector.direction - self._pending.direction))))
            confirmed = bool(turn <= np.deg2rad(CONTRADICTION_DEG))
        if confirmed:
            return self._accept(answer, f"matched anew: {why}" if why else "target matched")
        if self._pending is None:
            words, self._next_try = "ambiguous before, needs another image", time
        else:
            words = "homing vectors contradict"
        self._pending = vector
        return self._refused(time, Refusal(RefusalReason.AMBIGUOUS, words))

    def _begin(self, image: ByteArray, time: float) -> ActiveHoming | Refusal:
        self._next_try = time + RETRY_S
        answer = self._front_end.begin(image, self._target, time)
        if isinstance(answer, Refusal):
            return answer
        try:
            return ActiveHoming(answer, self._make_estimator, self.remaining)
        except EstimatorError as error:
            return Refusal(RefusalReason.UNCERTAIN, str(error))

    def _accept(self, homing: ActiveHoming, why: str) -> Command:
        time = homing.start.time
        if self._standing_since is not None or self.initialisations == 0:
            self._nearer_at = time  # the robot stood until now
        self.active = homing
        if self._pending is not None or not self._begun:
            self._begun.append(homing.start)
        self._heading = homing.start.vector.direction
        self._was_ahead = self._was_ahead or abs(self._heading) <= np.pi / 2
        self._pending = self._standing_since = None
        self._ambiguous = self._recognised = False  # it was another estimate that was seen right
        self._blind_until = self._search_until = -np.inf
        self.initialisations += 1
        return self._drive(homing, time, why)

    def _refused(self, time: float, refusal: Refusal) -> Command:
        """Stands, or drives blind, until there was nothing but refusals for too long.

        Then it tries from farther on: another image shows more than the same one again.
        """
        if refusal.reason is RefusalReason.AT_TARGET:
            return self._end(time, HomingState.ARRIVED, refusal.details)
        self._obstacle = refusal.details
        command = self._hold(time, refusal.details)
        since = self._standing_since
        if since is None or time - since < GIVE_UP_S:
            return command
        if self._searches < FARTHER_TRIES:
            self._searches += 1
            self._search_until = time + FARTHER_S
            self._standing_since = self._pending = None
            self._nearer_at = time
            return self._hold(time, refusal.details)
        if self.initialisations:
            refusal = Refusal(RefusalReason.LOST, f"lost, then: {refusal.details}")
        return self._refuse(time, refusal)

    # ----------------------------------------------------------------------------------------
    # Commands

    def _drive(self, homing: ActiveHoming, time: float, why: str) -> Command:
        home = homing.home
        return Command(
            time=time,
            state=HomingState.DRIVE,
            heading=home.direction,
            remaining=home.distance,
            rotation=home.rotation,
            covariance=home.covariance,
            stop=False,
            reason=why,
        )

    def _hold(self, time: float, why: str) -> Command:
        """Command without an estimate: blind or searching while that is allowed, then standing."""
        if self._pending is None and time < self._blind_until:
            return self._without_estimate(time, HomingState.BLIND, why)
        if self._pending is None and time < self._search_until:
            return self._without_estimate(time, HomingState.SEARCH, why)
        if self._standing_since is None:
            self._standing_since = time
        state = HomingState.WAIT if self.initialisations else HomingState.INITIALISE
        if self._pending is not None:
            state = HomingState.CONFIRM
        return self._without_estimate(time, state, why)

    def _refuse(self, time: float, refusal: Refusal) -> Command:
        return self._end(time, HomingState.REFUSED, refusal.details, refusal)

    def _end(
        self, time: float, state: HomingState, why: str, refusal: Refusal | None = None
    ) -> Command:
        self._ended = self._without_estimate(time, state, why, refusal)
        return self._ended

    def _without_estimate(
        self, time: float, state: HomingState, why: str, refusal: Refusal | None = None
    ) -> Command:
        stop = state not in (HomingState.BLIND, HomingState.SEARCH)
        return Command(time, state, why, remaining=self.remaining, stop=stop, refusal=refusal)


# --------------------------------------------------------------------------------------------
# Following a path: a chain of homings, one target image after another


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
        target: number of the target image that is aimed at, or was last.
        outcomes: of the legs that ended.
        controller: of the present leg.
    """

    def __init__(
        self,
        front_end: ImageFrontEnd,
        path: Sequence[OmniFeatures],
        make_estimator: EstimatorMaker,
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
        self._skipped = 0
        self._ended: Command | None = None
        self.outcomes: list[LegOutcome] = []
        self._began: float | None = None  # time of the leg's first image
        self._aim(0, None)

    @property
    def finished(self) -> bool:
        """Whether the last target is reached, or the path abandoned."""
        return self._ended is not None

    def step(self, image: ByteArray, time: float) -> Command:
        """The command after one more image; see :meth:`HomingController.step`."""
        if self._ended is not None:
            return replace(self._ended, time=time)
        if self._began is None:
            self._began = time
        command = self._step(image, time)
        # Each turn ends a leg, so that it ends with the path at the latest.
        while command.state in (HomingState.ARRIVED, HomingState.REFUSED):
            if not self._go_on(command):
                self._ended = command
                return command
            command = self._step(image, time)
        return command

    @property
    def given_up(self) -> bool:
        """Whether the path ended in a refusal."""
        return self._ended is not None and self._ended.state is HomingState.REFUSED

    def aim(self, target: int, time: float, reason: str) -> None:
        """Goes on to another target, for the robot was found elsewhere; also after giving up."""
        if self._ended is None:
            self._note("skipped", time, self.controller.remaining, reason)
        self._ended, self._skipped = None, 0
        self._aim(target, time)

    def held_up(self, seconds: float) -> None:
        """See :meth:`HomingController.held_up`."""
        self.controller.held_up(seconds)

    def interrupt(self, time: float, reason: str) -> None:
        """Notes the present leg as unfinished: the drive is ended from outside."""
        if self._ended is None:
            self._note("unfinished", time, self.controller.remaining, reason)

    def _go_on(self, command: Command) -> bool:
        """Notes how the leg ended and begins the next one; False at the path's end."""
        last = self.target + 1 == len(self._path)
        result: LegResult = "arrived"
        if command.state is not HomingState.ARRIVED:
            result = "refused" if last or self._skipped >= _MAX_SKIPS else "skipped"
        self._note(result, command.time, command.remaining, command.reason)
        if last or result == "refused":
            return False
        self._skipped = self._skipped + 1 if result == "skipped" else 0
        self._aim(self.target + 1, command.time)
        return True

    def _aim(self, target: int, time: float | None) -> None:
        """Begins the leg to a target."""
        self.target, self._began = target, time
        self.controller = HomingController(
            self._front_end, self._path[target], self._make_estimator
        )

    def _step(self, image: ByteArray, time: float) -> Command:
        command = self.controller.step(image, time)
        return replace(command, target=self.target, final=self.target + 1 == len(self._path))

    def _note(self, result: LegResult, time: float, remaining: float, reason: str) -> None:
        began = time if self._began is None else self._began
        self.outcomes.append(
            LegOutcome(
                self.target, result, began, time, self.controller.initialisations, remaining,
                reason,
            )
        )  # fmt: skip
