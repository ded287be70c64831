"""Residuals of many matches at many poses, and Gauss-Newton on all poses at once.

A feature is compared in the image as (column, row, disparity), where its noise is Gaussian. A
feature of a submap may project outside the image or lie behind the camera; it is compared in space
by its position (X, Y, Z) instead. Both give three numbers with a covariance (3, 3), and all that
follows treats them alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray, Rows
from fgslam.core.estimates import LandmarkMap
from fgslam.core.features import StereoFeatures
from fgslam.core.floor import Floor
from fgslam.core.geometry import (
    inverse_spd3,
    point_pose_jacobian,
    project,
    projection_jacobian,
    so3_exp,
)
from fgslam.core.sensors import CameraRig

_NEAREST_M = 0.1
_LOG_TWO_PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True, slots=True, eq=False)
class SeenPoints(Rows):
    """Features as they are compared with landmarks.

    Attributes:
        in_image: (n,) True where compared in the image, False where in space.
        value: (n, 3) (column, row, disparity), or (X, Y, Z) in the camera's frame.
        covariance: (n, 3, 3) of it.
        position: (n, 3) in the camera's frame, metres.
        position_covariance: (n, 3, 3).
    """

    in_image: BoolArray
    value: FloatArray
    covariance: FloatArray
    position: FloatArray
    position_covariance: FloatArray

    @staticmethod
    def of(features: StereoFeatures, rig: CameraRig, view_sigma_px: float = 0.0) -> SeenPoints:
        """The features of a frame, or of a submap in its last camera's frame.

        ``view_sigma_px`` is added to the noise of columns and rows: a corner seen from elsewhere is
        found elsewhere. It is so by the same in all images of the rig: disparities keep theirs.
        """
        column, row, disparity = features.measurement.T
        inside = (column >= -0.5) & (column <= rig.width - 0.5)
        inside &= (row >= -0.5) & (row <= rig.height - 0.5)
        inside &= (disparity > 0.0) & (features.position[:, 2] > _NEAREST_M)
        pick = inside[:, None, None]
        return SeenPoints(
            in_image=inside,
            value=np.where(inside[:, None], features.measurement, features.position),
            covariance=np.where(
                pick,
                features.measurement_covariance + view_sigma_px**2 * np.diag([1.0, 1.0, 0.0]),
                features.position_covariance,
            ),
            position=features.position,
            position_covariance=features.position_covariance,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Pairs(Rows):
    """Features matched with landmarks, row by row.

    Attributes:
        seen: the features, k rows.
        points: (k, 3) the landmarks, world.
        point_covariances: (k, 3, 3).
    """

    seen: SeenPoints
    points: FloatArray
    point_covariances: FloatArray

    @staticmethod
    def of(seen: SeenPoints, features: IntArray, landmarks: LandmarkMap, rows: IntArray) -> Pairs:
        """Features (k,) by index with landmarks (k,) by row of the map."""
        return Pairs(seen.select(features), landmarks.positions[rows], landmarks.covariances[rows])


@dataclass(frozen=True, slots=True, eq=False)
class Residuals:
    """Measured less predicted, for m matches: one row each.

    Attributes:
        valid: (m,) False where a landmark to be seen in the image lies behind the camera.
        residual: (m, 3).
        by_pose: (m, 3, 6) derivative of the *prediction* by the pose's tangent vector.
        covariance: (m, 3, 3) of the measurement and of the landmark as seen from the pose.
    """

    valid: BoolArray
    residual: FloatArray
    by_pose: FloatArray
    covariance: FloatArray


def residuals(
    rig: CameraRig,
    poses: FloatArray,
    pairs: Pairs,
    pose_rows: IntArray | None = None,
) -> Residuals:
    """Residuals of all pairs at one pose (4, 4), or of each pair at its own.

    Args:
        rig: the cameras.
        poses: (4, 4), or (h, 4, 4) with ``pose_rows`` (k,) naming each pair's.
        pairs: k matches.
        pose_rows: None for a single pose.
    """
    wTc = poses if pose_rows is None else poses[pose_rows]
    wRc = np.broadcast_to(wTc[..., :3, :3], (len(pairs), 3, 3))
    offset = pairs.points - wTc[..., :3, 3]
    points = np.einsum("kji,kj->ki", wRc, offset)
    seen = pairs.seen
    ahead = points[:, 2] > _NEAREST_M
    valid = ahead | ~seen.in_image
    safe = np.where(ahead[:, None], points, [0.0, 0.0, 1.0])
    pick = seen.in_image[:, None]
    predicted = np.where(pick, project(rig, safe), points)
    jacobian = np.where(pick[:, :, None], projection_jacobian(rig, safe), np.eye(3))
    to_value = jacobian @ np.swapaxes(wRc, 1, 2)
    covariance = to_value @ pairs.point_covariances @ np.swapaxes(to_value, 1, 2)
    return Residuals(
        valid=valid,
        residual=seen.value - predicted,
        by_pose=jacobian @ point_pose_jacobian(points),
        covariance=covariance + seen.covariance,
    )


def squared_distances(found: Residuals, pose_covariance: FloatArray | None = None) -> FloatArray:
    """Mahalanobis distances squared (m,); infinite where invalid.

    ``pose_covariance`` (6, 6) or (m, 6, 6) is that of the poses, where they are uncertain.
    """
    information, _ = _information(found, pose_covariance)
    squared = np.einsum("mi,mij,mj->m", found.residual, information, found.residual)
    return np.where(found.valid, squared, np.inf)


def log_likelihoods(found: Residuals, pose_covariance: FloatArray | None = None) -> FloatArray:
    """Log densities (m,) of the residuals as Gaussians; minus infinity where invalid."""
    information, log_determinant = _information(found, pose_covariance)
    squared = np.einsum("mi,mij,mj->m", found.residual, information, found.residual)
    logs = -0.5 * (squared + log_determinant + 3.0 * _LOG_TWO_PI)
    return np.where(found.valid, logs, -np.inf)


def _information(
    found: Residuals, pose_covariance: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """Inverse covariances (m, 3, 3) and log determinants (m,) of the covariances."""
    covariance = found.covariance
    if pose_covariance is not None:
        spread = found.by_pose @ pose_covariance @ np.swapaxes(found.by_pose, 1, 2)
        covariance = covariance + 0.5 * (spread + np.swapaxes(spread, 1, 2))
    return inverse_spd3(covariance), np.linalg.slogdet(covariance)[1]


def log_uniform(
    rig: CameraRig, seen: SeenPoints, max_disparity_px: float, room: float
) -> FloatArray:
    """Log density (n,) of a feature that has nothing to do with its landmark.

    In the image uniform over its pixels and disparities; in space over ``room`` cubic metres.
    """
    image = -np.log(rig.width * rig.height * max_disparity_px)
    return np.asarray(np.where(seen.in_image, image, -np.log(room)))


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
    for _ in range(iterations):
        hessians, gradients = _normal_equations(rig, poses, pairs, pose_rows, kernel_width)
        steps = np.einsum("hij,hj->hi", _inverses(floor, poses, hessians), gradients)
        steps[~np.isfinite(steps).all(axis=1)] = 0.0
        # No step turns by over half a radian or moves by over a metre: all is linear no more.
        turn = np.linalg.norm(steps[:, :3], axis=1) / 0.5
        way = np.linalg.norm(steps[:, 3:], axis=1) / 1.0
        steps = steps / np.maximum(1.0, np.maximum(turn, way))[:, None]
        moved = poses.copy()
        for k, step in enumerate(steps):  # turn and move apart: planar motion stays planar
            moved[k, :3, 3] += poses[k, :3, :3] @ step[3:]
            moved[k, :3, :3] = poses[k, :3, :3] @ so3_exp(step[:3])
        poses = moved
    hessians, _ = _normal_equations(rig, poses, pairs, pose_rows, None)
    return poses, _inverses(floor, poses, hessians)


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


def _inverses(floor: Floor, poses: FloatArray, hessians: FloatArray) -> FloatArray:
    """Inverses (h, 6, 6) on the directions that the floor allows; infinite where undetermined."""
    bases = np.array([floor.basis(pose) for pose in poses]).reshape(len(poses), 6, -1)
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
