"""Laws of the geometry over all inputs, with samples where formulas are singular or nearly so."""

from __future__ import annotations

import dataclasses

import numpy as np
from hypothesis import assume, example, given, strategies as st
from hypothesis.extra.numpy import arrays

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import wrap
from fgslam.core.sensors import CameraRig

SINGULAR_ANGLES = [0.0, 1e-12, 1e-9, 1e-5, 0.99e-4, 1.01e-4, np.pi - 1e-6, np.pi - 1e-9, np.pi]


def vectors(size: float, n: int = 3) -> st.SearchStrategy[FloatArray]:
    return arrays(np.float64, n, elements=st.floats(-size, size, allow_subnormal=False))


@st.composite
def rotation_vectors(draw: st.DrawFn) -> FloatArray:
    """Rotation vectors of angle in [0, pi], often at or beside a singular angle."""
    axis = draw(vectors(1.0))
    norm = float(np.linalg.norm(axis))
    assume(norm > 1e-3)
    angle = draw(st.one_of(st.sampled_from(SINGULAR_ANGLES), st.floats(0.0, np.pi)))
    return np.asarray(angle * axis / norm)


@st.composite
def poses(draw: st.DrawFn) -> FloatArray:
    return g.pose(g.so3_exp(draw(rotation_vectors())), draw(vectors(100.0)))


@st.composite
def rigs(draw: st.DrawFn) -> CameraRig:
    return CameraRig(
        width=640,
        height=480,
        fx=draw(st.floats(50.0, 2000.0)),
        fy=draw(st.floats(50.0, 2000.0)),
        cx=draw(st.floats(0.0, 640.0)),
        cy=draw(st.floats(0.0, 480.0)),
        baseline=draw(st.floats(0.01, 2.0)),
        vertical_baseline=draw(st.one_of(st.none(), st.floats(0.01, 2.0))),
        bTc=draw(poses()),
    )


@st.composite
def visible_points(draw: st.DrawFn) -> FloatArray:
    """Points (n, 3) in front of the camera, 0.2 m to 100 m, inside 60 degrees off the axis."""
    rows = st.tuples(st.floats(-1.7, 1.7), st.floats(-1.7, 1.7), st.floats(0.2, 100.0))
    rays = np.array(draw(st.lists(rows, min_size=1, max_size=20)))
    return np.column_stack([rays[:, :2] * rays[:, 2:], rays[:, 2]])


@st.composite
def covariances(draw: st.DrawFn, n: int) -> FloatArray:
    root = draw(arrays(np.float64, (n, n), elements=st.floats(-3.0, 3.0)))
    return np.asarray(root @ root.T + 1e-3 * np.eye(n))


# --------------------------------------------------------------------------------------------
# Group laws


@given(rotation_vectors())
@example(np.zeros(3))
@example(np.array([np.pi, 0.0, 0.0]))
@example(np.array([0.0, 0.0, -np.pi]))
def test_exp_gives_rotations_and_log_undoes_it(omega: FloatArray) -> None:
    rotation = g.so3_exp(omega)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=1e-14)
    assert np.linalg.det(rotation) > 0
    recovered = g.so3_log(rotation)
    assert np.linalg.norm(recovered) <= np.pi + 1e-15
    np.testing.assert_allclose(g.so3_exp(recovered), rotation, rtol=0, atol=1e-12)
    if np.linalg.norm(omega) < np.pi - 1e-8:
        np.testing.assert_allclose(recovered, omega, rtol=1e-9, atol=1e-14)


@given(rotation_vectors(), vectors(100.0))
def test_se3_exp_and_log_undo_each_other(omega: FloatArray, v: FloatArray) -> None:
    aTb = g.se3_exp(np.concatenate([omega, v]))
    np.testing.assert_allclose(g.se3_exp(g.se3_log(aTb)), aTb, rtol=0, atol=1e-9)


