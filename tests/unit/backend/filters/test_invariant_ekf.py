"""The joint filter with right-invariant errors."""

from __future__ import annotations

import numpy as np
import pytest
from simulated import RIG, Drive, simulate, tracked_at

from fgslam.backend.filters.ekf import GrowingCovariance
from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import EkfSettings, InvariantEkfSettings
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.sensors import Increment, Odometry
from fgslam.core.store import state_of
from fgslam.core.types import Prediction
from fgslam.factors.models import Position
from fgslam.slam.build import make_estimator

UNKNOWN = np.diag([0.2, 0.3, 0.2, 0.5, 0.4, 0.6]) ** 2
"""Of a first pose that is known to half a radian."""
DRIVE = Drive(
    frames=10,
    points=25,
    twist=(0.0, 0.1, 0.0, 0.0, 0.0, 0.1),
    odometry_sigma=(2e-2,) * 3 + (5e-2,) * 3,
    sigma_px=(0.3, 0.3, 0.3),
)


def make(kind: str, prior: FloatArray = UNKNOWN, floor: str = "none") -> Estimator:
    settings = InvariantEkfSettings if kind == "invariant_ekf" else EkfSettings
    return make_estimator(RIG, settings(floor=floor), prior=Prediction(np.eye(4), prior))


def in_camera(estimator: Estimator) -> FloatArray:
    return g.transform_to_camera(estimator.predict(None).wTc, estimator.landmarks().positions)


@pytest.mark.parametrize(("kind", "stays"), [("invariant_ekf", True), ("ekf", False)])
def test_a_world_that_turns_takes_pose_and_map_along_as_one(kind: str, stays: bool) -> None:
    """Only their motion together is uncertain; antennas on masts show it to be wrong."""
    first = simulate(DRIVE, np.random.default_rng(1)).increments[0]
    antennas = [Position(g.pose(np.eye(3), np.array(arm))) for arm in ([3.0, 0, 0], [0, 0, 3.0])]
    turned = g.so3_exp(np.array([0.3, -0.4, 0.2]))
    measured = [
        one.measured(turned @ one.bTs[:3, 3] + [0.5, -0.3, 0.2], 1e-6 * np.eye(3))
        for one in antennas
    ]
    estimator = make(kind)
    estimator.update(first, tracked_at(estimator.predict(None), 0))
    before = in_camera(estimator)
    later = Increment.of(1, 1.0, Odometry(np.eye(4), np.zeros((6, 6))), measured)
    estimator.update(later, tracked_at(estimator.predict(None), 0))
    moved = np.linalg.norm(in_camera(estimator) - before, axis=1)
    assert g.rotation_angle(estimator.predict(None).wTc[:3, :3]) > 0.3
    assert (moved.max() < 1e-9) == stays


def information(estimator: Estimator) -> FloatArray:
    """(6, 6) of the motions of the whole world, pose and landmarks alike."""
    wTc, held = estimator.predict(None).wTc, estimator.landmarks()
    directions = np.zeros((6 + 3 * len(held), 6))
    directions[:6] = g.adjoint(g.inverse(wTc))
    directions[6:, :3] = -g.skew(held.positions).reshape(-1, 3)
    directions[6:, 3:] = np.tile(np.eye(3), (len(held), 1))
    joint = GrowingCovariance.unpacked(state_of(estimator)["covariance"])
    joint = joint.columns(np.arange(len(directions)))
    return np.asarray(directions.T @ np.linalg.solve(joint, directions))


@pytest.mark.parametrize(("kind", "gains"), [("invariant_ekf", False), ("ekf", True)])
def test_landmarks_tell_nothing_of_where_the_whole_world_is(kind: str, gains: bool) -> None:
    simulation = simulate(DRIVE, np.random.default_rng(2))
    estimator = make(kind)
    found = []
    for increment in simulation.increments:
        estimator.update(increment, tracked_at(estimator.predict(increment.odometry), 0))
        found.append(np.diagonal(information(estimator)))
    # A new landmark's error is its own, and odometry takes information away.
    np.testing.assert_allclose(found[0], 1.0 / np.diagonal(UNKNOWN), rtol=1e-6, atol=0)
    assert (found[-1].max() > 1.05 * found[0].max()) == gains
