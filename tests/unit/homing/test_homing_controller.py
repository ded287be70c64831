"""The state machine of one homing, on scripted front-end and on a world of landmarks."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from homing import make_matches
from landmark_world import DARK, Setting, drive_path, make_follower, winding_path

from fgslam.backend.homing.estimators import make_homing_estimator
from fgslam.backend.settings import (
    AverageLandmarkVectorSettings,
    HomingEkfSettings,
    HomingEstimatorSettings,
    HomingGraphSettings,
    SnapshotSettings,
)
from fgslam.core.arrays import ByteArray, FloatArray
from fgslam.core.bearings import (
    HomingEstimate,
    HomingStart,
    LocalMap,
    OmniFeatures,
    Refusal,
    RefusalReason,
    TrackedBearings,
    TwoViewVector,
)
from fgslam.core.errors import ConfigError, EstimatorError
from fgslam.core.geometry import bearings, between, unit, wrap
from fgslam.homing.active import (
    MIN_TRACKS,
    ActiveHoming,
    Sighting,
    surely_left,
)
from fgslam.homing.closed_loop import (
    STAGES,
    DriveRecord,
    corners,
    cross_track,
    pass_distances,
    slope_by_leg,
)
from fgslam.homing.controller import (
    BLIND_S,
    FARTHER_S,
    FARTHER_TRIES,
    GIVE_UP_S,
    MAX_STALLS,
    NEAR_FRACTION,
    RETRY_S,
    SWITCH_FRACTION,
    HomingChain,
    HomingController,
)
from fgslam.homing.settings import (
    ClosedLoopSettings,
    HomingBehaviourSettings,
)
from fgslam.homing.steering import Command, CorridorAvoidance, Drive, HomingState, RangeScan

POINTS = 3.0 * unit(np.linspace(-3.0, 3.0, 20)) * np.linspace(0.6, 1.4, 20)[:, None]
"""(20, 2) landmarks around start and target, legs."""


def vector_to(direction: float, rotation: float = 0.0) -> TwoViewVector:
    """A homing vector of 20 inliers and a degree."""
    covariance = np.eye(2) * np.deg2rad(1.0) ** 2
    return TwoViewVector(direction, rotation, covariance, np.ones(20, dtype=np.bool_), 0)


def start_at(time: float, vector: TwoViewVector) -> HomingStart:
    """A start whose local map is exact."""
    target = np.array([*unit(np.array(vector.direction)), vector.rotation])
    angles = np.zeros((20, 4))
    angles[:, 0] = np.arctan2(POINTS[:, 1], POINTS[:, 0])
    angles[:, 2] = bearings(target, POINTS)
    distance = np.hypot(*POINTS.T)
    covariance = np.tile(np.eye(2) * 1e-6, (20, 1, 1))
    local_map = LocalMap(np.arange(20), angles[:, 0], distance, covariance)
    return HomingStart(time, vector, local_map, make_matches(angles, 0.01))


def sighting_of(vector: TwoViewVector, part: float, wrong: int = 0) -> Sighting:
    """The target seen by a vector from so many legs; the last ``wrong`` matches are others'."""
    turned = np.array([part * np.cos(vector.direction), part * np.sin(vector.direction)])
    heading = -vector.rotation  # the target stands at (1, 0), heading 0
    c, s = np.cos(heading), np.sin(heading)
    robot = np.append([1.0, 0.0] - np.array([[c, -s], [s, c]]) @ turned, heading)
    angles = np.zeros((20, 4))
    angles[:, 0] = bearings(robot, POINTS)
    angles[:, 2] = bearings(np.array([1.0, 0.0, 0.0]), POINTS)
    angles[20 - wrong :, 0] = bearings(robot, -POINTS[20 - wrong :])
    return Sighting(vector, make_matches(angles, 0.01))


class OracleEstimator:
    """Believes what it is given: ``robot`` is set from outside."""

    kind = "oracle"

    def __init__(self, start: HomingStart) -> None:
        self.time, self.robot, self.sigma = start.time, np.zeros(3), 1e-3
        self.mapped = 20
        self.target = np.array([*unit(np.array(start.vector.direction)), start.vector.rotation])

    def update(self, tracked: TrackedBearings) -> None:
        """Takes in nothing."""
        self.time = tracked.time

    def estimate(self, landmarks: bool = True) -> HomingEstimate:
        """As given; the map is exact."""
        covariance = np.eye(6) * self.sigma**2  # NaN where sigma is
        many = np.tile(np.eye(2) * 1e-6, (20, 1, 1))
        n = self.mapped
        return HomingEstimate(
            self.time, self.robot, self.target, covariance, np.arange(n), POINTS[:n], many[:n]
        )


