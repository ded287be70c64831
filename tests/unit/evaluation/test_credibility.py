"""Stated covariances against errors: other programs' formulas, tangent spaces, what mends them."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import logm
from scipy.spatial.transform import Rotation

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.types import Trajectory, pose_rows
from fgslam.evaluation.credibility import (
    Tangent,
    accumulated,
    credibility,
    guess_tangent,
    independent_count,
    turned_axes,
)

SPACES = ("local", "global", "split_local", "split_global")
ORDERS = ("rotation_first", "translation_first")
NOISE = np.diag([1e-6, 4e-6, 2e-6, 4e-5, 1e-4, 9e-4])


def dead_reckoning(seed: int, frames: int = 120) -> tuple[Trajectory, FloatArray, Trajectory]:
    """A path whose steps are noisy, its exact covariances in our tangent space, and the truth."""
    rng = np.random.default_rng(seed)
    true, poses, covariances = [np.eye(4)], [np.eye(4)], [np.zeros((6, 6))]
    for k in range(1, frames):
        twist = np.array([0.03 * np.sin(k / 9), 0.05, 0.02 * np.cos(k / 7), 0.0, 0.0, 0.2])
        step = g.se3_exp(twist)
        measured = step @ g.se3_exp(rng.multivariate_normal(np.zeros(6), NOISE))
        true.append(true[-1] @ step)
        poses.append(poses[-1] @ measured)
        covariances.append(g.compose_covariance(measured, covariances[-1], NOISE))
    times = 0.1 * np.arange(frames)
    known = Trajectory(times, np.array(true))
    return Trajectory(times, np.array(poses)), np.array(covariances), known


def as_stated(tangent: Tangent, poses: FloatArray, local: FloatArray) -> FloatArray:
    """Covariances of our tangent space as another program would write them."""
    out = []
    for wTb, covariance in zip(poses, local, strict=True):
        change, wRb = np.eye(6), wTb[:3, :3]
        if tangent.space == "global":
            change = g.adjoint(wTb)
        if tangent.space.startswith("split"):
            change[3:, 3:] = wRb
        if tangent.space == "split_global":
            change[:3, :3] = wRb
        given = change @ covariance @ change.T
        if tangent.unit == "degrees":
            scale = np.diag(np.repeat([np.degrees(1.0), 1.0], 3))
            given = scale @ given @ scale
        swap = [3, 4, 5, 0, 1, 2] if tangent.order == "translation_first" else list(range(6))
        out.append(given[np.ix_(swap, swap)])
    return np.array(out)


def openvins(
    estimate: FloatArray, true: FloatArray, ori: FloatArray, pos: FloatArray
) -> list[float]:
    """NEES of orientation and of position of one pose by JPL quaternions (ov_eval)."""

    def rotation_to_body(q: FloatArray) -> FloatArray:
        x, y, z, w = q
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        v = np.array([x, y, z])
        return np.asarray((2 * w**2 - 1) * np.eye(3) - 2 * w * cross + 2 * np.outer(v, v))

    off = rotation_to_body(true[3:]) @ rotation_to_body(estimate[3:]).T
    theta = -Rotation.from_matrix(off).as_rotvec()
    moved = true[:3] - estimate[:3]
    return [theta @ np.linalg.inv(ori) @ theta, moved @ np.linalg.inv(pos) @ moved]


def test_rotation_and_position_are_openvins_and_the_pose_is_cnspy_s_type_5() -> None:
    """Exactly, at errors of some degrees: errors are those that the covariance is stated for."""
    rng = np.random.default_rng(4)
    path, local, truth = dead_reckoning(1, 40)
    wide = path.poses @ np.array([g.se3_exp(0.05 * rng.normal(size=6)) for _ in range(40)])
    stated = as_stated(Tangent(space="split_local"), wide, local + 1e-3 * np.eye(6))
    stated[:, :3, 3:] = stated[:, 3:, :3] = 0.0
    own = Tangent(space="split_local").to_local(wide, stated)
    found = credibility(wide, own, truth.poses, split=True).nees
    ours, theirs = pose_rows(wide), pose_rows(truth.poses)
    each = np.array([openvins(a, b, c[:3, :3], c[3:, 3:])
                     for a, b, c in zip(ours, theirs, stated, strict=True)])  # fmt: skip
    turned = Rotation.from_quat(ours[:, 3:]).inv() * Rotation.from_quat(theirs[:, 3:])
    errors = np.hstack([theirs[:, :3] - ours[:, :3], turned.as_rotvec()])  # position first
    swap = np.ix_([3, 4, 5, 0, 1, 2], [3, 4, 5, 0, 1, 2])
    cnspy = [e @ np.linalg.inv(c[swap]) @ e for e, c in zip(errors, stated, strict=True)]
    expected = {
        "rotation": each[:, 0].mean() / 3.0,
        "position": each[:, 1].mean() / 3.0,
        "pose": np.mean(cnspy) / 6.0,
    }
    for name, value in expected.items():
        consistency = found[name]
        assert consistency is not None
        assert consistency.per_dof == pytest.approx(value, abs=1e-6)


def test_the_pose_in_a_local_tangent_space_is_cnspy_s_type_1_on_se3() -> None:
    path, local, truth = dead_reckoning(2, 30)
    stated = local + 1e-6 * np.eye(6)
    expected = []
    for wTe, wTt, covariance in zip(path.poses, truth.poses, stated, strict=True):
        off = np.real(logm(np.linalg.inv(wTe) @ wTt))
        xi = np.array([off[2, 1], off[0, 2], off[1, 0], *off[:3, 3]])
        expected.append(xi @ np.linalg.inv(covariance) @ xi / 6.0)
    found = credibility(path.poses, stated, truth.poses, split=False).nees["pose"]
    assert found is not None
    assert found.per_dof == pytest.approx(np.mean(expected), abs=1e-6)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("space", SPACES)
def test_the_tangent_space_is_told_from_the_errors(order: str, space: str) -> None:
    """Each of three drives, whose covariances grow; degrees are not suspected."""
    written = Tangent(order, space)
    for seed in range(3):
        path, local, truth = dead_reckoning(seed)
        stated = as_stated(written, path.poses, local)
        found = guess_tangent(path, stated, truth, frozenset(), "")
        assert "guess" in found[1]
        assert found[0] == written
        np.testing.assert_allclose(written.to_local(path.poses, stated), local, atol=1e-12)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("space", ["local", "split_global"])
def test_errors_alone_tell_the_order_and_what_they_leave_open(order: str, space: str) -> None:
    """Independent poses, whose covariances do not grow: as of localisation."""
    rng = np.random.default_rng(3)
    path, _, truth = dead_reckoning(0)
    sigma = np.array([0.01, 0.002, 0.002, 0.1, 0.02, 0.02])
    local = np.tile(np.diag(sigma**2), (len(path), 1, 1))
    poses = truth.poses @ np.array([g.se3_exp(-sigma * e) for e in rng.normal(size=(len(path), 6))])
    poses[0] = truth.poses[0]
    written = Tangent(order, space)
    stated = as_stated(written, poses, local)
    found = guess_tangent(Trajectory(path.timestamps, poses), stated, truth, frozenset(), "")
    assert found[0].order == order
    assert found[0] == written or str(written) in found[1]


def test_degrees_are_told_from_radians() -> None:
    path, local, truth = dead_reckoning(0)
    for unit in ("radians", "degrees"):
        written = Tangent(unit=unit)
        stated = as_stated(written, path.poses, local)
        words = frozenset({"rotation_first", "local"})
        assert guess_tangent(path, stated, truth, words, "")[0] == written


def test_a_statement_holds_and_is_contradicted_where_the_errors_do_so() -> None:
    path, local, truth = dead_reckoning(0)
    words = frozenset({"translation_first", "local", "radians"})
    found = guess_tangent(path, local, truth, words, "")
    assert (found[0].order, found[1]) == ("translation_first", "")
    assert found[2] is not None
    assert found[2].order == "rotation_first"
    right = guess_tangent(path, local, truth, frozenset({"rotation_first", "local"}), "")
    assert right[2] is None


def test_the_usual_space_is_left_only_where_the_errors_demand_it() -> None:
    """Nothing tells the axes of body and world apart of what is stated alike along all."""
    path, _, truth = dead_reckoning(0)
    round_ones = np.tile(np.diag(np.repeat([0.04, 0.0004], 3)), (len(path), 1, 1))
    found = guess_tangent(path, round_ones, truth, frozenset({"translation_first"}), "split_global")
    assert found[0] == Tangent("translation_first", "split_global")
    assert "not surely" in found[1]


@pytest.mark.parametrize("factor", [0.25, 1.0, 4.0])
def test_the_factor_mends_stated_deviations(factor: float) -> None:
    rng = np.random.default_rng(0)
    truth = np.tile(np.eye(4), (2000, 1, 1))
    covariance = np.diag([1e-4, 2e-4, 3e-4, 0.01, 0.02, 0.03])
    errors = rng.multivariate_normal(np.zeros(6), covariance, 2000)
    poses = np.array([g.inverse(g.se3_exp(e)) for e in errors])
    stated = np.tile(factor**2 * covariance, (2000, 1, 1))
    found = credibility(poses, stated, truth, split=False)
    mend = found.sigma_factor["pose"]
    assert mend == pytest.approx(1.0 / factor, rel=0.03)
    consistency = found.nees["pose"]
    assert consistency is not None
    assert (consistency.verdict == "consistent") == (factor == 1.0)
    if factor == 1.0:
        for sigmas, share in {"1": 0.683, "2": 0.954, "3": 0.997}.items():
            assert found.within_sigma[sigmas] == pytest.approx(share, abs=0.01)


@pytest.mark.parametrize("correlation", [0.0, 0.8, 0.95])
def test_correlated_errors_count_less(correlation: float) -> None:
    """Of a first-order process n (1 - r) / (1 + r) values are as good as independent."""
    rng = np.random.default_rng(7)
    n, found = 4000, []
    for _ in range(5):
        values = np.zeros(n)
        for k in range(1, n):
            values[k] = correlation * values[k - 1] + rng.normal()
        found.append(independent_count(values))
    expected = n * (1.0 - correlation) / (1.0 + correlation)
    assert np.mean(found) == pytest.approx(expected, rel=0.2)


def test_what_does_not_vary_is_counted_as_it_is() -> None:
    assert independent_count(np.ones(50)) == 50.0
    assert independent_count(np.empty(0)) == 0.0


def test_motions_of_dead_reckoning_have_the_noise_of_their_steps() -> None:
    path, local, _ = dead_reckoning(3)
    found = accumulated(path.poses, local, 1)
    np.testing.assert_allclose(found, np.tile(NOISE, (len(path) - 1, 1, 1)), atol=1e-12)
    five = accumulated(path.poses, local, 5)
    assert np.isfinite(five).all()


def test_a_covariance_that_shrinks_tells_nothing_of_motions() -> None:
    path, local, _ = dead_reckoning(3, 30)
    local[20:] *= 0.01
    found = accumulated(path.poses, local, 1)
    assert np.isnan(found[19]).all()
    assert np.isfinite(found[:19]).all()


def test_axes_of_a_camera_are_told_from_those_of_a_robot() -> None:
    path, _, truth = dead_reckoning(0)
    turned = g.BODY_FORWARD_LEFT_UP_FROM_CAMERA
    robot = Trajectory(path.timestamps, path.poses @ g.inverse(turned))
    np.testing.assert_array_equal(turned_axes(path, truth), np.eye(3))
    axes = turned_axes(robot, truth)
    np.testing.assert_array_equal(axes, g.inverse(turned)[:3, :3])
