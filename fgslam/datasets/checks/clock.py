"""Offset of the odometry's clock against the cameras', estimated from turns of the truth."""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError
from fgslam.core.geometry import inverse, so3_log
from fgslam.core.recordings import Sequence
from fgslam.datasets.checks.findings import Finding, Level
from fgslam.datasets.recording import OdometrySource, Recording
from fgslam.datasets.tables import rows_at

_STAMP_TOLERANCE_S = 1e-3
_RANGE_S, _STEP_S = 0.2, 0.02
_FEWEST_STEPS = 20
_CLEAR_GAIN = 0.7
_SIGNIFICANT_RAD = np.radians(0.005)
_YAW = 2  # the body's z axis points up


def check_clock(sequence: Sequence) -> tuple[Finding, ...]:
    """Shift of the odometry's clock at which its turns agree best with the truth's.

    Reported where the median yaw error of a step falls by 30 % or more. A recording that never
    turns gives no finding: its clock cannot be checked.
    """
    if not isinstance(sequence, Recording) or sequence.odometry_source is None:
        return ()
    if sequence.ground_truth is None or len(sequence.ground_truth) < _FEWEST_STEPS:
        return ()
    shifts = _STEP_S * np.arange(-round(_RANGE_S / _STEP_S), round(_RANGE_S / _STEP_S) + 1)
    true = _true_turns(sequence)
    source, stamps = sequence.odometry_source, sequence.timestamps
    errors = np.array([_median_error(source, stamps - shift, true) for shift in shifts])
    now = errors[len(errors) // 2]
    if not np.isfinite(now):
        return ()
    best = int(np.nanargmin(errors))
    if errors[best] > _CLEAR_GAIN * now or now - errors[best] < _SIGNIFICANT_RAD:
        return ()
    text = (
        f"turns agree best when the odometry's stamps are shifted by {shifts[best]:+.2f} s "
        f"({np.degrees(errors[best]):.2g} instead of {np.degrees(now):.2g} degrees a step, "
        "median); add that to odometry.time_offset_s"
    )
    return (Finding(Level.WARNING, "odometry against truth", text),)


def _true_turns(sequence: Recording) -> FloatArray:
    """Rotations (n - 1, 3, 3) of the body between frames by the truth; NaN where it has gaps."""
    truth = sequence.ground_truth
    out = np.full((len(sequence) - 1, 3, 3), np.nan)
    if truth is not None:
        rows = rows_at(truth.timestamps, sequence.timestamps, _STAMP_TOLERANCE_S)
        body = (truth.poses @ inverse(sequence.rig.bTc))[:, :3, :3]
        known = (rows[:-1] >= 0) & (rows[1:] >= 0)
        before, after = body[rows[:-1][known]], body[rows[1:][known]]
        out[known] = np.swapaxes(before, -1, -2) @ after
    return out


def _median_error(source: OdometrySource, stamps: FloatArray, true: FloatArray) -> float:
    """Median yaw error in radians of the odometry's steps; NaN where too few can be compared."""
    try:
        steps = source(stamps)
    except DatasetError:
        return float("nan")
    errors = [
        abs(so3_log(step.motion[:3, :3].T @ turn)[_YAW])
        for step, turn in zip(steps, true, strict=True)
        if step is not None and np.isfinite(turn[0, 0])
    ]
    return float(np.median(errors)) if len(errors) >= _FEWEST_STEPS else float("nan")
