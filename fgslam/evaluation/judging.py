"""Accuracy, consistency and time of one estimator's result, and errors of its landmarks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.estimates import EgoMotionStatus, Estimate, LandmarkMap, Trajectory
from fgslam.core.geometry import transform_to_world
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.recordings import LandmarkTruth
from fgslam.evaluation.consistency import (
    Consistency,
    Nees,
    judge,
    landmark_nees,
    pose_errors,
    within,
)
from fgslam.evaluation.consistency import nees as normalised
from fgslam.evaluation.metrics import EstimatorMetrics, JsonValue, UpdateTime, time_growth
from fgslam.evaluation.trajectory import (
    Alignment,
    TrajectoryError,
    end_pose,
    estimate_from_truth,
    evaluate_trajectory,
    to_estimate_world,
)

LEAST_SIGHTINGS = 3
"""Landmarks are compared with the truth that were seen so often: `valid` of Se et al. (6.1)."""


_DEAD_RECKONING = "odometry"  # the kind of estimator that moves on odometry alone


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What is known to be true of a run; None where nothing is.

    Attributes:
        trajectory: true poses of the reference camera or sensor.
        landmarks: true positions, in the same world.
        landmark_sigma_m: typical standard error of those positions; 0 where they are exact.
    """

    trajectory: Trajectory | None = None
    landmarks: LandmarkTruth | None = None
    landmark_sigma_m: float | None = None


