"""Trajectory error against ground truth: association, alignment, ATE, RPE and end pose.

Estimate and truth live in world frames of their own, so every number depends on how the two were
aligned; the result says which alignment was used and how many poses took part. A value that
cannot be known (no truth, too few matched poses, a standstill) is None, never a guess.

Sources: alignment after Umeyama (PAMI 1991); absolute and relative errors after Sturm et al.
(IROS 2012), so that they agree with the `evo` tools; the end pose after Se, Lowe and Little (2001).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.estimates import Trajectory
from fgslam.core.geometry import inverse, pose, yaw_pitch_roll

SAME_TIME_S = 0.01
"""Largest difference of time between poses that belong together; evo's default, too."""

# Three points are the fewest that fix a rigid motion in space.
_MIN_POSES_TO_ALIGN = 3


class Alignment(str, Enum):
    """How the estimate was brought into the frame of the truth."""

    FIRST_POSE = "first_pose"
    SE3 = "se3"


@dataclass(frozen=True, slots=True)
class TrajectoryError:
    """Errors of a trajectory against the truth; None where a value cannot be known.

    Attributes:
        alignment: alignment behind the ATE and the RPE.
        matched_poses: poses of the estimate that found a true one.
        ate_rmse_m: absolute trajectory error, root mean square of the positions' distances.
        ate_max_m: the largest of those distances.
        rpe_trans_m: relative pose error from pose to pose, root mean square of translation.
        rpe_rot_deg: the same of the rotation angle.
        path_length_m: length of the true path over the matched poses.
        drift_percent: ``end_error_m`` over ``path_length_m``, in percent.
        end_error_m: distance of the last pose from the true one, with the *first* pose aligned.
        end_error_deg: angle between the last orientation and the true one, first pose aligned.
    """

    alignment: Alignment
    matched_poses: int = 0
    ate_rmse_m: float | None = None
    ate_max_m: float | None = None
    rpe_trans_m: float | None = None
    rpe_rot_deg: float | None = None
    path_length_m: float | None = None
    drift_percent: float | None = None
    end_error_m: float | None = None
    end_error_deg: float | None = None


@dataclass(frozen=True, slots=True)
class EndPose:
    """The last pose as seen from the first one: how well a closed drive closes (Se et al. 5).

    Attributes:
        x_cm, y_cm, z_cm: right, down and ahead, in the first camera's frame, centimetres.
        distance_cm: length of that vector.
        yaw_deg, pitch_deg, roll_deg: clockwise from above, up, clockwise, degrees.
    """

    x_cm: float
    y_cm: float
    z_cm: float
    distance_cm: float
    yaw_deg: float
    pitch_deg: float
    roll_deg: float


# --------------------------------------------------------------------------------------------
# Association


def associate(
    estimate_times: FloatArray, truth_times: FloatArray, tolerance_s: float = SAME_TIME_S
) -> tuple[IntArray, IntArray]:
    """Rows of estimate and truth that belong together: mutual nearest neighbours in time.

    Args:
        estimate_times: (n,) seconds, increasing.
        truth_times: (m,) seconds, increasing.
        tolerance_s: largest difference of time that still counts as the same instant.

    Returns:
        Two index arrays (k,), increasing, no row used twice.
    """
    if len(estimate_times) == 0 or len(truth_times) == 0:
        return np.empty(0, np.int64), np.empty(0, np.int64)
    to_truth = _nearest(truth_times, estimate_times)
    to_estimate = _nearest(estimate_times, truth_times)
    rows = np.arange(len(estimate_times))
    mutual = to_estimate[to_truth] == rows
    near = np.abs(truth_times[to_truth] - estimate_times) <= tolerance_s
    keep = mutual & near
    return rows[keep], to_truth[keep]


def _nearest(sorted_values: FloatArray, queries: FloatArray) -> IntArray:
    """Index of the nearest of ``sorted_values`` to each query; the earlier one of a tie."""
    right = np.clip(np.searchsorted(sorted_values, queries), 1, max(len(sorted_values) - 1, 1))
    right = np.minimum(right, len(sorted_values) - 1)
    left = np.maximum(right - 1, 0)
    closer_left = queries - sorted_values[left] <= sorted_values[right] - queries
    return np.asarray(np.where(closer_left, left, right), dtype=np.int64)


