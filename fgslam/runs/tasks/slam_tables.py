"""What is said of a run of SLAM in the terminal: its table, and what was tolerated."""

from __future__ import annotations

from fgslam.evaluation.metrics import EstimatorMetrics
from fgslam.report.content import Column, TextTable
from fgslam.runs.tasks.slam_outputs import RunOutputs
from fgslam.runs.tasks.slam_summary import frame_problems, run_numbers

_PROBLEMS_SHOWN = 5


def summary_table(outputs: RunOutputs, metrics: EstimatorMetrics) -> TextTable:
    """The numbers of the live estimator; a table of names and values without headings."""
    numbers = run_numbers(outputs.recorder)
    remark = f"\n{outputs.remark}" if outputs.remark else ""
    matches = numbers["landmark_matches"]
    rows: list[tuple[str, object]] = [
        ("frames", f"{len(outputs.recorder)} of {len(outputs.sequence)}"),
        ("pose found from", _counts(numbers["status_counts"])),
        ("landmarks", metrics.landmarks),
        ("landmarks matched, median (5 %)", _spread(matches)),
        ("ATE rms, SE3 aligned", _metres(metrics.ate_rmse_m)),
        ("RPE a frame", f"{_metres(metrics.rpe_trans_m)}, {_degrees(metrics.rpe_rot_deg)}"),
        ("end error, first pose aligned", _end(outputs, metrics)),
        ("end against start", _start(outputs, metrics)),
        ("drift", "unknown" if metrics.drift_percent is None else f"{metrics.drift_percent:.2f} %"),
        ("pose NEES per dof", _nees(metrics)),
        ("loop without SIFT, median", _milliseconds(numbers["loop_ms"])),
    ]
    heading = f"{outputs.config.name}: {outputs.title}{remark}"
    cells = tuple((name, (str(value),)) for name, value in rows)
    return TextTable("summary", heading, "", (Column("", "of the run"),), cells)


def run_notes(outputs: RunOutputs, metrics: EstimatorMetrics) -> tuple[str, ...]:
    """What was tolerated: notes on the recording, and frames that could not be used."""
    problems = frame_problems(outputs.recorder)
    lines = [*outputs.sequence.notes, *outputs.notes, *problems[:_PROBLEMS_SHOWN]]
    if len(problems) > _PROBLEMS_SHOWN:
        lines.append(f"and {len(problems) - _PROBLEMS_SHOWN} more such frames, see metrics.json")
    if not metrics.landmarks:
        lines.append("there is no landmark in the map; fgslam inspect says what ails the recording")
    return tuple(lines)


def _metres(value: float | None) -> str:
    if value is None:
        return "unknown"
    return f"{100.0 * value:.2f} cm" if value < 1.0 else f"{value:.3f} m"


def _degrees(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3f} deg"


def _counts(counts: object) -> str:
    if not isinstance(counts, dict):
        return "unknown"
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _spread(spread: object) -> str:
    if not isinstance(spread, dict):
        return "none"
    return f"{spread['median']:.0f} ({spread['p05']:.0f})"


def _milliseconds(times: object) -> str:
    known = isinstance(times, dict) and times["median"] is not None
    return f"{times['median']:.1f} ms" if known and isinstance(times, dict) else "unknown"


def _end(outputs: RunOutputs, metrics: EstimatorMetrics) -> str:
    if metrics.end_error_m is None or len(outputs.recorder) < 2:
        return "unknown"
    return f"{_metres(metrics.end_error_m)}, {_degrees(metrics.end_error_deg)}"


def _start(outputs: RunOutputs, metrics: EstimatorMetrics) -> str:
    end = metrics.more.get("end_against_start")
    if not isinstance(end, dict) or len(outputs.recorder) < 2:
        return "unknown"
    # Adding zero turns -0.00 into 0.00.
    x, y, z = (f"{round(end[name], 2) + 0.0:.2f}" for name in ("x_cm", "y_cm", "z_cm"))
    yaw, pitch, roll = (
        f"{round(end[name], 2) + 0.0:.2f}" for name in ("yaw_deg", "pitch_deg", "roll_deg")
    )
    return f"{x}, {y}, {z} cm\nyaw {yaw}, pitch {pitch}, roll {roll} deg"


def _nees(metrics: EstimatorMetrics) -> str:
    found = metrics.more.get("nees_pose")
    if not isinstance(found, dict):
        return "unknown"
    band = f"{found['lower']:.2f}-{found['upper']:.2f}"
    return f"{found['per_dof']:.1f}: {found['verdict']} (band {band})"
