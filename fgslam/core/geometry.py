"""Pure geometry: rigid motions, the stereo camera and its Jacobians, triangulation, frame changes.

Conventions as in :mod:`fgslam.core`: ``wTc`` poses as 4x4 matrices, tangent vectors
[rotation, translation] on the right (``T * Exp(xi)``), which is GTSAM's ``Pose3`` convention.
Functions over many items are vectorised over the leading axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.linalg import LinAlgError

from fgslam.core.arrays import BoolArray, FloatArray, middle
from fgslam.core.errors import EstimatorError

# Below this rotation angle the series of sin and cos are exact to double precision.
_SMALL_ANGLE = 1e-4
_EYE3, _EYE4, _EYE6 = np.eye(3), np.eye(4), np.eye(6)  # made once: six of them a step
_RIGID_TOLERANCE = 1e-4  # of hand-written rotation matrices, four digits each

BODY_FORWARD_LEFT_UP_FROM_CAMERA: FloatArray = np.array(
    [[0.0, 0.0, 1.0, 0.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
"""``bTc`` of a level camera looking ahead: body x forward, y left, z up; camera z ahead, y down."""


# --------------------------------------------------------------------------------------------
# Rotations and rigid motions


def skew(v: FloatArray) -> FloatArray:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3): ``skew(a) @ b == cross(a, b)``."""
    if v.ndim == 1:  # of a single one: a quarter of the time
        x, y, z = v.tolist()
        return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))
    out = np.zeros((*v.shape[:-1], 3, 3))
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    return out


def _one_minus_cos(theta: float) -> float:
    # The difference itself would lose half of the digits of a small angle.
    return float(2.0 * np.sin(0.5 * theta) ** 2)


def so3_exp(omega: FloatArray) -> FloatArray:
    """Rotation matrix (3, 3) of a rotation vector (3,), by Rodrigues' formula."""
    theta2 = float(omega @ omega)
    theta = np.sqrt(theta2)
    if theta < _SMALL_ANGLE:
        a, b = 1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0
    else:
        a, b = np.sin(theta) / theta, _one_minus_cos(theta) / theta2
    k = skew(omega)
    return np.asarray(_EYE3 + a * k + b * (k @ k))


def so3_log(rotation: FloatArray) -> FloatArray:
    """Rotation vector (3,) of a rotation matrix (3, 3), angle in [0, pi], stable at both ends."""
    cosine = 0.5 * (float(np.trace(rotation)) - 1.0)
    if cosine > 0.0:
        # Up to a right angle the skew part has it all; the quaternion costs three times as much.
        twice = np.array(
            [
                rotation[2, 1] - rotation[1, 2],
                rotation[0, 2] - rotation[2, 0],
                rotation[1, 0] - rotation[0, 1],
            ]
        )
        sine = 0.5 * math.sqrt(float(twice @ twice))
        ratio = math.atan2(sine, cosine) / sine if sine > _SMALL_ANGLE else 1.0 + sine * sine / 6.0
        return np.asarray((0.5 * ratio) * twice)
    quaternion = quaternion_from_rotation(rotation)
    if quaternion[3] < 0.0:
        quaternion = -quaternion
    vector, w = quaternion[:3], quaternion[3]
    sine = float(np.linalg.norm(vector))
    if sine < _SMALL_ANGLE:
        return np.asarray(vector * (2.0 / w) * (1.0 - sine * sine / (3.0 * w * w)))
    return np.asarray(vector * (2.0 * np.arctan2(sine, w) / sine))


def quaternion_from_rotation(rotation: FloatArray) -> FloatArray:
    """Unit quaternion (x, y, z, w) of a rotation matrix (3, 3); Shepperd's method."""
    diagonal = np.diagonal(rotation)
    trace = float(diagonal.sum())
    choice = int(np.argmax([diagonal[0], diagonal[1], diagonal[2], trace]))
    q = np.empty(4)
    if choice == 3:
        q[3] = 1.0 + trace
        q[0] = rotation[2, 1] - rotation[1, 2]
        q[1] = rotation[0, 2] - rotation[2, 0]
        q[2] = rotation[1, 0] - rotation[0, 1]
    else:
        i, j, k = choice, (choice + 1) % 3, (choice + 2) % 3
        q[i] = 1.0 - trace + 2.0 * rotation[i, i]
        q[j] = rotation[j, i] + rotation[i, j]
        q[k] = rotation[k, i] + rotation[i, k]
        q[3] = rotation[k, j] - rotation[j, k]
    return np.asarray(q / np.linalg.norm(q))


