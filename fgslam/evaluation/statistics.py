"""Numbers of an estimate against the truth: trajectory errors, NEES with its bands, times."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import Enum
from typing import Any, Literal, TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray, chi_square_quantile, nearest_rows
from fgslam.core.geometry import adjoint, inverse, pose, se3_exp, se3_log, yaw_pitch_roll
from fgslam.core.types import Trajectory

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
        end_error_m: distance of the last pose from the true one, with the *first* pose aligned;
            None where the last pose has no truth.
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
    to_truth = nearest_rows(truth_times, estimate_times)
    to_estimate = nearest_rows(estimate_times, truth_times)
    rows = np.arange(len(estimate_times))
    mutual = to_estimate[to_truth] == rows
    near = np.abs(truth_times[to_truth] - estimate_times) <= tolerance_s
    keep = mutual & near
    return rows[keep], to_truth[keep]


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
    aligned = None if tTe is None else moved(tTe, estimated)
    ate = None if aligned is None else position_errors(aligned, true)
    steps = None if aligned is None or len(rows) < 2 else relative_errors(aligned, true)
    # A drift is measured from the start to the end: with the first pose aligned.
    end_m = end_deg = None
    if rows[-1] == len(estimate) - 1:
        end = inverse(inverse(true[0]) @ true[-1]) @ inverse(estimated[0]) @ estimated[-1]
        end_m = float(np.linalg.norm(end[:3, 3]))
        end_deg = float(np.degrees(rotation_angles(end[None, :3, :3])[0]))
    length = path_length(true)
    return TrajectoryError(
        alignment=alignment,
        matched_poses=len(rows),
        ate_rmse_m=None if ate is None else _rmse(ate),
        ate_max_m=None if ate is None else float(ate.max()),
        rpe_trans_m=None if steps is None else _rmse(steps[0]),
        rpe_rot_deg=None if steps is None else float(np.degrees(_rmse(steps[1]))),
        path_length_m=length,
        drift_percent=100.0 * end_m / length if end_m is not None and length > 0.0 else None,
        end_error_m=end_m,
        end_error_deg=end_deg,
    )


def end_pose(trajectory: Trajectory) -> dict[str, float] | None:
    """The last pose as seen from the first one: how well a closed drive closes (Se et al. 5).

    Returns:
        ``x_cm``, ``y_cm``, ``z_cm``, right, down and ahead in the first camera's frame, and
        ``distance_cm``, their length; ``yaw_deg``, ``pitch_deg``, ``roll_deg``, clockwise from
        above, up, clockwise. None for an empty trajectory.
    """
    if len(trajectory) == 0:
        return None
    sTe = inverse(trajectory.poses[0]) @ trajectory.poses[-1]
    lengths = [*(100.0 * sTe[:3, 3]).tolist(), float(100.0 * np.linalg.norm(sTe[:3, 3]))]
    names = ("x_cm", "y_cm", "z_cm", "distance_cm", "yaw_deg", "pitch_deg", "roll_deg")
    return dict(zip(names, (*lengths, *np.degrees(yaw_pitch_roll(sTe)).tolist()), strict=True))


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


ConsistencyVerdict: TypeAlias = Literal["consistent", "overconfident", "conservative"]

# Directions whose variance is this much below the largest one (of radians and metres, which are
# of like size here) are constraints, not knowledge: a ratio of 1e5 in standard deviation.
_RELATIVE_RANK_TOLERANCE = 1e-10
_LEAST_SHARE = 1e-3  # of an axis that lies in that subspace: two degrees out of what is excluded


@dataclass(frozen=True, slots=True, eq=False)
class Nees:
    """Normalised errors squared of many items.

    Attributes:
        values: (n,) NEES, not divided by the degrees of freedom.
        dof: (n,) rank of each covariance; 0 where nothing was uncertain.
    """

    values: FloatArray
    dof: IntArray

    def __len__(self) -> int:
        return len(self.values)

    @property
    def per_dof(self) -> float | None:
        """Mean NEES per degree of freedom; None where there is none."""
        total = int(self.dof.sum())
        return float(self.values.sum() / total) if total else None


@dataclass(frozen=True, slots=True)
class Consistency:
    """NEES per degree of freedom and the band in which a consistent one would lie.

    Attributes:
        per_dof: mean NEES per degree of freedom.
        lower, upper: the chi-square band, per degree of freedom.
        probability: of the band.
        items: how many errors were averaged.
        independent: how many of them the band took as independent.
        verdict: `consistent`, `overconfident` or `conservative`.
    """

    per_dof: float
    lower: float
    upper: float
    probability: float
    items: int
    independent: int
    verdict: ConsistencyVerdict


def nees(errors: FloatArray, covariances: FloatArray) -> Nees:
    """NEES of errors (n, d) with covariances (n, d, d), by pseudo-inverse on their support.

    Items with a value that is not finite are left out (0 degrees of freedom).
    """
    known = np.isfinite(errors).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    finite = np.asarray(known)
    symmetric = 0.5 * (covariances + np.swapaxes(covariances, 1, 2))
    variances, directions = np.linalg.eigh(np.where(finite[:, None, None], symmetric, 0.0))
    largest = variances[:, -1:]
    supported = (variances > _RELATIVE_RANK_TOLERANCE * largest) & (largest > 0.0)
    components = np.einsum("nji,nj->ni", directions, np.where(finite[:, None], errors, 0.0))
    terms = np.divide(components**2, variances, out=np.zeros_like(variances), where=supported)
    return Nees(terms.sum(axis=1), supported.sum(axis=1))


def within(errors: FloatArray, covariances: FloatArray, sigmas: float = 2.0) -> FloatArray:
    """Shares (d,) of errors (n, d) within so many reported standard deviations, axis by axis.

    Of two, 95 % lie within where the errors are normal and the covariances right. Items with a
    value that is not finite are left out; NaN along an axis that was never uncertain, or leans
    towards an uncertain one by rounding alone, as on a floor that holds stiffly.
    """
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    largest = variances.max(axis=1, initial=0.0, keepdims=True)
    known = np.isfinite(errors).all(axis=1) & np.isfinite(covariances).all(axis=(1, 2))
    counted = np.asarray(known)[:, None] & (variances > _RELATIVE_RANK_TOLERANCE * largest)
    # Axes that lie in the uncertain subspace, and not just next to it.
    given = np.where(counted.any(axis=1)[:, None, None], covariances, 0.0)
    spread, directions = np.linalg.eigh(0.5 * (given + np.swapaxes(given, 1, 2)))
    supported = spread > _RELATIVE_RANK_TOLERANCE * spread[:, -1:]
    counted &= np.einsum("nij,nj->ni", directions**2, supported) > _LEAST_SHARE
    held = counted & (errors**2 <= sigmas**2 * np.where(counted, variances, 0.0))
    number = counted.sum(axis=0)
    shares = np.full(len(number), np.nan)
    return np.asarray(np.divide(held.sum(axis=0), number, out=shares, where=number > 0))


def pose_errors(estimate: FloatArray, truth: FloatArray) -> FloatArray:
    """Tangent vectors (n, 6) ``Log(estimate^-1 truth)``, [rotation, translation], radians, metres.

    Args:
        estimate: (n, 4, 4) poses ``wTc``.
        truth: (n, 4, 4) true poses in the *same* world (align the first pose before).
    """
    relative = inverse(estimate) @ truth
    return np.array([se3_log(motion) for motion in relative]).reshape(-1, 6)


_ROUNDS = 20  # of Gauss-Newton for the best alignment
_SETTLED = 1e-9  # radians and metres


def best_aligned(estimate: FloatArray, covariances: FloatArray, truth: FloatArray) -> FloatArray:
    """True poses (n, 4, 4) where their NEES against the estimates is least: weighted least squares.

    Args:
        estimate: (n, 4, 4) poses ``wTc``.
        covariances: (n, 6, 6) in the tangent space at them; exact and unknown ones pull nothing.
        truth: (n, 4, 4) true poses of the same instants, nearly in the estimates' world.
    """
    known = np.asarray(np.isfinite(covariances).all(axis=(1, 2)))
    found = np.where(known[:, None, None], covariances, 0.0)
    weights = np.linalg.pinv(found, rcond=_RELATIVE_RANK_TOLERANCE, hermitian=True)
    by_world = adjoint(inverse(estimate))  # of a motion of the truth's world, at each pose
    pull = np.swapaxes(by_world, 1, 2) @ weights
    information = (pull @ by_world).sum(axis=0)
    inverse_information = np.linalg.pinv(
        information, rcond=_RELATIVE_RANK_TOLERANCE, hermitian=True
    )
    for _ in range(_ROUNDS):
        errors = pose_errors(estimate, truth)
        step = -inverse_information @ np.einsum("nij,nj->i", pull, errors)
        truth = se3_exp(step) @ truth
        if np.abs(step).max() < _SETTLED:
            break
    return truth


def pose_nees(estimate: FloatArray, covariances: FloatArray, truth: FloatArray) -> Nees:
    """NEES of poses.

    Args:
        estimate: (n, 4, 4) poses ``wTc``.
        covariances: (n, 6, 6) in the tangent space at the estimate, [rotation, translation].
        truth: (n, 4, 4) true poses in the same world.
    """
    return nees(pose_errors(estimate, truth), covariances)


def chi_square_band(dof: float, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided band of a chi-square variable per degree of freedom: its quantiles over ``dof``."""
    tail = 0.5 * (1.0 - probability)
    lower, upper = chi_square_quantile([tail, 1.0 - tail], dof) / dof
    return float(lower), float(upper)