@dataclass
class ScriptedFrontEnd:
    """Answers to ``begin`` from a list, the last one repeated; tracks of a robot that one sets."""

    answers: list[TwoViewVector | Refusal]
    robot: FloatArray = field(default_factory=lambda: np.zeros(3))
    tracks: int = 20
    turned: float = 0.0
    begun: list[float] = field(default_factory=list)
    looks: list[Sighting | Refusal] = field(default_factory=list)
    looked: int = 0
    home: FloatArray = field(default_factory=lambda: np.array([1.0, 0.0, 0.0]))
    matched: int = 0
    """Number of the target's first feature that ``begin`` matches."""

    def describe(self, image: ByteArray) -> OmniFeatures:
        """Never asked."""
        raise AssertionError

    def begin(self, image: ByteArray, target: OmniFeatures, time: float) -> HomingStart | Refusal:
        """The next answer."""
        self.begun.append(time)
        answer = self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]
        if isinstance(answer, Refusal):
            return answer
        self.home = np.array([*unit(np.array(answer.direction)), answer.rotation])
        start = start_at(time, answer)
        of_target = start.matches.index_b + self.matched
        return replace(start, matches=replace(start.matches, index_b=of_target))

    def look(self, image: ByteArray, target: OmniFeatures) -> Sighting | Refusal:
        """From a list, the last one repeated; without one the truth since the last match."""
        self.looked += 1
        if self.looks:
            return self.looks.pop(0) if len(self.looks) > 1 else self.looks[0]
        way = between(self.robot, self.home)
        return sighting_of(vector_to(float(np.arctan2(way[1], way[0])), float(way[2])), 0.1)

    def track(self, image: ByteArray, time: float) -> TrackedBearings:
        """Exact bearings."""
        seen = wrap(bearings(self.robot, POINTS) + self.turned)[: self.tracks]
        n = len(seen)
        nan = np.full(n, np.nan)
        return TrackedBearings(time, np.arange(n), seen, np.full(n, 0.01), nan, nan)


@dataclass
class Bench:
    """A controller with scripted front-end and an estimator that one can set."""

    front_end: ScriptedFrontEnd
    estimators: list[OracleEstimator] = field(default_factory=list)
    time: float = -0.1

    def __post_init__(self) -> None:
        """Makes the controller."""
        target = OmniFeatures(None, None)  # type: ignore[arg-type]  # never looked at
        self.controller = HomingController(self.front_end, target, self._make)

    def _make(self, start: HomingStart) -> OracleEstimator:
        self.estimators.append(OracleEstimator(start))
        return self.estimators[-1]

    def at(self, x: float, y: float = 0.0, psi: float = 0.0) -> None:
        """Puts the robot, truth and belief alike, into the start frame."""
        self.front_end.robot = np.array([x, y, psi])
        self.estimators[-1].robot = self.front_end.robot

    def step(self, dt: float = 0.1) -> Command:
        """One image later."""
        self.time += dt
        return self.controller.step(DARK, self.time)


def bench(*answers: TwoViewVector | Refusal) -> Bench:
    """With these answers to ``begin``."""
    return Bench(ScriptedFrontEnd(list(answers)))


@pytest.fixture
def _never_farther(monkeypatch: pytest.MonkeyPatch) -> None:
    """A refused target is not looked for from farther on."""
    monkeypatch.setattr("fgslam.homing.controller.FARTHER_TRIES", 0)


FEW = Refusal(RefusalReason.TOO_FEW_MATCHES, "2 matches, of 8 needed")


def test_first_image_is_matched_and_driven_by() -> None:
    """Heading, rotation and remaining part are the vector's; nothing is tracked yet."""
    command = bench(vector_to(0.3, -0.2)).step()
    assert command.state is HomingState.DRIVE
    assert command.heading == pytest.approx(0.3)
    assert command.rotation == pytest.approx(-0.2)
    assert command.remaining == pytest.approx(1.0)
    assert not command.stop


def test_reached_and_stays_reached() -> None:
    """Less than the switch fraction left: stop; later images change nothing but the time."""
    b = bench(vector_to(0.0))
    b.step()
    b.at(1.0 - 1.01 * SWITCH_FRACTION)
    assert b.step().state is HomingState.DRIVE
    b.at(1.0 - 0.99 * SWITCH_FRACTION)
    arrived = b.step()
    assert arrived.state is HomingState.ARRIVED
    assert arrived.stop
    later = b.step()
    assert (later.state, later.time) == (HomingState.ARRIVED, b.time)
    assert len(b.front_end.begun) == 1


def test_passed_target_counts_as_reached_only_when_near() -> None:
    """Behind and near: passed. Behind and far, or behind from the beginning: not."""
    b = bench(vector_to(0.0))
    b.step()
    b.at(0.9, 0.15)
    assert b.step().state is HomingState.DRIVE
    b.at(1.02, 0.15)
    passed = b.step()
    assert passed.state is HomingState.ARRIVED
    assert "passed" in passed.reason
    far = bench(vector_to(0.0))
    far.step()
    far.at(1.3, 0.3)
    assert far.step().state is HomingState.DRIVE
    behind = bench(vector_to(np.pi))
    behind.step()
    behind.at(-0.8, 0.0)  # driving backwards: home was never ahead
    assert behind.step().state is HomingState.DRIVE


