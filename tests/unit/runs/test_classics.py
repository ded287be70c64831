"""Well-known data sets out of the installed GTSAM: numbers known from elsewhere, refusals."""

from __future__ import annotations

import pytest

from fgslam.core.errors import ConfigError
from fgslam.runs.classics import (
    CLASSICS,
    classics_notes,
    classics_table,
    require_classics,
    run_classic,
)


@pytest.mark.parametrize(
    ("name", "steps"),
    [("sphere2500", 120), pytest.param("city10000", 250, marks=pytest.mark.slow)],
)
def test_graphs_with_truth_are_judged(name: str, steps: int) -> None:
    """The covariances of both solvers hold their errors, and both come to one optimum."""
    online, batch = run_classic(name, steps)
    assert (online.estimator, batch.estimator) == ("isam2", "batch")
    assert online.poses == batch.poses == steps + 1
    for row in (online, batch):
        assert row.ate_m is not None
        assert row.nees is not None
        assert 0.0 < row.ate_m < 2.0
        assert 0.1 < row.nees < 2.5
    assert batch.chi_square is not None
    assert online.chi_square == pytest.approx(batch.chi_square, rel=0.1)


def test_ranges_that_are_scaled_locate_a_mower() -> None:
    """By odometry alone it is lost, as its turns are 5 % too small."""
    rows = {one.estimator: one for one in run_classic("plaza2", 400)}
    assert not any(one.why for one in rows.values())
    assert rows["odometry"].ate_m > 1.5
    for kind in ("ekf", "fixed_lag", "isam2", "batch"):
        assert rows[kind].ate_m < 0.6


def test_a_solver_that_is_not_asked_for_does_not_solve() -> None:
    for kind in ("isam2", "batch"):
        assert [one.estimator for one in run_classic("w10000", 40, [kind])] == [kind]


@pytest.mark.slow
def test_victoria_park_is_solved_to_the_known_optimum() -> None:
    """GTSAM's own example has an error of 2339.22, half the chi-square."""
    batch = next(one for one in run_classic("victoria_park") if one.estimator == "batch")
    assert batch.measurements == 10_608
    assert batch.chi_square == pytest.approx(2.0 * 2339.22, abs=0.1)
    assert batch.ate_m is None


@pytest.mark.slow
def test_stereo_tracks_go_through_all_that_fit() -> None:
    rows = list(run_classic("kitti00", 3))
    assert [one.estimator for one in rows][:2] == ["landmark_kalman", "fixed_lag"]
    assert all(one.poses == 3 and not one.why for one in rows)
    assert "the reference poses are estimates" in classics_notes(rows)[0]


def test_the_table_has_a_row_for_each_and_unknown_numbers_are_dashes() -> None:
    rows = list(run_classic("victoria_park", 30))
    table = classics_table(rows)
    assert [name for name, _ in table.rows] == [
        f"victoria_park {kind}"
        for kind in ("isam2", "batch", "ekf", "landmark_kalman", "sliding_window")
    ]
    assert table.rows[0][1][2] == "-"
    assert any("batch begins where isam2 ended" in note for note in classics_notes(rows))


def test_an_unknown_name_is_refused_with_those_that_are_known() -> None:
    require_classics(CLASSICS)
    with pytest.raises(ConfigError, match="no classic 'manhattan'; give victoria_park"):
        require_classics(["manhattan"])
