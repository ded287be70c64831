"""Frames whose prediction fails are found by what was seen lately, or not at all."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from simulated import RIG, FeatureWorld, points_in_view
from test_tracker import CERTAIN, SETTINGS, Scene

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.types import EgoMotionStatus, Prediction
from fgslam.frontend.tracking import tracker as regaining
from fgslam.frontend.tracking.tracker import Tracked, log_false_poses, places

RESCUING = dataclasses.replace(
    SETTINGS, matching=dataclasses.replace(SETTINGS.matching, rescue=True)
)
TURNED = g.se3_exp(np.array([0.05, 0.2, -0.1, 0.2, 0.05, 0.1]))  # 13 degrees, half the image
ABSURD = g.se3_exp(np.array([0.0, 2.5, 0.0, -4.0, 0.0, 1.0]))  # looks away from all landmarks


def tracked_at(scene: Scene, predicted: FloatArray, wTc: FloatArray = TURNED) -> Tracked:
    stereo = scene.stereo.match(scene.world.features(wTc, sigma_px=0.1))
    return scene.tracker.track(Prediction(predicted, CERTAIN), scene.map, stereo)


@pytest.fixture
def scene() -> Scene:
    begun = Scene(RESCUING, 150)
    begun.step(np.eye(4))
    return begun


@pytest.mark.parametrize("predicted", [np.eye(4), ABSURD], ids=["turned", "absurd"])
def test_a_frame_is_found_whatever_was_predicted(scene: Scene, predicted: FloatArray) -> None:
    found = tracked_at(scene, predicted).ego_motion
    assert found.status is EgoMotionStatus.RELOCALISED
    assert found.inliers.sum() > 30
    np.testing.assert_allclose(g.se3_log(g.inverse(TURNED) @ found.wTc), 0.0, atol=4e-3)


def test_the_same_frame_gives_the_same_bits(scene: Scene) -> None:
    stereo = scene.stereo.match(scene.world.features(TURNED, sigma_px=0.1))
    wrong = Prediction(ABSURD, CERTAIN)
    first, again = (scene.tracker.track(wrong, scene.map, stereo).ego_motion for _ in range(2))
    assert first.status is EgoMotionStatus.RELOCALISED
    np.testing.assert_array_equal(first.wTc, again.wTc)
    np.testing.assert_array_equal(first.covariance, again.covariance)


def test_nobody_looks_for_a_frame_that_was_foreseen(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(regaining.Regainer, "find", lambda *_: pytest.fail("looked for"))
    assert tracked_at(scene, TURNED).ego_motion.status is EgoMotionStatus.OK


def test_other_surroundings_are_not_taken_for_known_ones(scene: Scene) -> None:
    rng = np.random.default_rng(5)
    scene.world = FeatureWorld(points_in_view(RIG, 150, (1.5, 5.0), rng), rng)
    found = tracked_at(scene, np.eye(4)).ego_motion
    assert found.status is EgoMotionStatus.TOO_FEW_MATCHES


@pytest.mark.parametrize(("share", "believed"), [(0.25, True), (0.5, False)])
def test_what_moved_together_may_not_rival_the_rest(
    scene: Scene, share: float, believed: bool
) -> None:
    """A part of the view has moved by itself: small it is left out, large it is one of two."""
    moved = g.se3_exp(np.array([0.0, 0.0, 0.1, 0.6, 0.1, -0.3]))
    part = scene.world.points[:, 0] < np.quantile(scene.world.points[:, 0], share)
    scene.world.points[part] = g.transform_to_world(moved, scene.world.points[part])
    found = tracked_at(scene, ABSURD, np.eye(4)).ego_motion
    assert found.status.measured is believed
    if believed:
        np.testing.assert_allclose(g.se3_log(found.wTc), 0.0, atol=4e-3)


def test_a_stiff_wrong_prediction_does_not_win_by_a_handful_of_matches(scene: Scene) -> None:
    """Most far landmarks stay where they were; the near ones tell that the camera moved on."""
    step = g.se3_exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.5]))
    stiff = Prediction(np.eye(4), np.diag([1e-4] * 6) ** 2)
    stereo = scene.stereo.match(scene.world.features(step, sigma_px=0.1))
    found = scene.tracker.track(stiff, scene.map, stereo).ego_motion
    np.testing.assert_allclose(g.se3_log(g.inverse(step) @ found.wTc), 0.0, atol=4e-3)


def test_a_few_matches_where_they_were_predicted_do_not_hide_all_others(scene: Scene) -> None:
    """A tenth of the landmarks, moved with the camera, fit the wrong pose that was predicted."""
    few = scene.world.points[:, 0] < np.quantile(scene.world.points[:, 0], 0.1)
    scene.world.points[few] = g.transform_to_world(TURNED, scene.world.points[few])
    stereo = scene.stereo.match(scene.world.features(TURNED, sigma_px=0.1))
    around = Prediction(np.eye(4), CERTAIN)
    wrong = scene.tracker.match_and_solve(around, around, scene.map, stereo).ego_motion
    assert wrong.status is EgoMotionStatus.OK
    assert wrong.coherent
    found = scene.tracker.track(around, scene.map, stereo).ego_motion
    assert found.status is EgoMotionStatus.RELOCALISED
    np.testing.assert_allclose(g.se3_log(g.inverse(TURNED) @ found.wTc), 0.0, atol=4e-3)


@pytest.mark.parametrize("returns", [False, True])
def test_new_ground_is_no_reason_to_look(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, returns: bool
) -> None:
    """A sound pose that a third of the features agree with, where two thirds are seen first."""
    monkeypatch.setattr(regaining.Regainer, "find", lambda *_: pytest.fail("looked for"))
    scene.tracker.expects_returns = returns
    known = scene.map.without(np.delete(scene.map.ids, np.s_[::3]))
    stereo = scene.stereo.match(scene.world.features(np.eye(4), sigma_px=0.1))
    found = scene.tracker.track(Prediction(np.eye(4), CERTAIN), known, stereo).ego_motion
    assert found.status is EgoMotionStatus.OK
    assert found.inliers.sum() < 0.4 * len(stereo)


@pytest.mark.parametrize("returns", [False, True])
def test_few_matches_are_a_reason_whoever_else_looks(scene: Scene, returns: bool) -> None:
    scene.tracker.expects_returns = returns
    few = scene.world.points[:, 0] < np.quantile(scene.world.points[:, 0], 0.1)
    scene.world.points[few] = g.transform_to_world(TURNED, scene.world.points[few])
    found = tracked_at(scene, np.eye(4)).ego_motion
    assert found.status is EgoMotionStatus.RELOCALISED


def test_only_what_was_seen_lately_is_looked_for(scene: Scene) -> None:
    """A map from which the run has seen nothing for long is the business of place recognition."""
    rng = np.random.default_rng(5)
    old, scene.world = (
        scene.world,
        FeatureWorld(points_in_view(RIG, 80, (1.5, 5.0), rng), rng),
    )
    for _ in range(regaining.LATELY + 1):
        scene.step(np.eye(4))
    scene.world = old
    assert not tracked_at(scene, ABSURD).ego_motion.status.measured


def test_number_of_false_poses_is_that_of_moisan_and_stival() -> None:
    """(10 - 3) C(10, 5) C(5, 3) 0.01^2 = 7 * 252 * 10 * 1e-4."""
    assert math.exp(log_false_poses(10, 5, 3, 0.01)) == pytest.approx(1.764)
    assert log_false_poses(10, 3, 3, 0.01) == math.inf


def test_matches_at_one_place_count_once() -> None:
    assert places(np.array([[10.0, 10.0], [10.5, 10.9], [40.0, 10.0]]), 3.0) == 2


def test_landmarks_described_lately(scene: Scene) -> None:
    database = scene.tracker.database
    first = set(database.ids.tolist())
    for _ in range(2):
        scene.step(np.eye(4), hidden=np.arange(75))
    assert first <= set(database.described_lately(2).tolist())
    left = first & set(database.described_lately(1).tolist())
    assert not left & set(scene.ids_at(np.arange(75)).tolist())
    assert len(left) > 60


def test_doubles_seen_before_do_not_hide_what_the_last_frame_saw(scene: Scene) -> None:
    """Among all of lately each feature has two landmarks that look alike; at last it has one."""
    rng, before = np.random.default_rng(6), scene.world
    scene.world = FeatureWorld(points_in_view(RIG, 150, (1.5, 5.0), rng), rng)
    scene.world.descriptors = before.descriptors
    scene.step(np.eye(4))
    found = tracked_at(scene, ABSURD).ego_motion
    assert found.status is EgoMotionStatus.RELOCALISED
    np.testing.assert_allclose(g.se3_log(g.inverse(TURNED) @ found.wTc), 0.0, atol=4e-3)
