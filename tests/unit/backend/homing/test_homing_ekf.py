"""The homing filters: deletion, gauges, motion; the averages' assumptions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from homings import Trial, trial

from fgslam.backend.homing import ekf
from fgslam.backend.homing.ekf import (
    INITIAL_SPEED,
    FilterState,
    HomingEkf,
    Measured,
    initial_state,
    motion,
    predicted,
    seen_from_robot,
    updated,
)
from fgslam.backend.homing.estimators import AverageDisplacement, AverageLandmarkVector
from fgslam.backend.homing.paper_ekf import PaperEkf, seen_from_target, separate_initial_state
from fgslam.backend.settings import HomingEkfSettings, PaperEkfSettings
from fgslam.core.arrays import FloatArray
from fgslam.core.bearings import HomingStart, LocalMap, TrackedBearings, TwoViewVector
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import bearings, wrap
from fgslam.factors.bearing import (
    bearing_jacobians,
    polar_jacobians,
    polar_points,
    target_jacobian,
    target_pose,
)
from fgslam.worlds.settings import SimulatedBearingsSettings


def test_deleting_features_is_marginalising_them() -> None:
    """The other marginals stay as they are, to 1e-12, as elimination leaves them."""
    case = trial(2)
    estimator = HomingEkf(case.start, HomingEkfSettings())
    for image in case.tracks[:30]:
        estimator.update(image)
    state = estimator.state
    keep = np.ones(len(state.ids), np.bool_)
    keep[::3] = False
    left = state.keeping(keep)
    rows = np.concatenate([np.ones(7, np.bool_), np.repeat(keep, 2)])
    free = np.diagonal(state.covariance) > 0.0
    whole = np.linalg.inv(state.covariance[np.ix_(free, free)])
    a, b = rows[free], ~rows[free]
    schur = whole[np.ix_(a, a)] - whole[np.ix_(a, b)] @ np.linalg.solve(
        whole[np.ix_(b, b)], whole[np.ix_(b, a)]
    )
    kept_free = np.diagonal(left.covariance) > 0.0
    np.testing.assert_allclose(
        left.covariance[np.ix_(kept_free, kept_free)], np.linalg.inv(schur), atol=1e-12
    )
    np.testing.assert_array_equal(left.mean, state.mean[rows])


def test_states_without_variance_never_move() -> None:
    """Printed initial variances."""
    case = trial(4, SimulatedBearingsSettings(lost_per_s=0.0))
    estimator = PaperEkf(case.start, PaperEkfSettings())
    first = estimator.state
    for image in case.tracks[:20]:
        estimator.update(image)
    last = estimator.state
    kept = np.isin(first.ids, last.ids)
    np.testing.assert_array_equal(last.polar[:, 1], first.polar[kept, 1])
    variances = np.diagonal(first.covariance)[7::2]
    gauge = int(np.argmin(variances))
    assert variances[gauge] == 0.0
    assert np.count_nonzero(variances == 0.0) == 1
    assert kept[gauge]
    assert last.polar[np.flatnonzero(kept).tolist().index(gauge), 0] == first.polar[gauge, 0]


def test_motion_derivative() -> None:
    robot = np.array([0.3, -0.2, 0.7, 0.4])
    _, jacobian, spread = motion(robot, 0.2)
    for k in range(4):
        step = np.eye(4)[k] * 1e-6
        numeric = (motion(robot + step, 0.2)[0] - motion(robot - step, 0.2)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[:, k], numeric, atol=1e-9)
    half = np.sqrt(np.diagonal(motion(robot, 0.1)[2]) * 2.0)
    np.testing.assert_allclose(np.sqrt(np.diagonal(spread)), half)


@pytest.mark.parametrize("seen_from", [seen_from_robot, seen_from_target])
def test_derivatives_of_bearings(seen_from: Callable[..., Measured]) -> None:
    rng = np.random.default_rng(5)
    features, measured, sigma = 4, rng.uniform(-np.pi, np.pi, 4), np.full(4, 0.01)
    state = FilterState(np.arange(features), rng.uniform(0.5, 1.5, 7 + 2 * features), np.eye(15))
    jacobian = seen_from(state, measured, sigma).jacobian
    for k, step in enumerate(1e-6 * np.eye(len(state.mean))):
        before, after = (
            seen_from(replace(state, mean=state.mean + by), measured, sigma).innovation
            for by in (-step, step)
        )
        np.testing.assert_allclose(jacobian[:, k], wrap(before - after) / 2e-6, atol=1e-7)


def test_gate_keeps_gross_bearings_out() -> None:
    case = trial(9)
    clean = HomingEkf(case.start, HomingEkfSettings())
    gross = HomingEkf(case.start, HomingEkfSettings())
    naive = HomingEkf(case.start, HomingEkfSettings(gate_sigmas=0.0))
    for image in case.tracks[:20]:
        bearing = image.bearing.copy()
        bearing[3] = wrap(bearing[3] + 2.0)
        clean.update(image.select(np.arange(len(image)) != 3))
        wrong = replace(image, bearing=bearing)
        gross.update(wrong)
        naive.update(wrong)
    shift = np.abs(gross.state.mean[:3] - clean.state.mean[:3]).max()
    assert shift < 1e-2
    assert np.abs(naive.state.mean[:3] - clean.state.mean[:3]).max() > 5.0 * shift


# --------------------------------------------------------------------------------------------
# Averages


def round_start(
    n: int, robot: np.ndarray, target: np.ndarray
) -> tuple[HomingStart, TrackedBearings]:
    """Landmarks all around at one, far distance; exact bearings."""
    case = trial(1)
    angle = 2.0 * np.pi * (np.arange(n) + 0.3) / n
    points = 20.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    matches = replace(
        case.start.matches.select(np.zeros(n, np.int64)),
        bearing_a=bearings(np.zeros(3), points),
        bearing_b=bearings(target, points),
    )
    chart = LocalMap(np.arange(n), angle, np.full(n, 20.0), np.tile(np.eye(2), (n, 1, 1)))
    vector = TwoViewVector(0.0, 0.0, np.eye(2), np.ones(n, np.bool_), 0)
    none, sigma = np.full(n, np.nan), np.full(n, 0.01)
    image = TrackedBearings(1.0, np.arange(n), bearings(robot, points), sigma, none, none)
    return HomingStart(0.0, vector, chart, matches), image


@pytest.mark.parametrize("method", [AverageLandmarkVector, AverageDisplacement])
def test_averages_are_right_where_their_assumptions_hold(
    method: type[AverageLandmarkVector] | type[AverageDisplacement],
) -> None:
    robot, target = np.array([0.3, -0.2, 0.5]), np.array([0.9, 0.4, -0.3])
    start, image = round_start(40, robot, target)
    estimator = method(start)
    estimator.update(image)
    home = estimator.estimate().home()
    assert home.rotation == pytest.approx(-0.8, abs=1e-3)
    assert home.direction == pytest.approx(np.pi / 4 - 0.5, abs=0.02)
    assert np.isnan(home.covariance).all()


@pytest.mark.parametrize("method", [AverageLandmarkVector, AverageDisplacement])
def test_a_compass_takes_the_rotation_over(
    method: type[AverageLandmarkVector] | type[AverageDisplacement],
) -> None:
    robot, target = np.array([0.3, -0.2, 0.5]), np.array([0.9, 0.4, -0.3])
    start, image = round_start(40, robot, target)
    estimator = method(start)
    estimator.update(image, compass=-0.8)
    assert estimator.estimate().home().rotation == pytest.approx(-0.8)
    assert estimator.estimate().home().direction == pytest.approx(np.pi / 4 - 0.5, abs=0.02)


@pytest.mark.parametrize("broken", ["covariance", "solve"])
def test_a_filter_that_breaks_down_is_refused_and_stays(
    broken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A covariance that is no number is no estimate, and a failed solution no traceback."""
    case = trial(3)
    estimator = HomingEkf(case.start, HomingEkfSettings())
    estimator.update(case.tracks[0])
    before = estimator.state

    def spoilt(state: FilterState, *_: object) -> FilterState:
        if broken == "solve":
            raise np.linalg.LinAlgError("Singular matrix")
        return replace(state, covariance=np.full_like(state.covariance, np.nan))

    monkeypatch.setattr(ekf, "updated", spoilt)
    with pytest.raises(EstimatorError, match=r"filter.* at \d"):
        estimator.update(case.tracks[1])
    assert estimator.state is before


