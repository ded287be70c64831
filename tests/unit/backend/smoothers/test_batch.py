"""Batch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from smoothing import (
    SMOOTHERS,
    answer,
    assert_consistent,
    assert_finite,
    ate,
    blackout,
    counting,
    drawn,
    nees_of,
    position_sigma,
    run,
    wrong_matches,
)
from threadpoolctl import threadpool_info, threadpool_limits

from fgslam.backend.settings import BatchSettings
from fgslam.backend.smoothers import final as refinement
from fgslam.backend.smoothers.bundle import State, WholeGraph
from fgslam.backend.smoothers.smoother import MapSmoother
from fgslam.core.errors import EstimatorError
from fgslam.evaluation.statistics import judge


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("batch", 10),
        *(pytest.param(n, 20, marks=pytest.mark.slow) for n in ("gnc", "isam2", "fixed_lag")),
        *(pytest.param(n, 20, marks=pytest.mark.slow) for n in ("sliding_window", "batch")),
    ],
)
def test_pose_and_landmarks_are_consistent_over_many_drives(name: str, count: int) -> None:
    assert_consistent(SMOOTHERS[name], count)


def test_covariances_stay_consistent_among_wrong_matches() -> None:
    """The last solution is plain least squares over what fits: its covariances hold."""
    found = []
    for seed in range(10):
        simulation = drawn(100 + seed)
        spoilt = wrong_matches(simulation.increments, 0.2, np.random.default_rng(seed))
        found.append(nees_of(answer(BatchSettings(), spoilt), simulation)[0])
    verdict = judge(found)
    assert verdict is not None
    assert verdict.verdict == "consistent", verdict


def test_final_solution_is_the_minimum_over_what_fits() -> None:
    simulation = drawn(5)
    spoilt = wrong_matches(simulation.increments, 0.3, np.random.default_rng(5))
    estimator, _ = run(BatchSettings(), spoilt)
    assert isinstance(estimator, MapSmoother)
    refined = estimator.solver.refined()
    everything, values = estimator.builder.kept_factors(), refined.values
    graph, total = counting(everything, refined.graph), everything.size()
    assert 0.7 * total < graph.size() < 0.85 * total
    gradient = graph.linearize(values).gradientAtZero()
    step = graph.linearize(values).optimize()
    assert max(np.abs(step.at(key)).max() for key in values.keys()) < 1e-4  # noqa: SIM118
    assert gradient.size() == values.size()
    # 3 numbers an observation, 3 a landmark, 6 a pose but the first; the motions have 6 as well.
    freedom = 3 * (graph.size() - 16) - 3 * len(refined.variables)
    assert 2.0 * graph.error(values) == pytest.approx(freedom, rel=0.2)


def test_a_blackout_is_bridged_and_the_uncertainty_shows_it() -> None:
    simulation = drawn(3, frames=26)
    found = answer(BatchSettings(), blackout(simulation.increments, range(10, 20)))
    sigma = position_sigma(found.covariances)
    assert (np.diff(sigma[9:14]) > 0).all()
    assert (np.diff(sigma[16:21]) < 0).all()
    assert sigma[14] > 4 * max(sigma[9], sigma[20])
    error = np.linalg.norm(found.trajectory.poses[:, :3, 3] - simulation.poses[:, :3, 3], axis=1)
    assert (error[1:] < 4 * sigma[1:]).all()
    assert error[20:].max() < 0.03


def test_failing_solver_is_reported_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    estimator, _ = run(BatchSettings(), drawn(7, frames=6).increments)

    def failing(*arguments: object, **named: object) -> None:
        raise RuntimeError("\nout of\nluck\n")

    monkeypatch.setattr(WholeGraph, "minimum", failing)
    with pytest.raises(EstimatorError, match=r"^batch: the solver failed after frame 5 \(out of l"):
        estimator.estimate()


def test_landmark_without_any_fitting_observation_is_left_out_with_a_remark(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    simulation = drawn(7)
    estimator, _ = run(BatchSettings(), simulation.increments)
    variable = estimator.builder.admission.tracks[3].variable
    reported = [{variable: "has no observation that fits the others"}]

    def lost(*given: object) -> dict[int, str]:
        return reported.pop() if reported else {}

    monkeypatch.setattr(refinement, "lost_landmarks", lost)
    found = estimator.estimate()
    assert_finite(found)
    assert len(found.remarks) == 1
    assert found.remarks[0].startswith("landmark 3 (seen ")
    assert found.remarks[0].endswith("has no observation that fits the others: left out")
    assert 3 in found.landmarks.ids
    assert ate(found, simulation) < 0.01


def test_landmarks_lost_in_every_round_come_to_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    simulation = drawn(7)
    estimator, _ = run(BatchSettings(), simulation.increments)

    def lost(builder: object, found: refinement.Refined) -> dict[int, str]:
        return {found.variables[0]: "is lost"}

    monkeypatch.setattr(refinement, "lost_landmarks", lost)
    found = estimator.estimate()
    assert_finite(found)
    assert len(found.remarks) == 5


def test_the_solution_takes_one_blas_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    # Its sums, and so its bytes, must not depend on how many threads the environment allows.
    estimator, _ = run(BatchSettings(), drawn(0).increments)
    threads: list[int] = []
    minimum = WholeGraph.minimum

    def counted(self: WholeGraph, *arguments: Any, **options: Any) -> State:
        threads.extend(x["num_threads"] for x in threadpool_info() if x["user_api"] == "blas")
        return minimum(self, *arguments, **options)

    monkeypatch.setattr(WholeGraph, "minimum", counted)
    with threadpool_limits(limits=2, user_api="blas"):
        estimator.estimate()
    assert set(threads) == {1}