@given(poses(), poses())
def test_adjoint_is_a_homomorphism(a: FloatArray, b: FloatArray) -> None:
    np.testing.assert_allclose(g.adjoint(a @ b), g.adjoint(a) @ g.adjoint(b), rtol=0, atol=1e-10)
    np.testing.assert_allclose(g.adjoint(g.inverse(a)) @ g.adjoint(a), np.eye(6), rtol=0, atol=1e-9)


@given(poses())
def test_quaternions_return_the_rotation(aTb: FloatArray) -> None:
    q = g.quaternion_from_rotation(aTb[:3, :3])
    assert abs(np.linalg.norm(q) - 1.0) < 1e-15
    np.testing.assert_allclose(g.rotation_from_quaternion(q), aTb[:3, :3], rtol=0, atol=1e-14)


@given(vectors(0.2, 6))
@example(np.zeros(6))
def test_log_jacobian_undoes_the_right_jacobian(xi: FloatArray) -> None:
    # Jr(xi)^-1 maps xi to itself, and Jr(-xi)^-1 = Ad(Exp(xi)) Jr(xi)^-1.
    inverse_right = g.se3_log_jacobian(xi)
    np.testing.assert_allclose(inverse_right @ xi, xi, rtol=0, atol=1e-14)
    inverse_left = g.se3_log_jacobian(-xi)
    np.testing.assert_allclose(
        inverse_right @ g.adjoint(g.inverse(g.se3_exp(xi))), inverse_left, rtol=0, atol=1e-8
    )


@given(poses(), covariances(6), covariances(6))
def test_noise_only_grows_over_a_motion(
    motion: FloatArray, before: FloatArray, noise: FloatArray
) -> None:
    after = g.compose_covariance(motion, before, noise)
    still = g.compose_covariance(np.eye(4), before, noise)
    np.testing.assert_allclose(still, before + noise, rtol=1e-12, atol=1e-12)
    # The adjoint's determinant is one: without noise the volume of the ellipsoid stays.
    carried = g.compose_covariance(motion, before, np.zeros((6, 6)))
    np.testing.assert_allclose(
        np.linalg.slogdet(carried)[1], np.linalg.slogdet(before)[1], rtol=0, atol=1e-3
    )
    smallest = np.linalg.eigvalsh(after - carried).min()
    assert smallest > -1e-9 * np.abs(after).max()


@given(poses(), covariances(6))
def test_changing_the_tangent_frame_and_back(aTb: FloatArray, covariance: FloatArray) -> None:
    there = g.change_tangent_frame(aTb, covariance)
    back = g.change_tangent_frame(g.inverse(aTb), there)
    np.testing.assert_allclose(back, covariance, rtol=0, atol=1e-11 * np.abs(there).max())


@given(st.floats(-np.pi, 3.1415), st.floats(-1.57, 1.57), st.floats(-np.pi, 3.1415))
def test_yaw_pitch_roll_are_the_angles_that_made_the_pose(
    yaw: float, pitch: float, roll: float
) -> None:
    assume(abs(pitch) < 1.5)
    about_y = g.so3_exp(np.array([0.0, yaw, 0.0]))
    about_x = g.so3_exp(np.array([pitch, 0.0, 0.0]))
    about_z = g.so3_exp(np.array([0.0, 0.0, roll]))
    wTc = g.pose(about_y @ about_x @ about_z, np.zeros(3))
    difference = np.array(g.yaw_pitch_roll(wTc)) - [yaw, pitch, roll]
    np.testing.assert_allclose(wrap(difference), 0.0, rtol=0, atol=1e-9)


@given(st.lists(st.floats(-1e4, 1e4), min_size=1, max_size=20), st.integers(-50, 50))
@example([-np.pi, np.pi], 0)
def test_wrapping_forgets_whole_turns(angles: list[float], turns: int) -> None:
    angle = np.array(angles)
    wrapped = wrap(angle)
    assert ((wrapped >= -np.pi) & (wrapped < np.pi)).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), rtol=0, atol=1e-10)
    np.testing.assert_allclose(
        np.exp(1j * wrap(angle + 2 * np.pi * turns)),
        np.exp(1j * wrapped),
        rtol=0,
        atol=1e-10,
    )