def rotation_from_quaternion(quaternion: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) (x, y, z, w), normalised first."""
    x, y, z, w = np.moveaxis(quaternion, -1, 0) / np.linalg.norm(quaternion, axis=-1)
    rows = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return np.moveaxis(rows, (0, 1), (-2, -1))


def pose(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """Homogeneous (..., 4, 4) matrices of rotations (..., 3, 3) and translations (..., 3)."""
    out = _EYE4.copy() if rotation.ndim == 2 else np.tile(_EYE4, (*rotation.shape[:-2], 1, 1))
    out[..., :3, :3], out[..., :3, 3] = rotation, translation
    return out


def inverse(aTb: FloatArray) -> FloatArray:
    """``bTa`` of a rigid ``aTb``; poses (..., 4, 4)."""
    out = np.zeros_like(aTb)
    transposed = np.swapaxes(aTb[..., :3, :3], -1, -2)
    out[..., :3, :3] = transposed
    out[..., :3, 3] = -(transposed @ aTb[..., :3, 3:])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def so3_left_jacobian(omega: FloatArray) -> FloatArray:
    """(3, 3) ``V``: turned by ``omega`` in unit time, a velocity v leads by ``V v``."""
    theta2 = float(omega @ omega)
    theta = np.sqrt(theta2)
    if theta < _SMALL_ANGLE:
        b, c = 0.5 - theta2 / 24.0, 1.0 / 6.0 - theta2 / 120.0
    else:
        b, c = _one_minus_cos(theta) / theta2, (theta - np.sin(theta)) / (theta2 * theta)
    k = skew(omega)
    return np.asarray(np.eye(3) + b * k + c * (k @ k))


def _so3_left_jacobian_inverse(omega: FloatArray) -> FloatArray:
    theta2 = float(omega @ omega)
    theta, half = math.sqrt(theta2), 0.5 * math.sqrt(theta2)
    if theta < _SMALL_ANGLE:
        c = 1.0 / 12.0 + theta2 / 720.0
    else:
        c = (1.0 - half * math.cos(half) / math.sin(half)) / theta2
    k = skew(omega)
    return np.asarray(_EYE3 - 0.5 * k + c * (k @ k))


def se3_exp(xi: FloatArray) -> FloatArray:
    """Rigid motion (4, 4) of a tangent vector (6,) [rotation, translation]; GTSAM's Expmap."""
    return pose(so3_exp(xi[:3]), so3_left_jacobian(xi[:3]) @ xi[3:])


def moved_apart(aTb: FloatArray, step: FloatArray) -> FloatArray:
    """A pose moved by a step (6,), rotation and translation apart: planar motion stays planar."""
    return pose(aTb[:3, :3] @ so3_exp(step[:3]), aTb[:3, 3] + aTb[:3, :3] @ step[3:])


def se3_log(aTb: FloatArray) -> FloatArray:
    """Tangent vector (6,) [rotation, translation] of a rigid motion (4, 4); GTSAM's Logmap."""
    omega = so3_log(aTb[:3, :3])
    out = np.empty(6)
    out[:3], out[3:] = omega, _so3_left_jacobian_inverse(omega) @ aTb[:3, 3]
    return out


