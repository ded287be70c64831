"""Results of the estimators of one run, as figures and the page show them: plain arrays.

All poses and points of one report are in one world: that of the estimates, the reference camera's
first frame. What cannot be known is None or NaN, never a guess; the page then reports it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.types import NO_LANDMARKS, Estimate, LandmarkMap, Trajectory
from fgslam.evaluation.statistics import (
    Alignment,
    Nees,
    chi_square_band,
    evaluate_trajectory,
    judge,
    pose_nees,
    position_errors,
    to_estimate_world,
)
from fgslam.evaluation.truth import sound_truth
from fgslam.report.content import Page


@dataclass(frozen=True, slots=True, eq=False)
class EstimatorReport:
    """One estimator's result, frame by frame; arrays of (n, ...) share their rows.

    Attributes:
        title: its name in this run, unique.
        kind: which estimator it is.
        timestamps: (n,) seconds, increasing.
        final_poses: (n, 4, 4) ``wTc`` as estimated at the end.
        online_poses: (n, 4, 4) ``wTc``, each as estimated at its own time; NaN where unknown.
        covariances: (n, 6, 6) of the final poses, tangent [rotation, translation]; NaN unknown.
        landmarks: the final map.
        final_error_m, online_error_m: (n,) distance from the true position; NaN where unknown.
        nees: (n,) normalised error squared of the final pose per degree of freedom; NaN unknown.
        nees_band: interval that holds 95 % of a consistent estimator's values, or None.
        update_ms: (n,) milliseconds a frame; NaN where not timed.
        ate_m: absolute trajectory error of the final path, after SE3 alignment.
        matched_poses: of how many poses; judged_poses: and NEES.
        truth_remark: which true poses are left out of all but the first, and what else of it is
            doubtful.
        nees_per_dof: mean NEES of the run per degree of freedom.
        verdict: `consistent`, `overconfident` or `conservative`; None where not known.
        remarks: what the estimator had to correct or leave out, in words.
        failure: why it ended early, with what it had until then, or gave nothing; else empty.
        predicted: (n,) poses that no landmark measured.
        noise: (n,) each, the columns of noise.csv; empty where nothing is known of it.
        counts: (n,) each, landmarks `matched`, `inliers` (used for the pose) and `landmarks` (in
            the map) of each frame; empty where nothing is known of them.
    """

    title: str
    kind: str
    timestamps: FloatArray
    final_poses: FloatArray
    online_poses: FloatArray
    covariances: FloatArray
    landmarks: LandmarkMap
    final_error_m: FloatArray
    online_error_m: FloatArray
    nees: FloatArray
    update_ms: FloatArray
    predicted: BoolArray
    nees_band: tuple[float, float] | None = None
    ate_m: float | None = None
    matched_poses: int = 0
    judged_poses: int = 0
    truth_remark: str = ""
    nees_per_dof: float | None = None
    verdict: str | None = None
    remarks: tuple[str, ...] = ()
    failure: str = ""
    noise: Mapping[str, FloatArray] = field(default_factory=dict)
    counts: Mapping[str, FloatArray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rows = {f.name: getattr(self, f.name) for f in fields(self)}
        rows |= dict(self.noise) | dict(self.counts)
        del rows["landmarks"]
        for name, values in rows.items():
            if isinstance(values, np.ndarray) and len(values) != len(self):
                raise ValueError(f"{self.title}: {name} has {len(values)} rows, not {len(self)}")

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def final(self) -> Trajectory:
        """The path as estimated at the end."""
        return Trajectory(self.timestamps, self.final_poses)

    @property
    def position_sigma_m(self) -> FloatArray:
        """Root of the summed variances of each final position (n,); NaN where unknown."""
        variance = np.trace(self.covariances[:, 3:, 3:], axis1=1, axis2=2)
        # A planar covariance may round to just below zero.
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))

    @staticmethod
    def failed(title: str, kind: str, why: str) -> EstimatorReport:
        """An estimator that gave no result."""
        path = Trajectory(np.empty(0), np.empty((0, 4, 4)))
        nothing = Estimate(path, np.empty((0, 6, 6)), NO_LANDMARKS)
        return replace(judged_report(title, kind, nothing, None, None), failure=why)


@dataclass(frozen=True, slots=True, eq=False)
class ReportData(Page):
    """Results of one run with the words of its page or viewer.

    Attributes:
        estimators: one or more, in the order of the table; their colours follow it.
        truth: true poses in the estimates' world; None where there are none.
        closures: pairs of frames (closing, returned to) of the loops closed, counted in the first
            estimator's poses.
        up: (3,) the world's vertical, upwards; need not be of unit length.
        alarms: what makes the run no success, in sentences.
        calibration: (n,) each, the columns of calibration.csv; None where the run kept none.
        stages: (n,) each, `timestamp` and milliseconds of every stage of the live loop.
        views: small JPEG images of the reference camera by the row of the first estimator's path.
    """

    estimators: tuple[EstimatorReport, ...] = ()
    truth: Trajectory | None = None
    closures: tuple[tuple[int, int], ...] = ()
    up: FloatArray = field(default_factory=lambda: np.array([0.0, -1.0, 0.0]))
    alarms: tuple[str, ...] = ()
    calibration: Mapping[str, FloatArray] | None = None
    stages: Mapping[str, FloatArray] | None = None
    views: Mapping[int, bytes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        titles = [estimator.title for estimator in self.estimators]
        if len(set(titles)) != len(titles):
            raise ValueError(f"titles of estimators are not unique: {titles}")

    @property
    def remarks_of_all(self) -> tuple[str, ...]:
        """What the estimators had to correct or leave out, and why some failed, in words."""
        lines = [f"{e.title}: {remark}" for e in self.estimators for remark in e.remarks]
        lines += [f"{e.title} failed: {e.failure}" for e in self.estimators if e.failure]
        return tuple(lines)

    @property
    def start(self) -> float:
        """Seconds of the first frame: times in the plots count from it."""
        known = [e.timestamps[0] for e in self.estimators if len(e)]
        return float(min(known, default=0.0))

    @property
    def best(self) -> int:
        """Number of the most accurate estimator with a map; the first one where that is not known.

        One that ended early has its error over part of the way only, and is no match for the
        others.
        """
        errors = [
            (e.ate_m, i)
            for i, e in enumerate(self.estimators)
            if e.ate_m is not None and len(e.landmarks) and not e.failure
        ]
        if errors:
            return min(errors)[1]
        return next((i for i, e in enumerate(self.estimators) if len(e.landmarks)), 0)


def judged_report(
    title: str,
    kind: str,
    estimate: Estimate,
    online: Trajectory | None,
    truth: Trajectory | None,
) -> EstimatorReport:
    """An estimate with its errors, by the same functions as the numbers of metrics.json.

    Args:
        title: its name in the run.
        kind: which estimator it is.
        estimate: as known at the end.
        online: each pose as first estimated, where that is known.
        truth: true poses in any world, where there are some.
    """
    final, unknown = estimate.trajectory, np.full(len(estimate.trajectory), np.nan)
    first: FloatArray = np.full((len(final), 4, 4), np.nan)
    if online is not None:
        rows, of = same_times(final.timestamps, online.timestamps)
        first[rows] = online.poses[of]
    sound = sound_truth(final, truth)
    report = EstimatorReport(
        title=title,
        kind=kind,
        timestamps=final.timestamps,
        final_poses=final.poses,
        online_poses=first,
        covariances=estimate.covariances,
        landmarks=estimate.landmarks,
        final_error_m=unknown,
        online_error_m=unknown,
        nees=unknown,
        update_ms=unknown,
        predicted=np.zeros(len(final), np.bool_),
        remarks=estimate.remarks,
    )
    located = None if sound.trajectory is None else to_estimate_world(final, sound.trajectory)
    if located is None:
        return report
    rows, true_poses = located
    errors, online_errors, values = (np.full(len(final), np.nan) for _ in range(3))
    errors[rows] = position_errors(final.poses[rows], true_poses)
    online_errors[rows] = position_errors(first[rows], true_poses)
    found = pose_nees(final.poses[rows], estimate.covariances[rows], true_poses)
    per_dof = np.full(len(rows), np.nan)
    values[rows] = np.divide(found.values, found.dof, out=per_dof, where=found.dof > 0)
    usual = np.bincount(found.dof[found.dof > 0])
    judged = judge([Nees(found.values[1:], found.dof[1:])])  # the first pose is the gauge
    aligned = evaluate_trajectory(final, truth, Alignment.SE3)
    return replace(
        report,
        final_error_m=errors,
        online_error_m=online_errors,
        nees=values,
        nees_band=chi_square_band(float(usual.argmax())) if len(usual) else None,
        ate_m=aligned.ate_rmse_m,
        matched_poses=aligned.matched_poses,
        judged_poses=len(rows) - 1,
        nees_per_dof=None if judged is None else judged.per_dof,
        verdict=None if judged is None else judged.verdict,
    )


def truth_in_their_world(
    estimators: tuple[EstimatorReport, ...], truth: Trajectory | None
) -> Trajectory | None:
    """Sound true poses of the frames, the first one aligned, of the estimator with most of them."""
    best: Trajectory | None = None
    for estimator in estimators:
        final = estimator.final
        if (sound := sound_truth(final, truth).trajectory) is None:
            break
        found = to_estimate_world(final, sound)
        if found is not None and (best is None or len(found[0]) > len(best)):
            best = Trajectory(final.timestamps[found[0]], found[1])
    return best


def same_times(a: FloatArray, b: FloatArray) -> tuple[IntArray, IntArray]:
    """Rows of both that have the very same time stamp, as files of one estimator do."""
    _, rows, of = np.intersect1d(a, b, return_indices=True)
    return rows, of
