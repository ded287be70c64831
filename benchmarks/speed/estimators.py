"""Speed of the estimators as ratios, on simulated measurements (docs/results).

Every ratio is of processor times in this process, taken in turns; medians are quoted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gtsam
import numpy as np

from benchmarks.gtsam_graphs import in_arrays
from benchmarks.speed.drives import (
    MeasuredDrive,
    Played,
    cpu_seconds,
    interleaved,
    largest_offset_mm,
    open_drive,
    play,
)
from fgslam.backend.filters.kalman import LandmarkKalman
from fgslam.backend.filters.kalman_graph import LandmarkKalmanGraph
from fgslam.backend.settings import (
    BatchSettings,
    Isam2Settings,
    KernelSettings,
    LandmarkKalmanGraphSettings,
    LandmarkKalmanSettings,
)
from fgslam.backend.smoothers.batch import BatchSolver
from fgslam.backend.smoothers.elimination import reduced
from fgslam.backend.smoothers.smoother import Smoother
from fgslam.core.arrays import FloatArray
from fgslam.core.log import MeasurementLog
from fgslam.core.store import restore, state_of
from fgslam.core.types import LandmarkMap
from fgslam.factors.graphs import solver_parameters
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver
from fgslam.slam.build import make_estimator
from fgslam.slam.motion import ConstantVelocityMotion
from fgslam.slam.replay import replay_frame

LIMITS = {
    "isam2_windowed_over_own_ordering": 0.5,
    "isam2_windowed_to_own_ordering_mm": 1.0,
    "isam2_buffered_5_over_own_ordering": 0.25,
    "isam2_buffered_10_over_own_ordering": 0.25,
    "isam2_all_updates_over_one_batch_solve": 6.0,
    "graph_filter_an_update_difference": 1e-12,
    "marginals_all_landmarks_s": 2.0,
}
ISAM2 = {
    "own": Isam2Settings(update_every=1, ordering_window=0),
    "windowed": Isam2Settings(update_every=1),
    "buffered_5": Isam2Settings(update_every=5),
    "buffered_10": Isam2Settings(update_every=10),
}
LEAST_SQUARES = BatchSettings(kernel=KernelSettings("none"), trim=False)
BIG_MAP = ("dataset.world.landmarks=16000", "dataset.detection.features=320")
SAMPLE = 100


def isam2(drive: MeasuredDrive, repeats: int) -> dict[str, float]:
    """Orderings, buffering, and all of iSAM2 over one batch solution."""
    last: dict[str, Played] = {}

    def updates_of(name: str) -> float:
        last[name] = play(drive, ISAM2[name])
        return float(last[name].cpu_s.sum())

    works: dict[str, Callable[[], float]] = {
        name: lambda name=name: updates_of(name)  # type: ignore[misc]
        for name in ISAM2
    }
    s = interleaved(works | {"batch": lambda: batch_solve_s(drive)}, repeats)
    own, windowed = last["own"], last["windowed"]
    final = largest_offset_mm(poses_of(own), poses_of(windowed))
    frames = len(drive.log)
    return {
        "isam2_windowed_over_own_ordering": s["windowed"] / s["own"],
        "isam2_windowed_to_own_ordering_mm": final,
        "isam2_windowed_to_own_ordering_online_mm": largest_offset_mm(own.online, windowed.online),
        "isam2_buffered_5_over_own_ordering": s["buffered_5"] / s["own"],
        "isam2_buffered_10_over_own_ordering": s["buffered_10"] / s["own"],
        "isam2_buffered_5_over_windowed": s["buffered_5"] / s["windowed"],
        "isam2_buffered_10_over_windowed": s["buffered_10"] / s["windowed"],
        "isam2_all_updates_over_one_batch_solve": s["buffered_5"] / s["batch"],
        "isam2_ms_per_frame": 1e3 * s["buffered_5"] / frames,
        "batch_solve_s": s["batch"],
    }


def poses_of(played: Played) -> FloatArray:
    """The final trajectory."""
    return played.estimator.estimate().trajectory.poses


def batch_solve_s(drive: MeasuredDrive) -> float:
    """One plain least-squares solution from the tracker's initial values, without marginals."""
    graph, values = problem(drive)
    return cpu_seconds(lambda: minimum(graph, values))


def problem(drive: MeasuredDrive) -> tuple[Any, Any]:
    """Batch's factors and initial values of a whole drive."""
    estimator = play(drive, LEAST_SQUARES).estimator
    assert isinstance(estimator, Smoother)
    assert isinstance(estimator.solver, BatchSolver)
    return estimator.builder.kept_factors(), estimator.solver.values


