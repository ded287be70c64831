"""2,500 frames, eight times round a corridor: does a frame's cost stay, and how near is batch?

`make bench-long`, or `python -m benchmarks long_drive`: some ten minutes and 2 GB, most of it
batch; the parts without batch belong to `make bench`, too.
"""

from __future__ import annotations

import numpy as np

from benchmarks.speed.drives import MeasuredDrive, Player, cpu_seconds, open_drive, play
from fgslam.backend.settings import (
    BatchSettings,
    EstimatorSettings,
    FixedLagSettings,
    Isam2Settings,
    KernelSettings,
    LandmarkKalmanSettings,
    SlidingWindowSettings,
)
from fgslam.core.threads import one_blas_thread
from fgslam.core.types import Estimate
from fgslam.evaluation.statistics import Alignment, evaluate_trajectory

KEYFRAMES = Isam2Settings(keyframe_every=4, update_every=40, ordering_window=10)
WINDOW = 500
LEAST_SQUARES = BatchSettings(kernel=KernelSettings("none"), trim=False)
LIMITS = {
    "fixed_lag_last_over_early": 1.1,
    "isam2_keyframes_ms_per_frame": 10.0,
    "isam2_keyframes_ate_over_batch": 1.3,
}


def last_over_early(drive: MeasuredDrive, settings: EstimatorSettings) -> float:
    """Median update of the last 500 frames over that of frames 500 to 1000.

    Two estimators take turns, frame by frame, one that is 1,500 frames older than the other: what
    else the machine does meets both alike.
    """
    older, younger = Player(drive, settings), Player(drive, settings)
    start = len(drive.log) - WINDOW
    older.on_to(start)
    younger.on_to(WINDOW)
    for k in range(WINDOW):
        older.on_to(start + k + 1)
        younger.on_to(WINDOW + k + 1)
    late, early = (p.played().cpu_s[-WINDOW:] for p in (older, younger))
    return float(np.median(late) / np.median(early))


def fixed_lag_flat(drive: MeasuredDrive) -> dict[str, float]:
    """Of the fixed lag; beside the filter, which shows how much of it is the drive itself."""
    return {
        "fixed_lag_last_over_early": last_over_early(drive, FixedLagSettings()),
        "landmark_kalman_last_over_early": last_over_early(drive, LandmarkKalmanSettings()),
    }


def keyframes(drive: MeasuredDrive) -> tuple[dict[str, float], Estimate]:
    """iSAM2 with keyframes: milliseconds of the processor a frame, and the answer."""
    played = play(drive, KEYFRAMES)
    cpu, answers = 1e3 * played.cpu_s, []
    final = cpu_seconds(lambda: answers.append(played.estimator.estimate()))
    ratios = {
        "isam2_keyframes_ms_per_frame": float(cpu.mean()),
        "isam2_keyframes_ms_median": float(np.median(cpu)),
        "isam2_keyframes_ms_worst": float(cpu.max()),
        "isam2_keyframes_final_s": final,
    }
    return ratios, answers[0]


def sliding_window(drive: MeasuredDrive) -> tuple[dict[str, float], Estimate]:
    """The sliding window: milliseconds of the processor a frame, and the answer."""
    played = play(drive, SlidingWindowSettings())
    cpu = 1e3 * played.cpu_s
    ratios = {
        "sliding_window_ms_median": float(np.median(cpu)),
        "sliding_window_99_over_median": float(np.percentile(cpu, 99) / np.median(cpu)),
        "sliding_window_ms_worst": float(cpu.max()),
    }
    return ratios, played.estimator.estimate()


def without_batch(drive: MeasuredDrive) -> dict[str, float]:
    """What `make bench` takes over."""
    return fixed_lag_flat(drive) | keyframes(drive)[0]


def ate_cm(estimate: Estimate, drive: MeasuredDrive) -> float:
    """After alignment by a rigid motion."""
    found = evaluate_trajectory(estimate.trajectory, drive.truth, Alignment.SE3)
    if found.ate_rmse_m is None:
        raise ValueError("an accuracy needs ground truth")
    return 100.0 * found.ate_rmse_m


def with_batch(drive: MeasuredDrive) -> dict[str, float]:
    """The accuracy of keyframes beside that of batch on the same measurements."""
    ratios, estimate = keyframes(drive)
    played, answers = play(drive, LEAST_SQUARES), []
    batch_s = cpu_seconds(lambda: answers.append(played.estimator.estimate()))
    ours, best = ate_cm(estimate, drive), ate_cm(answers[0], drive)
    return ratios | {
        "isam2_keyframes_ate_cm": ours,
        "batch_ate_cm": best,
        "isam2_keyframes_ate_over_batch": ours / best,
        "batch_final_s": batch_s,
    }


@one_blas_thread()
def ratios_beside_batch() -> dict[str, float]:
    """Everything measured on the 2,500 frames, batch included (some ten minutes, 2 GB)."""
    drive = open_drive("long_drive")
    window, estimate = sliding_window(drive)
    window["sliding_window_ate_cm"] = ate_cm(estimate, drive)
    return fixed_lag_flat(drive) | window | with_batch(drive)