def adjoint(aTb: FloatArray) -> FloatArray:
    """Adjoints (..., 6, 6) of ``aTb``: map a tangent vector in b to the same motion's in a."""
    rotation = aTb[..., :3, :3]
    out = np.zeros((*aTb.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    out[..., 3:, :3] = skew(aTb[..., :3, 3]) @ rotation
    return out


def se3_log_jacobian(xi: FloatArray) -> FloatArray:
    """Inverse right Jacobian (6, 6): d Log(Exp(xi) Exp(delta)) / d delta at delta = 0.

    Bernoulli series of the adjoint representation up to the sixth order; for |xi| < 0.5 exact to
    1e-8, which is all that a correction to a predicted pose needs.
    """
    ad = np.zeros((6, 6))
    ad[:3, :3] = ad[3:, 3:] = skew(xi[:3])
    ad[3:, :3] = skew(xi[3:])
    ad2 = ad @ ad
    ad4 = ad2 @ ad2
    return np.asarray(_EYE6 + ad / 2 + ad2 / 12 - ad4 / 720 + (ad4 @ ad2) / 30240)


def compose_covariance(motion: FloatArray, before: FloatArray, noise: FloatArray) -> FloatArray:
    """Covariance (6, 6) of ``T * motion`` given that of ``T`` and of the motion (at its end)."""
    ad = adjoint(inverse(motion))
    return np.asarray(ad @ before @ ad.T + noise)


def motion_covariance(
    motion: FloatArray, before: FloatArray, after: FloatArray, cross: FloatArray
) -> FloatArray:
    """Covariance (..., 6, 6) of a motion ``iTj`` (..., 4, 4) between two poses, by their joint one.

    Args:
        motion: ``inverse(wTi) @ wTj``; its error is at its end.
        before: of the first pose, in the tangent space at it.
        after: of the second.
        cross: of both: the first's errors in rows, the second's in columns.
    """
    ad = adjoint(inverse(motion))
    shared = ad @ cross
    found = after + ad @ before @ np.swapaxes(ad, -1, -2) - shared - np.swapaxes(shared, -1, -2)
    return np.asarray(0.5 * (found + np.swapaxes(found, -1, -2)))


def is_rigid(matrix: FloatArray) -> bool:
    """Whether the matrix is a finite rigid motion (4, 4)."""
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        return False
    rotation = matrix[:3, :3]
    if np.abs(rotation).max() > 2.0:  # whose product may overflow
        return False
    orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), atol=_RIGID_TOLERANCE)
    right_handed = np.linalg.det(rotation) > 0.0
    return bool(orthonormal and right_handed and np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]))


def change_tangent_frame(aTb: FloatArray, covariance: FloatArray) -> FloatArray:
    """Covariance (..., 6, 6) of a motion in b, expressed in a: ``Ad(aTb) C Ad(aTb)^T``."""
    ad = adjoint(aTb)
    return np.asarray(ad @ covariance @ np.swapaxes(ad, -1, -2))


def body_to_camera_motion(bTb: FloatArray, bTc: FloatArray) -> FloatArray:
    """Motion (4, 4) of the camera when the robot's body moves by ``bTb`` (Se et al. 5).

    The lever arm turns a pure spin of the robot into an arc at the camera.
    """
    return np.asarray(inverse(bTc) @ bTb @ bTc)


def reorthonormalise(wTc: FloatArray) -> FloatArray:
    """The nearest rigid motions (..., 4, 4); removes the drift of many products."""
    u, _, vt = np.linalg.svd(wTc[..., :3, :3])
    u[..., 2] *= np.linalg.det(u @ vt)[..., None]
    return pose(u @ vt, wTc[..., :3, 3])


def rotation_angle(rotation: FloatArray) -> float:
    """Angle in radians of a rotation matrix (3, 3)."""
    return float(np.linalg.norm(so3_log(rotation)))


def yaw_pitch_roll(wTc: FloatArray) -> tuple[float, float, float]:
    """Paper's angles of a camera pose, radians: yaw clockwise from above, pitch up, roll clockwise.

    The rotation is yaw about y (down), then pitch about x, then roll about z: ``Ry Rx Rz``.
    """
    r = wTc[:3, :3]
    pitch = float(np.arcsin(np.clip(-r[1, 2], -1.0, 1.0)))
    yaw = float(np.arctan2(r[0, 2], r[2, 2]))
    roll = float(np.arctan2(r[1, 0], r[1, 1]))
    return yaw, pitch, roll


# --------------------------------------------------------------------------------------------
# The stereo camera


def transform_to_camera(wTc: FloatArray, points: FloatArray) -> FloatArray:
    """World points (n, 3) in the coordinates of cameras ``wTc`` (..., 4, 4): (..., n, 3)."""
    return np.asarray((points - wTc[..., None, :3, 3]) @ wTc[..., :3, :3])


