"""Answers against the truth, loop closures taken and refused, paired comparisons of estimators."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray, student_quantile
from fgslam.core.checks import require_flag
from fgslam.core.errors import ConfigError
from fgslam.core.geometry import inverse, transform_to_world
from fgslam.core.log import LandmarkTruth, MeasurementLog
from fgslam.core.sensors import CameraRig, LoopClosure, PoseFrame
from fgslam.core.types import EgoMotionStatus, Estimate, LandmarkMap, Outcome, Trajectory
from fgslam.evaluation.statistics import (
    Alignment,
    Consistency,
    EstimatorMetrics,
    JsonValue,
    Nees,
    TrajectoryError,
    associate,
    best_aligned,
    end_pose,
    estimate_from_truth,
    evaluate_trajectory,
    judge,
    nees as normalised,
    pose_errors,
    position_errors,
    rotation_angles,
    spread,
    time_growth,
    to_estimate_world,
    value_at,
    within,
)
from fgslam.evaluation.truth import sound_truth

if TYPE_CHECKING:
    import pandas

LEAST_SIGHTINGS = 3
"""Landmarks are compared with the truth that were seen so often: `valid` of Se et al. (6.1)."""


_DEAD_RECKONING = "odometry"  # the kind of estimator that moves on odometry alone


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What is known to be true of a run; None where nothing is.

    Attributes:
        trajectory: true poses of the reference camera or sensor, or of another frame of the rig.
        landmarks: true positions, in the same world.
        landmark_sigma_m: typical standard error of those positions; 0 where they are exact.
        rig: where that other frame sits; None where the truth is the reference camera's.
    """

    trajectory: Trajectory | None = None
    landmarks: LandmarkTruth | None = None
    landmark_sigma_m: float | None = None
    rig: CameraRig | None = None

    def of_same_frame(self, path: Trajectory) -> Trajectory:
        """Poses of the reference camera as those of the frame whose truth is known."""
        known = self.trajectory
        if known is None or self.rig is None or known.frame == path.frame:
            return path
        return path.of(known.frame, self.rig)

    def of_camera(self) -> Truth:
        """The same with true poses of the reference camera."""
        if self.trajectory is None or self.rig is None:
            return self
        return replace(self, trajectory=self.trajectory.of("right", self.rig))


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
    def of(replay: Outcome) -> Answer:
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


_OF_CONTRACT = (
    *("ate_rmse_m", "rpe_trans_m", "rpe_rot_deg", "end_error_m", "end_error_deg"),
    "nees_pose_per_dof",
)


