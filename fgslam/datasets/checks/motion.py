"""Checks of odometry and ground truth: coverage, jumps, agreement, and the odometry's clock."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.geometry import inverse, se3_log, so3_log
from fgslam.core.measurements import Odometry
from fgslam.core.recordings import Sequence
from fgslam.datasets.checks.recording import Finding, Level, listed, share
from fgslam.datasets.odometry import OdometrySource
from fgslam.datasets.recording import Recording
from fgslam.datasets.times import rows_at

_STAMP_TOLERANCE_S = 1e-3
_NONE = 1e-9  # metres, and of a rotation: rounding
_MAX_JUMP = 8.0
_STEPS_AROUND = 3
_SMALLEST_JUMP_M = 0.05  # below it a standing camera's truth trembles, whatever its rate
_MAX_NOISE_RATIO = 3.0
_TANGENT_NAMES = (
    "roll",
    "pitch",
    "yaw",
    "forward motion",
    "sideways motion",
    "vertical motion",
)


def check_odometry(sequence: Sequence) -> tuple[Finding, ...]:
    """Whether motions are recorded, and where they are missing."""
    try:
        missing = [i for i in range(1, len(sequence)) if sequence.odometry(i) is None]
    except DatasetError as error:
        return (Finding(Level.PROBLEM, "odometry", str(error)),)
    steps = len(sequence) - 1
    if len(missing) == steps:
        text = (
            "none recorded; set odometry.kind to constant_velocity, or synthetic if there is truth"
        )
        return (Finding(Level.INFO, "odometry", text),)
    covered = Finding(Level.INFO, "odometry", f"covers {share(steps - len(missing), steps)} steps")
    if not missing:
        return (covered, *_frozen(sequence))
    text = f"none before frames {listed(missing)}; constant velocity stands in there"
    return (covered, Finding(Level.WARNING, "odometry", text))


def _frozen(sequence: Sequence) -> tuple[Finding, ...]:
    """A warning where every step is none, to the last digit: of a source that stands still."""
    given = [sequence.odometry(i) for i in range(1, len(sequence))]
    if not given or any(s is None or np.abs(s.motion - np.eye(4)).max() > _NONE for s in given):
        return ()
    text = (
        f"states no motion in any of {len(given)} steps; if the robot moved, it is of another "
        "source: choose a topic or file, or set odometry.kind to constant_velocity"
    )
    return (Finding(Level.WARNING, "odometry", text),)


def check_truth(sequence: Sequence) -> tuple[Finding, ...]:
    """Whether ground truth covers the frames, its length, and jumps in it."""
    truth = sequence.ground_truth
    if truth is None or len(truth) == 0:
        return (Finding(Level.INFO, "ground truth", "none, so no accuracy can be computed"),)
    matched = int((rows_at(truth.timestamps, sequence.timestamps, _STAMP_TOLERANCE_S) >= 0).sum())
    length = float(np.linalg.norm(np.diff(truth.poses[:, :3, 3], axis=0), axis=1).sum())
    found = [
        Finding(
            Level.INFO,
            "ground truth",
            f"covers {share(matched, len(sequence))} frames, path length {length:.4g} m",
        )
    ]
    jumps = _jumps(truth)
    if jumps:
        text = (
            f"moves suddenly before its poses {listed(jumps)}: more than {_MAX_JUMP:g} times as "
            "fast as before and after, and as in nine of ten steps"
        )
        found.append(Finding(Level.WARNING, "ground truth", text))
    return tuple(found)


def _jumps(truth: Trajectory) -> list[int]:
    """Rows that are reached many times faster than the rows around them, and than most others.

    Who stands for long and then drives is fast against the median, yet not against the steps that
    follow. A jump is one step, of one bad pose two.
    """
    if len(truth) < _STEPS_AROUND + 2:
        return []
    step = np.linalg.norm(np.diff(truth.poses[:, :3, 3], axis=0), axis=1)
    speed = step / np.diff(truth.timestamps)
    around = sliding_window_view(np.pad(speed, _STEPS_AROUND, mode="reflect"), _STEPS_AROUND)
    local = np.median(around, axis=1)
    before, after = local[: len(speed)], local[_STEPS_AROUND + 1 :]
    usual = np.maximum(np.maximum(before, after), np.quantile(speed, 0.9))
    jumps = (speed > _MAX_JUMP * usual) & (step > _SMALLEST_JUMP_M)
    return [int(k) + 1 for k in np.flatnonzero(jumps)]


def check_odometry_against_truth(sequence: Sequence) -> tuple[Finding, ...]:
    """Errors of the odometry's steps against the truth's, and against the stated noise.

    The spread is the median absolute error, scaled to a normal distribution's standard deviation,
    so that a few bad poses of the truth do not decide.
    """
    try:
        errors, sigmas = _step_errors(sequence)
    except DatasetError:
        return ()  # check_odometry has reported it.
    if len(errors) < 5:
        return ()
    spread = 1.4826 * np.median(np.abs(errors), axis=0)
    ratio = spread / np.median(sigmas, axis=0)
    text = (
        f"differs from truth by {np.degrees(spread[2]):.2g} degrees in yaw and "
        f"{100.0 * spread[3]:.2g} cm forward a step (median over {len(errors)} steps)"
    )
    found = [Finding(Level.INFO, "odometry against truth", text)]
    for k in np.flatnonzero(ratio > _MAX_NOISE_RATIO):
        text = (
            f"the error in {_TANGENT_NAMES[k]} is {ratio[k]:.1f} times the stated noise; raise its "
            "sigma in the odometry settings, or check mounting and time offset"
        )
        found.append(Finding(Level.WARNING, "odometry against truth", text))
    return tuple(found)


def _step_errors(sequence: Sequence) -> tuple[FloatArray, FloatArray]:
    """Tangent errors (n, 6) of the odometry in the body's frame, and stated sigmas (n, 6)."""
    truth = sequence.ground_truth
    errors: list[FloatArray] = []
    sigmas: list[FloatArray] = []
    if truth is not None and len(truth):
        rows = rows_at(truth.timestamps, sequence.timestamps, _STAMP_TOLERANCE_S)
        body = truth.poses @ inverse(sequence.rig.bTc)
        for i in range(1, len(sequence)):
            step = sequence.odometry(i)
            if step is not None and rows[i - 1] >= 0 and rows[i] >= 0:
                errors.append(_step_error(step, body[rows[i - 1]], body[rows[i]]))
                sigmas.append(np.sqrt(np.diag(step.covariance)))
    return np.array(errors).reshape(-1, 6), np.array(sigmas).reshape(-1, 6)


def _step_error(step: Odometry, before: FloatArray, after: FloatArray) -> FloatArray:
    return se3_log(inverse(step.motion) @ inverse(before) @ after)


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