# --------------------------------------------------------------------------------------------
# The homing filters are the graph, linearised once, with past poses eliminated


TOLERANCE = 1e-11
JOINT, SEPARATE = HomingEkfSettings(gate_sigmas=0.0), PaperEkfSettings()


def robot(k: int) -> int:
    return int(gtsam.symbol("r", k))


TARGET = int(gtsam.symbol("t", 0))


def feature(identity: int) -> int:
    return int(gtsam.symbol("l", int(identity)))


@dataclass
class Linear:
    """A graph of whitened linear factors on absolute values."""

    graph: gtsam.GaussianFactorGraph

    def add(self, blocks: dict[int, FloatArray], value: FloatArray, sigma: float) -> None:
        """Sum of blocks times variables equals ``value`` up to ``sigma``."""
        unit = gtsam.noiseModel.Unit.Create(len(value))
        terms = [part for key, block in blocks.items() for part in (key, block / sigma)]
        self.graph.add(gtsam.JacobianFactor(*terms, value / sigma, unit))

    def marginalised(self, keys: list[int]) -> None:
        """Eliminates variables; what they leave behind replaces their factors."""
        ordering = gtsam.Ordering()
        for key in keys:
            ordering.push_back(key)
        if keys:
            _, self.graph = self.graph.eliminatePartialSequential(ordering, gtsam.EliminateQR)

    def solved(self, keys: list[int]) -> tuple[FloatArray, FloatArray]:
        """Mean and covariance of variables in the order given, which must be all."""
        ordering = gtsam.Ordering()
        for key in keys:
            ordering.push_back(key)
        root, right = self.graph.eliminateSequential(ordering, gtsam.EliminateQR).matrix()
        inverse = np.linalg.inv(root)
        return inverse @ right, inverse @ inverse.T


