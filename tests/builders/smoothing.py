"""What the tests of the smoothers share: drives that go wrong in one way, and their judging."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import gtsam
import numpy as np
import pytest
from simulated import RIG, Drive, Simulation, observations, play, simulate

from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import (
    BatchSettings,
    EstimatorSettings,
    FixedLagSettings,
    Isam2Settings,
    SlidingWindowSettings,
)
from fgslam.backend.smoothers import admission, graph as graph_builder
from fgslam.backend.smoothers.bundle import WholeGraph
from fgslam.core import geometry as g
from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.sensors import Increment
from fgslam.core.types import Estimate, Prediction, UpdateStats
from fgslam.evaluation.statistics import Nees, judge, nees, pose_nees
from fgslam.factors import graphs
from fgslam.factors.noise import plain
from fgslam.frontend.settings import EgoMotionSettings
from fgslam.slam.build import make_estimator

FREE = EgoMotionSettings(dof=6)
"""The front-end's least squares without a floor: the simulated drives leave it."""

SMOOTHERS: dict[str, EstimatorSettings] = {
    "batch": BatchSettings(),
    "gnc": BatchSettings(method="gnc"),
    "isam2": Isam2Settings(),
    "isam2, every frame": Isam2Settings(update_every=1),
    "isam2, keyframes": Isam2Settings(keyframe_every=4),
    "fixed_lag": FixedLagSettings(lag_frames=5),
    "sliding_window": SlidingWindowSettings(window=5, update_every=2),
}
PIXELS = np.array([0.3, 0.3, 0.2])


def admit_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Landmarks enter a graph with their first sighting, without a prior, and never start anew."""
    monkeypatch.setattr(admission, "LEAST_SIGHTINGS", 1)
    monkeypatch.setattr(admission, "LEAST_PARALLAX", 0.0)
    monkeypatch.setattr(admission, "CONTRADICTED_AFTER", 10**9)
    monkeypatch.setattr(graph_builder, "WEAK_PARALLAX", 0.0)


def relinearise_beyond(monkeypatch: pytest.MonkeyPatch, threshold: float) -> None:
    """iSAM2 relinearises what moves by more than a threshold."""
    monkeypatch.setattr(graphs, "RELINEARISED", threshold)


def drawn(seed: int, **drive: object) -> Simulation:
    """A short drive past 60 points; ``drive`` overrides."""
    settings = {"frames": 16, "points": 60} | drive
    return simulate(Drive(**settings), np.random.default_rng(seed))  # type: ignore[arg-type]


def build(settings: EstimatorSettings, prior: Prediction | None = None) -> Estimator:
    """An estimator without a floor."""
    return make_estimator(RIG, settings, FREE, prior)


def run(
    settings: EstimatorSettings, increments: list[Increment]
) -> tuple[Estimator, list[UpdateStats]]:
    """A new estimator and what it said frame by frame."""
    estimator = build(settings)
    return estimator, play(estimator, increments, FREE)


def answer(settings: EstimatorSettings, increments: list[Increment]) -> Estimate:
    """The estimate at the end of a run."""
    return run(settings, increments)[0].estimate()


def ate(estimate: Estimate, simulation: Simulation) -> float:
    """Root mean square of position errors, metres; the first pose is shared."""
    offsets = estimate.trajectory.poses[:, :3, 3] - simulation.poses[:, :3, 3]
    return float(np.sqrt((offsets**2).sum(axis=1).mean()))


def nees_of(estimate: Estimate, simulation: Simulation) -> tuple[Nees, Nees]:
    """Of the poses and of the landmarks."""
    truth = simulation.points_by_id[estimate.landmarks.ids]
    poses = estimate.trajectory.poses[1:], estimate.covariances[1:], simulation.poses[1:]
    landmarks = estimate.landmarks
    return pose_nees(*poses), nees(truth - landmarks.positions, landmarks.covariances)


def assert_consistent(settings: EstimatorSettings, count: int = 20) -> None:
    """Errors of poses and landmarks over many drives are those that the covariances state."""
    drives = [drawn(100 + seed) for seed in range(count)]
    found = [nees_of(answer(settings, drive.increments), drive) for drive in drives]
    for runs in zip(*found, strict=True):
        verdict = judge(runs)
        assert verdict is not None
        assert verdict.verdict == "consistent", verdict


class Failing:
    """A solver that fails with a message when it is next updated, and works otherwise."""

    def __init__(self, solver: Any, message: str) -> None:
        self._solver = solver
        self._message = message

    def __getattr__(self, name: str) -> Any:
        return getattr(self._solver, name)

    def update(self, *arguments: Any) -> None:
        raise RuntimeError(self._message)


def counting(graph: Any, whole: WholeGraph) -> Any:
    """Those of GTSAM's factors that count in a graph in arrays made of them, without kernels."""
    every = [graph.at(row) for row in range(graph.size())]
    left = np.zeros(len(every), np.bool_)
    seen = [isinstance(factor, gtsam.GenericStereoFactor3D) for factor in every]
    left[seen] = whole.weights <= 0.0
    out = gtsam.NonlinearFactorGraph()
    for row in np.flatnonzero(~left).tolist():
        out.add(plain(every[row]))
    return out