def minimum(graph: Any, values: Any) -> Any:
    """By Levenberg-Marquardt, as batch does it."""
    params = solver_parameters(100, 1e-9)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()


def graph_filter(drive: MeasuredDrive, repeats: int) -> dict[str, float]:
    """The paper's filter by GTSAM against its closed form: time, and difference."""
    closed, graph = LandmarkKalmanSettings(), LandmarkKalmanGraphSettings()
    s = interleaved(
        {
            "closed": lambda: float(play(drive, closed).cpu_s.sum()),
            "graph": lambda: float(play(drive, graph).cpu_s.sum()),
        },
        repeats,
    )
    one, other = play(drive, closed).estimator, play(drive, graph).estimator
    return {
        "graph_filter_over_closed_form": s["graph"] / s["closed"],
        "graph_filter_ms_per_frame": 1e3 * s["graph"] / len(drive.log),
        "graph_filter_run_difference": difference(other.landmarks(), one.landmarks()),
        "graph_filter_an_update_difference": worst_update(drive),
    }


def worst_update(drive: MeasuredDrive) -> float:
    """Largest difference that one update makes, both starting from the closed form's state."""
    log, worst = drive.log, 0.0
    closed = make_estimator(log.rig, LandmarkKalmanSettings(), drive.ego_motion)
    solver, motion = EgoMotionSolver(log.rig, drive.ego_motion), ConstantVelocityMotion()
    for k, increment in enumerate(log):
        graph = make_estimator(log.rig, LandmarkKalmanGraphSettings(), drive.ego_motion)
        assert isinstance(closed, LandmarkKalman)
        assert isinstance(graph, LandmarkKalmanGraph)
        restore(graph, state_of(closed))
        found = replay_frame(increment, closed, solver, motion, k)
        # The pose found by the one serves both: without a point to weight at, it is the tracking's.
        graph.predict(increment.odometry)
        graph.update(increment, replace(found.tracking, weighted_at=None))
        worst = max(worst, difference(graph.landmarks(), closed.landmarks()))
    return worst


def difference(found: LandmarkMap, expected: LandmarkMap) -> float:
    """Largest one, of positions relative to the distance, of covariances to their size."""
    if not len(expected):
        return 0.0
    offset = np.linalg.norm(found.positions - expected.positions, axis=1)
    size = 1.0 + np.linalg.norm(expected.positions, axis=1)
    change = np.abs(found.covariances - expected.covariances).max(axis=(1, 2))
    scale = np.abs(expected.covariances).max(axis=(1, 2))
    return float(max((offset / size).max(), (change / scale).max()))


def all_marginals(repeats: int, seed: int = 0) -> dict[str, float]:
    """All landmark covariances of a large map at once, over GTSAM's one by one.

    GTSAM's are measured on a sample of the landmarks, and extrapolated to all.
    """
    graph, start = problem(open_drive("lab_trials", BIG_MAP))
    values = minimum(graph, start)
    whole, state = in_arrays(graph, values)
    keys = np.array(whole.landmark_keys)
    sample = np.random.default_rng(seed).choice(keys, SAMPLE, replace=False)

    def at_once() -> FloatArray:
        return reduced(whole.linear(state)).landmarks()

    s = interleaved({"all": lambda: cpu_seconds(at_once)}, repeats)["all"]
    built: list[Any] = []
    building = cpu_seconds(lambda: built.append(gtsam.Marginals(graph, values)))
    ones: list[FloatArray] = []
    sampled = cpu_seconds(
        lambda: ones.extend(built[0].marginalCovariance(int(key)) for key in sample)
    )
    ours = at_once()[np.searchsorted(keys, sample)]
    error = np.abs(ours - np.array(ones)).max(axis=(1, 2)) / np.abs(ours).max(axis=(1, 2))
    one_by_one = building + sampled / SAMPLE * len(keys)
    return {
        "marginals_landmarks": float(len(keys)),
        "marginals_all_landmarks_s": s,
        "marginals_gtsam_one_by_one_extrapolated_s": one_by_one,
        "marginals_all_over_gtsam_extrapolated": s / one_by_one,
        "marginals_sample_difference": float(error.max()),
    }


def ratios_of_estimators(repeats: int = 3) -> dict[str, float]:
    """All of this module."""
    drive = open_drive("lab_trials")
    assert isinstance(drive.log, MeasurementLog)
    return isam2(drive, repeats) | graph_filter(drive, repeats) | all_marginals(repeats)
