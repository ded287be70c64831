"""Files of numbers in a run folder: metrics.json, timing.csv, comparison.csv, any other table."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from fgslam.core.errors import DatasetError
from fgslam.core.files import replacing, write_text
from fgslam.evaluation.metrics import EstimatorMetrics, JsonValue, value_at

Cell: TypeAlias = "str | bool | int | float | np.generic | None"


def write_csv(path: Path, columns: Sequence[str], rows: Iterable[Sequence[Cell]]) -> None:
    """Writes a table: ten significant digits; empty where a value is None or not finite.

    Raises:
        ValueError: a row has not as many cells as there are columns.
        OutputError: the file cannot be written.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        if len(row) != len(columns):
            raise ValueError(f"{len(row)} cells in a table of {len(columns)} columns")
        writer.writerow([_text(cell) for cell in row])
    write_text(path, out.getvalue())


def write_parquet(
    path: Path, columns: Mapping[str, Sequence[Cell]], about: Mapping[str, str]
) -> None:
    """Writes a table as Parquet, atomically; equal values give equal bytes.

    Args:
        path: the file; `pandas.read_parquet` opens it.
        columns: n cells each, of one type; None where a value is not known.
        about: texts for the file's own metadata.

    Raises:
        OutputError: the file cannot be written.
    """
    import pyarrow
    from pyarrow import parquet

    table = pyarrow.table({name: pyarrow.array(cells) for name, cells in columns.items()})
    with replacing(path) as partial:
        parquet.write_table(table.replace_schema_metadata(about), partial, compression="zstd")


def write_json(path: Path, document: Mapping[str, JsonValue]) -> None:
    """Writes a document; what is not finite becomes null. Raises OutputError."""
    write_text(path, json.dumps(plain(document), indent=2, allow_nan=False) + "\n")


def _text(cell: Cell) -> str:
    if isinstance(cell, np.generic):
        cell = cell.item()
    if cell is None or (isinstance(cell, float) and not math.isfinite(cell)):
        return ""
    if isinstance(cell, bool):
        return "true" if cell else "false"
    return f"{cell:.10g}" if isinstance(cell, float) else str(cell)


RESULT_COLUMNS: tuple[tuple[str, str], ...] = (
    ("kind", "kind"),
    ("odometry", "odometry"),
    ("frames", "frames"),
    ("predicted_frames", "predicted_frames"),
    ("alignment", "alignment"),
    ("matched_poses", "matched_poses"),
    ("ate_final_m", "ate_rmse_m"),
    ("ate_online_m", "online.ate_rmse_m"),
    ("ate_max_final_m", "ate_max_m"),
    ("rpe_final_m", "rpe_trans_m"),
    ("rpe_final_deg", "rpe_rot_deg"),
    ("rpe_online_m", "online.rpe_trans_m"),
    ("rpe_online_deg", "online.rpe_rot_deg"),
    ("end_error_final_m", "end_error_m"),
    ("end_error_final_deg", "end_error_deg"),
    ("end_error_online_m", "online.end_error_m"),
    ("end_error_online_deg", "online.end_error_deg"),
    ("drift_percent", "drift_percent"),
    ("path_length_m", "path_length_m"),
    ("landmarks", "landmarks"),
    ("landmarks_with_truth", "landmarks_with_truth"),
    ("landmark_rmse_m", "landmark_rmse_m"),
    ("landmark_median_m", "landmark_median_m"),
    ("landmark_truth_sigma_m", "landmark_truth_sigma_m"),
    ("nees_pose_final_per_dof", "nees_pose_per_dof"),
    ("nees_pose_band_lower", "nees_pose.lower"),
    ("nees_pose_band_upper", "nees_pose.upper"),
    ("nees_pose_final_verdict", "nees_pose.verdict"),
    ("nees_pose_online_per_dof", "online.nees_pose_per_dof"),
    ("nees_pose_online_verdict", "online.nees_pose.verdict"),
    ("coverage_final", "coverage.all"),
    ("coverage_online", "online.coverage.all"),
    ("nees_landmark_per_dof", "nees_landmark_per_dof"),
    ("nees_landmark_verdict", "nees_landmark.verdict"),
    ("nis_per_dof", "nis_per_dof"),
    ("last_pose_sigma_m", "last_pose_sigma.position_m"),
    ("last_pose_sigma_deg", "last_pose_sigma.rotation_deg"),
    ("failure", "failure"),
)
"""What the same measurements give to the byte: column, and where its value is in the metrics."""

TIME_COLUMNS: tuple[tuple[str, str], ...] = (
    ("update_median_ms", "update_ms.median"),
    ("update_p95_ms", "update_ms.p95"),
    ("update_max_ms", "update_ms.max"),
    ("solve_median_ms", "solve_ms.median"),
    ("final_estimate_ms", "final_ms"),
    ("update_growth_ratio", "update_growth.ratio"),
    ("update_slope_ms_per_1000_frames", "update_growth.slope_ms_per_1000"),
    ("peak_memory_mib", "peak_memory_mb"),
    ("memory_before_mib", "memory_before_mb"),
)
"""What differs from one execution to the next."""


def write_comparison_csv(
    path: Path,
    runs: Sequence[tuple[str, Mapping[str, Mapping[str, Any]]]],
    columns: Sequence[tuple[str, str]] = RESULT_COLUMNS + TIME_COLUMNS,
    key: str = "run",
) -> None:
    """Write the table atomically; a value that is not known is an empty cell.

    Args:
        path: the file.
        runs: name of each run and its estimators' numbers of metrics.json by title.
        columns: which, see above.
        key: heading of the runs' names.

    Raises:
        OutputError: the file cannot be written.
    """
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow([key, "estimator", *(name for name, _ in columns)])
    for run, estimators in runs:
        for title, values in estimators.items():
            cells = [_cell(value_at(values, where)) for _, where in columns]
            writer.writerow([run, title, *cells])
    write_text(path, buffer.getvalue())


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.9g}" if isinstance(value, float) else str(value)


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
    write_json(path, document)


def read_metrics(path: Path) -> dict[str, Any]:
    """The metrics.json of a run of any task: :func:`write_metrics` wrote those of SLAM.

    Raises:
        DatasetError: the file is missing or is not one.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror}; check the path") from error
    except ValueError as error:
        raise DatasetError(f"{path} is not JSON ({error}); run the experiment again") from error
    if not isinstance(document, dict) or not document.keys() & {"estimators", "task"}:
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