def judge(
    runs: Sequence[Nees], probability: float = 0.95, *, independent: float | None = None
) -> Consistency | None:
    """NEES of one or more runs and its chi-square band, and whether it lies inside.

    The errors within one run are correlated (each pose starts from the one before, all landmarks
    are seen from the same poses), so their mean scatters far more than that many independent
    ones would. By default each *run* counts as a single independent item of average dimension,
    which calls no consistent estimator inconsistent more often than the band states; many runs make
    the band narrow.

    Args:
        runs: NEES of independent runs (different seeds).
        probability: of the band.
        independent: how many items count as independent; infinite: every one, for errors that are
            (innovations, one frame of many runs).

    Returns:
        The comparison, or None when no run has a degree of freedom.
    """
    values = np.concatenate([run.values for run in runs]) if runs else np.empty(0)
    dof = np.concatenate([run.dof for run in runs]) if runs else np.empty(0, np.int64)
    items = int((dof > 0).sum())
    if items == 0:
        return None
    informative_runs = sum(bool(run.dof.any()) for run in runs)
    independent = min(items, informative_runs if independent is None else independent)
    return consistency(float(values.sum()), float(dof.sum()), items, independent, probability)


def consistency(
    squared: float, total: float, items: int, independent: float, probability: float = 0.95
) -> Consistency:
    """Sums of normalised errors squared and of their degrees of freedom, held against the band.

    Args:
        squared: sum of the squares.
        total: of the degrees of freedom, at least 1.
        items: how many errors were added.
        independent: how many of them count as independent, each of average dimension.
        probability: of the band.
    """
    lower, upper = chi_square_band(total * independent / items, probability)
    per_dof = squared / total
    verdict: ConsistencyVerdict = "overconfident" if per_dof > upper else "consistent"
    if per_dof < lower:
        verdict = "conservative"
    return Consistency(per_dof, lower, upper, probability, items, round(independent), verdict)