def judge_answer(answer: Answer, truth: Truth) -> Judgement:
    """All numbers of one answer.

    ``ate_rmse_m`` and the RPE are after SE3 alignment; drift, end errors, NEES and landmark errors
    have the first pose aligned. Errors of the path are those of the frame whose truth is known, as
    its data set judges; NEES, which is the same for every frame, and landmarks the camera's.
    """
    estimate = answer.estimate
    sound = sound_truth(truth.of_same_frame(estimate.trajectory), truth.trajectory)
    of_camera = replace(truth, trajectory=sound.trajectory).of_camera()

    def path_numbers(
        poses: Trajectory, covariances: FloatArray, relative: Mapping[int, FloatArray]
    ) -> tuple[dict[str, Any], TrajectoryError, TrajectoryError, Nees]:
        """Of one path: its numbers, its errors by both alignments, and its NEES."""
        path = truth.of_same_frame(poses)
        aligned = evaluate_trajectory(path, truth.trajectory, Alignment.SE3)
        first = evaluate_trajectory(path, sound.trajectory, Alignment.FIRST_POSE)
        errors = _pose_errors(poses, covariances, of_camera)
        best = judge([normalised(*_pose_errors(poses, covariances, of_camera, best=True))])
        nees = normalised(*errors)
        judged = judge([nees])
        numbers = {
            "ate_rmse_m": aligned.ate_rmse_m,
            "ate_first_pose_m": first.ate_rmse_m,
            "rpe_trans_m": aligned.rpe_trans_m,
            "rpe_rot_deg": aligned.rpe_rot_deg,
            "end_error_m": first.end_error_m,
            "end_error_deg": first.end_error_deg,
            "nees_pose_per_dof": _per_dof(judged),
            "nees_pose": _as_json(judged),
            "nees_best": _as_json(best),
            "nees_relative": _relative(poses, relative, of_camera.trajectory),
            "coverage": _coverage(*errors),
        }
        return numbers, aligned, first, nees

    final, aligned, first, pose_nees = path_numbers(
        estimate.trajectory, estimate.covariances, estimate.relative
    )
    online, *_ = path_numbers(answer.online, answer.online_covariances, estimate.online_relative)
    known, compared = of_camera.trajectory, None
    eTt = None if known is None else estimate_from_truth(estimate.trajectory, known)
    if eTt is not None and truth.landmarks is not None:
        compared = landmark_errors(estimate.landmarks, truth.landmarks, eTt)
    distances, of_landmarks = compared or (np.empty(0), Nees(np.empty(0), np.empty(0, np.int64)))
    judged = judge([of_landmarks])
    remarks = [*filter(None, [sound.why, _orientations(final["nees_relative"])])]
    metrics = EstimatorMetrics(
        **{name: final.pop(name) for name in _OF_CONTRACT},
        drift_percent=first.drift_percent,
        landmarks=len(estimate.landmarks),
        nees_landmark_per_dof=_per_dof(judged),
        update_ms=spread(answer.update_ms),
        peak_memory_mb=answer.peak_memory_mb,
        more={
            "frames": max(len(answer.online), len(estimate.trajectory)),
            "predicted_frames": int(answer.predicted.sum()),
            "predicted_rows": np.flatnonzero(answer.predicted).tolist(),
            "alignment": aligned.alignment.value,
            "matched_poses": aligned.matched_poses,
            "ate_max_m": aligned.ate_max_m,
            "path_length_m": aligned.path_length_m,
            **final,
            "nees_landmark": _as_json(judged),
            "online": online,
            "landmark_rmse_m": float(np.sqrt(np.mean(distances**2))) if len(distances) else None,
            "landmark_median_m": float(np.median(distances)) if len(distances) else None,
            "landmarks_with_truth": None if compared is None else len(distances),
            "landmark_truth_sigma_m": truth.landmark_sigma_m,
            **_innovations(answer),
            "update_growth": time_growth(answer.update_ms),
            **_claims(estimate),
            # Se et al. (5) measure by it how well a loop closes.
            "end_against_start": end_pose(estimate.trajectory),
            "noise_factor": estimate.noise_factor,
            "remarks": [*estimate.remarks, *remarks],
            "judged_poses": first.matched_poses,
            "truth_left_out": sound.left_out.tolist(),
            "truth_remark": "; ".join(remarks) or None,
        },
    )
    return Judgement(metrics, {"pose": pose_nees, "landmark": of_landmarks})


def judge_replay(replay: Outcome, truth: Truth) -> Judgement:
    """As :func:`judge_answer`, with what only a replay knows."""
    judged = judge_answer(Answer.of(replay), truth)
    metrics = judged.metrics
    more = (
        {"kind": replay.kind}
        | dict(metrics.more)
        | {
            "failure": replay.failure or None,
            "solve_ms": spread(replay.column("solve_ms").astype(np.float64)),
            "final_ms": replay.final_ms,
            "memory_before_mb": replay.memory_before_mb,
            **closure_counts(replay.closed),
        }
    )
    return Judgement(replace(metrics, more=more), judged.nees)


