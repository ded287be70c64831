"""Gauss-Newton on the residuals of many poses at once, each with matches of its own."""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.floor import Floor
from fgslam.core.geometry import inverse_spd3, so3_exp
from fgslam.core.sensors import CameraRig
from fgslam.frontend.places.relocalisation.residuals import Pairs, residuals

_HOPELESS = 1e-12  # of the reduced Hessian's reciprocal condition


def refine(
    rig: CameraRig,
    floor: Floor,
    poses: FloatArray,
    pairs: Pairs,
    pose_rows: IntArray,
    iterations: int,
    kernel_width: float | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Poses (h, 4, 4) moved to fit their matches, and their covariances (h, 6, 6).

    Args:
        rig: the cameras.
        floor: which motions are allowed.
        poses: (h, 4, 4) where to start.
        pairs: matches of all poses.
        pose_rows: (k,) which pose each match belongs to.
        iterations: steps taken; all poses take the same number.
        kernel_width: of a Cauchy kernel on normalised residuals; None for plain least squares.

    A pose that its matches do not fix keeps its place and gets an infinite covariance.
    """
    poses = poses.copy()
    for _ in range(iterations):
        hessians, gradients = _normal_equations(rig, poses, pairs, pose_rows, kernel_width)
        bases = _bases(floor, poses)
        inverses = _inverses(bases, hessians)
        steps = np.einsum("hij,hj->hi", inverses, gradients)
        steps[~np.isfinite(steps).all(axis=1)] = 0.0
        poses = _moved(poses, _limited(steps))
    hessians, _ = _normal_equations(rig, poses, pairs, pose_rows, None)
    return poses, _inverses(_bases(floor, poses), hessians)


def _normal_equations(
    rig: CameraRig,
    poses: FloatArray,
    pairs: Pairs,
    pose_rows: IntArray,
    kernel_width: float | None,
) -> tuple[FloatArray, FloatArray]:
    """Hessians (h, 6, 6) and steepest descents (h, 6)."""
    found = residuals(rig, poses, pairs, pose_rows)
    information = inverse_spd3(found.covariance)
    weight = found.valid.astype(np.float64)
    if kernel_width is not None:
        squared = np.einsum("mi,mij,mj->m", found.residual, information, found.residual)
        weight = weight / (1.0 + squared / kernel_width**2)
    weighted = np.swapaxes(found.by_pose, 1, 2) @ (weight[:, None, None] * information)
    hessian = (weighted @ found.by_pose).reshape(-1, 36)
    gradient = np.einsum("mij,mj->mi", weighted, found.residual)
    hessians = _summed(hessian, pose_rows, len(poses)).reshape(-1, 6, 6)
    return hessians, _summed(gradient, pose_rows, len(poses))


def _summed(values: FloatArray, rows: IntArray, count: int) -> FloatArray:
    """Sums (count, d) of the values (m, d) that belong to each row, added in their order."""
    d = values.shape[1]
    places = rows[:, None] * d + np.arange(d)
    sums = np.bincount(places.ravel(), values.ravel(), minlength=count * d)
    return np.asarray(sums.reshape(count, d), np.float64)


def _bases(floor: Floor, poses: FloatArray) -> FloatArray:
    """(h, 6, dof) tangent directions that the floor allows at each pose."""
    return np.array([floor.basis(pose) for pose in poses]).reshape(len(poses), 6, -1)


def _inverses(bases: FloatArray, hessians: FloatArray) -> FloatArray:
    """Inverses (h, 6, 6) on the allowed directions; infinite where undetermined."""
    reduced = np.swapaxes(bases, 1, 2) @ hessians @ bases
    size = np.sqrt(np.maximum(np.diagonal(reduced, axis1=1, axis2=2), 1e-300))
    scaled = reduced / (size[:, :, None] * size[:, None, :])
    good = np.isfinite(scaled).all(axis=(1, 2))
    scaled[~good] = np.eye(bases.shape[2])
    values, vectors = np.linalg.eigh(scaled)
    good &= values[:, 0] > _HOPELESS
    inverted = (vectors / np.maximum(values, _HOPELESS)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    inverted /= size[:, :, None] * size[:, None, :]
    out = bases @ inverted @ np.swapaxes(bases, 1, 2)
    out[~good] = np.inf
    return np.asarray(0.5 * (out + np.swapaxes(out, 1, 2)))


def _limited(steps: FloatArray) -> FloatArray:
    """No step turns by over half a radian or moves by over a metre: all is linear no more."""
    turn = np.linalg.norm(steps[:, :3], axis=1) / 0.5
    way = np.linalg.norm(steps[:, 3:], axis=1) / 1.0
    return np.asarray(steps / np.maximum(1.0, np.maximum(turn, way))[:, None])


def _moved(poses: FloatArray, steps: FloatArray) -> FloatArray:
    """Rotation and translation apart: planar motion stays planar."""
    out = poses.copy()
    for k, step in enumerate(steps):
        out[k, :3, 3] += poses[k, :3, :3] @ step[3:]
        out[k, :3, :3] = poses[k, :3, :3] @ so3_exp(step[:3])
    return out