def transform_to_world(wTc: FloatArray, points: FloatArray) -> FloatArray:
    """Camera points (n, 3) in world coordinates."""
    return np.asarray(points @ wTc[:3, :3].T + wTc[:3, 3])


def in_front(points: FloatArray, nearest_m: float = 1e-3) -> BoolArray:
    """Which points (n, 3) in the camera's frame lie before it, by more than ``nearest_m``."""
    return np.asarray(points[:, 2] > nearest_m)


def point_pose_jacobian(points: FloatArray) -> FloatArray:
    """d(point in camera)/d(tangent of wTc) (n, 3, 6) for points (n, 3) in the camera's frame."""
    out = np.empty((len(points), 3, 6))
    out[:, :, :3], out[:, :, 3:] = skew(points), -_EYE3
    return out


def congruence(a: FloatArray, s: FloatArray) -> FloatArray:
    """``a @ s @ a^T`` over the leading axis, symmetric to the last bit."""
    out = a @ s @ np.swapaxes(a, -1, -2)
    return np.asarray(0.5 * (out + np.swapaxes(out, -1, -2)))


def block_diagonal(first: FloatArray, rest: FloatArray) -> FloatArray:
    """Joint covariance of one item (n, n) and k independent others (k, m, m), in that order."""
    n, (k, m) = len(first), rest.shape[:2]
    out = np.zeros((n + k * m, n + k * m))
    out[:n, :n] = first
    at = n + m * np.arange(k)[:, None] + np.arange(m)
    out[at[:, :, None], at[:, None, :]] = rest
    return out


def rotate_covariances(aRb: FloatArray, covariances: FloatArray) -> FloatArray:
    """Covariances (n, 3, 3) of vectors in b, expressed in a, by one rotation ``aRb`` (3, 3).

    One matrix product for all of them: ``vec(R C R^T) = (R kron R) vec(C)``.
    """
    flat = covariances.reshape(-1, 9) @ np.kron(aRb, aRb).T
    return np.asarray(flat.reshape(-1, 3, 3))


def inverse_spd3(matrices: FloatArray) -> FloatArray:
    """Inverses (n, 3, 3) of symmetric positive definite matrices, by their L D L^T factors.

    As exact as LAPACK on the long thin ellipsoids of far landmarks (cofactors lose the square of
    the condition number), six times faster on batches of hundreds, symmetric to the last bit.
    """
    a, b, c = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 0, 2]
    l10, l20 = b / a, c / a
    d1 = matrices[:, 1, 1] - l10 * b
    e1 = matrices[:, 1, 2] - l10 * c
    l21 = e1 / d1
    i22 = 1.0 / (matrices[:, 2, 2] - l20 * c - l21 * e1)
    m20 = l10 * l21 - l20  # of the inverse of L
    i20, i21, i10 = m20 * i22, -l21 * i22, -l10 / d1
    out = np.empty_like(matrices)
    out[:, 0, 0] = 1.0 / a - l10 * i10 + m20 * i20
    out[:, 0, 1] = out[:, 1, 0] = i10 - l21 * i20
    out[:, 0, 2] = out[:, 2, 0] = i20
    out[:, 1, 1] = 1.0 / d1 - l21 * i21
    out[:, 1, 2] = out[:, 2, 1] = i21
    out[:, 2, 2] = i22
    return out


def right_from_left_camera(wTl: FloatArray, baseline: float) -> FloatArray:
    """Poses (..., 4, 4) of the right camera from those of the left one."""
    out = np.array(wTl, dtype=np.float64)
    out[..., :3, 3] += baseline * wTl[..., :3, 0]
    return out


# ------------------------------------------------------------------------------------------
# Poses and bearings in the plane: the geometry of homing


