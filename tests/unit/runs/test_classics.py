"""Well-known data sets out of the installed GTSAM: numbers known from elsewhere, refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fgslam.core.errors import ConfigError, DatasetError
from fgslam.runs.classics import (
    CLASSICS,
    classics_notes,
    classics_table,
    require_classics,
    run_classic,
    run_classics,
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


@pytest.mark.slow  # tests/contract holds the lag to batch on a linear problem
def test_ranges_that_are_scaled_locate_a_mower() -> None:
    """By odometry alone it is lost, as its turns are 5 % too small."""
    rows = {one.estimator: one for one in run_classic("plaza2", 400)}
    assert not any(one.why for one in rows.values())
    assert rows["odometry"].ate_m > 1.5
    for kind in ("ekf", "fixed_lag", "isam2", "batch"):
        assert rows[kind].ate_m < 0.6
    assert rows["fixed_lag"].nees < 1.5 * rows["batch"].nees  # what is stiff informs of no more


def write_barcodes(folder: Path, rng: np.random.Generator) -> Path:
    """A folder of UTIAS MRCLAM: one robot, twice round among eight landmarks, and another robot."""
    corners = 4.0 * np.array([(x, y) for x in (-1, 0, 1) for y in (-1, 0, 1) if x or y])
    speed, turn, end = 0.4, 0.2, 60.0
    times = 1.288e9 + np.arange(0.0, end, 0.05)
    heading = turn * (times - times[0])
    x, y = speed / turn * np.sin(heading), speed / turn * (1.0 - np.cos(heading))
    course = np.column_stack([times, x, y, (heading + np.pi) % (2.0 * np.pi) - np.pi])
    noisy = np.array([speed, turn]) + 0.06 * rng.standard_normal((len(times), 2))
    seen = []
    for k in range(3, len(times), 10):
        for code, place in [*zip(range(60, 68), corners, strict=True), (5, np.zeros(2))]:
            ahead, left = place - course[k, 1:3]
            bearing = np.arctan2(left, ahead) - heading[k]
            if np.cos(bearing) > 0.0:
                spread = rng.normal(size=2) * [0.05, 0.02]
                seen.append((times[k] + 0.01, code, np.hypot(ahead, left), bearing))
                seen[-1] = (*seen[-1][:2], *(seen[-1][2:] + spread))
    codes = [(1, 5), *zip(range(6, 14), range(60, 68), strict=True)]
    truth = np.column_stack([np.arange(6, 14), corners, np.full((8, 2), 1e-4)])
    tables = {
        "Barcodes": codes, "Landmark_Groundtruth": truth, "Robot2_Groundtruth": course,
        "Robot2_Odometry": np.column_stack([times, noisy]), "Robot2_Measurement": seen,
    }  # fmt: skip
    for name, rows in tables.items():
        np.savetxt(folder / f"{name}.dat", rows, fmt="%.4f", header="as published")
    return folder / "Robot2_Measurement.dat"


def test_barcodes_of_utias_locate_a_robot(tmp_path: Path, rng: np.random.Generator) -> None:
    path = write_barcodes(tmp_path, rng)
    require_classics([str(path)])
    rows = {one.estimator: one for one in run_classic(str(path), 30)}
    assert not any(one.why for one in rows.values())
    assert rows["batch"].poses == 30
    assert rows["batch"].classic == "Robot2_Measurement.dat"
    for kind in ("ekf", "batch"):
        assert rows[kind].ate_m < 0.85 * rows["odometry"].ate_m
        assert rows[kind].nees < 4.0


def test_barcodes_without_a_landmark_are_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    path = write_barcodes(tmp_path, rng)
    path.write_text("1288000001.0 5 2.0 0.1\n")  # another robot
    with pytest.raises(DatasetError, match=r"sees no landmark .* truth last; take all five"):
        run_classic(str(path))


def test_a_solver_that_is_not_asked_for_does_not_solve() -> None:
    for kind in ("isam2", "batch"):
        assert [one.estimator for one in run_classic("w10000", 40, [kind])] == [kind]


def test_several_come_in_their_order_and_a_stop_begins_no_more() -> None:
    told: list[tuple[str, int, int]] = []

    def tell(*what: object) -> None:
        told.append(what)

    names = ["w10000", "city10000", "sphere2500"]
    rows = run_classics(names, 30, ["batch"], 1, tell, lambda: len(told) > 3)
    assert [one.classic for one in rows] == names[:2]
    assert told[:3] == [("w10000", 0, 1), ("w10000", 1, 1), ("city10000", 0, 1)]


@pytest.mark.slow
def test_workers_find_what_one_process_does() -> None:
    both = []
    for jobs in (1, 2):
        rows = run_classics(
            ["plaza2", "w10000"], 40, ["isam2"], jobs, lambda *_: None, lambda: False
        )
        both.append([replace(one, step_ms=None, worst_ms=None) for one in rows])
    assert both[0] == both[1]


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


@pytest.mark.parametrize("name", ["Robot1_Measurement.dat", "folder/manhattan.g2o"])
def test_a_file_that_is_absent_is_named_as_such(name: str) -> None:
    with pytest.raises(ConfigError, match=f"^{name}: no such file; give the path"):
        require_classics([name])