def test_one_place_is_arrival() -> None:
    """Start and target coincide: there is no way to drive, and no refusal either."""
    here = Refusal(RefusalReason.AT_TARGET, "median parallax 0.1 deg", 0.4)
    command = bench(here).step()
    assert command.state is HomingState.ARRIVED
    assert command.refusal is None


@pytest.mark.usefixtures("_never_farther")
def test_refused_target_is_tried_for_a_while_and_then_given_up() -> None:
    """Standing all the time, one attempt a retry period, the refusal handed on."""
    b = bench(FEW)
    commands = [b.step() for _ in range(40)]
    assert {c.state for c in commands[:30]} == {HomingState.INITIALISE}
    assert all(c.stop for c in commands)
    assert commands[-1].state is HomingState.REFUSED
    assert commands[-1].refusal is FEW
    assert np.all(np.diff(b.front_end.begun) > RETRY_S - 0.01)
    assert commands[0].reason == FEW.details


def test_few_tracks_match_anew_while_driving_on() -> None:
    """With too few tracks the target is matched anew; refused, the old estimate still serves."""
    b = bench(vector_to(0.0), FEW, vector_to(0.05))
    b.step()
    b.at(0.4)
    b.step()
    b.front_end.tracks = MIN_TRACKS - 1
    refused = b.step(RETRY_S)
    assert refused.state is HomingState.DRIVE
    assert FEW.details in refused.reason
    assert refused.remaining == pytest.approx(0.6)
    renewed = [b.step() for _ in range(6)]
    assert b.controller.initialisations == 2
    assert any("matched anew" in c.reason for c in renewed)
    assert all(c.state is HomingState.DRIVE for c in renewed)
    assert len(b.front_end.begun) == 3


def test_remaining_goes_on_in_the_old_unit() -> None:
    """Matched anew at 60 % of the way: the new homing's leg counts 0.4, with its covariance."""
    b = bench(vector_to(0.0), vector_to(0.0))
    b.step()
    b.at(0.6)
    b.step()
    b.front_end.tracks = 9
    assert b.step(RETRY_S).remaining == pytest.approx(0.4)
    b.front_end.tracks = 20
    b.at(0.5)  # half of the new leg
    command = b.step()
    assert command.remaining == pytest.approx(0.2)
    sigma = b.estimators[-1].sigma
    # Target and robot are both uncertain by sigma legs, and a leg is 0.4 of the first one.
    assert np.sqrt(command.covariance[0, 0]) == pytest.approx(0.4 * np.sqrt(2.0) * sigma)


def test_estimate_without_a_covariance_is_uncertain() -> None:
    """NaN is no small number: matched anew, and no arrival is believed meanwhile."""
    b = bench(vector_to(0.0), FEW)
    b.step()
    b.at(0.4)
    b.estimators[-1].sigma = float("nan")
    command = b.step(RETRY_S)
    assert command.state is HomingState.DRIVE
    assert "no covariance" in command.reason
    assert len(b.front_end.begun) == 2
    b.at(0.999)
    assert b.step().state is HomingState.DRIVE
    b.estimators[-1].sigma = 1e-3
    assert b.step().state is HomingState.ARRIVED


def test_arrival_needs_tracks_in_the_map() -> None:
    """Carried on by its motion alone an estimate reaches any target: match anew, then."""
    b = bench(vector_to(0.0), FEW)
    b.step()
    b.at(0.999)
    b.estimators[-1].mapped = 2
    command = b.step(RETRY_S)
    assert command.state is HomingState.DRIVE
    assert "no track confirms it: reached" in command.reason
    assert len(b.front_end.begun) == 2
    b.estimators[-1].mapped = 3
    assert b.step().state is HomingState.ARRIVED


@pytest.mark.parametrize("settings", [AverageLandmarkVectorSettings(), SnapshotSettings()])
def test_averages_without_map_and_covariance_drive(settings: HomingEstimatorSettings) -> None:
    """They never have any; that is no fault of theirs."""
    start = start_at(0.0, vector_to(0.0))
    homing = ActiveHoming(start, lambda s: make_homing_estimator(s, settings), 1.0)
    front_end = ScriptedFrontEnd([FEW], robot=np.array([0.2, 0.0, 0.0]))
    assert homing.update(front_end.track(DARK, 0.1)) is None
    assert homing.supported


def test_diverged_estimate_is_not_driven_by() -> None:
    """Belief and bearings part: matched anew at once, whatever the estimator's covariance says."""
    b = bench(vector_to(0.0), FEW)
    b.step()
    b.at(0.2)
    b.step()
    b.estimators[-1].robot = np.array([0.2, 0.5, 0.3])
    command = b.step()
    assert command.state is HomingState.BLIND
    assert "diverged" in command.reason
    assert command.reason.endswith(FEW.details)
    assert len(b.front_end.begun) == 2


def test_all_tracks_lost_in_one_frame_heals_in_the_same() -> None:
    """One dark image, and the next is matched: no step without a command to drive."""
    b = bench(vector_to(0.0))
    b.step()
    b.at(0.3)
    b.step()
    b.front_end.tracks = 0
    command = b.step()
    assert command.state is HomingState.DRIVE
    assert b.controller.initialisations == 2
    assert command.reason == "matched anew: 0 tracks left"
    assert command.remaining == pytest.approx(0.7)


