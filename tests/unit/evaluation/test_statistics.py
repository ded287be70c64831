"""Trajectory errors, NEES and its bands."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from fgslam.core.geometry import pose, quaternion_from_rotation, se3_exp, so3_exp
from fgslam.core.types import Trajectory
from fgslam.evaluation.statistics import (
    Alignment,
    Nees,
    associate,
    best_aligned,
    end_pose,
    evaluate_trajectory,
    judge,
    nees,
    pose_errors,
    pose_nees,
    rotation_angles,
    to_estimate_world,
    umeyama,
    within,
)


def wandering(seed: int, n: int = 60) -> Trajectory:
    """A bent path in space with turning cameras."""
    rng = np.random.default_rng(seed)
    poses = [se3_exp(rng.normal(size=6))]
    for _ in range(n - 1):
        step = np.concatenate([rng.normal(scale=0.1, size=3), [0.05, 0.0, 0.3]])
        poses.append(poses[-1] @ se3_exp(step))
    return Trajectory(10.0 + 0.1 * np.arange(n), np.array(poses))


def disturbed(truth: Trajectory, seed: int) -> Trajectory:
    """The same path in another world, with noise on every pose."""
    rng = np.random.default_rng(seed)
    world = se3_exp(np.array([0.3, -0.8, 0.5, 4.0, -2.0, 7.0]))
    noise = [se3_exp(rng.normal(scale=[0.02] * 3 + [0.05] * 3)) for _ in truth.poses]
    poses = world @ truth.poses @ np.array(noise)
    return Trajectory(truth.timestamps + 0.001, poses)


def evo_path(trajectory: Trajectory):
    evo_trajectory = pytest.importorskip("evo.core.trajectory", reason="evo is not installed")
    quaternions = [quaternion_from_rotation(p[:3, :3]) for p in trajectory.poses]
    return evo_trajectory.PoseTrajectory3D(
        positions_xyz=trajectory.poses[:, :3, 3].copy(),
        orientations_quat_wxyz=np.array(quaternions)[:, [3, 0, 1, 2]],
        timestamps=trajectory.timestamps,
    )


def evo_aligned(estimate: Trajectory, truth: Trajectory, alignment: Alignment):
    from evo.core import sync

    true, estimated = sync.associate_trajectories(
        evo_path(truth), evo_path(estimate), max_diff=0.01
    )
    if alignment is Alignment.FIRST_POSE:
        estimated.align_origin(true)
    else:
        estimated.align(true)
    return true, estimated


@pytest.mark.parametrize("alignment", list(Alignment))
def test_ate_and_rpe_agree_with_evo(alignment: Alignment) -> None:
    truth = wandering(1)
    estimate = disturbed(truth, 2)
    true, estimated = evo_aligned(estimate, truth, alignment)
    from evo.core import metrics

    expected = {}
    for name, metric in {
        "ate": metrics.APE(metrics.PoseRelation.translation_part),
        "trans": metrics.RPE(metrics.PoseRelation.translation_part, 1, metrics.Unit.frames),
        "rot": metrics.RPE(metrics.PoseRelation.rotation_angle_deg, 1, metrics.Unit.frames),
    }.items():
        metric.process_data((true, estimated))
        expected[name] = metric.get_statistic(metrics.StatisticsType.rmse)

    ours = evaluate_trajectory(estimate, truth, alignment)

    assert ours.matched_poses == len(truth)
    assert ours.ate_rmse_m == pytest.approx(expected["ate"], rel=1e-9)
    assert ours.rpe_trans_m == pytest.approx(expected["trans"], rel=1e-9)
    assert ours.rpe_rot_deg == pytest.approx(expected["rot"], rel=1e-8)


def test_alignment_recovers_an_exact_motion() -> None:
    rng = np.random.default_rng(5)
    source, motion = rng.normal(size=(30, 3)), se3_exp(rng.normal(size=6))

    found = umeyama(source, source @ motion[:3, :3].T + motion[:3, 3])

    assert found is not None
    np.testing.assert_allclose(found, motion, rtol=0, atol=1e-12)


def test_alignment_never_mirrors() -> None:
    rng = np.random.default_rng(7)
    source = rng.normal(size=(20, 3))
    found = umeyama(source, source * [1.0, 1.0, -1.0])
    assert found is not None
    assert np.linalg.det(found[:3, :3]) == pytest.approx(1.0)


def test_straight_path_still_has_an_ate() -> None:
    truth = Trajectory(np.arange(5.0), np.array([pose(np.eye(3), [0, 0, z]) for z in range(5)]))
    turned = Trajectory(
        truth.timestamps, pose(so3_exp(np.array([0, 1.0, 0])), [1, 2, 3]) @ truth.poses
    )
    result = evaluate_trajectory(turned, truth, Alignment.SE3)
    assert result.ate_rmse_m == pytest.approx(0.0, abs=1e-12)


def test_end_error_and_drift_by_hand() -> None:
    positions = [[0, 0, 0], [0, 0, 10.0], [0, 0, 20.0]]
    truth = Trajectory(np.arange(3.0), np.array([pose(np.eye(3), p) for p in positions]))
    poses = truth.poses.copy()
    poses[2] = pose(so3_exp(np.array([0, np.radians(2.0), 0])), [0.3, 0, 20.4])
    result = evaluate_trajectory(Trajectory(truth.timestamps, poses), truth)
    assert result.path_length_m == pytest.approx(20.0)
    assert result.end_error_m == pytest.approx(0.5)
    assert result.drift_percent == pytest.approx(2.5)
    assert result.end_error_deg == pytest.approx(2.0)


def test_without_truth_nothing_is_known() -> None:
    result = evaluate_trajectory(wandering(9), None)
    assert result.matched_poses == 0
    assert result.ate_rmse_m is result.rpe_trans_m is result.drift_percent is None


def test_too_few_poses_leave_what_cannot_be_known_none() -> None:
    truth = wandering(10, n=2)
    result = evaluate_trajectory(disturbed(truth, 11), truth, Alignment.SE3)
    assert result.matched_poses == 2
    assert result.ate_rmse_m is None
    assert result.end_error_m is not None
    alone = wandering(12, n=1)
    first = evaluate_trajectory(alone, alone, Alignment.FIRST_POSE)
    assert first.ate_rmse_m == pytest.approx(0.0, abs=1e-12)
    assert first.rpe_trans_m is None
    assert first.drift_percent is None


def test_standstill_has_no_drift_percentage() -> None:
    still = Trajectory(np.arange(4.0), np.tile(np.eye(4), (4, 1, 1)))
    result = evaluate_trajectory(still, still, Alignment.SE3)
    assert result.drift_percent is None


def test_diverged_estimate_is_not_called_accurate() -> None:
    truth = wandering(13)
    poses = truth.poses.copy()
    poses[30:] = np.nan
    result = evaluate_trajectory(Trajectory(truth.timestamps, poses), truth)
    assert result.matched_poses == len(truth)
    assert result.ate_rmse_m is None
    assert result.end_error_m is None


def test_association_is_mutual_and_within_tolerance() -> None:
    truth = np.arange(0.0, 1.0, 0.01)
    estimate = np.array([0.0502, 0.0504, 0.3, 0.7049, 5.0])
    rows, true_rows = associate(estimate, truth, 0.004)
    np.testing.assert_array_equal(rows, [0, 2])
    np.testing.assert_array_equal(true_rows, [5, 30])


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 3.0, np.pi - 1e-9, np.pi])
def test_rotation_angles_at_both_ends(angle: float) -> None:
    axis = np.array([2.0, -1.0, 2.0]) / 3.0
    assert rotation_angles(so3_exp(angle * axis)[None])[0] == pytest.approx(angle, abs=1e-12)


def test_end_pose_in_the_papers_units() -> None:
    start = se3_exp(np.array([0.1, 2.0, -0.3, 1, 2, 3.0]))
    motion = pose(so3_exp(np.array([0, np.radians(0.3), 0])), [-0.0209, 0.0, -0.0391])
    closed = end_pose(Trajectory(np.arange(2.0), np.array([start, start @ motion])))
    assert closed is not None
    assert closed == pytest.approx(
        {"x_cm": -2.09, "y_cm": 0.0, "z_cm": -3.91, "distance_cm": np.hypot(2.09, 3.91)}
        | {"yaw_deg": 0.3, "pitch_deg": 0.0, "roll_deg": 0.0}
    )
    assert end_pose(Trajectory(np.empty(0), np.empty((0, 4, 4)))) is None


def test_truth_is_brought_into_the_estimates_world() -> None:
    truth = wandering(15)
    world = se3_exp(np.array([1.0, 0.5, -0.2, 3, 2, 1.0]))
    estimate = Trajectory(truth.timestamps[5:], world @ truth.poses[5:])
    found = to_estimate_world(estimate, truth)
    assert found is not None
    rows, poses = found
    np.testing.assert_array_equal(rows, np.arange(len(estimate)))
    np.testing.assert_allclose(poses, estimate.poses, atol=1e-12)
    late = Trajectory(truth.timestamps + 1e6, truth.poses)
    assert to_estimate_world(late, truth) is None


def random_covariances(rng: np.random.Generator, n: int, d: int) -> np.ndarray:
    root = rng.normal(scale=0.05, size=(n, d, d))
    return root @ np.swapaxes(root, 1, 2) + 1e-6 * np.eye(d)


def drawn(rng: np.random.Generator, covariances: np.ndarray) -> np.ndarray:
    return np.array([rng.multivariate_normal(np.zeros(len(c)), c) for c in covariances])


@pytest.mark.parametrize("free", [3, 6])
def test_constrained_poses_count_only_their_free_directions(free: int) -> None:
    rng = np.random.default_rng(2)
    basis, _ = np.linalg.qr(rng.normal(size=(6, 6)))
    inner = random_covariances(rng, 400, free)
    covariances = basis[:, :free] @ inner @ basis[:, :free].T
    errors = drawn(rng, inner) @ basis[:, :free].T
    result = nees(errors, covariances)
    assert (result.dof == free).all()
    expected = [
        e @ np.linalg.pinv(c, rcond=1e-9) @ e for e, c in zip(errors, covariances, strict=True)
    ]
    np.testing.assert_allclose(result.values, expected, rtol=1e-4)
    assert result.per_dof == pytest.approx(1.0, abs=4 * np.sqrt(2 / (400 * free)))


def test_an_exactly_known_pose_adds_no_degrees_of_freedom() -> None:
    result = nees(np.ones((2, 6)), np.stack([np.zeros((6, 6)), np.eye(6)]))
    np.testing.assert_array_equal(result.dof, [0, 6])
    np.testing.assert_allclose(result.values, [0.0, 6.0])
    assert nees(np.ones((1, 6)), np.zeros((1, 6, 6))).per_dof is None


def test_unknown_truth_is_left_out() -> None:
    truth = np.array([[1.0, 2.0, 3.0], [np.nan] * 3])
    result = nees(truth, np.tile(np.eye(3), (2, 1, 1)))
    np.testing.assert_allclose(result.values, [14.0, 0.0])
    np.testing.assert_array_equal(result.dof, [3, 0])


def test_pose_errors_invert_the_retraction() -> None:
    rng = np.random.default_rng(3)
    xi = rng.normal(scale=0.3, size=(10, 6))
    estimate = np.array([se3_exp(v) for v in rng.normal(size=(10, 6))])
    truth = np.array([p @ se3_exp(v) for p, v in zip(estimate, xi, strict=True)])
    np.testing.assert_allclose(pose_errors(estimate, truth), xi, atol=1e-10)
    assert pose_errors(estimate[:0], truth[:0]).shape == (0, 6)


def simulated_run(seed: int, inflation: float) -> Nees:
    rng = np.random.default_rng(seed)
    covariances = random_covariances(rng, 60, 6) * 1e-2
    estimate = np.array([se3_exp(v) for v in rng.normal(size=(60, 6))])
    xi = drawn(rng, covariances)
    truth = np.array([p @ se3_exp(v) for p, v in zip(estimate, xi, strict=True)])
    return pose_nees(estimate, inflation * covariances, truth)


@pytest.mark.parametrize(
    ("inflation", "verdict"), [(1.0, "consistent"), (0.25, "overconfident"), (4.0, "conservative")]
)
def test_wrong_covariances_are_recognised_over_many_runs(inflation: float, verdict: str) -> None:
    runs = [simulated_run(seed, inflation) for seed in range(10)]
    for independent, counted in ((None, 10), (np.inf, 600)):
        result = judge(runs, independent=independent)
        assert result is not None
        assert result.verdict == verdict
        assert result.items == 600
        assert result.independent == counted
        assert result.per_dof == pytest.approx(1.0 / inflation, rel=0.1)


def test_without_degrees_of_freedom_consistency_is_not_known() -> None:
    empty = Nees(np.empty(0), np.empty(0, np.int64))
    assert judge([]) is None
    assert judge([empty]) is None
    assert judge([nees(np.ones((3, 6)), np.zeros((3, 6, 6)))]) is None


def test_two_sigmas_hold_95_percent_of_errors_that_are_as_large_as_stated() -> None:
    rng = np.random.default_rng(8)
    covariances = random_covariances(rng, 4000, 6)
    errors = drawn(rng, covariances)
    np.testing.assert_allclose(within(errors, covariances), chi2.cdf(4.0, 1), atol=0.02)
    np.testing.assert_allclose(within(errors, covariances / 16.0), chi2.cdf(0.25, 1), atol=0.03)


def test_an_axis_that_is_held_has_no_share() -> None:
    covariances = np.tile(np.diag([1e-4, 0.0, 1e-4]), (3, 1, 1))
    errors = np.array([[0.0, 0.0, 0.03], [0.01, 0.0, 0.0], [np.nan, 0.0, 0.0]])
    np.testing.assert_equal(within(errors, covariances), [1.0, np.nan, 0.5])


def test_an_axis_that_leans_out_of_a_constraint_by_rounding_is_not_judged() -> None:
    """A floor held stiffly: what it excludes is tilted by a ten-thousandth."""
    basis = np.array([[1.0, 0.0], [0.0, 1.0], [1e-4, 0.0]])
    covariances = np.tile(basis @ np.diag([1.0, 0.25]) @ basis.T, (4, 1, 1))
    errors = np.tile([0.5, 0.5, 1e-3], (4, 1))
    np.testing.assert_equal(within(errors, covariances), [1.0, 1.0, np.nan])


def test_without_the_last_poses_truth_there_is_no_end_error() -> None:
    truth = wandering(1)
    estimate = disturbed(truth, 2)
    known = Trajectory(truth.timestamps[:-1], truth.poses[:-1])
    found = evaluate_trajectory(estimate, known)
    assert found.matched_poses == len(truth) - 1
    assert (found.end_error_m, found.end_error_deg, found.drift_percent) == (None, None, None)
    assert found.ate_rmse_m is not None
    assert evaluate_trajectory(estimate, truth).end_error_m is not None


def test_the_best_alignment_has_the_least_nees(rng: np.random.Generator) -> None:
    """A first pose whose truth is wrong spoils all errors from it, and not those at the best."""
    truth = wandering(3)
    sigmas = np.repeat([0.01, 0.05], 3)
    noise = sigmas * rng.normal(size=(len(truth), 6))
    poses = truth.poses @ np.array([*map(se3_exp, noise)])
    covariances = np.tile(np.diag(sigmas**2), (len(truth), 1, 1))
    world = se3_exp(np.array([0.02, -0.03, 0.05, 0.4, -0.2, 0.1]))
    before = pose_nees(poses, covariances, world @ truth.poses)
    after = pose_nees(poses, covariances, best_aligned(poses, covariances, world @ truth.poses))
    assert before.per_dof is not None
    assert after.per_dof is not None
    assert before.per_dof > 10.0
    assert 0.8 < after.per_dof < 1.2
    for k in range(6):
        moved = se3_exp(1e-3 * np.eye(6)[k]) @ best_aligned(poses, covariances, truth.poses)
        assert pose_nees(poses, covariances, moved).values.sum() > after.values.sum()
