"""The homing graph in plain arrays next to the same graph in GTSAM's factors."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from homings import Trial, trial

from fgslam.backend.homing.estimators import make_homing_estimator
from fgslam.backend.homing.graph import HomingGraph
from fgslam.backend.homing.schur import Factored, SchurSolver, State
from fgslam.backend.settings import HomingGraphSettings
from fgslam.core.arrays import FloatArray
from fgslam.core.bearings import HomingEstimate
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import wrap
from fgslam.worlds.settings import SimulatedBearingsSettings
from fgslam.worlds.simulated_bearings import HomingOutliers

EXACT = HomingGraphSettings()


@pytest.fixture(autouse=True)
def exact(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every image is solved to convergence, and no match weighs less."""
    monkeypatch.setattr("fgslam.backend.homing.schur.STEPS", 30)
    monkeypatch.setattr("fgslam.backend.homing.schur.MATCH_LIMIT", np.inf)


@cache
def case(images_per_s: float = 1.5) -> Trial:
    settings = SimulatedBearingsSettings(images_per_s=images_per_s, part=0.4, lost_per_s=0.1)
    return trial(4, settings)


def estimated(settings: HomingGraphSettings) -> HomingEstimate:
    given = case()
    estimator = make_homing_estimator(given.start, settings)
    for image in given.tracks:
        estimator.update(image)
    return estimator.estimate()


def test_the_same_optimum_and_covariance_as_gtsams_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both driven to convergence, which reweighting reaches slowly: hundredths of a deviation."""
    monkeypatch.setattr("fgslam.backend.homing.schur.STILL", 1e-7)
    monkeypatch.setattr("fgslam.backend.homing.gtsam.RELATIVE_TOLERANCE", 1e-14)
    monkeypatch.setattr("fgslam.backend.homing.gtsam.MAX_ITERATIONS", 200)
    own = estimated(EXACT)
    batch = estimated(replace(EXACT, solver="batch"))
    deviations = np.sqrt(np.diagonal(batch.covariance))
    np.testing.assert_array_less(np.abs(own.robot - batch.robot), 1e-2 * deviations[:3])
    np.testing.assert_array_less(np.abs(own.target - batch.target), 1e-2 * deviations[3:])
    np.testing.assert_array_equal(own.ids, batch.ids)
    spread = np.sqrt(np.diagonal(batch.landmark_covariances, axis1=1, axis2=2))
    np.testing.assert_array_less(np.abs(own.landmarks - batch.landmarks), 1e-2 * spread)
    scale = np.outer(deviations, deviations)
    np.testing.assert_allclose(own.covariance / scale, batch.covariance / scale, atol=1e-2)
    assert len(own.ids) > 10


def solver_of(given: Trial, settings: HomingGraphSettings) -> SchurSolver:
    estimator = make_homing_estimator(given.start, settings)
    for image in given.tracks:
        estimator.update(image)
    assert isinstance(estimator, HomingGraph)
    assert isinstance(estimator.solver, SchurSolver)
    return estimator.solver


def test_gradient_is_that_of_the_cost() -> None:
    solver = solver_of(case(), EXACT)
    model, state = solver.model, solver.state
    rng = np.random.default_rng(0)
    state = State(*(part + 0.01 * rng.standard_normal(part.shape) for part in parts(state)))
    equations = model.normal(model.look(state))
    gradient = np.append(equations.chain_gradient.ravel(), equations.border_gradient)
    for k in rng.permutation(len(gradient))[:40]:
        step = np.zeros(len(gradient))
        step[k] = 1e-6
        ahead, behind = (model.look(moved(state, s * step)).cost for s in (1.0, -1.0))
        assert (ahead - behind) / 2e-6 == pytest.approx(gradient[k], rel=1e-4, abs=1e-2)


def test_the_factored_system_is_solved() -> None:
    """Step and covariance against the whole matrix, inverted."""
    solver = solver_of(case(), EXACT)
    e = solver.model.normal(solver.model.look(solver.state))
    count, m = len(e.diagonal), len(e.border)
    n = 6 * count
    whole = np.zeros((n + m, n + m))
    for k in range(count):
        at = slice(6 * k, 6 * k + 6)
        whole[at, at] = e.diagonal[k]
        if k + 1 < count:
            whole[6 * k + 6 : 6 * k + 12, at] = e.below[k]
            whole[at, 6 * k + 6 : 6 * k + 12] = e.below[k].T
    whole[:n, n:] = e.cross.reshape(n, m)
    whole[n:, :n] = whole[:n, n:].T
    whole[n:, n:] = e.border
    inverse = np.linalg.inv(whole)
    factored = Factored(e)
    chosen = np.concatenate([np.arange(n - 6, n - 3), n + np.array([0, 2, 5])])
    found = factored.covariance(np.array([0, 2, 5]))
    np.testing.assert_allclose(found, inverse[np.ix_(chosen, chosen)], rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(factored.border_covariance(), inverse[n:, n:], rtol=1e-5, atol=1e-12)


def test_wrong_matches_are_found_by_what_contradicts_them(
    exact: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A wrong match that RANSAC let pass, and that no kernel separates from the others."""
    settings = SimulatedBearingsSettings(images_per_s=5.0, part=0.6)
    given = trial(3, settings, HomingOutliers(wrong_matches=0.3))
    wrong = np.flatnonzero(~given.correct)
    assert len(wrong) == 1
    assert without_target(solver_of(given, EXACT)) == []
    monkeypatch.undo()
    assert without_target(solver_of(given, HomingGraphSettings())) == wrong.tolist()


def test_dropped_match_takes_the_elevations_along() -> None:
    solver = solver_of(case(), EXACT)
    before = solver.model.look(solver.state)
    solver.model.drop_match(0)
    after = solver.model.look(solver.state)
    assert before.bearings[1][0, 0] > 0.0
    assert after.bearings[1][0, 0] == 0.0
    assert np.count_nonzero(before.pairs[1]) - np.count_nonzero(after.pairs[1]) == 1


@pytest.mark.parametrize("rotation", [np.pi - 1e-9, 1e-9 - np.pi])
def test_headings_stay_within_half_a_turn(rotation: float) -> None:
    """The solution leaves the first guess, one way or the other; its heading is an angle still."""
    given = case()
    vector, matches = given.start.vector, given.start.matches
    seen = wrap(matches.bearing_b + vector.rotation - rotation)
    start = replace(
        given.start,
        vector=replace(vector, rotation=rotation),
        matches=replace(matches, bearing_b=seen),
    )
    heading = make_homing_estimator(start, EXACT).estimate().target[2]
    assert -np.pi <= heading < np.pi
    assert 1e-6 < abs(wrap(heading - rotation)) < 0.2


def test_start_that_is_no_number_is_refused() -> None:
    start = case().start
    vector = replace(start.vector, covariance=np.full((2, 2), np.nan))
    with pytest.raises(EstimatorError, match="cannot be solved"):
        make_homing_estimator(replace(start, vector=vector), EXACT)


def without_target(solver: SchurSolver) -> list[int]:
    """Rows of landmarks whose bearing from the target was dropped."""
    model = solver.model
    information = model.look(solver.state).bearings[1][0]
    return [row for row, number in model.landmarks.items() if information[number] == 0.0]


def parts(state: State) -> tuple[FloatArray, FloatArray, FloatArray]:
    return state.chain, state.target, state.points


def moved(state: State, step: FloatArray) -> State:
    chain = step[: state.chain.size].reshape(state.chain.shape)
    return state.moved(chain, step[state.chain.size :])