@pytest.mark.usefixtures("_never_farther")
def test_blind_is_short_then_stands_then_refuses() -> None:
    """Lost and not healing: straight on for a second at most, then standing, then the end."""
    b = bench(vector_to(0.0), FEW)
    b.step()
    b.step()
    b.front_end.tracks = 0
    commands = [b.step() for _ in range(60)]
    states = [c.state for c in commands]
    blind = states.count(HomingState.BLIND)
    assert 0 < blind <= round(BLIND_S / 0.1) + 1
    assert states[:blind] == [HomingState.BLIND] * blind
    assert all(not c.stop and c.heading == 0.0 for c in commands[:blind])
    assert states[blind] is HomingState.WAIT
    assert states[-1] is HomingState.REFUSED
    assert commands[-1].refusal is not None
    assert commands[-1].refusal.reason is RefusalReason.LOST


def test_blind_only_where_home_was_ahead() -> None:
    """Turning towards home when the tracks were lost: straight on would lead astray."""
    b = bench(vector_to(1.0), FEW)
    b.step()
    b.step()
    b.front_end.tracks = 0
    assert b.step().state is HomingState.WAIT


def test_flip_is_named() -> None:
    """The reason tells what was seen."""
    b = bench(vector_to(0.0))
    b.step()
    active = b.controller.active
    assert active is not None
    b.front_end.turned = np.pi
    fault = active.update(b.front_end.track(DARK, 0.1))
    assert fault is not None
    assert not fault.usable
    assert "turned by" in fault.reason
    assert "180 deg within 0.10 s" in fault.reason


def test_fast_turn_is_no_flip() -> None:
    """A robot may turn at its limit, a second between images."""
    b = bench(vector_to(0.0))
    b.step()
    for k in range(1, 4):
        b.at(0.0, 0.0, np.deg2rad(40.0) * k)
        assert b.step(1.0).state is HomingState.DRIVE
    assert b.controller.initialisations == 1


def test_contradicting_vector_is_confirmed_before_it_is_driven_by() -> None:
    """A sound estimate against a new vector: stand, look again; two that agree win."""
    b = bench(vector_to(0.0), vector_to(2.0), vector_to(2.1))
    b.step()
    b.step()
    b.front_end.tracks = 9
    doubt = b.step(RETRY_S)
    assert doubt.state is HomingState.CONFIRM
    assert doubt.stop
    b.front_end.tracks = 20
    b.front_end.robot = np.zeros(3)
    confirmed = b.step()
    assert confirmed.state is HomingState.DRIVE
    assert confirmed.heading == pytest.approx(2.1)


@pytest.mark.usefixtures("_never_farther")
def test_vectors_that_keep_contradicting_end_the_homing() -> None:
    """Never a confident wrong vector: no two images agree, so there is no answer."""
    answers = [vector_to(0.0)] + [vector_to(2.0 * (-1.0) ** k) for k in range(60)]
    b = bench(*answers)
    b.step()
    b.step()
    b.front_end.tracks = 9
    commands = [b.step(RETRY_S) for _ in range(12)]
    assert all(c.stop for c in commands)
    assert commands[-1].state is HomingState.REFUSED