@given(poses(), arrays(np.float64, (3, 3), elements=st.floats(-1e-3, 1e-3)))
def test_reorthonormalising_is_idempotent_and_close(wTc: FloatArray, dirt: FloatArray) -> None:
    dirty = wTc.copy()
    dirty[:3, :3] += dirt
    clean = g.reorthonormalise(dirty)
    np.testing.assert_allclose(g.reorthonormalise(clean), clean, rtol=0, atol=1e-13)
    np.testing.assert_allclose(clean[:3, :3].T @ clean[:3, :3], np.eye(3), rtol=0, atol=1e-13)
    assert g.rotation_angle(clean[:3, :3].T @ wTc[:3, :3]) < 5e-3


# --------------------------------------------------------------------------------------------
# The stereo camera


@given(rigs(), visible_points())
def test_triangulation_undoes_projection(rig: CameraRig, points: FloatArray) -> None:
    measured = rig.predict(points)
    assert (measured[:, 2] > 0).all()
    np.testing.assert_allclose(rig.triangulate(measured), points, rtol=1e-9, atol=1e-9)
    again = rig.predict(rig.triangulate(measured))
    np.testing.assert_allclose(again, measured, rtol=1e-9, atol=1e-9)


@given(rigs(), visible_points(), poses())
def test_the_left_camera_sees_columns_shifted_by_the_disparity(
    rig: CameraRig, points: FloatArray, wTr: FloatArray
) -> None:
    world = g.transform_to_world(wTr, points)
    wTl = g.right_from_left_camera(wTr, -rig.baseline)
    seen_right = rig.predict(points)
    seen_left = rig.predict(g.transform_to_camera(wTl, world))
    scale = 1.0 + np.abs(seen_left).max()
    shifted = seen_right[:, 0] + seen_right[:, 2]
    np.testing.assert_allclose(seen_left[:, 0], shifted, rtol=0, atol=1e-9 * scale)
    np.testing.assert_allclose(seen_left[:, 1], seen_right[:, 1], rtol=0, atol=1e-9 * scale)


@given(rigs(), visible_points(), covariances(3), st.floats(0.1, 10.0))
def test_triangulated_covariances_are_lawful_and_scale(
    rig: CameraRig, points: FloatArray, covariance: FloatArray, factor: float
) -> None:
    measured = rig.predict(points)
    pixels = np.tile(covariance, (len(points), 1, 1))
    spread = rig.triangulation_covariance(measured, pixels)
    np.testing.assert_array_equal(spread, np.swapaxes(spread, 1, 2))
    eigenvalues = np.linalg.eigvalsh(spread)
    assert (eigenvalues[:, 0] > -1e-12 * eigenvalues[:, 2]).all()
    # A wider baseline sees the same rays with a larger disparity: its error shrinks in proportion.
    wide = dataclasses.replace(rig, baseline=factor * rig.baseline)
    only_disparity = np.zeros_like(pixels)
    only_disparity[:, 2, 2] = 1.0
    narrow_error = rig.triangulation_covariance(measured, only_disparity)
    wide_error = wide.triangulation_covariance(wide.predict(points), only_disparity)
    least = np.finfo(np.float64).tiny  # subnormal numbers have fewer digits
    np.testing.assert_allclose(wide_error * factor**2, narrow_error, rtol=1e-9, atol=least)


@given(covariances(3), st.floats(-6.0, 6.0))
def test_inverse_spd3_inverts(matrix: FloatArray, exponent: float) -> None:
    scaled = 10.0**exponent * matrix[None]
    inverse = g.inverse_spd3(scaled)
    condition = np.linalg.cond(matrix)
    np.testing.assert_allclose(inverse @ scaled, np.eye(3)[None], rtol=0, atol=1e-14 * condition)
    assert (np.linalg.eigvalsh(inverse) > 0).all()
    np.testing.assert_allclose(g.inverse_spd3(inverse), scaled, rtol=1e-7, atol=1e-7 * scaled.max())