class Replayed(Protocol):
    """What is evaluated of a replayed measurement log, as ``fgslam.slam.replay.Replay`` has it."""

    @property
    def kind(self) -> str:
        """Which estimator it is."""
        ...

    @property
    def estimate(self) -> Estimate:
        """Trajectory, covariances and map as known at the end."""
        ...

    @property
    def online(self) -> Trajectory:
        """Each pose as first estimated."""
        ...

    @property
    def online_covariances(self) -> FloatArray:
        """(n, 6, 6) of those."""
        ...

    @property
    def closed(self) -> tuple[bool, ...]:
        """Of the loop closures offered, in order, whether each was taken."""
        ...

    @property
    def failure(self) -> str:
        """Why it ended early; else empty."""
        ...

    @property
    def final_ms(self) -> float:
        """Milliseconds for the final estimate."""
        ...

    @property
    def memory_before_mb(self) -> float | None:
        """Resident memory before the estimator was made, mebibytes."""
        ...

    @property
    def peak_memory_mb(self) -> float | None:
        """Its largest, mebibytes."""
        ...

    def column(self, name: str) -> npt.NDArray[Any]:
        """(n,) one number of every frame: `nis`, `nis_dof`, `update_ms`, `solve_ms`."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """Result of an estimator, live or replayed; row k of every array is frame k.

    Attributes:
        estimate: as known at the end.
        online: each pose as first estimated; ``online_covariances`` (n, 6, 6).
        nis, nis_dof: (n,) innovations squared and their degrees of freedom.
        update_ms: (n,) prediction and update.
        peak_memory_mb: of the process.
        predicted: (n,) whether no landmark measured the pose: bridged by odometry, or by the
            velocity. Empty: none.
    """

    estimate: Estimate
    online: Trajectory
    online_covariances: FloatArray
    nis: FloatArray
    nis_dof: IntArray
    update_ms: FloatArray
    peak_memory_mb: float | None = None
    predicted: BoolArray = field(default_factory=lambda: np.zeros(0, np.bool_))

    @staticmethod
    def of(replay: Replayed) -> Answer:
        """The answer of a replay."""
        statuses = replay.column("status").tolist()
        return Answer(
            estimate=replay.estimate,
            online=replay.online,
            online_covariances=replay.online_covariances,
            nis=replay.column("nis").astype(np.float64),
            nis_dof=replay.column("nis_dof").astype(np.int64),
            update_ms=replay.column("update_ms").astype(np.float64),
            peak_memory_mb=replay.peak_memory_mb,
            predicted=predicted_poses(statuses, replay.kind),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """The metrics, and the normalised errors that several runs are pooled from."""

    metrics: EstimatorMetrics
    nees: dict[str, Nees] = field(default_factory=dict)


def judge_answer(answer: Answer, truth: Truth) -> Judgement:
    """All numbers of one answer.

    ``ate_rmse_m`` and the RPE are after SE3 alignment; drift, end errors, NEES and landmark errors
    have the first pose aligned.
    """
    final = answer.estimate.trajectory
    aligned = evaluate_trajectory(final, truth.trajectory, Alignment.SE3)
    first = evaluate_trajectory(final, truth.trajectory, Alignment.FIRST_POSE)
    errors = _landmark_errors(answer.estimate, truth)
    final_errors = _pose_errors(final, answer.estimate.covariances, truth)
    online_errors = _pose_errors(answer.online, answer.online_covariances, truth)
    nees = {
        "pose": normalised(*final_errors),
        "online_pose": normalised(*online_errors),
        "landmark": _no_nees() if errors is None else errors.nees,
    }
    judged = {name: judge([values]) for name, values in nees.items()}
    metrics = EstimatorMetrics(
        ate_rmse_m=aligned.ate_rmse_m,
        rpe_trans_m=aligned.rpe_trans_m,
        rpe_rot_deg=aligned.rpe_rot_deg,
        drift_percent=first.drift_percent,
        end_error_m=first.end_error_m,
        end_error_deg=first.end_error_deg,
        landmarks=len(answer.estimate.landmarks),
        nees_pose_per_dof=_per_dof(judged["pose"]),
        nees_landmark_per_dof=_per_dof(judged["landmark"]),
        update_ms=UpdateTime.of(answer.update_ms),
        peak_memory_mb=answer.peak_memory_mb,
        more={
            "frames": max(len(answer.online), len(final)),
            "predicted_frames": int(answer.predicted.sum()),
            "predicted_rows": np.flatnonzero(answer.predicted).tolist(),
            **_alignment_notes(aligned, first),
            "nees_pose": _as_json(judged["pose"]),
            "nees_landmark": _as_json(judged["landmark"]),
            "coverage": _coverage(*final_errors),
            "online": _online(answer.online, truth, judged["online_pose"])
            | {"coverage": _coverage(*online_errors)},
            **_landmark_numbers(errors, truth),
            **_innovations(answer),
            "update_growth": _growth(answer.update_ms),
            "last_pose_sigma": _last_pose_sigma(answer.estimate),
            "end_against_start": _end_against_start(final),
            "noise_factor": answer.estimate.noise_factor,
            **_gyroscope(answer.estimate),
            "remarks": list(answer.estimate.remarks),
        },
    )
    return Judgement(metrics, nees)


def judge_replay(replay: Replayed, truth: Truth) -> Judgement:
    """As :func:`judge_answer`, with what only a replay knows."""
    judged = judge_answer(Answer.of(replay), truth)
    metrics = judged.metrics
    more = (
        {"kind": replay.kind}
        | dict(metrics.more)
        | {
            "failure": replay.failure or None,
            "solve_ms": asdict(UpdateTime.of(replay.column("solve_ms").astype(np.float64))),
            "final_ms": replay.final_ms,
            "memory_before_mb": replay.memory_before_mb,
            **closure_counts(replay.closed),
        }
    )
    return Judgement(replace(metrics, more=more), judged.nees)


def predicted_poses(statuses: Iterable[str], kind: str = "") -> BoolArray:
    """(n,) whether a status says that no landmark measured the pose; the first frame is given.

    Of dead reckoning, an estimator's ``kind``, no pose is marked, since none is measured.
    """
    found = map(EgoMotionStatus, [] if kind == _DEAD_RECKONING else statuses)
    return np.array(
        [not one.measured and one is not EgoMotionStatus.FIRST for one in found], np.bool_
    )


def closure_counts(closed: Sequence[bool]) -> dict[str, JsonValue]:
    """How many loops an estimator closed, and closures it refused; nothing where none came."""
    if not closed:
        return {}
    taken = sum(closed)
    return {"closures": taken, "refused_closures": len(closed) - taken}


def seen_often(log: MeasurementLog, truth: LandmarkTruth) -> LandmarkTruth:
    """True positions of the landmarks that the log saw in at least three frames.

    The same ones for every estimator: a smoother lets a landmark wait that was seen once.
    """
    seen = [increment.observations.ids[~increment.rejected] for increment in log]
    ids, counts = np.unique(np.concatenate([np.empty(0, np.int64), *seen]), return_counts=True)
    keep = np.isin(truth.ids, ids[counts >= LEAST_SIGHTINGS])
    return LandmarkTruth(truth.ids[keep], truth.positions[keep])


# --------------------------------------------------------------------------------------------


def _no_nees() -> Nees:
    return Nees(np.empty(0), np.empty(0, np.int64))


def _per_dof(found: Consistency | None) -> float | None:
    return None if found is None else found.per_dof


def _as_json(found: Consistency | None) -> JsonValue:
    return None if found is None else asdict(found)


def _pose_errors(
    trajectory: Trajectory, covariances: FloatArray, truth: Truth
) -> tuple[FloatArray, FloatArray]:
    """Errors (k, 6) and covariances (k, 6, 6) of all poses with a truth, but the first of them.

    It is aligned, and the gauge has neither error nor covariance.
    """
    known = truth.trajectory
    found = None if known is None else to_estimate_world(trajectory, known)
    if found is None:
        return np.empty((0, 6)), np.empty((0, 6, 6))
    rows, poses = found[0][1:], found[1][1:]
    return pose_errors(trajectory.poses[rows], poses), covariances[rows]


def _coverage(errors: FloatArray, covariances: FloatArray) -> JsonValue:
    """Shares of pose errors within two reported sigmas, by axis of the camera and of all axes."""
    axes = within(errors, covariances)
    if not np.isfinite(axes).any():
        return None
    shares = [None if np.isnan(share) else float(share) for share in axes]
    return {"rotation": shares[:3], "position": shares[3:], "all": float(np.nanmean(axes))}


def _landmark_errors(estimate: Estimate, truth: Truth) -> LandmarkErrors | None:
    if truth.landmarks is None or truth.trajectory is None:
        return None
    eTt = estimate_from_truth(estimate.trajectory, truth.trajectory)
    return None if eTt is None else landmark_errors(estimate.landmarks, truth.landmarks, eTt)


def _alignment_notes(aligned: TrajectoryError, first: TrajectoryError) -> dict[str, JsonValue]:
    return {
        "alignment": aligned.alignment.value,
        "matched_poses": aligned.matched_poses,
        "ate_max_m": aligned.ate_max_m,
        "ate_first_pose_m": first.ate_rmse_m,
        "path_length_m": aligned.path_length_m,
    }


def _online(online: Trajectory, truth: Truth, nees: Consistency | None) -> dict[str, JsonValue]:
    """The same errors of the poses as they were first estimated."""
    aligned = evaluate_trajectory(online, truth.trajectory, Alignment.SE3)
    first = evaluate_trajectory(online, truth.trajectory, Alignment.FIRST_POSE)
    return {
        "ate_rmse_m": aligned.ate_rmse_m,
        "ate_first_pose_m": first.ate_rmse_m,
        "rpe_trans_m": aligned.rpe_trans_m,
        "rpe_rot_deg": aligned.rpe_rot_deg,
        "end_error_m": first.end_error_m,
        "end_error_deg": first.end_error_deg,
        "nees_pose_per_dof": _per_dof(nees),
        "nees_pose": _as_json(nees),
    }


def _landmark_numbers(errors: LandmarkErrors | None, truth: Truth) -> dict[str, JsonValue]:
    return {
        "landmark_rmse_m": None if errors is None else errors.rmse_m,
        "landmark_median_m": None if errors is None else errors.median_m,
        "landmarks_with_truth": None if errors is None else len(errors),
        "landmark_truth_sigma_m": truth.landmark_sigma_m,
    }


def _innovations(answer: Answer) -> dict[str, JsonValue]:
    """NIS of the matched observations, each frame an independent item."""
    known = np.isfinite(answer.nis) & (answer.nis_dof > 0)
    found = judge([Nees(answer.nis[known], answer.nis_dof[known])], items_independent=True)
    return {"nis_per_dof": _per_dof(found), "nis": _as_json(found)}


def _growth(update_ms: FloatArray) -> JsonValue:
    found = time_growth(update_ms)
    return None if found is None else asdict(found)


def _last_pose_sigma(estimate: Estimate) -> JsonValue:
    """Standard deviations of the last pose as claimed: roots of the traces of its two blocks."""
    if not len(estimate.covariances) or not np.isfinite(estimate.covariances[-1]).all():
        return None
    variances = np.maximum(np.diagonal(estimate.covariances[-1]), 0.0)
    return {
        "rotation_deg": float(np.degrees(np.sqrt(variances[:3].sum()))),
        "position_m": float(np.sqrt(variances[3:].sum())),
    }


def _gyroscope(estimate: Estimate) -> dict[str, JsonValue]:
    """Bias of the gyroscope at the end, about the axes of the body; nothing where there is none."""
    found = estimate.gyroscope
    if found is None:
        return {}
    sigmas = np.sqrt(np.diagonal(found.covariance))
    return {
        "gyroscope_bias_dps": {
            "rates": np.degrees(found.rates).tolist(),
            "sigmas": np.degrees(sigmas).tolist(),
        }
    }


def _end_against_start(trajectory: Trajectory) -> JsonValue:
    """Last pose in the frame of the first: Se et al. (5) measure by it how well a loop closes."""
    found = end_pose(trajectory)
    return None if found is None else asdict(found)


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkErrors:
    """Distances of landmarks from where they truly are.

    Attributes:
        ids: (n,) landmarks of the map whose truth is known, ascending.
        distances_m: (n,) metres.
        nees: of each, three degrees of freedom where its covariance is known.
    """

    ids: IntArray
    distances_m: FloatArray
    nees: Nees

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def rmse_m(self) -> float | None:
        """Root mean square distance; None without a landmark."""
        return float(np.sqrt(np.mean(self.distances_m**2))) if len(self) else None

    @property
    def median_m(self) -> float | None:
        """Median distance, which a few wrong identities do not spoil; None without a landmark."""
        return float(np.median(self.distances_m)) if len(self) else None


def landmark_errors(
    landmarks: LandmarkMap, truth: LandmarkTruth, eTt: FloatArray
) -> LandmarkErrors:
    """Compares the landmarks that both know.

    Args:
        landmarks: of the estimate, in its world.
        truth: true positions in the world of the ground-truth trajectory.
        eTt: (4, 4) from the truth's world to the estimate's: with the first pose aligned, as for
            the poses' NEES (:func:`fgslam.evaluation.trajectory.estimate_from_truth`). That adds
            no uncertainty where the first pose is the gauge of the estimate's world.
    """
    ids, rows, of = np.intersect1d(landmarks.ids, truth.ids, return_indices=True)
    true = transform_to_world(eTt, truth.positions[of])
    positions = landmarks.positions[rows]
    return LandmarkErrors(
        ids=ids,
        distances_m=np.linalg.norm(positions - true, axis=1),
        nees=landmark_nees(positions, landmarks.covariances[rows], true),
    )
