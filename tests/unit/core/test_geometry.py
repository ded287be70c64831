"""Geometry against GTSAM, finite differences, Monte Carlo and cases worked out by hand."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
import pytest

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import wrap
from fgslam.core.sensors import CameraRig

RIG = CameraRig(
    width=320,
    height=240,
    fx=277.0,
    fy=281.0,
    cx=159.5,
    cy=118.25,
    baseline=0.1,
    vertical_baseline=0.1,
    bTc=g.pose(g.BODY_FORWARD_LEFT_UP_FROM_CAMERA[:3, :3], np.array([0.25, 0.05, 1.0])),
)
AXES = [
    np.array([1.0, 0.0, 0.0]),
    np.array([0.0, 1.0, 0.0]),
    np.array([0.0, 0.0, -1.0]),
    np.array([0.6, -0.48, 0.64]),
]
# Zero, both sides of the switch to series, ordinary angles.
ANGLES = [0.0, 1e-12, 1e-9, 1e-5, 0.99e-4, 1.01e-4, 1e-3, 0.5, 2.0, 3.0]
NEAR_HALF_TURN = [np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9, np.pi]


def numerical_jacobian(
    function: Callable[[FloatArray], FloatArray], at: FloatArray, step: float = 1e-6
) -> FloatArray:
    """Central differences: outputs (m,) by inputs (n,) to (m, n)."""
    columns = [
        (function(at + step * e) - function(at - step * e)) / (2 * step) for e in np.eye(len(at))
    ]
    return np.stack(columns, axis=-1)


def random_pose(rng: np.random.Generator, angle: float = 1.0) -> FloatArray:
    return g.se3_exp(np.concatenate([angle * rng.standard_normal(3) / 2, rng.standard_normal(3)]))


def random_covariance(rng: np.random.Generator, n: int) -> FloatArray:
    a = rng.standard_normal((n, n))
    return np.asarray(a @ a.T + 0.1 * np.eye(n))


def points_in_view(rng: np.random.Generator, n: int = 40) -> FloatArray:
    depth = rng.uniform(0.8, 8.0, n)
    sideways = rng.uniform(-0.5, 0.5, (n, 2)) * depth[:, None]
    return np.column_stack([sideways, depth])


# --------------------------------------------------------------------------------------------
# Rotations and rigid motions against GTSAM


@pytest.mark.parametrize("axis", AXES, ids=str)
@pytest.mark.parametrize("angle", ANGLES + NEAR_HALF_TURN)
def test_so3_exp_agrees_with_gtsam(angle: float, axis: FloatArray) -> None:
    expected = gtsam.Rot3.Expmap(angle * axis).matrix()
    np.testing.assert_allclose(g.so3_exp(angle * axis), expected, rtol=0, atol=1e-14)


@pytest.mark.parametrize("axis", AXES, ids=str)
@pytest.mark.parametrize("angle", ANGLES + NEAR_HALF_TURN)
def test_quaternions_agree_with_gtsam_and_return(angle: float, axis: FloatArray) -> None:
    rotation = g.so3_exp(angle * axis)
    q = g.quaternion_from_rotation(rotation)
    expected = gtsam.Rot3(rotation).toQuaternion()
    expected_xyzw = np.array([expected.x(), expected.y(), expected.z(), expected.w()])
    assert abs(abs(q @ expected_xyzw) - 1.0) < 1e-12
    np.testing.assert_allclose(g.rotation_from_quaternion(q), rotation, rtol=0, atol=1e-14)
    np.testing.assert_allclose(g.rotation_from_quaternion(-3.0 * q), rotation, rtol=0, atol=1e-14)


@pytest.mark.parametrize("axis", AXES, ids=str)
@pytest.mark.parametrize("angle", ANGLES)
def test_se3_exp_and_log_agree_with_gtsam(angle: float, axis: FloatArray) -> None:
    xi = np.concatenate([angle * axis, [0.3, -1.2, 2.5]])
    expected = gtsam.Pose3.Expmap(xi)
    np.testing.assert_allclose(g.se3_exp(xi), expected.matrix(), rtol=0, atol=1e-13)
    np.testing.assert_allclose(g.se3_log(expected.matrix()), xi, rtol=0, atol=1e-11)


@pytest.mark.parametrize("axis", AXES, ids=str)
@pytest.mark.parametrize("angle", NEAR_HALF_TURN)
def test_se3_log_undoes_exp_near_the_half_turn(angle: float, axis: FloatArray) -> None:
    aTb = g.se3_exp(np.concatenate([angle * axis, [0.3, -1.2, 2.5]]))
    np.testing.assert_allclose(g.se3_exp(g.se3_log(aTb)), aTb, rtol=0, atol=1e-9)


@pytest.mark.parametrize("scale", [1e-12, 1e-9, 1e-6, 1e-4, 1e-3])
def test_se3_log_keeps_the_digits_of_tiny_motions(scale: float) -> None:
    xi = scale * np.array([0.5, -0.3, 0.8, 1.0, 2.0, -1.5])
    np.testing.assert_allclose(g.se3_log(g.se3_exp(xi)), xi, rtol=0, atol=1e-12 * scale + 1e-16)


def test_pose_composes_with_inverse(rng: np.random.Generator) -> None:
    poses = np.stack([random_pose(rng) for _ in range(5)])
    np.testing.assert_allclose(
        poses @ g.inverse(poses), np.tile(np.eye(4), (5, 1, 1)), rtol=0, atol=1e-14
    )
    for aTb in poses:
        expected = gtsam.Pose3(aTb).inverse().matrix()
        np.testing.assert_allclose(g.inverse(aTb), expected, rtol=0, atol=1e-14)
        np.testing.assert_array_equal(g.pose(aTb[:3, :3], aTb[:3, 3]), aTb)


def test_adjoint_agrees_with_gtsam_and_its_definition(rng: np.random.Generator) -> None:
    aTb = random_pose(rng)
    np.testing.assert_allclose(g.adjoint(aTb), gtsam.Pose3(aTb).AdjointMap(), rtol=0, atol=1e-14)
    xi = 0.3 * rng.standard_normal(6)
    np.testing.assert_allclose(
        g.se3_exp(g.adjoint(aTb) @ xi), aTb @ g.se3_exp(xi) @ g.inverse(aTb), rtol=0, atol=1e-13
    )


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.05, 0.3])
def test_se3_log_jacobian_against_differences(rng: np.random.Generator, size: float) -> None:
    xi = rng.standard_normal(6)
    xi *= size / np.linalg.norm(xi)
    base = g.se3_exp(xi)
    numeric = numerical_jacobian(lambda d: g.se3_log(base @ g.se3_exp(d)), np.zeros(6), 1e-5)
    np.testing.assert_allclose(g.se3_log_jacobian(xi), numeric, rtol=0, atol=2e-9)


def test_se3_log_jacobian_is_as_exact_as_it_says(rng: np.random.Generator) -> None:
    worst = 0.0
    for _ in range(200):
        xi = rng.standard_normal(6)
        xi *= 0.5 / np.linalg.norm(xi)
        exact = np.asarray(gtsam.Pose3.LogmapDerivative(gtsam.Pose3.Expmap(xi)))
        worst = max(worst, float(np.abs(g.se3_log_jacobian(xi) - exact).max()))
    assert worst < 1e-8


# --------------------------------------------------------------------------------------------
# Covariances of motions


def test_compose_covariance_agrees_with_gtsam_jacobians(rng: np.random.Generator) -> None:
    start, motion = random_pose(rng), random_pose(rng)
    before, noise = random_covariance(rng, 6), random_covariance(rng, 6)
    h_before = np.zeros((6, 6), order="F")
    h_motion = np.zeros((6, 6), order="F")
    gtsam.Pose3(start).compose(gtsam.Pose3(motion), h_before, h_motion)
    expected = h_before @ before @ h_before.T + h_motion @ noise @ h_motion.T
    np.testing.assert_allclose(g.compose_covariance(motion, before, noise), expected, rtol=1e-12)


def test_change_tangent_frame_moves_samples(rng: np.random.Generator) -> None:
    aTb, covariance = random_pose(rng), random_covariance(rng, 6)
    # A motion known in b by a square root of its covariance; each column moved to a by itself.
    root = 1e-5 * np.linalg.cholesky(covariance)
    moved = np.stack(
        [g.se3_log(aTb @ g.se3_exp(column) @ g.inverse(aTb)) for column in root.T], axis=-1
    )
    np.testing.assert_allclose(
        1e-10 * g.change_tangent_frame(aTb, covariance), moved @ moved.T, rtol=1e-6, atol=1e-18
    )


# --------------------------------------------------------------------------------------------
# The robot and its camera


def test_a_spin_of_the_robot_is_an_arc_at_the_camera() -> None:
    ahead = 0.25
    bTc = g.pose(g.BODY_FORWARD_LEFT_UP_FROM_CAMERA[:3, :3], np.array([ahead, 0.0, 1.0]))
    for degrees in (5.0, -90.0, 180.0):
        angle = np.deg2rad(degrees)
        spin = g.pose(g.so3_exp(np.array([0.0, 0.0, angle])), np.zeros(3))
        motion = g.body_to_camera_motion(spin, bTc)
        # The chord of the arc, worked out in the plane; left of the body is -x of the camera.
        chord = ahead * np.array([-np.sin(angle), 0.0, np.cos(angle) - 1.0])
        np.testing.assert_allclose(motion[:3, 3], chord, rtol=0, atol=1e-15)
        assert g.rotation_angle(motion[:3, :3]) == pytest.approx(abs(angle), abs=1e-12)
        yaw, pitch, roll = g.yaw_pitch_roll(motion)
        assert (pitch, roll) == pytest.approx((0.0, 0.0), abs=1e-12)
        assert wrap(np.array(yaw + angle)) == pytest.approx(0.0, abs=1e-12)


def test_reorthonormalise_finds_the_nearest_rotation(rng: np.random.Generator) -> None:
    wTc = random_pose(rng)
    np.testing.assert_allclose(g.reorthonormalise(wTc), wTc, rtol=0, atol=1e-14)
    dirty = wTc.copy()
    dirty[:3, :3] += 1e-3 * rng.standard_normal((3, 3))
    clean = g.reorthonormalise(dirty)
    np.testing.assert_allclose(clean[:3, :3] @ clean[:3, :3].T, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(clean[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_array_equal(clean[:3, 3], wTc[:3, 3])
    distance = np.linalg.norm(clean[:3, :3] - dirty[:3, :3])
    for _ in range(50):
        other = clean[:3, :3] @ g.so3_exp(1e-3 * rng.standard_normal(3))
        assert np.linalg.norm(other - dirty[:3, :3]) > distance


@pytest.mark.parametrize("angle", ANGLES + NEAR_HALF_TURN)
def test_rotation_angle(angle: float) -> None:
    assert g.rotation_angle(g.so3_exp(angle * AXES[3])) == pytest.approx(angle, abs=1e-9)


def test_yaw_is_clockwise_pitch_up_roll_clockwise() -> None:
    turn = np.deg2rad(10.0)
    looks_right = g.pose(g.so3_exp(np.array([0.0, turn, 0.0])), np.zeros(3))
    assert looks_right[0, 2] > 0, "its optical axis points to +x, the right"
    assert g.yaw_pitch_roll(looks_right) == pytest.approx((turn, 0.0, 0.0))
    looks_up = g.pose(g.so3_exp(np.array([turn, 0.0, 0.0])), np.zeros(3))
    assert looks_up[1, 2] < 0, "its optical axis points to -y, up"
    assert g.yaw_pitch_roll(looks_up) == pytest.approx((0.0, turn, 0.0))
    right_side_down = g.pose(g.so3_exp(np.array([0.0, 0.0, turn])), np.zeros(3))
    assert right_side_down[1, 0] > 0, "its right points to +y, down"
    assert g.yaw_pitch_roll(right_side_down) == pytest.approx((0.0, 0.0, turn))


def test_wrap_angle_stays_below_pi() -> None:
    just_below = np.nextafter(-np.pi, -4.0)
    angles = np.array([0.0, np.pi, -np.pi, just_below, 3 * np.pi, -7.5, 100.0])
    wrapped = wrap(angles)
    assert (wrapped >= -np.pi).all()
    assert (wrapped < np.pi).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), rtol=0, atol=1e-12)


# --------------------------------------------------------------------------------------------
# The stereo camera


def gtsam_stereo(left: FloatArray) -> gtsam.StereoCamera:
    calibration = gtsam.Cal3_S2Stereo(RIG.fx, RIG.fy, 0.0, RIG.cx, RIG.cy, RIG.baseline)
    return gtsam.StereoCamera(gtsam.Pose3(left), calibration)


def test_projection_is_gtsams_seen_from_the_right_camera(rng: np.random.Generator) -> None:
    wTr = random_pose(rng)
    wTl = g.right_from_left_camera(wTr, -RIG.baseline)
    camera = gtsam_stereo(wTl)
    points = g.transform_to_world(wTr, points_in_view(rng))
    measured = RIG.predict(g.transform_to_camera(wTr, points))
    for point, (column, row, disparity) in zip(points, measured, strict=True):
        expected = camera.project(point)
        ours = [column + disparity, column, row]
        np.testing.assert_allclose(ours, expected.vector(), rtol=0, atol=1e-9)


def test_top_camera_disparity_is_positive(rng: np.random.Generator) -> None:
    points = points_in_view(rng)
    assert RIG.vertical_baseline is not None
    rTt = g.pose(np.eye(3), np.array([0.0, -RIG.vertical_baseline, 0.0]))
    row_top = RIG.predict(g.transform_to_camera(rTt, points))[:, 1]
    measured = RIG.predict(points)
    ratio = RIG.fy * RIG.vertical_baseline / (RIG.fx * RIG.baseline)
    np.testing.assert_allclose(row_top - measured[:, 1], ratio * measured[:, 2], rtol=0, atol=1e-9)


def test_projection_jacobian_against_differences(rng: np.random.Generator) -> None:
    points = points_in_view(rng)
    analytic = RIG.jacobian(points)
    for point, jacobian in zip(points, analytic, strict=True):
        numeric = numerical_jacobian(lambda p: RIG.predict(p[None])[0], point)
        np.testing.assert_allclose(jacobian, numeric, rtol=1e-6, atol=1e-6)


def test_point_pose_jacobian_against_differences_and_gtsam(rng: np.random.Generator) -> None:
    wTc, points = random_pose(rng), points_in_view(rng, 10)
    world = g.transform_to_world(wTc, points)
    for camera_point, world_point, jacobian in zip(
        points, world, g.point_pose_jacobian(points), strict=True
    ):

        def moved(xi: FloatArray, world_point: FloatArray = world_point) -> FloatArray:
            return g.transform_to_camera(wTc @ g.se3_exp(xi), world_point[None])[0]

        np.testing.assert_allclose(
            jacobian, numerical_jacobian(moved, np.zeros(6)), rtol=0, atol=1e-7
        )
        h_pose = np.zeros((3, 6), order="F")
        h_point = np.zeros((3, 3), order="F")
        expected = gtsam.Pose3(wTc).transformTo(world_point, h_pose, h_point)
        np.testing.assert_allclose(camera_point, expected, rtol=0, atol=1e-12)
        np.testing.assert_allclose(jacobian, h_pose, rtol=0, atol=1e-12)


def test_triangulate_agrees_with_gtsam_backproject(rng: np.random.Generator) -> None:
    measured = RIG.predict(points_in_view(rng))
    camera = gtsam_stereo(g.right_from_left_camera(np.eye(4), -RIG.baseline))
    for point, (column, row, disparity) in zip(RIG.triangulate(measured), measured, strict=True):
        expected = camera.backproject(gtsam.StereoPoint2(column + disparity, column, row))
        np.testing.assert_allclose(point, expected, rtol=0, atol=1e-9)


def test_triangulation_covariance_is_the_inverse_projections(rng: np.random.Generator) -> None:
    measured = RIG.predict(points_in_view(rng))
    covariance = np.stack([0.1 * random_covariance(rng, 3) for _ in measured])
    jacobian = np.linalg.inv(RIG.jacobian(RIG.triangulate(measured)))
    expected = jacobian @ covariance @ np.swapaxes(jacobian, 1, 2)
    np.testing.assert_allclose(
        RIG.triangulation_covariance(measured, covariance), expected, rtol=1e-8, atol=1e-12
    )


# --------------------------------------------------------------------------------------------
# Small matrices


def test_congruence_is_symmetric_to_the_last_bit(rng: np.random.Generator) -> None:
    a = rng.standard_normal((20, 2, 3))
    s = np.stack([random_covariance(rng, 3) for _ in range(20)])
    out = g.congruence(a, s)
    np.testing.assert_array_equal(out, np.swapaxes(out, -1, -2))
    np.testing.assert_allclose(out, np.einsum("nij,njk,nlk->nil", a, s, a), rtol=1e-12)


def test_inverse_spd3_agrees_with_lapack(rng: np.random.Generator) -> None:
    matrices = np.stack([random_covariance(rng, 3) for _ in range(100)])
    out = g.inverse_spd3(matrices)
    np.testing.assert_allclose(out, np.linalg.inv(matrices), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(out, np.swapaxes(out, -1, -2))


def test_inverse_spd3_survives_long_thin_ellipsoids(rng: np.random.Generator) -> None:
    # A landmark at the far end: millimetres across, a metre along the ray.
    rotations = np.stack([g.so3_exp(rng.standard_normal(3)) for _ in range(50)])
    matrices = rotations @ np.diag([1e-6, 1e-6, 1.0]) @ np.swapaxes(rotations, 1, 2)
    matrices = 0.5 * (matrices + np.swapaxes(matrices, 1, 2))
    product = g.inverse_spd3(matrices) @ matrices
    np.testing.assert_allclose(product, np.tile(np.eye(3), (50, 1, 1)), rtol=0, atol=1e-6)


def test_rotate_covariances_equals_the_product_for_each() -> None:
    rng = np.random.default_rng(5)
    roots = rng.normal(size=(20, 3, 3))
    covariances = roots @ roots.swapaxes(1, 2)
    aRb = g.so3_exp(np.array([0.3, -1.2, 0.7]))
    expected = np.array([aRb @ c @ aRb.T for c in covariances])
    np.testing.assert_allclose(g.rotate_covariances(aRb, covariances), expected, rtol=0, atol=1e-12)