def test_no_progress_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Held up for good: matched anew a few times, then given up with the reason."""
    monkeypatch.setattr("fgslam.homing.controller.STALL_S", 1.0)
    b = bench(vector_to(0.0))
    commands = [b.step() for _ in range(60)]
    assert commands[-1].state is HomingState.REFUSED
    assert commands[-1].refusal is not None
    assert commands[-1].refusal.reason is RefusalReason.NO_PROGRESS
    assert b.controller.initialisations == MAX_STALLS


def test_refused_target_is_looked_for_from_farther_on() -> None:
    """Standing did not help: slowly straight on, and the first answer is driven by."""
    standing = int(GIVE_UP_S / RETRY_S) + 1
    b = bench(*[FEW] * (standing + 2), vector_to(0.1))
    commands = [b.step() for _ in range(60)]
    states = [c.state for c in commands]
    first = states.index(HomingState.SEARCH)
    assert states[:first] == [HomingState.INITIALISE] * first
    searching = [c for c in commands if c.state is HomingState.SEARCH]
    assert all(not c.stop and c.heading == 0.0 for c in searching)
    assert states[first + len(searching)] is HomingState.DRIVE
    assert b.controller.initialisations == 1


def test_search_for_a_refused_target_ends_after_the_stated_tries() -> None:
    """So many drives of that length, standing and trying in between; then the refusal."""
    b = bench(FEW)
    states = [b.step().state for _ in range(400)]
    assert states[-1] is HomingState.REFUSED
    driven = 0.1 * states.count(HomingState.SEARCH)
    assert driven == pytest.approx(FARTHER_TRIES * FARTHER_S, abs=0.5)
    begun = [now for was, now in itertools.pairwise(states) if now is not was]
    assert begun.count(HomingState.SEARCH) == FARTHER_TRIES


def test_answer_after_an_ambiguous_one_needs_another_image() -> None:
    """Two images must agree; one that says something else is not driven by."""
    doubtful = Refusal(RefusalReason.AMBIGUOUS, "34 inliers, 38 for a different solution")
    b = bench(doubtful, vector_to(2.0), vector_to(0.1), vector_to(0.12))
    commands = [b.step() for _ in range(20)]
    states = [c.state for c in commands]
    assert HomingState.CONFIRM in states
    driven = states.index(HomingState.DRIVE)
    assert all(c.stop for c in commands[:driven])
    assert commands[driven].heading == pytest.approx(0.12)
    assert len(b.front_end.begun) == 4


def test_near_the_target_one_look_confirms_it() -> None:
    """Not before, and not again once it agreed; the tracks go on."""
    b = bench(vector_to(0.0))
    b.step()
    b.at(1.0 - 1.1 * NEAR_FRACTION)
    b.step()
    assert b.front_end.looked == 0
    b.at(1.0 - 0.9 * NEAR_FRACTION)
    assert b.step().state is HomingState.DRIVE
    b.at(0.95)
    assert b.step().state is HomingState.ARRIVED
    assert b.front_end.looked == 1
    assert b.controller.initialisations == 1


def test_target_seen_elsewhere_begins_the_leg_anew() -> None:
    """A wrong vector that was sure of itself: two images that agree on another one win."""
    b = bench(vector_to(0.0), vector_to(1.5))
    b.front_end.looks = [sighting_of(vector_to(1.4), 0.9)]
    b.step()
    b.at(0.8)
    doubt = b.step()
    assert doubt.state is HomingState.CONFIRM
    assert "seen elsewhere" in doubt.reason
    b.front_end.robot, b.front_end.looks = np.zeros(3), []
    anew = b.step()
    assert anew.state is HomingState.DRIVE
    assert anew.heading == pytest.approx(1.5)
    assert anew.remaining == pytest.approx(0.9)


@pytest.mark.parametrize(
    ("vector", "part", "state"),
    [
        (vector_to(np.pi), 0.2, HomingState.ARRIVED),  # passed
        (vector_to(1.5), 0.05, HomingState.ARRIVED),  # beside it
        (vector_to(1.5), 0.2, HomingState.CONFIRM),  # ahead still
        (vector_to(np.pi), 0.9, HomingState.CONFIRM),  # driven the wrong way: as at the start
        (vector_to(np.pi, 3.0), 0.05, HomingState.CONFIRM),  # turned: another place
    ],
)
def test_how_near_the_target_is_seen_decides(
    vector: TwoViewVector, part: float, state: HomingState
) -> None:
    """Seen elsewhere than expected: at the target itself that is an arrival, else an error."""
    b = bench(vector_to(0.0))
    b.step()
    b.front_end.looks = [sighting_of(vector, part)]
    b.at(0.8)
    command = b.step()
    assert command.state is state
    assert command.remaining == pytest.approx(1.0 if vector.rotation else part)


def test_target_that_is_surely_passed_only_by_few_features_is_no_arrival() -> None:
    """Behind, and a fifth of the leg away by a third of the matches: nothing is certain."""
    b = bench(vector_to(0.0))
    b.front_end.looks = [sighting_of(vector_to(np.pi), 0.2, wrong=14)]
    b.step()
    b.at(0.8)
    command = b.step()
    assert command.state is HomingState.CONFIRM
    assert command.remaining == 1.0


@pytest.mark.parametrize(("common", "state"), [(20, "arrived"), (4, "confirm")])
def test_arrival_of_an_estimate_matched_anew_is_confirmed_by_common_features(
    common: int, state: str
) -> None:
    """Its unit is that of an estimate that was given up: few common features confirm nothing."""
    b = bench(vector_to(0.0), vector_to(0.0))
    b.step()
    b.at(0.6)
    b.step()
    b.front_end.tracks = 9
    b.step(RETRY_S)
    assert b.controller.initialisations == 2
    b.front_end.tracks = 20
    seen = sighting_of(vector_to(0.0), 0.05)
    b.front_end.looks = [Sighting(seen.vector, seen.matches.select(np.arange(common)))]
    b.at(0.9)
    assert b.step().state.value == state


@pytest.mark.parametrize(("near", "state"), [(0.05, "arrived"), (0.6, "confirm")])
def test_start_that_was_contradicted_bounds_no_later_arrival(near: float, state: str) -> None:
    """Its features are another place's; homing goes on from where two images agree.

    What begins there is no better by itself: its features and the look's must put it near.
    """
    b = bench(vector_to(1.5), vector_to(0.0))
    b.front_end.matched, b.front_end.looks = 100, [sighting_of(vector_to(0.0), 0.9)]
    b.step()
    b.at(*(0.8 * unit(np.array(1.5))))
    assert b.step().state is HomingState.CONFIRM
    b.front_end.matched, b.front_end.robot = 0, np.zeros(3)
    anew = b.step()
    assert anew.state is HomingState.DRIVE
    assert anew.remaining == 1.0
    b.front_end.looks = [sighting_of(vector_to(0.0), near)]
    b.at(0.95)
    assert b.step(RETRY_S).state.value == state


def test_what_is_left_is_bounded_by_common_features() -> None:
    """Exact without wrong matches; with some at least as much; 1 where too few are common."""
    begun = start_at(0.0, vector_to(0.0))
    for part in (0.05, 0.2, 0.6):
        for direction in (0.3, 1.5, np.pi):
            exact = surely_left(begun, sighting_of(vector_to(direction), part))
            assert exact == pytest.approx(part)
            bound = surely_left(begun, sighting_of(vector_to(direction), part, wrong=5))
            assert bound >= 0.999 * part
    seen = sighting_of(vector_to(1.5), 0.2)
    few = Sighting(seen.vector, seen.matches.select(np.arange(4)))
    assert surely_left(begun, few) == 1.0
    assert surely_left(begun, Sighting(seen.vector, seen.matches.select(np.arange(0)))) == 1.0


def test_estimate_in_doubt_is_driven_by_no_more_not_even_blind(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Matched anew within the time that may be driven blind; then no look shows the target."""
    monkeypatch.setattr("fgslam.homing.controller.BLIND_S", 5.0)
    b = bench(vector_to(0.0), FEW, vector_to(0.0), FEW)
    b.step()
    b.front_end.tracks = 0
    assert b.step().state is HomingState.BLIND
    b.front_end.tracks, b.front_end.looks = 20, [FEW]
    while b.controller.active is None:
        b.step()
    b.at(0.99)
    doubt = b.step()
    assert "not seen where it is believed" in doubt.reason
    assert doubt.stop