def predicted_poses(statuses: Iterable[str], kind: str = "") -> BoolArray:
    """(n,) where by its status no landmark measured the pose; the first frame is given.

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


def _per_dof(found: Consistency | None) -> float | None:
    return None if found is None else found.per_dof


def _as_json(found: Consistency | None) -> JsonValue:
    return None if found is None else asdict(found)


def _pose_errors(
    trajectory: Trajectory, covariances: FloatArray, truth: Truth, best: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Errors (k, 6) and covariances (k, 6, 6) of all poses with a truth, but the first of them.

    It is aligned, and the gauge has neither error nor covariance. Or where they are the ``best``.
    """
    known = truth.trajectory
    found = None if known is None else to_estimate_world(trajectory, known)
    if found is None:
        return np.empty((0, 6)), np.empty((0, 6, 6))
    rows, poses = found[0][1:], found[1][1:]
    if best:
        poses = best_aligned(trajectory.poses[rows], covariances[rows], poses)
    return pose_errors(trajectory.poses[rows], poses), covariances[rows]


def _relative(
    path: Trajectory, relative: Mapping[int, FloatArray], truth: Trajectory | None
) -> dict[str, JsonValue]:
    """NEES of the motions over so many frames, both ends of which have a truth, by their number.

    Of their ``lengths`` alone, too: these need no orientation of the truth.
    """
    if truth is None or not len(path):  # a bare estimate has no poses on the way
        return {}
    rows, true_rows = associate(path.timestamps, truth.timestamps)
    true = np.full((len(path), 4, 4), np.nan)
    true[rows] = truth.poses[true_rows]
    out: dict[str, JsonValue] = {}
    for lag, covariances in relative.items():
        known = np.isfinite(true[lag:]).all(axis=(1, 2)) & np.isfinite(true[:-lag]).all(axis=(1, 2))
        known &= np.isfinite(covariances).all(axis=(1, 2))
        at, poses = np.flatnonzero(known), path.poses
        motions, truths = (inverse(one[at]) @ one[at + lag] for one in (poses, true))
        judged = judge([normalised(pose_errors(motions, truths), covariances[at])])
        lengths = _length_nees(motions, truths, covariances[at])
        out[str(lag)] = None if judged is None else asdict(judged) | {"lengths": lengths}
    return out


_LONG = 3.0  # deviations of a length, from which on it is a normal number


def _length_nees(motions: FloatArray, truths: FloatArray, covariances: FloatArray) -> float | None:
    """Mean NEES of the lengths of motions (n, 4, 4) that are long enough; None of none."""
    lengths, true = (np.linalg.norm(one[:, :3, 3], axis=1) for one in (motions, truths))
    along = np.einsum("nji,nj->ni", motions[:, :3, :3], motions[:, :3, 3])  # in the motion's end
    variances = np.einsum("ni,nij,nj->n", along, covariances[:, 3:, 3:], along)
    long = lengths**4 > _LONG**2 * variances
    squared = ((lengths - true) * lengths)[long] ** 2 / variances[long]
    return float(squared.mean()) if long.any() else None


def _orientations(relative: Mapping[str, Any]) -> str:
    """That lengths of motions are what the covariances let expect, and whole motions are not."""
    judged = [one for one in relative.values() if one and one["lengths"] is not None]
    if not judged or any(
        one["verdict"] != "overconfident" or one["lengths"] > one["upper"] for one in judged
    ):
        return ""
    whole, lengths = (
        ", ".join(f"{one[name]:.2g}" for one in judged) for name in ("per_dof", "lengths")
    )
    return (
        f"lengths of motions agree with the truth (NEES {lengths}), whole motions do not ({whole}):"
        " the truth's orientations are off, or the path's are less certain than stated"
    )


def _coverage(errors: FloatArray, covariances: FloatArray) -> JsonValue:
    """Shares of pose errors within two reported sigmas, by axis of the camera and of all axes."""
    axes = within(errors, covariances)
    if not np.isfinite(axes).any():
        return None
    shares = [None if np.isnan(share) else float(share) for share in axes]
    return {"rotation": shares[:3], "position": shares[3:], "all": float(np.nanmean(axes))}


def _innovations(answer: Answer) -> dict[str, JsonValue]:
    """NIS of the matched observations, each frame an independent item."""
    known = np.isfinite(answer.nis) & (answer.nis_dof > 0)
    found = judge([Nees(answer.nis[known], answer.nis_dof[known])], independent=np.inf)
    return {"nis_per_dof": _per_dof(found), "nis": _as_json(found)}


