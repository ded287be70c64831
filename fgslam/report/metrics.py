"""The numbers of a run: metrics.json and timing.csv, under names that scripts may rely on."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.atomic_files import write_text
from fgslam.core.errors import DatasetError

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


@dataclass(frozen=True, slots=True)
class StageTime:
    """How long one stage took for one frame.

    Attributes:
        frame: the recording's frame number.
        timestamp: seconds.
        stage: name of the stage (`sift`, `match`, ...).
        milliseconds: wall-clock time.
    """

    frame: int
    timestamp: float
    stage: str
    milliseconds: float


def write_metrics(
    path: Path,
    frames: int,
    estimators: Mapping[str, EstimatorMetrics],
    more: Mapping[str, JsonValue] | None = None,
) -> None:
    """Write metrics.json atomically; NaN and infinities become null, never a missing name.

    Args:
        path: the file.
        frames: number of frames processed.
        estimators: metrics by the estimator's kind.
        more: further values of the run as a whole.

    Raises:
        OutputError: the file cannot be written.
    """
    document: dict[str, Any] = {
        "frames": frames,
        **(more or {}),
        "estimators": {kind: metrics.as_json() for kind, metrics in estimators.items()},
    }
    write_text(path, json.dumps(plain(document), indent=2, allow_nan=False) + "\n")


def read_metrics(path: Path) -> dict[str, Any]:
    """The document that :func:`write_metrics` wrote.

    Raises:
        DatasetError: the file is missing or is not one.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror}; check the path") from error
    except ValueError as error:
        raise DatasetError(f"{path} is not JSON ({error}); run the experiment again") from error
    if not isinstance(document, dict) or "estimators" not in document:
        raise DatasetError(f"{path} holds no metrics; give the metrics.json of a run folder")
    return document


def write_timing(path: Path, times: Sequence[StageTime]) -> None:
    """Write timing.csv: frame, timestamp (s), stage, milliseconds. Raises OutputError."""
    lines = ["frame,timestamp,stage,milliseconds"]
    lines += [
        f"{time.frame},{time.timestamp:.9f},{time.stage},{time.milliseconds:.4f}" for time in times
    ]
    write_text(path, "\n".join(lines) + "\n")


def plain(value: Any) -> Any:
    """Plain JSON types: NumPy numbers unwrapped, what is not finite as None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