def joint_start(case: Trial, state: FilterState) -> Linear:
    """Vector, start bearings and target bearings, each once, linearised at the triangulation."""
    linear = Linear(gtsam.GaussianFactorGraph())
    vector = case.start.vector
    half = np.linalg.inv(np.linalg.cholesky(0.5 * (vector.covariance + vector.covariance.T)))
    mean = np.array([vector.direction, vector.rotation])
    linear.add({TARGET: half}, half @ mean, 1.0)
    target = state.mean[4:7]
    points = polar_points(state.polar)
    by_pose, by_point = bearing_jacobians(target_pose(target), points)
    by_target = (by_pose @ target_jacobian(target))[:, 1:]
    by_polar = np.einsum("ij,ijk->ik", by_point, polar_jacobians(state.polar))
    rows = np.searchsorted(case.start.local_map.ids, state.ids)
    for k, row in enumerate(rows.tolist()):
        polar, sigma = state.polar[k], case.start.matches.sigma[row]
        linear.add({feature(row): np.array([[0.0, 1.0]])}, polar[1:], float(sigma[0]))
        value = by_target[k] @ mean + by_polar[k] @ polar
        blocks = {TARGET: by_target[k][None], feature(row): by_polar[k][None]}
        linear.add(blocks, np.array([value]), float(sigma[2]))
    return linear


def map_start(state: FilterState) -> Linear:
    """Each feature's own prior; nothing without variance."""
    linear = Linear(gtsam.GaussianFactorGraph())
    for k, identity in enumerate(state.ids.tolist()):
        rows = free_rows(state, k)
        at = 7 + 2 * k + rows
        if len(rows):
            half = np.linalg.inv(np.linalg.cholesky(state.covariance[np.ix_(at, at)]))
            linear.add({feature(identity): half}, half @ state.mean[at], 1.0)
    return linear


def free_rows(state: FilterState, k: int) -> np.ndarray:
    """Which of a feature's (distance, bearing) have a variance at the start."""
    return np.flatnonzero(np.diagonal(state.covariance)[7 + 2 * k : 9 + 2 * k] > 0.0)