def _claims(estimate: Estimate) -> dict[str, JsonValue]:
    """What the estimate states of itself at the end: of its last pose, and of the gyroscope."""
    out: dict[str, JsonValue] = {"last_pose_sigma": None}
    if len(estimate.covariances) and np.isfinite(estimate.covariances[-1]).all():
        variances = np.maximum(np.diagonal(estimate.covariances[-1]), 0.0)
        out["last_pose_sigma"] = {  # roots of the traces of its two blocks
            "rotation_deg": float(np.degrees(np.sqrt(variances[:3].sum()))),
            "position_m": float(np.sqrt(variances[3:].sum())),
        }
    if estimate.gyroscope is not None:
        sigmas = np.sqrt(np.diagonal(estimate.gyroscope.covariance))
        out["gyroscope_bias_dps"] = {  # about the axes of the body
            "rates": np.degrees(estimate.gyroscope.rates).tolist(),
            "sigmas": np.degrees(sigmas).tolist(),
        }
    return out


def landmark_errors(
    landmarks: LandmarkMap, truth: LandmarkTruth, eTt: FloatArray
) -> tuple[FloatArray, Nees]:
    """Distances (n,) in metres of the landmarks that both know, by identity; and their NEES.

    Args:
        landmarks: of the estimate, in its world.
        truth: true positions in the world of the ground-truth trajectory.
        eTt: (4, 4) from the truth's world to the estimate's: with the first pose aligned, as for
            the poses' NEES (:func:`fgslam.evaluation.statistics.estimate_from_truth`). That adds
            no uncertainty where the first pose is the gauge of the estimate's world.
    """
    _, rows, of = np.intersect1d(landmarks.ids, truth.ids, return_indices=True)
    true = transform_to_world(eTt, truth.positions[of])
    positions = landmarks.positions[rows]
    distances = np.linalg.norm(positions - true, axis=1)
    return distances, normalised(true - positions, landmarks.covariances[rows])


Comparable: TypeAlias = Outcome | Answer | Estimate
"""A replayed log, an :class:`~fgslam.evaluation.judging.Answer`, or an estimate alone."""

COLUMNS: tuple[tuple[str, str], ...] = (
    ("kind", "kind"),
    ("frames", "frames"),
    ("ate_m", "ate_rmse_m"),
    ("rpe_trans_m", "rpe_trans_m"),
    ("rpe_rot_deg", "rpe_rot_deg"),
    ("drift_percent", "drift_percent"),
    ("end_error_m", "end_error_m"),
    ("end_error_deg", "end_error_deg"),
    ("nees", "nees_pose_per_dof"),
    ("consistency", "nees_pose.verdict"),
    ("landmarks", "landmarks"),
    ("landmark_rmse_m", "landmark_rmse_m"),
    ("nees_landmark", "nees_landmark_per_dof"),
    ("ate_online_m", "online.ate_rmse_m"),
    ("nees_online", "online.nees_pose_per_dof"),
    ("nis", "nis_per_dof"),
    ("ms", "update_ms.median"),
    ("ms_p95", "update_ms.p95"),
    ("ms_max", "update_ms.max"),
    ("failure", "failure"),
)
"""All columns of :func:`compare`, and where each value is in metrics.json."""

_MAIN = ("ate_m", "rpe_trans_m", "rpe_rot_deg", "nees", "ms")
"""Those that a person compares; with names of estimators they fit a terminal of 80 columns."""

_TEXT = frozenset({"kind", "consistency", "failure"})


