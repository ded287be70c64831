"""comparison.csv: estimators side by side."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from fgslam.core.files import write_text
from fgslam.evaluation.metrics import value_at

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