JsonValue: TypeAlias = (
    bool | int | float | str | Sequence["JsonValue"] | Mapping[str, "JsonValue"] | None
)


def spread(values: FloatArray) -> dict[str, float | None]:
    """``median``, 95th percentile ``p95`` and ``max`` of what is known; None where nothing is."""
    known = values[np.isfinite(values)]
    quantiles = {"median": 50.0, "p95": 95.0, "max": 100.0}
    return {
        name: float(np.percentile(known, q)) if len(known) else None
        for name, q in quantiles.items()
    }


@dataclass(frozen=True, slots=True)
class EstimatorMetrics:
    """What is known about one estimator's result; None where it cannot be known.

    Attributes:
        ate_rmse_m: absolute trajectory error (by `alignment` in ``more``).
        rpe_trans_m, rpe_rot_deg: relative pose error a frame.
        drift_percent: error at the end over the length of the path, first pose aligned.
        end_error_m, end_error_deg: error of the last pose against truth, first pose aligned.
        landmarks: number of landmarks in the final map.
        nees_pose_per_dof, nees_landmark_per_dof: 1 is consistent, more is overconfident.
        update_ms: milliseconds for a frame, their :func:`spread`.
        peak_memory_mb: largest resident memory of the process, mebibytes.
        more: further values, under names of their own.
    """

    ate_rmse_m: float | None = None
    rpe_trans_m: float | None = None
    rpe_rot_deg: float | None = None
    drift_percent: float | None = None
    end_error_m: float | None = None
    end_error_deg: float | None = None
    landmarks: int | None = None
    nees_pose_per_dof: float | None = None
    nees_landmark_per_dof: float | None = None
    update_ms: Mapping[str, float | None] = field(default_factory=lambda: spread(np.empty(0)))
    peak_memory_mb: float | None = None
    more: Mapping[str, JsonValue] = field(default_factory=dict)

    def as_json(self) -> dict[str, JsonValue]:
        """Every name of the contract, then the further ones."""
        out: dict[str, JsonValue] = asdict(self)
        del out["more"]
        if clash := sorted(out.keys() & self.more.keys()):
            raise ValueError(f"metric '{clash[0]}' is a name of the contract, not a further one")
        return out | dict(self.more)


def value_at(values: Mapping[str, Any], where: str) -> Any:
    """The value under a dotted path; None where there is none or it is not finite."""
    at: Any = values
    for key in where.split("."):
        at = at.get(key) if isinstance(at, Mapping) else None
    return None if isinstance(at, float) and not math.isfinite(at) else at


_LEAST_FRAMES = 25  # five a fifth: the median of fewer is noise


def time_growth(milliseconds: FloatArray) -> dict[str, float] | None:
    """Growth of times (n,) of consecutive frames; None for fewer than 25 of them.

    Returns:
        ``ratio``: median of the last fifth of the frames over that of the second fifth (the first
        holds what is slow only once); 1 is flat, 4 is proportional to the frames so far.
        ``slope_ms_per_1000``: least-squares slope, milliseconds a thousand frames.
    """
    n = len(milliseconds)
    if n < _LEAST_FRAMES:
        return None
    fifth = n // 5
    early, late = np.median(milliseconds[fifth : 2 * fifth]), np.median(milliseconds[-fifth:])
    if not early > 0.0:
        return None
    slope = np.polyfit(np.arange(n, dtype=np.float64), milliseconds, 1)[0]
    return {"ratio": float(late / early), "slope_ms_per_1000": float(1000.0 * slope)}