def test_estimate_that_takes_another_s_place_is_looked_at_itself() -> None:
    """One agreed with the look from near; what contradicts it later has yet to."""
    b = bench(vector_to(0.0), vector_to(1.5))
    b.step()
    b.at(0.8)
    b.step()
    assert b.front_end.looked == 1
    b.front_end.tracks = 9
    assert b.step(RETRY_S).state is HomingState.CONFIRM
    b.front_end.robot, b.front_end.tracks = np.zeros(3), 20
    assert b.step().state is HomingState.DRIVE
    b.at(*(0.8 * unit(np.array(1.5))))
    b.step()
    assert b.front_end.looked == 2


def test_no_arrival_where_the_target_is_not_seen() -> None:
    """The estimate is there, the look is refused: given up, then matched again or refused."""
    b = bench(vector_to(0.0), FEW)
    b.front_end.looks = [FEW]
    b.step()
    b.at(0.99)
    commands = [b.step() for _ in range(300)]
    assert commands[0].stop
    assert "not seen where it is believed" in commands[0].reason
    assert HomingState.ARRIVED not in {c.state for c in commands}
    assert commands[-1].refusal is not None
    assert commands[-1].refusal.reason is RefusalReason.LOST


def test_look_from_the_target_itself_is_arrival() -> None:
    """Both views are from one place, whatever the estimate says of the last bit."""
    b = bench(vector_to(0.0))
    b.front_end.looks = [Refusal(RefusalReason.AT_TARGET, "median parallax 0.1 deg", 0.0)]
    b.step()
    b.at(0.85)
    assert b.step().state is HomingState.ARRIVED


def test_blocked_way_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Held up by obstacles is no lack of progress, for so long; then it is."""
    monkeypatch.setattr("fgslam.homing.controller.MAX_STALLS", 1)
    monkeypatch.setattr("fgslam.homing.controller.STALL_S", 1.0)
    monkeypatch.setattr("fgslam.homing.controller.WAIT_S", 2.0)
    b = bench(vector_to(0.0))
    ended = []
    for _ in range(60):
        b.controller.held_up(0.1)
        ended.append(b.step().state is HomingState.REFUSED)
    assert 0.1 * ended.index(True) == pytest.approx(3.0, abs=0.35)


@pytest.mark.parametrize("time", [0.0, -1.0, float("nan"), float("inf")])
def test_time_must_run_forward(time: float) -> None:
    """One clear line, and the homing goes on as if nothing had been said."""
    b = bench(vector_to(0.0))
    b.step()
    with pytest.raises(EstimatorError, match=r"homing: the time stamp .*; give"):
        b.controller.step(DARK, time)
    assert len(b.front_end.begun) == 1
    assert b.step().state is HomingState.DRIVE


def real_controller(
    setting: Setting, kind: HomingEkfSettings | HomingGraphSettings
) -> HomingController:
    """On the world's first target with the program's own estimator."""
    return HomingController(
        setting.front_end,
        setting.path()[0],
        lambda start: make_homing_estimator(start, kind),
    )


def test_real_estimators_survive_a_dark_second() -> None:
    """All tracks lost in one frame, light again after a second; the robot's pose is frozen."""
    setting = winding_path(3, 1, 2.0)
    setting.front_end.dark = lambda t: 0.95 < t < 1.95
    controller = real_controller(setting, HomingGraphSettings())
    states = []
    for k in range(40):
        command = controller.step(DARK, 0.1 * k)
        states.append(command.state)
        if not command.stop:
            setting.world.drive(0.2, float(np.clip(command.heading, -0.5, 0.5)), 0.1)
    assert HomingState.BLIND in states
    assert states[-1] is HomingState.DRIVE
    truth = setting.targets[0][:2] - setting.world.true_pose[:2]
    expected = wrap(np.arctan2(truth[1], truth[0]) - setting.world.true_pose[2])
    assert abs(wrap(command.heading - expected)) < np.deg2rad(5.0)


