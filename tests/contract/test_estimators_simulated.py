"""More of the contract: truth without noise, moved priors, and replays that repeat live runs.

The estimators are those that ``test_estimators.SETTINGS`` lists.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from simulated import (
    RIG,
    TURN_AND_GO,
    Drive,
    FeatureWorld,
    assert_same_bits,
    play,
    points_in_views,
    simulate,
)
from smoothing import relinearise_beyond
from test_estimators import SETTINGS

from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import EstimatorSettings, FastSlamSettings
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.log import Frame
from fgslam.core.sensors import Odometry
from fgslam.core.store import state_of
from fgslam.core.types import Prediction
from fgslam.frontend.settings import EgoMotionSettings, FrontendSettings
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver
from fgslam.slam.build import make_estimator, make_stereo, make_tracker
from fgslam.slam.feature_stream import FeatureFrame
from fgslam.slam.motion import ConstantVelocityMotion, OdometryMotion
from fgslam.slam.pipeline import FrameReport, SlamPipeline
from fgslam.slam.replay import replay_frame

DRIVE = Drive(frames=8, points=90)
SIXDOF = EgoMotionSettings(dof=6)


def build(settings: EstimatorSettings, prior: Prediction) -> Estimator:
    """An estimator that starts at the prior."""
    return make_estimator(RIG, settings, prior=prior)


@pytest.fixture(params=SETTINGS)
def settings(request: pytest.FixtureRequest) -> EstimatorSettings:
    return SETTINGS[request.param]


def at_origin(settings: EstimatorSettings) -> Estimator:
    return make_estimator(RIG, settings)


def test_exact_measurements_give_the_exact_truth(settings: EstimatorSettings) -> None:
    simulation = simulate(dataclasses.replace(DRIVE, noise=0.0), np.random.default_rng(1))
    if isinstance(settings, FastSlamSettings):  # more particles are drawn by the stated noise
        settings = dataclasses.replace(settings, particles=1)
    estimator = at_origin(settings)
    stats = play(estimator, simulation.increments, SIXDOF)
    estimate = estimator.estimate()
    np.testing.assert_allclose(estimate.trajectory.poses, simulation.poses, rtol=0, atol=1e-6)
    truth = simulation.points_by_id[estimate.landmarks.ids]
    np.testing.assert_allclose(estimate.landmarks.positions, truth, rtol=0, atol=1e-5)
    innovations = [s.nis for s in stats if s.nis_dof]
    assert innovations or settings.kind == "odometry"
    assert max(innovations, default=0.0) < 1e-3


def test_a_moved_prior_moves_everything_rigidly(
    settings: EstimatorSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    increments = simulate(DRIVE, np.random.default_rng(5)).increments
    moved_by = g.se3_exp(np.array([0.4, -0.7, 0.2, 5.0, -3.0, 2.0]))
    covariance = 1e-6 * np.eye(6)
    # Left unlinearised, what has moved by less than the threshold differs with the world.
    relinearise_beyond(monkeypatch, 1e-9)
    here = build(settings, Prediction(np.eye(4), covariance))
    there = build(settings, Prediction(moved_by, covariance))
    play(here, increments, SIXDOF)
    play(there, increments, SIXDOF)
    a, b = here.estimate(), there.estimate()
    np.testing.assert_allclose(b.trajectory.poses, moved_by @ a.trajectory.poses, rtol=0, atol=1e-6)
    # Particles' weights differ by rounding, which processors do differently: 0.2 % of a variance.
    np.testing.assert_allclose(b.covariances, a.covariances, rtol=1e-3, atol=2e-9)
    np.testing.assert_array_equal(b.landmarks.ids, a.landmarks.ids)
    expected = g.transform_to_world(moved_by, a.landmarks.positions)
    np.testing.assert_allclose(b.landmarks.positions, expected, rtol=0, atol=1e-6)
    turned = g.congruence(moved_by[:3, :3], a.landmarks.covariances)
    np.testing.assert_allclose(b.landmarks.covariances, turned, rtol=1e-3, atol=1e-7)


# --------------------------------------------------------------------------------------------
# A live run, from ideal features on, against the replay of its log


FRAMES, POINTS = 12, 100
NO_IMAGE, NO_ODOMETRY = (5, 6), (4, 9)


def camera_odometry(rng: np.random.Generator) -> list[Odometry | None]:
    """Body motion of the drive's twist, with noise in all six degrees of freedom."""
    sigma = np.array(DRIVE.odometry_sigma)
    step = RIG.bTc @ g.se3_exp(np.array(TURN_AND_GO)) @ g.inverse(RIG.bTc)
    noisy = [step @ g.se3_exp(sigma * rng.standard_normal(6)) for _ in range(FRAMES)]
    return [
        None if i in (0, *NO_ODOMETRY) else Odometry(motion, np.diag(sigma**2))
        for i, motion in enumerate(noisy)
    ]


