"""The numbers of one estimator's result, under the names of metrics.json; times a frame."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray

JsonValue: TypeAlias = (
    bool | int | float | str | Sequence["JsonValue"] | Mapping[str, "JsonValue"] | None
)


@dataclass(frozen=True, slots=True)
class UpdateTime:
    """Milliseconds an estimator took for a frame; None where none was timed."""

    median: float | None = None
    p95: float | None = None
    max: float | None = None

    @staticmethod
    def of(milliseconds: FloatArray) -> UpdateTime:
        """Statistics of the times (n,) of all frames."""
        if len(milliseconds) == 0:
            return UpdateTime()
        median, p95 = np.percentile(milliseconds, [50.0, 95.0])
        return UpdateTime(float(median), float(p95), float(np.max(milliseconds)))


@dataclass(frozen=True, slots=True)
class EstimatorMetrics:
    """What is known about one estimator's result; None where it cannot be known.

    Attributes:
        ate_rmse_m: absolute trajectory error (`alignment` in ``more`` says how it was aligned).
        rpe_trans_m, rpe_rot_deg: relative pose error a frame.
        drift_percent: error at the end over the length of the path, first pose aligned.
        end_error_m, end_error_deg: error of the last pose against truth, first pose aligned.
        landmarks: number of landmarks in the final map.
        nees_pose_per_dof, nees_landmark_per_dof: 1 is consistent, more is overconfident.
        update_ms: time for a frame.
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
    update_ms: UpdateTime = field(default_factory=UpdateTime)
    peak_memory_mb: float | None = None
    more: Mapping[str, JsonValue] = field(default_factory=dict)

    def as_json(self) -> dict[str, JsonValue]:
        """Every name of the contract, then the further ones."""
        update = self.update_ms
        out: dict[str, JsonValue] = {
            "ate_rmse_m": self.ate_rmse_m,
            "rpe_trans_m": self.rpe_trans_m,
            "rpe_rot_deg": self.rpe_rot_deg,
            "drift_percent": self.drift_percent,
            "end_error_m": self.end_error_m,
            "end_error_deg": self.end_error_deg,
            "landmarks": self.landmarks,
            "nees_pose_per_dof": self.nees_pose_per_dof,
            "nees_landmark_per_dof": self.nees_landmark_per_dof,
            "update_ms": {"median": update.median, "p95": update.p95, "max": update.max},
            "peak_memory_mb": self.peak_memory_mb,
        }
        clash = sorted(out.keys() & self.more.keys())
        if clash:
            raise ValueError(f"metric '{clash[0]}' is a name of the contract, not a further one")
        return out | dict(self.more)


def value_at(values: Mapping[str, Any], where: str) -> Any:
    """The value under a dotted path; None where there is none or it is not finite."""
    at: Any = values
    for key in where.split("."):
        at = at.get(key) if isinstance(at, Mapping) else None
    return None if isinstance(at, float) and not math.isfinite(at) else at


_LEAST_FRAMES = 25  # five a fifth: the median of fewer is noise


@dataclass(frozen=True, slots=True)
class TimeGrowth:
    """Growth of the time a frame.

    Attributes:
        ratio: median of the last fifth of the frames over that of the second fifth (the first
            holds what is slow only once); 1 is flat, 4 is proportional to the frames so far.
        slope_ms_per_1000: least-squares slope, milliseconds a thousand frames.
    """

    ratio: float
    slope_ms_per_1000: float


def time_growth(milliseconds: FloatArray) -> TimeGrowth | None:
    """Growth of times (n,) of consecutive frames; None for fewer than 25 of them."""
    n = len(milliseconds)
    if n < _LEAST_FRAMES:
        return None
    fifth = n // 5
    early, late = np.median(milliseconds[fifth : 2 * fifth]), np.median(milliseconds[-fifth:])
    if not early > 0.0:
        return None
    slope = np.polyfit(np.arange(n, dtype=np.float64), milliseconds, 1)[0]
    return TimeGrowth(float(late / early), float(1000.0 * slope))