# --------------------------------------------------------------------------------------------
# Following a path through many targets; the record of a drive and its scores


@pytest.fixture(scope="module")
def record() -> DriveRecord:
    """Four legs of 2 m."""
    return drive_path(winding_path(7, 4, 2.0))


def test_path_is_followed_to_its_end(record: DriveRecord) -> None:
    """All targets reached in their order, each within 0.2 m."""
    assert record.arrived
    assert [leg.target for leg in record.legs] == [0, 1, 2, 3]
    assert {leg.result for leg in record.legs} == {"arrived"}
    assert pass_distances(record).max() < 0.2
    assert np.all(np.diff(record.target) >= 0)


def test_targets_on_the_way_are_passed_without_a_stop(record: DriveRecord) -> None:
    """A leg ends where the next begins, in one image; the robot stands at the end only."""
    for before, after in zip(record.legs[:-1], record.legs[1:], strict=True):
        assert after.began == before.ended
    moving = record.speed[(record.time > 3.0) & (record.target < 3)]
    assert moving.min() > 0.05
    driving = record.state.count(HomingState.DRIVE.value)
    assert set(record.state[driving:]) == {HomingState.ARRIVED.value}
    assert (record.speed[-1], record.turn_rate[-1]) == (0.0, 0.0)
    assert len(record) - driving < 10


def test_record_fits_together(record: DriveRecord) -> None:
    """Rows, logs and estimates belong to each other and to the truth."""
    steps = len(record)
    assert record.truth.shape == record.robot.shape == (steps, 3)
    assert record.joint.shape == (steps, 6, 6)
    assert set(record.seconds) == set(STAGES)
    for k, log in enumerate(record.homings):
        rows = np.flatnonzero(record.homing == k)
        assert log.first_step == rows[0]
        times = np.array([t.time for t in log.tracks])
        assert np.array_equal(record.time[log.steps], times)
        # The estimate in legs against the truth in metres.
        start, target = record.truth[log.first_step], record.targets[log.target]
        leg = np.hypot(*(target - start)[:2])
        moved = between(start, record.truth[rows[-1]])
        assert record.robot[rows[-1], :2] * leg == pytest.approx(moved[:2], abs=0.15)


@pytest.fixture
def _refuses_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fgslam.homing.controller.GIVE_UP_S", 0.5)
    monkeypatch.setattr("fgslam.homing.controller.FARTHER_TRIES", 0)


def follower_with_unknown(count: int) -> HomingChain:
    """Two targets on a path, the first ``count`` replaced by images from elsewhere."""
    setting = winding_path(9, count + 1, 1.0)
    elsewhere = setting.front_end.features_at(np.array([80.0, 80.0, 0.0]))
    images = [elsewhere] * count + setting.path()[count:]
    kind = HomingEkfSettings()
    return HomingChain(
        setting.front_end,
        images,
        lambda start: make_homing_estimator(start, kind),
    )


@pytest.mark.usefixtures("_refuses_soon")
def test_target_that_cannot_be_matched_is_skipped() -> None:
    """The next one can: the path goes on, and the record says so."""
    follower = follower_with_unknown(1)
    commands = [follower.step(DARK, 0.1 * k) for k in range(20)]
    assert commands[0].stop
    assert commands[-1].state is HomingState.DRIVE
    assert commands[-1].target == 1
    assert [leg.result for leg in follower.outcomes] == ["skipped"]
    assert "matches" in follower.outcomes[0].reason


def test_refusal_does_not_end_a_drive() -> None:
    """Blind for longer than a refused target is tried at a stand: looked for from farther on."""
    setting = winding_path(7, 2, 2.0)
    setting.front_end.dark = lambda t: t < 5.0
    record = drive_path(setting)
    assert HomingState.SEARCH.value in record.state
    assert [leg.result for leg in record.legs] == ["arrived", "arrived"]
    assert pass_distances(record).max() < 0.2


class Doorkeeper(CorridorAvoidance):
    """Stops the robot for so many steps on its way."""

    def __init__(self, first: int, last: int) -> None:
        super().__init__(40.0)
        self._steps, self._closed = 0, range(first, last)

    def override(self, wanted: Drive, heading: float, scan: RangeScan) -> Drive:
        """A stand while the way is closed."""
        self._steps += 1
        return Drive(0.0, 0.0, overridden=True) if self._steps in self._closed else wanted


