"""Estimators side by side as a data frame, and paired tests of two over many trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.checks import require_flag
from fgslam.core.errors import ConfigError
from fgslam.core.estimates import Estimate, Trajectory
from fgslam.core.quantiles import student_quantile
from fgslam.core.recordings import LandmarkTruth
from fgslam.evaluation.judging import Answer, Replayed, Truth, judge_answer, judge_replay
from fgslam.evaluation.metrics import EstimatorMetrics, value_at

if TYPE_CHECKING:
    import pandas


Comparable: TypeAlias = Replayed | Answer | Estimate
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
) -> pandas.DataFrame:
    """Accuracy, consistency and speed of estimators on one recording, a row each.

    Columns are ``ate_m``, ``rpe_trans_m``, ``rpe_rot_deg``, ``nees`` and ``ms``; where an estimator
    ended early ``failure``, too. With ``full`` all of these (NaN where a value cannot be known):

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
        truth: true poses of the reference camera, in any world frame.
        landmark_truth: true positions of landmarks, in the same world as ``truth``.
        full: all columns.

    Raises:
        ConfigError: one of the answers is none, or they have no names, or the truth is no
            trajectory, or ``full`` is neither true nor false.
    """
    require_named(answers, truth)
    if not isinstance(landmark_truth, LandmarkTruth | None):
        raise ConfigError(
            f"the landmarks' truth is a {type(landmark_truth).__name__}; give a LandmarkTruth, or "
            "None"
        )
    require_flag(full, "full")
    known = Truth(truth, landmark_truth)
    table = _frame({name: _judged(name, one, known) for name, one in answers.items()})
    if full:
        return table
    failed = ["failure"] if (table["failure"] != "").any() else []
    return table[[*_MAIN, *failed]]


def require_named(answers: Mapping[str, Comparable], truth: Trajectory | None) -> None:
    """Raises ConfigError where the answers have no names, or the truth is no trajectory."""
    if not isinstance(answers, Mapping):
        raise ConfigError(
            f"the answers are a {type(answers).__name__}; give a dict of results by name: "
            '{"isam2": result}'
        )
    if not isinstance(truth, Trajectory | None):
        raise ConfigError(
            f"the truth is a {type(truth).__name__}; give a trajectory: "
            "fgslam.Trajectory.load(file)"
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
        answer = _alone(answer)
    if isinstance(answer, Answer):
        return judge_answer(answer, truth).metrics
    if not hasattr(answer, "estimate"):
        raise ConfigError(
            f"{name}: {type(answer).__name__} is no estimator's result; give what replay or "
            "result returned"
        )
    return judge_replay(answer, truth).metrics


def _alone(estimate: Estimate) -> Answer:
    """An estimate of which nothing else is known: neither online poses nor times."""
    online = Trajectory(np.empty(0), np.empty((0, 4, 4)))
    none = np.empty(0)
    return Answer(estimate, online, np.empty((0, 6, 6)), none, np.empty(0, np.int64), none)


@dataclass(frozen=True, slots=True)
class MeanInterval:
    """Mean of independent trials and its confidence interval by Student's t.

    Attributes:
        mean: of the values.
        lower, upper: of the interval; None for fewer than two values.
        count: how many values.
        probability: of the interval.
    """

    mean: float
    lower: float | None
    upper: float | None
    count: int
    probability: float


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


def mean_interval(values: FloatArray, probability: float = 0.95) -> MeanInterval | None:
    """Mean and interval of finite values (n,); None where there is none."""
    known = values[np.isfinite(values)]
    n = len(known)
    if n == 0:
        return None
    mean = float(known.mean())
    if n == 1:
        return MeanInterval(mean, None, None, 1, probability)
    error = float(known.std(ddof=1)) / np.sqrt(n)
    half = float(student_quantile(0.5 + 0.5 * probability, n - 1)) * error
    return MeanInterval(mean, mean - half, mean + half, n, probability)


def paired_test(a: FloatArray, b: FloatArray, probability: float = 0.95) -> PairedTest | None:
    """Compares values (n,) of A and B on the same trials; pairs with an unknown value are left out.

    Returns:
        The comparison, or None where no pair is known.
    """
    known = np.isfinite(a) & np.isfinite(b)
    a, b = a[known], b[known]
    difference = mean_interval(a - b, probability)
    if difference is None:
        return None
    from scipy.stats import wilcoxon  # a second, and only trials need it

    p_value = float(wilcoxon(a, b).pvalue) if np.any(a != b) else None
    ratio = float(a.mean() / b.mean()) if b.mean() != 0.0 else None
    wins, losses = int(np.count_nonzero(a < b)), int(np.count_nonzero(a > b))
    return PairedTest(difference, wins, losses, p_value, ratio)


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