# --------------------------------------------------------------------------------------------
# Alignment


def umeyama(source: FloatArray, target: FloatArray) -> FloatArray | None:
    """The least-squares rigid motion (4, 4) from source to target (Umeyama 1991, eqs. 40-42).

    Of points on one line the rotation about that line is free: some minimiser is returned, and
    the remaining distances are the same for all of them.

    Args:
        source: (n, 3) metres.
        target: (n, 3) metres.

    Returns:
        The motion, or None when fewer than three points are given or a value is not finite.
    """
    finite = bool(np.isfinite(source).all() and np.isfinite(target).all())
    if len(source) < _MIN_POSES_TO_ALIGN or not finite:
        return None
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    centred_source, centred_target = source - source_mean, target - target_mean
    u, _, vt = np.linalg.svd(centred_target.T @ centred_source / len(source))
    signs = np.array([1.0, 1.0, 1.0 if np.linalg.det(u @ vt) > 0.0 else -1.0])
    rotation = (u * signs) @ vt
    return pose(rotation, target_mean - rotation @ source_mean)


def align(
    estimate: FloatArray, truth: FloatArray, alignment: Alignment = Alignment.SE3
) -> FloatArray | None:
    """The motion (4, 4) that brings the estimate's world into the truth's.

    Args:
        estimate: (n, 4, 4) poses, row by row the same instants as ``truth``.
        truth: (n, 4, 4) poses.
        alignment: which kind.

    Returns:
        The motion, or None when it cannot be found (see :func:`umeyama`).
    """
    if alignment is Alignment.SE3:
        return umeyama(estimate[:, :3, 3], truth[:, :3, 3])
    return truth[0] @ inverse(estimate[0]) if len(estimate) else None


def moved(tTe: FloatArray, poses: FloatArray) -> FloatArray:
    """Poses (n, 4, 4) of one world in another, to which ``tTe`` (4, 4) leads."""
    out = np.array(poses, dtype=np.float64)
    out[:, :3, :3] = tTe[:3, :3] @ poses[:, :3, :3]
    out[:, :3, 3] = poses[:, :3, 3] @ tTe[:3, :3].T + tTe[:3, 3]
    return out


# --------------------------------------------------------------------------------------------
# Errors