@pytest.mark.parametrize(("wait_s", "result"), [(10.0, "arrived"), (0.0, "refused")])
def test_way_that_is_blocked_for_a_while_is_driven_on(
    wait_s: float, result: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What avoidance takes does not count as lack of progress, as long as one may wait."""
    monkeypatch.setattr("fgslam.homing.controller.MAX_STALLS", 1)
    monkeypatch.setattr("fgslam.homing.controller.STALL_S", 2.0)
    monkeypatch.setattr("fgslam.homing.controller.WAIT_S", wait_s)
    record = drive_path(winding_path(7, 1, 2.0), avoider=Doorkeeper(20, 70))
    assert [leg.result for leg in record.legs] == [result]


@pytest.mark.usefixtures("_refuses_soon")
def test_two_targets_one_after_another_are_not_skipped() -> None:
    """The path ends with the refusal, standing."""
    follower = follower_with_unknown(2)
    commands = [follower.step(DARK, 0.1 * k) for k in range(30)]
    assert follower.finished
    assert commands[-1].state is HomingState.REFUSED
    assert commands[-1].stop
    assert commands[-1].refusal is not None
    assert follower.outcomes[-1].result == "refused"


def test_drive_that_takes_too_long_is_ended() -> None:
    """From outside: the leg is unfinished, the drive not arrived."""
    settings = HomingBehaviourSettings(loop=ClosedLoopSettings(longest_s=1.0))
    record = drive_path(winding_path(7, 2, 2.0), settings)
    assert not record.arrived
    assert not record.finished
    assert record.legs[-1].result == "unfinished"
    assert "1 s" in record.legs[-1].reason


def test_empty_path_and_wrong_times_are_refused() -> None:
    """No target; time that runs backwards, also right after a switch."""
    setting = winding_path(7, 1, 2.0)
    with pytest.raises(ConfigError, match="no target image"):
        HomingChain(
            setting.front_end, [], lambda _: pytest.fail("no start"),
        )  # fmt: skip
    follower = make_follower(setting)
    follower.step(DARK, 1.0)
    with pytest.raises(EstimatorError, match=r"1\.000000000 s"):
        follower.step(DARK, 1.0)


def test_slope_knows_growth_from_noise() -> None:
    """A known slope within its interval; flat noise is flat; nothing to fit is NaN."""
    rng = np.random.default_rng(4)
    legs = np.tile(np.arange(10), 20)
    noise = rng.normal(0.0, 0.02, 200)
    growing = slope_by_leg(legs, 0.01 * legs + noise)
    assert growing.low < 0.01 < growing.high
    assert not growing.flat
    assert slope_by_leg(legs, noise).flat
    assert np.isnan(slope_by_leg(legs[:2], noise[:2]).value)


def test_slope_beside_another_cause() -> None:
    """Corners that happen to sharpen look like growth; fitted along, they do not."""
    rng = np.random.default_rng(6)
    legs = np.tile(np.arange(10), 20)
    corner = 0.05 * legs + rng.uniform(0.0, 0.5, 200)
    values = 0.05 * corner + rng.normal(0.0, 0.005, 200)
    assert not slope_by_leg(legs, values).flat
    assert slope_by_leg(legs, values, corner).flat
    growing = slope_by_leg(legs, values + 0.002 * legs, corner)
    assert growing.low < 0.002 < growing.high
    assert not growing.flat
    assert np.isnan(slope_by_leg(legs, values, np.ones(200)).value)


def test_corners_are_those_of_the_targets_lines(record: DriveRecord) -> None:
    """Straight on, a right angle, and back."""
    places = np.array([[1.0, 0.0], [2.0, 0.0], [2.0, 1.0], [2.0, 0.2]])
    drawn = replace(
        record, truth=np.zeros((len(record), 3)), targets=np.column_stack([places, np.zeros(4)])
    )
    assert corners(drawn) == pytest.approx([0.0, 0.0, 1.0, 1.0])
    twice = replace(drawn, targets=drawn.targets[[0, 1, 1, 2, 3]])
    assert corners(twice) == pytest.approx([0.0, 0.0, np.nan, np.nan, 1.0], nan_ok=True)


def test_scores_of_a_drive_that_one_can_draw(record: DriveRecord) -> None:
    """A straight drive 0.1 m beside two targets: that far from both, and off the line by it."""
    x = np.linspace(0.0, 2.0, 21)
    drawn = replace(
        record,
        truth=np.column_stack([x, np.full(21, 0.1), np.zeros(21)]),
        end=np.array([2.0, 0.1, 0.0]),
        targets=np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]),
        target=(np.arange(21) > 9).astype(np.int64),
    )
    assert pass_distances(drawn) == pytest.approx([0.1, 0.1])
    assert cross_track(drawn)[1] == pytest.approx(0.1)
    unreached = replace(drawn, targets=np.vstack([drawn.targets, [[3.0, 0.0, 0.0]]]))
    assert np.isinf(pass_distances(unreached)[2])
    assert np.isnan(cross_track(unreached)[2])