def compare(
    answers: Mapping[str, Comparable],
    truth: Trajectory | None = None,
    landmark_truth: LandmarkTruth | None = None,
    full: bool = False,
    *,
    truth_of: PoseFrame | None = None,
    rig: CameraRig | None = None,
) -> pandas.DataFrame:
    """Accuracy, consistency and speed of estimators on one recording, a row each.

    Columns are ``ate_m``, ``rpe_trans_m``, ``rpe_rot_deg``, ``nees`` and ``ms``; where an estimator
    ended early ``failure``, too, which a warning states whole. With ``full`` all of these (NaN
    where a value cannot be known):

    * ``kind``, ``frames``, ``landmarks``: which estimator, and how much it estimated.
    * ``ate_m``: absolute trajectory error, root mean square, after SE3 alignment (Sturm et al.
      2012, eq. 2); ``rpe_trans_m``, ``rpe_rot_deg``: relative pose error a frame (eq. 1).
    * ``drift_percent``: ``end_error_m`` over the length of the true path; ``end_error_m``,
      ``end_error_deg``: of the last pose, with the first pose aligned.
    * ``nees``: normalised estimation error squared of the poses per degree of freedom, 1 being
      right (Bar-Shalom, Li and Kirubarajan 2001, 5.4); ``consistency``: `consistent`,
      `overconfident` or `conservative` by its 95 % chi-square band; ``nees_landmark`` alike.
    * ``landmark_rmse_m``: distance of the landmarks from their true positions.
    * ``ate_online_m``, ``nees_online``: the same of each pose as first estimated; ``nis``:
      normalised innovation squared per degree of freedom.
    * ``ms``, ``ms_p95``, ``ms_max``: milliseconds a frame, median, 95th percentile, longest.
    * ``failure``: why an estimator ended early; empty where it did not.

    Args:
        answers: results by the name that their row shall have.
        truth: true poses, in any world frame.
        landmark_truth: true positions of landmarks, in the same world as ``truth``.
        full: all columns.
        truth_of: what the truth's poses are of, `left`, `right` or `body`; None: of what its file
            states, else of the right camera, as those of recordings that are opened.
        rig: the cameras, where the truth is not the right one's.

    Raises:
        ConfigError: one of the answers is none, or they have no names, or the truth is no
            trajectory or of a frame that needs the rig, or ``full`` is neither true nor false.
    """
    if truth_of is not None and isinstance(truth, Trajectory):
        truth = replace(truth, frame=truth_of)
    require_named(answers, truth, rig)
    if not isinstance(landmark_truth, LandmarkTruth | None):
        raise ConfigError(
            f"the landmarks' truth is a {type(landmark_truth).__name__}; give a LandmarkTruth, or "
            "None"
        )
    require_flag(full, "full")
    known = Truth(truth, landmark_truth, rig=rig)
    table = _frame({name: _judged(name, one, known) for name, one in answers.items()})
    ended = table.loc[table["failure"] != "", "failure"]
    for name, why in ended.items():  # pandas cuts what it prints of it
        warnings.warn(f"{name} ended early: {why}", stacklevel=2)
    return table if full else table[[*_MAIN, *(["failure"] if len(ended) else [])]]


def require_named(
    answers: Mapping[str, Comparable], truth: Trajectory | None, rig: CameraRig | None = None
) -> None:
    """Raises ConfigError where the answers have no names, or the truth cannot be their truth."""
    if not isinstance(answers, Mapping):
        raise ConfigError(
            f"the answers are a {type(answers).__name__}; give a dict of results by name: "
            '{"isam2": result}'
        )
    if not isinstance(truth, Trajectory | None):
        raise ConfigError(
            f"the truth is a {type(truth).__name__}; give fgslam.Trajectory.load(file), or "
            "fgslam.Trajectory(times, poses) of arrays (n,) and (n, 4, 4)"
        )
    if truth is not None and truth.frame != "right" and not isinstance(rig, CameraRig):
        raise ConfigError(
            f"the truth is {truth.named}, the answers are the right camera's; give the rig, too: "
            f"truth.of('right', rig), or compare(..., truth_of={truth.frame!r}, rig=slam.log.rig)"
        )