def position_errors(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """Distances (n,) in metres between the positions of aligned poses (n, 4, 4)."""
    return np.asarray(np.linalg.norm(estimate[:, :3, 3] - truth[:, :3, 3], axis=1))


def rotation_angles(rotations: FloatArray) -> FloatArray:
    """Angles (n,) in radians, in [0, pi], of rotation matrices (n, 3, 3)."""
    antisymmetric = 0.5 * (rotations - np.swapaxes(rotations, -1, -2))
    sine = np.linalg.norm(antisymmetric[:, [2, 0, 1], [1, 2, 0]], axis=1)
    cosine = 0.5 * (np.trace(rotations, axis1=1, axis2=2) - 1.0)
    return np.asarray(np.arctan2(sine, cosine))


def relative_errors(estimate: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Errors of every motion from pose to pose (Sturm et al. 2012, eq. 1).

    Args:
        estimate: (n, 4, 4) poses.
        truth: (n, 4, 4) poses of the same instants.

    Returns:
        Translations (n - 1,) in metres and rotation angles (n - 1,) in radians.
    """
    estimated_motion = inverse(estimate[:-1]) @ estimate[1:]
    true_motion = inverse(truth[:-1]) @ truth[1:]
    error = inverse(true_motion) @ estimated_motion
    return np.linalg.norm(error[:, :3, 3], axis=1), rotation_angles(error[:, :3, :3])


def path_length(poses: FloatArray) -> float:
    """Length in metres of the polygon through the positions of poses (n, 4, 4)."""
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())


def evaluate_trajectory(
    estimate: Trajectory, truth: Trajectory | None, alignment: Alignment = Alignment.SE3
) -> TrajectoryError:
    """All errors of a trajectory, in one value.

    Args:
        estimate: the poses to judge.
        truth: the true poses, in any world frame; None where there are none.
        alignment: how ATE and RPE are aligned. The end pose is always judged with the first
            matched pose aligned, since a drift is measured from the start.

    Returns:
        The errors; a value that cannot be known is None.
    """
    if truth is None:
        return TrajectoryError(alignment)
    rows, true_rows = associate(estimate.timestamps, truth.timestamps)
    estimated, true = estimate.poses[rows], truth.poses[true_rows]
    if len(rows) == 0 or not (np.isfinite(estimated).all() and np.isfinite(true).all()):
        return TrajectoryError(alignment, len(rows))
    tTe = align(estimated, true, alignment)
    ate = None if tTe is None else position_errors(moved(tTe, estimated), true)
    rpe_trans, rpe_rot = _rpe_rmse(estimated, true, tTe)
    length, drift, end_m, end_deg = _end_errors(estimated, true)
    return TrajectoryError(
        alignment=alignment,
        matched_poses=len(rows),
        ate_rmse_m=None if ate is None else _rmse(ate),
        ate_max_m=None if ate is None else float(ate.max()),
        rpe_trans_m=rpe_trans,
        rpe_rot_deg=rpe_rot,
        path_length_m=length,
        drift_percent=drift,
        end_error_m=end_m,
        end_error_deg=end_deg,
    )


def end_pose(trajectory: Trajectory) -> EndPose | None:
    """Last pose against the first one, in the paper's units; None for an empty trajectory."""
    if len(trajectory) == 0:
        return None
    sTe = inverse(trajectory.poses[0]) @ trajectory.poses[-1]
    x, y, z = (100.0 * sTe[:3, 3]).tolist()
    yaw, pitch, roll = np.degrees(yaw_pitch_roll(sTe)).tolist()
    distance = float(100.0 * np.linalg.norm(sTe[:3, 3]))
    return EndPose(x, y, z, distance, yaw, pitch, roll)


def to_estimate_world(
    estimate: Trajectory, truth: Trajectory
) -> tuple[IntArray, FloatArray] | None:
    """True poses in the estimate's world, with the first matched pose aligned.

    Returns:
        Rows (k,) of the estimate that have a truth, and their true poses (k, 4, 4) ``wTc``; None
        when no pose matches.
    """
    rows, true_rows = associate(estimate.timestamps, truth.timestamps)
    eTt = estimate_from_truth(estimate, truth)
    return None if eTt is None else (rows, eTt @ truth.poses[true_rows])


def estimate_from_truth(estimate: Trajectory, truth: Trajectory) -> FloatArray | None:
    """(4, 4) from the truth's world to the estimate's, with the first matched pose aligned.

    None when no pose matches.
    """
    rows, true_rows = associate(estimate.timestamps, truth.timestamps)
    return align(truth.poses[true_rows], estimate.poses[rows], Alignment.FIRST_POSE)


def _rmse(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _rpe_rmse(
    estimate: FloatArray, truth: FloatArray, tTe: FloatArray | None
) -> tuple[float | None, float | None]:
    if tTe is None or len(estimate) <= 1:
        return None, None
    translation, rotation = relative_errors(moved(tTe, estimate), truth)
    return _rmse(translation), float(np.degrees(_rmse(rotation)))


def _end_errors(
    estimate: FloatArray, truth: FloatArray
) -> tuple[float, float | None, float, float]:
    """Path length, drift in percent, end error in metres and degrees; first pose aligned."""
    error = inverse(inverse(truth[0]) @ truth[-1]) @ inverse(estimate[0]) @ estimate[-1]
    end_m = float(np.linalg.norm(error[:3, 3]))
    end_deg = float(np.degrees(rotation_angles(error[None, :3, :3])[0]))
    length = path_length(truth)
    drift = 100.0 * end_m / length if length > 0.0 else None
    return length, drift, end_m, end_deg
