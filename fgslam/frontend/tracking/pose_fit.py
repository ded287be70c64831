"""Kernel that fits a pose to matches: damped Gauss-Newton with a robust cost and a prior.

The pose T is that in the frame of the predicted camera. Of a point (x, y, z) in the frame of T,
c = (c_x + f_x x/z, c_y + f_y y/z, f_x b/z) is expected. With r = c - measured, its information W,
J = dc / d(tangent of T) and s = r^T W r, minimised is ::

    sum rho(s) + d^T P d,    d = Log(T)        P the prior's information (Lowe 1991)
    H = sum rho'(s) J^T W J + L^T P L          L = dd / d(tangent), Bernoulli's series of ad(d)
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
    moved_apart,
    point_pose_jacobian,
    se3_log,
    se3_log_jacobian,
    transform_to_camera,
)
from fgslam.core.kernels import Kernel, invert
from fgslam.core.sensors import CameraRig

ROBUST = ("none", "huber", "cauchy")
_WIDTH = 2.0  # of the robust kernel, standard deviations of a residual
_MAX_DAMPING = 1e8
_NEAREST_M = 1e-3
_NO_TURN = 1e-12  # radians: below, the limits of the quotients by it


def multiply(a: Any, b: Any, out: Any) -> None:
    """Products of matrices (6, 6)."""
    for i in range(6):
        for j in range(6):
            out[i, j] = 0.0
            for k in range(6):
                out[i, j] += a[i, k] * b[k, j]


def add_term(j: Any, information: Any, r: Any, robust: int, system: Any) -> float:
    """The robust cost; adds ``J^T W J`` and, in the seventh row, ``J^T W r`` to a system (7, 6)."""
    square, weight, size = 0.0, 1.0, len(information)
    for a in range(size):
        for b in range(size):
            square += r[a] * information[a, b] * r[b]
    if robust == 2:
        weight = 1.0 / (1.0 + square / _WIDTH**2)
        square = _WIDTH**2 * math.log1p(square / _WIDTH**2)
    elif robust == 1 and square > _WIDTH**2:
        weight = _WIDTH / math.sqrt(square)
        square = _WIDTH * (2.0 * math.sqrt(square) - _WIDTH)
    for a in range(size):
        for i in range(6):
            pull = 0.0
            for b in range(size):
                pull += weight * information[a, b] * j[b, i]
            system[6, i] += pull * r[a]
            for k in range(6):
                system[i, k] += pull * j[a, k]
    return square


def add_matches(
    pose: Any, points: Any, measured: Any, information: Any, camera: Any, robust: int,
    system: Any, room: Any,
) -> float:  # fmt: skip
    """Cost of the matches, which are added to the system."""
    fx, fy, base, cost = camera[0], camera[1], camera[0] * camera[4], 0.0
    j, p, r = room[0], room[1, 0], room[1, 1]
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
        j[0, 0], j[0, 1], j[0, 2] = fx * u * v, -fx * (1.0 + u * u), fx * v
        j[1, 0], j[1, 1], j[1, 2] = fy * (1.0 + v * v), -fy * u * v, -fy * u
        j[2, 0], j[2, 1], j[2, 5] = base * v * near, -base * u * near, base * near * near
        j[0, 3], j[0, 5], j[1, 4], j[1, 5] = -fx * near, fx * u * near, -fy * near, fy * v * near
        cost += add_term(j, information[n], r, robust, system)
    return cost


def add_prior(pose: Any, prior: Any, system: Any, room: Any) -> float:
    """Cost of the deviation from the predicted pose, which is added to the system."""
    ad, ad2, ad4, ad6, d = room[0], room[1], room[2], room[3], room[4, 0]
    for i in range(3):
        d[i] = 0.5 * (pose[(i + 2) % 3, (i + 1) % 3] - pose[(i + 1) % 3, (i + 2) % 3])
    sine = math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    theta = math.atan2(sine, 0.5 * (pose[0, 0] + pose[1, 1] + pose[2, 2] - 1.0))
    along, c = 0.0, 1.0 / 12.0
    if theta > _NO_TURN:
        c = (1.0 - 0.5 * theta / math.tan(0.5 * theta)) / (theta * theta)
    for i in range(3):
        d[i] *= theta / sine if sine > _NO_TURN else 1.0
        along += d[i] * pose[i, 3]
    ad[:] = 0.0
    for i in range(3):  # with w = d[:3] the translation's part is t - w x t / 2 + c w x (w x t)
        a, b = (i + 1) % 3, (i + 2) % 3
        twice = d[i] * along - theta * theta * pose[i, 3]
        d[3 + i] = pose[i, 3] - 0.5 * (d[a] * pose[b, 3] - d[b] * pose[a, 3]) + c * twice
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        ad[i, a], ad[i, b], ad[3 + i, a], ad[3 + i, b] = -d[b], d[a], -d[3 + b], d[3 + a]
        ad[3 + i, 3 + a], ad[3 + i, 3 + b] = -d[b], d[a]
    multiply(ad, ad, ad2)
    multiply(ad2, ad2, ad4)
    multiply(ad4, ad2, ad6)
    for i in range(6):
        for k in range(6):
            ad[i, k] = ad[i, k] / 2 + ad2[i, k] / 12 - ad4[i, k] / 720 + ad6[i, k] / 30240
        ad[i, i] += 1.0
    return add_term(ad, prior, d, 0, system)


def solve_step(pose: Any, basis: Any, system: Any, damping: float, step: Any, room: Any) -> float:
    """The largest entry of the step; infinite where it is not determined."""
    b, hb, m, free = room[0], room[1], room[2], basis.shape[1]
    b[:] = 0.0
    for i in range(6):
        for k in range(free):
            for a in range(3):
                b[i, k] += pose[a, i % 3] * basis[i // 3 * 3 + a, k]
    multiply(system, b, hb)
    for i in range(free):
        for j in range(free):
            m[i, j] = 0.0
            for k in range(6):
                m[i, j] += b[k, i] * hb[k, j]
        m[i, i] *= 1.0 + damping
    if not invert(m, free):
        return math.inf
    largest = 0.0
    for i in range(6):
        step[i] = 0.0
        for k in range(free):
            for j in range(free):
                for a in range(6):
                    step[i] -= b[i, k] * m[k, j] * b[a, j] * system[6, a]
        largest = max(largest, abs(step[i]))
    return largest


def move(start: Any, step: Any, out: Any) -> None:
    """As :func:`fgslam.core.geometry.moved_apart`."""
    theta2 = step[0] * step[0] + step[1] * step[1] + step[2] * step[2]
    theta, a, b = math.sqrt(theta2), 1.0, 0.5
    if theta > _NO_TURN:
        a, b = math.sin(theta) / theta, 2.0 * math.sin(0.5 * theta) ** 2 / theta2
    for i in range(3):
        row, along = start[i], b * (start[i, 0] * step[0] + start[i, 1] * step[1])
        along += b * start[i, 2] * step[2]
        out[i, 3] = row[3]
        for k in range(3):
            p, q = (k + 1) % 3, (k + 2) % 3
            turned = a * (row[p] * step[q] - row[q] * step[p]) + along * step[k]
            out[i, k] = (1.0 - b * theta2) * row[k] + turned
            out[i, 3] += row[k] * step[3 + k]


def _fit(  # noqa: PLR0913  kernels take plain arrays
    points: Any, measured: Any, information: Any, camera: Any, prior: Any, basis: Any, robust: int,
    tolerance: float, most: int, pose: Any, system: Any, state: Any, room: Any,
) -> None:  # fmt: skip
    best, tried, now, step, still = system[0], system[1], room[5], room[4, 1], room[6, 0]
    best_cost, damping = math.inf, 0.0
    move(pose, still, now)
    while state[0] < most:
        state[0] += 1.0
        tried[:] = 0.0
        cost = add_matches(now, points, measured, information, camera, robust, tried, room)
        if math.isfinite(cost):
            cost += add_prior(now, prior, tried, room)
        if cost <= best_cost * (1.0 + 1e-12):
            for i in range(7):
                for k in range(6):
                    best[i, k] = tried[i, k]
            move(now, still, pose)
            best_cost, damping = cost, 0.1 * damping
        else:
            damping = max(10.0 * damping, 1e-4)
            if damping > _MAX_DAMPING:
                break
        largest = solve_step(pose, basis, best, damping, step, room)
        state[1] = 1.0 if math.isfinite(best_cost) and math.isfinite(largest) else 0.0
        if state[1] == 0.0 or largest < tolerance:
            break
        move(pose, step, now)


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
    residual = rig.predict(local) - measured
    jacobian = rig.jacobian(local) @ point_pose_jacobian(local)
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
    prior: FloatArray, basis: FloatArray, robust: int, tolerance: float, most: int,
    pose: FloatArray, system: FloatArray, state: FloatArray, _: FloatArray,
) -> None:  # fmt: skip
    now, best, best_cost, damping = pose.copy(), system[0], np.inf, 0.0
    for iteration in range(1, most + 1):
        state[0] = iteration
        cost, hessian, gradient = _linearised(now, points, measured, information, camera, robust)
        deviation = se3_log(now)
        pull = se3_log_jacobian(deviation).T @ prior
        cost += float(deviation @ prior @ deviation)
        if cost <= best_cost * (1.0 + 1e-12):
            pose[:], best_cost = now, cost
            best[:6] = hessian + pull @ se3_log_jacobian(deviation)
            best[6] = gradient + pull @ deviation
            damping *= 0.1
        else:
            damping = max(10.0 * damping, 1e-4)
            if damping > _MAX_DAMPING:
                break
        b = np.kron(np.eye(2), pose[:3, :3].T) @ basis
        reduced = b.T @ best[:6] @ b
        reduced.flat[:: len(reduced) + 1] *= 1.0 + damping
        try:
            step = -(b @ np.linalg.solve(reduced, b.T @ best[6]))
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
    "f8[:,::1] f8[:,::1] f8[:,:,::1] f8[::1] f8[:,::1] f8[:,::1] i8 f8 i8 f8[:,::1] f8[:,:,::1] "
    "f8[::1] f8[:,:,::1]",
    *(multiply, add_term, add_matches, add_prior, solve_step, move, invert),
)
"""(points (k, 3), measured (k, 3), information (k, 3, 3), camera (f_x, f_y, c_x, c_y, b), prior
(6, 6), directions allowed (6, f), place in :data:`ROBUST`, tolerance, most steps, pose, system,
state, zeros (7, 6, 6)), all in the frame of the predicted camera: the pose (4, 4), from where it
starts; hessian and gradient there, system[0] of (2, 7, 6); steps, and whether it is determined."""