def _frame(estimators: Mapping[str, EstimatorMetrics]) -> pandas.DataFrame:
    """Metrics under :data:`COLUMNS`, with the names as index."""
    import pandas  # half a second, and only tables need it

    rows = {
        name: [value_at(metrics.as_json(), path) for _, path in COLUMNS]
        for name, metrics in estimators.items()
    }
    names = [name for name, _ in COLUMNS]
    frame = pandas.DataFrame.from_dict(rows, orient="index", columns=names)
    frame.index.name = "estimator"
    for name in names:
        if name in _TEXT:
            frame[name] = frame[name].fillna("").astype(str)
        else:
            frame[name] = pandas.to_numeric(frame[name])
    return frame


def _judged(name: str, answer: Comparable, truth: Truth) -> EstimatorMetrics:
    if isinstance(answer, Estimate):
        answer = lone_answer(answer)
    if isinstance(answer, Answer):
        return judge_answer(answer, truth).metrics
    if not hasattr(answer, "estimate"):
        raise ConfigError(
            f"{name}: {type(answer).__name__} is no estimator's result; give what replay or "
            "result returned"
        )
    return judge_replay(answer, truth).metrics


def lone_answer(estimate: Estimate) -> Answer:
    """An estimate of which nothing else is known: neither online poses nor times."""
    online = Trajectory(np.empty(0), np.empty((0, 4, 4)))
    none = np.empty(0)
    return Answer(estimate, online, np.empty((0, 6, 6)), none, np.empty(0, np.int64), none)


@dataclass(frozen=True, slots=True)
class MeanInterval:
    """Mean of independent trials and its 95 % confidence interval by Student's t.

    Attributes:
        mean: of the values.
        lower, upper: of the interval; None for fewer than two values.
        count: how many values.
    """

    mean: float
    lower: float | None
    upper: float | None
    count: int


SIGNIFICANT = 0.05


@dataclass(frozen=True, slots=True)
class PairedTest:
    """Values of A minus values of B, pair by pair; smaller is better.

    Attributes:
        difference: mean and interval of A - B: below zero, A is better.
        wins, losses: pairs in which A, B is the smaller; the rest are ties.
        p_value: Wilcoxon's signed-rank test, two-sided; None where all pairs are ties.
        ratio: mean of A over mean of B; None where that is zero.
    """

    difference: MeanInterval
    wins: int
    losses: int
    p_value: float | None
    ratio: float | None


def mean_interval(values: FloatArray) -> MeanInterval | None:
    """Mean and interval of finite values (n,); None where there is none."""
    known = values[np.isfinite(values)]
    n = len(known)
    if n == 0:
        return None
    mean = float(known.mean())
    if n == 1:
        return MeanInterval(mean, None, None, 1)
    error = float(known.std(ddof=1)) / np.sqrt(n)
    half = float(student_quantile(0.975, n - 1)) * error
    return MeanInterval(mean, mean - half, mean + half, n)


def paired_test(a: FloatArray, b: FloatArray) -> PairedTest | None:
    """Compares values (n,) of A and B on the same trials; pairs with an unknown value are left out.

    Returns:
        The comparison, or None where no pair is known.
    """
    known = np.isfinite(a) & np.isfinite(b)
    a, b = a[known], b[known]
    difference = mean_interval(a - b)
    if difference is None:
        return None
    from scipy.stats import wilcoxon  # a second, and only trials need it

    p_value = float(wilcoxon(a, b).pvalue) if np.any(a != b) else None
    ratio = float(a.mean() / b.mean()) if b.mean() != 0.0 else None
    wins, losses = int(np.count_nonzero(a < b)), int(np.count_nonzero(a > b))
    return PairedTest(difference, wins, losses, p_value, ratio)


