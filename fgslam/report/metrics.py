"""The numbers of a run: metrics.json and timing.csv, under names that scripts may rely on."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from fgslam.core.errors import DatasetError
from fgslam.core.files import write_text
from fgslam.evaluation.metrics import EstimatorMetrics, JsonValue


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