def run_both(case: Trial, joint: bool) -> tuple[FilterState, FloatArray, FloatArray]:
    """The filter's last state, and mean and covariance of the graph, of all that is not fixed."""
    state = initial_state(case.start) if joint else separate_initial_state(case.start)
    linear = joint_start(case, state) if joint else map_start(state)
    rows_of = {
        identity: np.arange(2) if joint else free_rows(state, k)
        for k, identity in enumerate(state.ids.tolist())
    }
    speed = INITIAL_SPEED
    linear.add({robot(0): np.eye(1)}, np.zeros(1), speed)
    time = case.start.time
    for k, image in enumerate(case.tracks):
        lost = np.setdiff1d(state.ids, image.ids)
        linear.marginalised([feature(i) for i in lost if len(rows_of[i])])
        state = state.keeping(~np.isin(state.ids, lost))
        step = image.time - time
        time = image.time
        moved, by, spread = motion(state.mean[:4], step)
        whiten = np.diag(np.diagonal(spread) ** -0.5)
        if k == 0:  # the start's pose is no variable
            by = by[:, 3:]
            value = moved - by @ state.mean[3:4]
        else:
            value = moved - by @ state.mean[:4]
        linear.add({robot(k): -whiten @ by, robot(k + 1): whiten}, whiten @ value, 1.0)
        state = predicted(state, step)
        rows = np.isin(image.ids, state.ids)
        seen = seen_from_robot(state, image.bearing[rows], image.sigma_bearing[rows])
        for m, identity in enumerate(state.ids.tolist()):
            at = 7 + 2 * m + rows_of[identity]
            by_robot, by_feature = seen.jacobian[m, :4], seen.jacobian[m, at]
            value = seen.innovation[m] + by_robot @ state.mean[:4] + by_feature @ state.mean[at]
            blocks = {robot(k + 1): by_robot[None]}
            if len(at):
                blocks[feature(identity)] = by_feature[None]
            linear.add(blocks, np.array([value]), float(np.sqrt(seen.variance[m])))
        state = updated(state, seen, 0.0)
        linear.marginalised([robot(k)])
    keys = [robot(len(case.tracks))] + ([TARGET] if joint else [])
    keys += [feature(i) for i in state.ids.tolist() if len(rows_of[i])]
    return state, *linear.solved(keys)


@pytest.mark.parametrize(
    ("kind", "settings"), [(HomingEkf, JOINT), (PaperEkf, SEPARATE)], ids=["corrected", "paper"]
)
def test_filter_is_the_graph_with_past_poses_eliminated(
    kind: type[HomingEkf], settings: HomingEkfSettings
) -> None:
    case = trial(5)
    joint = kind is HomingEkf
    state, mean, covariance = run_both(case, joint)
    estimator = kind(case.start, settings)
    for image in case.tracks:
        estimator.update(image)
    np.testing.assert_array_equal(estimator.state.mean[:4], state.mean[:4])
    free = np.diagonal(state.covariance) > 0.0
    if not joint:
        free[4:7] = False
    assert np.count_nonzero(free) == len(mean) > 20
    np.testing.assert_allclose(state.mean[free], mean, rtol=0.0, atol=TOLERANCE)
    np.testing.assert_allclose(
        state.covariance[np.ix_(free, free)], covariance, rtol=0.0, atol=TOLERANCE
    )


def test_printed_target_filter_counts_each_bearing_once_an_image() -> None:
    """It is the graph that has every target bearing as often as there were images."""
    case = trial(7)
    estimator = PaperEkf(case.start, SEPARATE)
    linear = Linear(gtsam.GaussianFactorGraph())
    first = estimator.state
    half = np.linalg.inv(np.linalg.cholesky(first.covariance[4:7, 4:7]))
    linear.add({TARGET: half}, half @ first.mean[4:7], 1.0)
    counted = 0
    for image in case.tracks:
        before = estimator.state.mean[4:7]
        estimator.update(image)
        now = estimator.state
        held = FilterState(
            now.ids, np.concatenate([now.mean[:4], before, now.mean[7:]]), now.covariance
        )
        rows = np.searchsorted(case.start.local_map.ids, now.ids)
        matches = case.start.matches
        seen = seen_from_target(held, matches.bearing_b[rows], matches.sigma[rows, 2])
        for m in range(len(rows)):
            by = seen.jacobian[m, 4:7]
            linear.add(
                {TARGET: by[None]},
                np.array([seen.innovation[m] + by @ before]),
                float(seen.variance[m]) ** 0.5,
            )
        counted += len(rows)
    mean, covariance = linear.solved([TARGET])
    np.testing.assert_allclose(estimator.state.mean[4:7], mean, rtol=0.0, atol=TOLERANCE)
    np.testing.assert_allclose(
        estimator.state.covariance[4:7, 4:7], covariance, rtol=0.0, atol=TOLERANCE
    )
    assert counted > 40 * len(case.start.matches)
