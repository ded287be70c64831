"""Kernel that fits a pose to matches: damped Gauss-Newton with a robust cost and a prior.

A point (x, y, z) in the camera's frame is predicted at c = (c_x + f_x x/z, c_y + f_y y/z, f_x b/z).
With r = c - measured, its information W, J = dc / d(tangent of wTc), s = r^T W r, minimised is ::

    sum rho(s) + |d|^2 in the prior's metric P,    d = Log(predicted^-1 wTc)    (Lowe 1991)
    H = sum rho'(s) J^T W J + L^T P L              L = dd / d(tangent), Bernoulli's series of ad(d)
    step = -B (B^T H B, its diagonal times 1 + damping)^-1 B^T gradient

B (6, f) are the directions that the floor allows, turned into the camera's frame. Where a step
raises the cost, the damping grows, from the best pose so far (Levenberg); a pose behind a point
costs infinitely much.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import (
    in_front,
    inverse,
    moved_apart,
    point_pose_jacobian,
    project,
    projection_jacobian,
    se3_log,
    se3_log_jacobian,
    transform_to_camera,
)
from fgslam.core.kernels import Kernel
from fgslam.core.sensors import CameraRig

ROBUST = ("none", "huber", "cauchy")
_WIDTH = 2.0  # of the robust kernel, standard deviations of a residual
_MAX_DAMPING = 1e8
_SMALL_ANGLE = 1e-4  # below it the series are exact to double precision
_NEAREST_M = 1e-3


def multiply(a: Any, b: Any, out: Any) -> None:
    """Products of matrices (6, 6)."""
    for i in range(6):
        for j in range(6):
            out[i, j] = 0.0
            for k in range(6):
                out[i, j] += a[i, k] * b[k, j]


def square_of(information: Any, r: Any) -> float:
    """``r^T W r``."""
    total = 0.0
    for a in range(len(information)):
        for b in range(len(information)):
            total += r[a] * information[a, b] * r[b]
    return total


def add_term(j: Any, information: Any, r: Any, weight: float, room: Any) -> None:
    """Adds ``J^T W J`` to the hessian, room[0], and ``J^T W r`` to the gradient, room[1, 0]."""
    for a in range(len(information)):
        for i in range(6):
            pull = 0.0
            for b in range(len(information)):
                pull += weight * information[a, b] * j[b, i]
            room[1, 0, i] += pull * r[a]
            for k in range(6):
                room[0, i, k] += pull * j[a, k]


def add_matches(
    pose: Any, points: Any, measured: Any, information: Any, camera: Any, robust: int, room: Any
) -> float:
    """Cost of the matches, which are added."""
    fx, fy, base, cost = camera[0], camera[1], camera[0] * camera[4], 0.0
    j, p, r = room[2], room[1, 1], room[1, 2]
    j[:] = 0.0
    for n in range(len(points)):
        for i in range(3):
            p[i] = 0.0
            for k in range(3):
                p[i] += (points[n, k] - pose[k, 3]) * pose[k, i]
        if not p[2] > _NEAREST_M:
            return math.inf
        near = 1.0 / p[2]
        u, v = p[0] * near, p[1] * near
        r[0] = camera[2] + fx * u - measured[n, 0]
        r[1] = camera[3] + fy * v - measured[n, 1]
        r[2] = base * near - measured[n, 2]
        square = square_of(information[n], r)
        rho, weight = square, 1.0
        if robust == 2:
            weight = 1.0 / (1.0 + square / _WIDTH**2)
            rho = _WIDTH**2 * math.log1p(square / _WIDTH**2)
        elif robust == 1 and square > _WIDTH**2:
            weight = _WIDTH / math.sqrt(square)
            rho = _WIDTH * (2.0 * math.sqrt(square) - _WIDTH)
        cost += rho
        j[0, 0], j[0, 1], j[0, 2], j[0, 3], j[0, 5] = (
            fx * u * v, -fx * (1.0 + u * u), fx * v, -fx * near, fx * u * near
        )  # fmt: skip
        j[1, 0], j[1, 1], j[1, 2], j[1, 4], j[1, 5] = (
            fy * (1.0 + v * v), -fy * u * v, -fy * u, -fy * near, fy * v * near
        )  # fmt: skip
        j[2, 0], j[2, 1], j[2, 5] = base * v * near, -base * u * near, base * near * near
        add_term(j, information[n], r, weight, room)
    return cost


def add_prior(pose: Any, predicted: Any, prior: Any, room: Any) -> float:
    """Cost of the deviation from the predicted pose, which is added."""
    ad, ad2, ad4, ad6, d, m = room[2], room[3], room[4], room[5], room[1, 1], room[6]
    for i in range(3):  # m = predicted^-1 wTc
        for k in range(4):
            m[i, k] = 0.0
            for a in range(3):
                m[i, k] += predicted[a, i] * (pose[a, k] - (predicted[a, 3] if k == 3 else 0.0))
    sine, cosine, theta2, along = 0.0, 0.5 * (m[0, 0] + m[1, 1] + m[2, 2] - 1.0), 0.0, 0.0
    for i in range(3):
        d[i] = 0.5 * (m[(i + 2) % 3, (i + 1) % 3] - m[(i + 1) % 3, (i + 2) % 3])
        sine += d[i] * d[i]
    sine = math.sqrt(sine)
    small = sine < _SMALL_ANGLE and cosine > 0.0
    ratio = 1.0 + sine * sine / 6.0 if small else math.atan2(sine, cosine) / max(sine, 1e-12)
    for i in range(3):
        d[i] *= ratio
        theta2 += d[i] * d[i]
        along += d[i] * m[i, 3]
    half = 0.5 * math.sqrt(theta2)
    c = 1.0 / 12.0 + theta2 / 720.0
    if not small:
        c = (1.0 - half * math.cos(half) / math.sin(half)) / theta2
    ad[:] = 0.0
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        crossed = d[a] * m[b, 3] - d[b] * m[a, 3]
        d[3 + i] = m[i, 3] - 0.5 * crossed + c * (d[i] * along - theta2 * m[i, 3])
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        ad[i, a] = ad[3 + i, 3 + a] = -d[b]
        ad[i, b] = ad[3 + i, 3 + b] = d[a]
        ad[3 + i, a], ad[3 + i, b] = -d[3 + b], d[3 + a]
    multiply(ad, ad, ad2)
    multiply(ad2, ad2, ad4)
    multiply(ad4, ad2, ad6)
    for i in range(6):
        for k in range(6):
            ad[i, k] = ad[i, k] / 2 + ad2[i, k] / 12 - ad4[i, k] / 720 + ad6[i, k] / 30240
        ad[i, i] += 1.0
    add_term(ad, prior, d, 1.0, room)
    return square_of(prior, d)


def solve_step(
    pose: Any, basis: Any, hessian: Any, gradient: Any, damping: float, room: Any
) -> Any:
    """The largest entry of the step, ``room[2, 0]``; infinite where it is not determined."""
    step, right, b, hb, m = room[2, 0], room[2, 1], room[3], room[4], room[5]
    free = basis.shape[1]
    b[:] = 0.0
    for i in range(6):
        for k in range(free):
            for a in range(3):
                b[i, k] += pose[a, i % 3] * basis[i // 3 * 3 + a, k]
    multiply(hessian, b, hb)
    for i in range(free):
        right[i] = 0.0
        for k in range(6):
            right[i] -= b[k, i] * gradient[k]
        for j in range(free):
            m[i, j] = 0.0
            for k in range(6):
                m[i, j] += b[k, i] * hb[k, j]
        m[i, i] *= 1.0 + damping
    for p in range(free):  # Gauss and Jordan: definite, and needs no pivots
        if not m[p, p] > 0.0:
            return math.inf
        for i in range(free):
            if i != p:
                factor = m[i, p] / m[p, p]
                right[i] -= factor * right[p]
                for j in range(p, free):
                    m[i, j] -= factor * m[p, j]
    largest = 0.0
    for i in range(6):
        step[i] = 0.0
        for k in range(free):
            step[i] += b[i, k] * right[k] / m[k, k]
        largest = max(largest, abs(step[i]))
    return largest


def move(start: Any, step: Any, out: Any) -> None:
    """As :func:`fgslam.core.geometry.moved_apart`."""
    theta2 = step[0] * step[0] + step[1] * step[1] + step[2] * step[2]
    theta = math.sqrt(theta2)
    a, b = 1.0 - theta2 / 6.0, 0.5 - theta2 / 24.0
    if theta >= _SMALL_ANGLE:
        a, b = math.sin(theta) / theta, 2.0 * math.sin(0.5 * theta) ** 2 / theta2
    for i in range(3):
        x, y, z = start[i, 0], start[i, 1], start[i, 2]
        along = b * (x * step[0] + y * step[1] + z * step[2])
        rest = 1.0 - b * theta2
        out[i, 0] = rest * x + along * step[0] + a * (y * step[2] - z * step[1])
        out[i, 1] = rest * y + along * step[1] + a * (z * step[0] - x * step[2])
        out[i, 2] = rest * z + along * step[2] + a * (x * step[1] - y * step[0])
        out[i, 3] = start[i, 3] + x * step[3] + y * step[4] + z * step[5]


def _fit(  # noqa: PLR0913  kernels take plain arrays
    points: Any, measured: Any, information: Any, camera: Any, predicted: Any, prior: Any,
    basis: Any, robust: int, tolerance: float, most: int, pose: Any, hessian: Any, state: Any,
    room: Any,
) -> None:  # fmt: skip
    now, gradient, best_cost, damping = room[7], room[8, 0], math.inf, 0.0
    for i in range(3):
        for k in range(4):
            now[i, k] = pose[i, k]
    state[0] = 0.0
    while state[0] < most:
        state[0] += 1.0
        room[0], room[1] = 0.0, 0.0
        cost = add_matches(now, points, measured, information, camera, robust, room)
        if math.isfinite(cost):
            cost += add_prior(now, predicted, prior, room)
        if cost <= best_cost * (1.0 + 1e-12):
            for i in range(6):
                gradient[i] = room[1, 0, i]
                for k in range(6):
                    hessian[i, k] = room[0, i, k]
            for i in range(3):
                for k in range(4):
                    pose[i, k] = now[i, k]
            best_cost = cost
            damping *= 0.1
        else:
            damping = max(10.0 * damping, 1e-4)
            if damping > _MAX_DAMPING:
                break
        largest = solve_step(pose, basis, hessian, gradient, damping, room)
        state[1] = 1.0 if math.isfinite(best_cost) and math.isfinite(largest) else 0.0
        if state[1] == 0.0 or largest < tolerance:
            break
        move(pose, room[2, 0], now)


# ------------------------------------------------------------------------------------------
# The same in NumPy


def _linearised(
    pose: FloatArray, points: FloatArray, measured: FloatArray, information: FloatArray,
    camera: FloatArray, robust: int,
) -> tuple[float, FloatArray, FloatArray]:  # fmt: skip
    """Cost, hessian (6, 6) and gradient (6,) of the matches."""
    fx, fy, cx, cy, baseline = camera
    rig = CameraRig(1, 1, fx, fy, cx, cy, baseline, None, np.eye(4))
    local = transform_to_camera(pose, points)
    if not in_front(local).all():
        return np.inf, np.zeros((6, 6)), np.zeros(6)
    residual = project(rig, local) - measured
    jacobian = projection_jacobian(rig, local) @ point_pose_jacobian(local)
    rho = square = np.einsum("ki,kij,kj->k", residual, information, residual)
    weight = np.ones_like(square)
    if robust == ROBUST.index("cauchy"):
        ratio = square / _WIDTH**2
        rho, weight = _WIDTH**2 * np.log1p(ratio), 1.0 / (1.0 + ratio)
    elif robust == ROBUST.index("huber"):
        norm = np.maximum(np.sqrt(square), _WIDTH)
        rho = np.where(norm > _WIDTH, _WIDTH * (2.0 * norm - _WIDTH), square)
        weight = _WIDTH / norm
    flat = (weight[:, None, None] * (information @ jacobian)).reshape(-1, 6)
    return float(rho.sum()), flat.T @ jacobian.reshape(-1, 6), flat.T @ residual.ravel()


def _fit_numpy(  # noqa: PLR0913
    points: FloatArray, measured: FloatArray, information: FloatArray, camera: FloatArray,
    predicted: FloatArray, prior: FloatArray, basis: FloatArray, robust: int, tolerance: float,
    most: int, pose: FloatArray, hessian: FloatArray, state: FloatArray, _: FloatArray,
) -> None:  # fmt: skip
    now, gradient, best_cost, damping = pose.copy(), np.zeros(6), np.inf, 0.0
    for iteration in range(1, most + 1):
        state[0] = iteration
        cost, h, g = _linearised(now, points, measured, information, camera, robust)
        deviation = se3_log(inverse(predicted) @ now)
        pull = se3_log_jacobian(deviation).T @ prior
        cost += float(deviation @ prior @ deviation)
        if cost <= best_cost * (1.0 + 1e-12):
            best_cost, gradient = cost, g + pull @ deviation
            pose[:], hessian[:] = now, h + pull @ se3_log_jacobian(deviation)
            damping *= 0.1
        else:
            damping = max(10.0 * damping, 1e-4)
            if damping > _MAX_DAMPING:
                break
        b = np.kron(np.eye(2), pose[:3, :3].T) @ basis
        reduced = b.T @ hessian @ b
        reduced.flat[:: len(reduced) + 1] *= 1.0 + damping
        try:
            step = -(b @ np.linalg.solve(reduced, b.T @ gradient))
        except np.linalg.LinAlgError:
            step = np.full(6, np.inf)
        largest = np.abs(step).max()
        state[1] = np.isfinite(best_cost) and np.isfinite(largest)
        if not state[1] or largest < tolerance:
            break
        now = moved_apart(pose, step)


fit_pose = Kernel(
    _fit,
    _fit_numpy,
    "f8[:,::1] f8[:,::1] f8[:,:,::1] f8[::1] f8[:,::1] f8[:,::1] f8[:,::1] i8 f8 i8 "
    "f8[:,::1] f8[:,::1] f8[::1] f8[:,:,::1]",
    *(multiply, add_term, square_of, add_matches, add_prior, solve_step, move),
)
"""(points (k, 3), measured (k, 3), information (k, 3, 3), camera (f_x, f_y, c_x, c_y, b), predicted
(4, 4), prior (6, 6), directions allowed in the world (6, f), place in :data:`ROBUST`, tolerance,
most steps, pose, hessian, state, room (9, 6, 6)): the pose (4, 4), from where it starts, and there
the hessian (6, 6), and the state (2,): steps, and whether the pose is determined."""
