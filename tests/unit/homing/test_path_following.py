"""Following a path through many targets; the record of a drive and its scores."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fgslam.backend.homing.estimators import make_homing_estimator
from fgslam.backend.homing.settings import HomingEkfSettings, HomingGraphSettings
from fgslam.core.errors import ConfigError, EstimatorError
from fgslam.core.planar import between
from fgslam.homing.closed_loop import (
    STAGES,
    DriveRecord,
    corners,
    cross_track,
    pass_distances,
    slope_by_leg,
)
from fgslam.homing.controller import HomingChain
from fgslam.homing.settings import (
    ClosedLoopSettings,
    HomingBehaviourSettings,
    HomingControlSettings,
)
from fgslam.homing.steering import Drive, HomingState, RangeScan
from tests.landmark_world import DARK, drive_path, make_follower, winding_path


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


def test_heading_does_not_oscillate(record: DriveRecord) -> None:
    """Within a leg the turning rate changes its sign rarely."""
    rates = record.turn_rate[np.abs(record.turn_rate) > np.deg2rad(5.0)]
    changes = np.count_nonzero(np.diff(np.sign(rates)))
    assert changes < 4 * len(record.legs)


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


def test_remaining_share_of_the_way_falls_and_matches_the_truth(record: DriveRecord) -> None:
    """Monotone but for noise, and right to a tenth at mid-leg."""
    for k in range(4):
        rows = np.flatnonzero((record.target == k) & (record.homing >= 0))
        left = record.remaining[rows]
        assert np.all(np.diff(left) < 0.05)
        true = np.hypot(*(record.truth[rows, :2] - record.targets[k, :2]).T)
        middle = int(np.argmin(np.abs(true / true[0] - 0.5)))
        assert left[middle] == pytest.approx(true[middle] / true[0], abs=0.1)


def test_same_seed_same_drive(record: DriveRecord) -> None:
    """Bit for bit, wall times apart."""
    again = drive_path(winding_path(7, 4, 2.0))
    assert np.array_equal(again.truth, record.truth)
    assert np.array_equal(again.joint, record.joint, equal_nan=True)
    assert again.reason == record.reason


def test_graph_drives_as_well() -> None:
    """The same loop with the other estimator."""
    record = drive_path(winding_path(8, 2, 2.0), estimator=HomingGraphSettings())
    assert record.arrived
    assert pass_distances(record).max() < 0.2


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
        HomingControlSettings(),
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


class Doorkeeper:
    """Stops the robot for so many steps on its way."""

    def __init__(self, first: int, last: int) -> None:
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
            setting.front_end, [], lambda _: pytest.fail("no start"), HomingControlSettings(),
        )  # fmt: skip
    follower = make_follower(setting, HomingBehaviourSettings())
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
