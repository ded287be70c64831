"""The homing filters: deletion, gauges, motion; the averages' assumptions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from homings import trial

from fgslam.backend.homing import ekf
from fgslam.backend.homing.ekf import FilterState, HomingEkf, motion
from fgslam.backend.homing.estimators import AverageDisplacement, AverageLandmarkVector
from fgslam.backend.homing.paper_ekf import PaperEkf
from fgslam.backend.homing.settings import HomingEkfSettings, PaperEkfSettings
from fgslam.core.errors import EstimatorError
from fgslam.core.homing import HomingStart, LocalMap, TrackedBearings, TwoViewVector
from fgslam.core.planar import bearings, wrap
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


def test_unit_leg_holds_the_leg() -> None:
    case = trial(4)
    estimator = HomingEkf(case.start, HomingEkfSettings())
    for image in case.tracks:
        estimator.update(image)
    assert estimator.state.mean[4] == 1.0
    assert np.hypot(*estimator.estimate().target[:2]) == pytest.approx(1.0, abs=1e-15)


def test_motion_derivative() -> None:
    robot = np.array([0.3, -0.2, 0.7, 0.4])
    _, jacobian, spread = motion(robot, 0.2)
    for k in range(4):
        step = np.eye(4)[k] * 1e-6
        numeric = (motion(robot + step, 0.2)[0] - motion(robot - step, 0.2)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[:, k], numeric, atol=1e-9)
    half = np.sqrt(np.diagonal(motion(robot, 0.1)[2]) * 2.0)
    np.testing.assert_allclose(np.sqrt(np.diagonal(spread)), half)


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
def test_a_filter_that_breaks_down_says_so_and_stays(
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