def wrap(angle: FloatArray) -> FloatArray:
    """Angles in radians, wrapped to [-pi, pi)."""
    wrapped = (np.asarray(angle, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi
    # The remainder of a tiny negative number rounds up to the divisor itself.
    return np.asarray(np.where(wrapped >= np.pi, -np.pi, wrapped))


def wrapped_pose(pose: FloatArray) -> FloatArray:
    """(3,) the same pose, its heading within half a turn: steps of a solver may lead beyond."""
    out = np.array(pose, dtype=np.float64)
    out[2:] = wrap(out[2:])
    return out


def unit(angle: FloatArray) -> FloatArray:
    """(..., 2) unit vectors (cos, sin) of angles (...)."""
    angle = np.asarray(angle, dtype=np.float64)
    out = np.empty((*angle.shape, 2))  # what stacks its parts takes longer than their sines
    np.cos(angle, out=out[..., 0])
    np.sin(angle, out=out[..., 1])
    return out


def rotation(angle: float) -> FloatArray:
    """(2, 2) matrix that turns a vector counter-clockwise by ``angle`` radians."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def compose(aTb: FloatArray, bTc: FloatArray) -> FloatArray:
    """(..., 3) ``aTc`` of poses (..., 3) and (..., 3)."""
    aTb, bTc = np.asarray(aTb, dtype=np.float64), np.asarray(bTc, dtype=np.float64)
    c, s = np.cos(aTb[..., 2]), np.sin(aTb[..., 2])
    x = aTb[..., 0] + c * bTc[..., 0] - s * bTc[..., 1]
    y = aTb[..., 1] + s * bTc[..., 0] + c * bTc[..., 1]
    return _poses(x, y, aTb[..., 2] + bTc[..., 2])


def planar_inverse(aTb: FloatArray) -> FloatArray:
    """(..., 3) ``bTa``."""
    aTb = np.asarray(aTb, dtype=np.float64)
    c, s = np.cos(aTb[..., 2]), np.sin(aTb[..., 2])
    x = -c * aTb[..., 0] - s * aTb[..., 1]
    y = s * aTb[..., 0] - c * aTb[..., 1]
    return _poses(x, y, -aTb[..., 2])


def _poses(x: FloatArray, y: FloatArray, turn: FloatArray) -> FloatArray:
    """(..., 3) of coordinates and headings (...), these still to be wrapped."""
    out = np.empty((*np.shape(x), 3))
    out[..., 0], out[..., 1], out[..., 2] = x, y, wrap(turn)
    return out


def between(wTa: FloatArray, wTb: FloatArray) -> FloatArray:
    """(..., 3) ``aTb``: pose b as seen from a."""
    return compose(planar_inverse(wTa), wTb)


def to_robot(wTr: FloatArray, points: FloatArray) -> FloatArray:
    """(n, 2) points of the world in the robot's axes: R(psi)^T (P - p), eq. 8 corrected."""
    return (np.asarray(points) - wTr[:2]) @ rotation(float(wTr[2]))


def bearings(wTr: FloatArray, points: FloatArray) -> FloatArray:
    """(n,) bearings of points (n, 2) from a pose, counter-clockwise from its heading (eqs 7, 9)."""
    seen = to_robot(wTr, points)
    return np.arctan2(seen[:, 1], seen[:, 0])


def circular_median(angles: FloatArray) -> float:
    """The angle of (n,) wrapped ones, n > 0, with the least sum of absolute differences to all."""
    apart = np.abs(angles[:, None] - angles)
    apart = np.minimum(apart, np.abs(2.0 * np.pi - apart))
    return float(angles[int(np.argmin(apart.sum(axis=0)))])


# ------------------------------------------------------------------------------------------
# Robust linear least squares: Cauchy's M-estimator with a Gaussian prior

# ------------------------------------------------------------------------------------------
# Gauss-Newton over many small problems at once, from any number of first guesses

Linearised: TypeAlias = tuple[FloatArray, FloatArray]
"""Of c problems with k unknowns: half the Hessian (c, k, k) and the gradient (c, k) of the cost."""


@dataclass(frozen=True, slots=True)
class GaussNewton:
    """How far to go.

    Attributes:
        iterations: at most.
        converged: a problem is done once no unknown moves by this much.
        settling: first iterations after which no problem is done: while the caller still widens
            its gates, a short step means nothing.
        longest: no unknown moves by more in one step.
        damping: added to the Hessian's diagonal, so that unknowns left open stay where they are.
    """

    iterations: int
    converged: float
    settling: int = 0
    longest: float = np.inf
    damping: float = 0.0

    def minimise(
        self, start: FloatArray, linearise: Callable[[FloatArray, int], Linearised]
    ) -> FloatArray:
        """(c, k) unknowns at the minimum of each problem, or where the iterations ended.

        Args:
            start: (c, k) first guesses.
            linearise: gives Hessians and gradients at unknowns (g, k) of the problems that go on,
                and is given the iteration, from 0. Robust weights are its own affair: reweighting
                with every call makes this iteratively reweighted least squares.

        Raises:
            numpy.linalg.LinAlgError: a Hessian is singular.
        """
        unknowns = np.array(start, dtype=np.float64)
        going = np.arange(len(unknowns))
        damping, bounded = self.damping * np.eye(unknowns.shape[1]), np.isfinite(self.longest)
        for k in range(self.iterations):
            hessian, gradient = linearise(unknowns[going], k)
            step = np.linalg.solve(hessian + damping, -gradient[:, :, None])[:, :, 0]
            unknowns[going] += np.clip(step, -self.longest, self.longest) if bounded else step
            if k >= self.settling:
                going = going[np.abs(step).max(axis=1) >= self.converged]
            if not len(going):
                break
        return unknowns


# ------------------------------------------------------------------------------------------
# Levenberg and Marquardt's damping: as little as lets a step lower the cost

T = TypeVar("T")

_FIRST, _TIMES, _MOST = 1e-3, 10.0, 1e6
_ROUNDING = 1e-9


class Damping:
    """How much the last step was damped: none at first, as Gauss and Newton do it."""

    def __init__(self, least: float = 1e-9) -> None:
        """None yet; it ends below ``least``.

        Where an undamped step does not lower the cost, damping must fall from one step to the next:
        steps that are tried undamped in vain each time, and then damped as before, creep.
        """
        self.last = 0.0
        self._least = least

    def step(
        self, cost: float, attempt: Callable[[float], tuple[float, T]]
    ) -> tuple[float, T] | None:
        """Cost and state after one step that does not raise the cost; None where none does.

        Args:
            cost: before.
            attempt: cost and state after a step with so many times the diagonal added to itself;
                may raise LinAlgError or EstimatorError where that leaves variables open.
        """
        damping = self.last / _TIMES if self.last > self._least else 0.0
        while damping < _MOST:
            try:
                found = attempt(damping)
            except (LinAlgError, EstimatorError):
                pass
            else:
                if found[0] <= cost * (1.0 + _ROUNDING):
                    self.last = damping
                    return found
            damping = _TIMES * damping if damping > 0.0 else _FIRST
        return None


KERNEL = 2.0
"""Spreads of the residuals at which Cauchy's kernel turns from square to logarithm."""

_ROUNDS = 6


@dataclass(frozen=True, slots=True, eq=False)
class RobustFit:
    """The unknowns (p,), the spread of the residuals, and the weighted normal equations.

    ``normal`` (p, p) and ``moment`` (p,) are those of the last iteration, without the prior;
    divided by ``spread**2`` they are information and score.
    """

    found: FloatArray
    spread: float
    normal: FloatArray
    moment: FloatArray


def cauchy_fit(
    design: FloatArray, values: FloatArray, prior: FloatArray, least_spread: float
) -> RobustFit:
    """Iteratively reweighted least squares with Cauchy's kernel (Huber 1981, ch. 7).

    Args:
        design: (n, p), of a linear model ``values = design @ unknowns + noise``.
        values: (n,).
        prior: (p, p) information of the unknowns, whose prior mean is zero.
        least_spread: of the residuals: that of exact data.
    """
    found: FloatArray = np.zeros(design.shape[1])
    for _ in range(_ROUNDS):
        residual = values - design @ found
        spread = max(least_spread, 1.4826 * middle(np.abs(residual)))
        weighted = design.T * (1.0 / (1.0 + (residual / (KERNEL * spread)) ** 2))
        normal, moment = weighted @ design, weighted @ values
        found = np.asarray(np.linalg.solve(normal + spread**2 * prior, moment), np.float64)
    return RobustFit(found, spread, normal, moment)