def describe_test(smoother: str, against: str, test: PairedTest) -> str:
    """The outcome of a smoother against a filter by final ATE, in words."""
    mean = test.difference
    lower = mean.mean <= 0.0
    if test.p_value is None or test.p_value >= SIGNIFICANT:
        outcome = (
            f"no difference shown between {smoother} and {against}: better in {test.wins}, worse "
            f"in {test.losses} of {mean.count} trials"
        )
    elif lower:
        outcome = f"{smoother} beats {against} in {test.wins} of {mean.count} trials"
    else:
        outcome = f"{against} beats {smoother} in {test.losses} of {mean.count} trials"
    interval = "one trial has no interval"
    if mean.lower is not None and mean.upper is not None:
        sign = -1.0 if lower else 1.0
        low, high = sorted((100.0 * sign * mean.lower, 100.0 * sign * mean.upper))
        interval = f"95 % [{low:.3f}, {high:.3f}]"
    ratio = "" if test.ratio is None else f", {test.ratio:.2f} times"
    p_value = "all equal" if test.p_value is None else f"p = {test.p_value:.2g}"
    return (
        f"{outcome}; {smoother}'s final ATE is {'lower' if lower else 'higher'} by "
        f"{100.0 * abs(mean.mean):.3f} cm, {interval}{ratio}; {p_value}"
    )


def holm(p_values: Sequence[float]) -> list[float]:
    """P values corrected for testing so many hypotheses at once, in the same order (Holm 1979).

    The k-th smallest of n is multiplied by n - k + 1, and none may be below one that was smaller.
    """
    order = np.argsort(p_values, kind="stable")
    factors = np.arange(len(p_values), 0, -1)
    raised = np.maximum.accumulate(np.asarray(p_values, np.float64)[order] * factors)
    corrected = np.empty(len(p_values))
    corrected[order] = np.minimum(raised, 1.0)
    return [float(value) for value in corrected]


FALSE_M = 0.5
"""A closure that is farther from the true relative pose was none."""
FALSE_DEG = 10.0


@dataclass(frozen=True, slots=True)
class JudgedClosure:
    """One closure against the truth; NaN and None where nothing is known.

    Attributes:
        at, to: positions in the log of the frame that closed it and the one it returned to.
        matches: old landmarks seen again.
        merged: landmarks found to be one; 0 for a closure that was refused.
        correction_m: how far the closure moved the pose, metres; NaN where it was refused.
        error_m: of the relative pose that it measured, metres; error_deg: degrees.
        before_m: error of the last pose before, in the world of the first pose, metres.
        after_m: of the pose once corrected; NaN where nothing was.
        taken: whether the run's estimator took it, or refused it.
    """

    at: int
    to: int
    matches: int
    merged: int
    correction_m: float
    error_m: float
    error_deg: float
    before_m: float
    after_m: float
    taken: bool

    @property
    def false(self) -> bool | None:
        """Whether the return that it claims is none; None where that is not known."""
        if not np.isfinite(self.error_m):
            return None
        return self.error_m > FALSE_M or self.error_deg > FALSE_DEG


def judge_closures(
    closures: list[tuple[int, LoopClosure, bool]],
    tracked: FloatArray,
    online: Trajectory,
    truth: Trajectory | None,
) -> list[JudgedClosure]:
    """All closures of a run, in their order.

    Args:
        closures: each with the position in the log of the frame that it belongs to, and whether
            it was taken.
        tracked: (n, 4, 4) poses ``wTc`` before their frame's closures.
        online: poses after them.
        truth: true poses, in any world.
    """
    true_poses = np.full((len(online), 4, 4), np.nan)  # in the estimate's world
    matched = None if truth is None else to_estimate_world(online, truth)
    if matched is not None:
        true_poses[matched[0]] = matched[1]
    errors = position_errors(online.poses, true_poses)
    tracked_errors = position_errors(tracked, true_poses)
    out = []
    for at, closure, taken in closures:
        true = inverse(true_poses[closure.frame]) @ true_poses[at]
        off = inverse(true) @ closure.oTc
        step = online.poses[at, :3, 3] - tracked[at, :3, 3]
        out.append(
            JudgedClosure(
                at=at,
                to=closure.frame,
                matches=len(closure.observations),
                merged=len(closure.merged) if taken else 0,
                correction_m=float(np.linalg.norm(step)) if taken else np.nan,
                error_m=float(np.linalg.norm(off[:3, 3])),
                error_deg=float(np.rad2deg(rotation_angles(off[None, :3, :3])[0])),
                before_m=float(tracked_errors[at]),
                after_m=float(errors[at]) if taken else np.nan,
                taken=taken,
            )
        )
    return out