def position_sigma(covariance: FloatArray) -> FloatArray:
    """Deviation of positions in metres, of pose covariances (..., 6, 6)."""
    return np.asarray(np.sqrt(np.trace(covariance[..., 3:, 3:], axis1=-2, axis2=-1)))


def assert_finite(estimate: Estimate) -> None:
    """No NaN and no infinity anywhere in an answer."""
    landmarks = estimate.landmarks
    for array in (estimate.trajectory.poses, estimate.covariances):
        assert np.isfinite(array).all()
    assert np.isfinite(landmarks.positions).all()
    assert np.isfinite(landmarks.covariances).all()


# --------------------------------------------------------------------------------------------
# Drives that go wrong


def keep(
    increments: list[Increment], kept: Callable[[int, Increment], BoolArray]
) -> list[Increment]:
    """Drops observations, and keeps the book of identities: what is new, missed, pruned.

    Args:
        increments: of a whole drive.
        kept: which observations of frame k stay.
    """
    known: set[int] = set()
    out = []
    for k, increment in enumerate(increments):
        observed = increment.observations.select(kept(k, increment))
        is_new = np.array([i not in known for i in observed.ids.tolist()], np.bool_)
        observed = dataclasses.replace(observed, is_new=is_new)
        observed = observed.select(np.argsort(is_new, kind="stable"))
        missed = [i for i in increment.missed_ids.tolist() if i in known]
        known |= set(observed.ids.tolist())
        pruned = [i for i in increment.pruned_ids.tolist() if i in known]
        known -= set(pruned)
        out.append(
            dataclasses.replace(
                increment,
                observations=observed,
                rejected=np.zeros(len(observed), np.bool_),
                missed_ids=np.array(missed, np.int64),
                pruned_ids=np.array(pruned, np.int64),
            )
        )
    return out


def unseen(increments: list[Increment], identity: int, frames: range) -> list[Increment]:
    """One landmark is not seen in some frames."""
    return keep(increments, lambda k, x: ~((x.observations.ids == identity) & (k in frames)))


def blackout(increments: list[Increment], frames: range) -> list[Increment]:
    """Nothing is seen in some frames."""
    return keep(increments, lambda k, x: np.full(len(x.observations), k not in frames))


def wrong_matches(
    increments: list[Increment], share: float, rng: np.random.Generator
) -> list[Increment]:
    """A share of the matched observations becomes anything that the rig could see."""
    out = []
    for increment in increments:
        observed = increment.observations
        wrong = ~observed.is_new & (rng.uniform(size=len(observed)) < share)
        measured = observed.measurement.copy()
        measured[wrong] = rng.uniform([5.0, 5.0, 4.0], [314.0, 234.0, 18.0], (int(wrong.sum()), 3))
        spoilt = observations(observed.ids, measured, PIXELS, observed.is_new)
        out.append(dataclasses.replace(increment, observations=spoilt))
    return out


def moved(
    simulation: Simulation,
    identity: int,
    since: int,
    place: FloatArray,
    rng: np.random.Generator,
) -> list[Increment]:
    """A landmark is elsewhere, at ``place`` (3,) in the world, from frame ``since`` on."""
    out = []
    for k, increment in enumerate(simulation.increments):
        observed = increment.observations
        row = np.flatnonzero(observed.ids == identity)
        if k >= since and len(row):
            local = g.transform_to_camera(simulation.poses[k], place[None])
            measured = observed.measurement.copy()
            measured[row] = RIG.predict(local) + PIXELS * rng.standard_normal((1, 3))
            shown = observations(observed.ids, measured, PIXELS, observed.is_new)
            increment = dataclasses.replace(increment, observations=shown)
        out.append(increment)
    return out
