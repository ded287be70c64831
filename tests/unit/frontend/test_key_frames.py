"""When carried landmarks place a frame, and when it is left to SIFT."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fgslam.core.estimates import EgoMotion, EgoMotionStatus
from fgslam.frontend.tracking.carrying import Carried
from fgslam.frontend.tracking.key_frames import CarriedFrame

ENOUGH = 40


def frame(inliers: int, outliers: int, status: EgoMotionStatus = EgoMotionStatus.OK) -> Any:
    used = np.arange(inliers + outliers) < inliers
    pose = EgoMotion(np.eye(4), np.eye(6), used, np.zeros(len(used)), status, 1)
    tracked: Any = SimpleNamespace(ego_motion=pose)
    return CarriedFrame(Carried.nothing(), tracked, lasting=True)


@pytest.mark.parametrize(
    ("inliers", "outliers", "placed"),
    [(ENOUGH, 0, True), (ENOUGH - 1, 0, False), (100, 100, True), (100, 101, False)],
)
def test_enough_landmarks_that_mostly_agree_place_a_frame(
    inliers: int, outliers: int, placed: bool
) -> None:
    found = frame(inliers, outliers)
    assert found.placed is placed
    assert found.suffices is placed


def test_a_pose_that_was_not_measured_places_nothing() -> None:
    assert not frame(100, 0, EgoMotionStatus.DIVERGED).placed


def test_few_that_are_left_ask_for_a_key_frame_beside_which_they_are_used() -> None:
    found = replace(frame(100, 0), lasting=False)
    assert found.placed
    assert not found.suffices
