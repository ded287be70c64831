"""Whether a robot went on or was carried off: by what neighbouring images have in common."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from fgslam.core.homing import BearingMatches, Refusal, RefusalReason
from fgslam.homing.places import Continuity, in_common

CHANCE, MOST = 0.02, 400


def after(steps: Iterable[int], common: int) -> float:
    """Probability of being carried off in one more step."""
    drive = Continuity(CHANCE)
    for one in steps:
        drive.carried_off(one, MOST)
    return drive.carried_off(common, MOST)


def test_few_features_in_common_after_many_is_being_carried_off() -> None:
    assert after([210, 180, 200, 190, 220, 205], 8) > 0.8
    assert after([210, 180, 200, 190, 220, 205], 170) < CHANCE


def test_a_drive_whose_images_share_little_is_no_alarm() -> None:
    """As on a dim floor with a panorama every few metres: some pairs share nothing."""
    assert after([150, 0, 20, 90, 0, 0, 30, 0, 120], 0) < 3.0 * CHANCE


def test_a_robot_that_stood_and_drives_on_was_not_carried_off() -> None:
    """Standing, images are nearly alike; from the first step on 0.6 of it is left."""
    assert after([390, 391, 389, 390] * 20, 230) < 0.5


def test_what_followed_a_leap_does_not_count_as_usual() -> None:
    """Carried off twice: the second time is noticed like the first."""
    usual = [200, 190, 210, 205, 195, 200, 190, 210]
    assert after([*usual, 5, *usual], 5) == pytest.approx(after([*usual, *usual], 5))
    assert after([*usual, 5, *usual], 5) > 0.9


def alarms(steps: Iterable[int]) -> list[bool]:
    """Of each step, whether the robot was rather carried off than not."""
    drive = Continuity(CHANCE)
    return [drive.carried_off(one, 1000) > 0.5 for one in steps]


@pytest.mark.parametrize(
    ("before", "lasting"),
    [
        ([900] * 25, [200] * 200),  # stood, and drives on
        ([300, 310, 290, 305, 295] * 5, [60, 55, 62, 58] * 50),  # faster, or the light went down
        ([900] * 25, [200, 900, 900] * 60),  # by fits and starts
        ([900] * 25, [200] * 30 + [900] * 3 + [200] * 30),  # a short stand more
    ],
)
def test_a_lasting_change_is_taken_as_usual_after_two_alarms(
    before: list[int], lasting: list[int]
) -> None:
    said = alarms([*before, *lasting])
    assert not any(said[: len(before)])
    assert sum(said) == sum(said[len(before) : len(before) + 5]) == 2


def test_being_carried_off_is_noticed_at_the_new_level_too() -> None:
    assert alarms([*[900] * 25, *[200, 190, 210] * 4, 3])[-1]


def test_carried_off_again_and_again_is_noticed_each_time() -> None:
    """Every seventh image, as by somebody who plays with the robot."""
    legs = [200, 190, 210, 205, 195, 200]
    said = alarms([*legs * 2, *[4, *legs] * 5])
    assert [k for k, one in enumerate(said) if one] == [12, 19, 26, 33, 40]


def test_the_first_step_says_nothing() -> None:
    assert after([], 3) == CHANCE


@pytest.mark.parametrize(
    ("reason", "common"), [(RefusalReason.AT_TARGET, 5), (RefusalReason.TOO_FEW_INLIERS, 0)]
)
def test_without_a_way_between_them_all_matches_are_common(
    reason: RefusalReason, common: int
) -> None:
    none = np.zeros(5)
    matches = BearingMatches(
        kind=np.zeros(5, np.int64),
        index_a=np.arange(5),
        index_b=np.arange(5),
        bearing_a=none,
        elevation_a=none,
        bearing_b=none,
        elevation_b=none,
        sigma=np.ones((5, 4)),
        quality=none,
    )
    assert in_common(Refusal(reason, ""), matches) == common