def live_run(
    settings: EstimatorSettings, frontend: FrontendSettings
) -> tuple[Estimator, list[FrameReport], FloatArray]:
    rng = np.random.default_rng(7)
    poses = [np.eye(4)]
    for _ in range(FRAMES - 1):
        poses.append(poses[-1] @ g.se3_exp(np.array(TURN_AND_GO)))
    world = FeatureWorld(
        points_in_views(dataclasses.replace(DRIVE, points=POINTS), poses, rng), rng
    )
    stand_in = ConstantVelocityMotion()
    odometry = camera_odometry(rng)
    pipeline = SlamPipeline(
        stereo=make_stereo(RIG, frontend),
        tracker=make_tracker(RIG, frontend),
        motion=OdometryMotion(RIG.bTc, "recorded", stand_in),
        estimator=at_origin(settings),
    )
    image = np.zeros((RIG.height, RIG.width), np.uint8)
    reports = []
    for i, wTc in enumerate(poses):
        features = world.features(wTc, sigma_px=0.2, hidden=rng.choice(POINTS, POINTS // 10))
        frame = Frame(i, 0.5 * i, (image,) * 3)
        found = FeatureFrame(i, frame, features, "", 0.0, 0.0)
        if i in NO_IMAGE:
            found = FeatureFrame(i, None, (), "not there", 0.0, 0.0)
        reports.append(pipeline.process(found, i, 0.5 * i, odometry[i]))
    return pipeline.estimator, reports, np.array(poses)


def frontend_settings(dof: int, rescue: bool) -> FrontendSettings:
    default = FrontendSettings()
    return dataclasses.replace(
        default,
        ego_motion=dataclasses.replace(default.ego_motion, dof=dof),
        matching=dataclasses.replace(default.matching, rescue=rescue, refine=rescue),
    )


@pytest.mark.parametrize(
    ("settings", "dof", "rescue"),
    [*((name, 6, True) for name in SETTINGS), ("landmark_kalman", 3, False)],
    indirect=["settings"],
)
def test_a_replay_repeats_the_live_run(settings: EstimatorSettings, dof: int, rescue: bool) -> None:
    """To the last bit, over missing images and missing odometry."""
    frontend = frontend_settings(dof, rescue)
    live, reports, truth = live_run(settings, frontend)
    error = live.estimate().trajectory.poses[:, :3, 3] - truth[:, :3, 3]
    assert np.linalg.norm(error, axis=1).max() < 0.2
    assert sum(r.tracking.status.measured for r in reports) >= FRAMES - len(NO_IMAGE) - 1
    replayed = at_origin(settings)
    solver = EgoMotionSolver(RIG, frontend.ego_motion)
    motion = ConstantVelocityMotion()
    stats = [
        replay_frame(report.increment, replayed, solver, motion, k).stats
        for k, report in enumerate(reports)
    ]
    assert_same_bits([s.wTc for s in stats], [r.stats.wTc for r in reports])
    assert_same_bits(state_of(replayed), state_of(live))
