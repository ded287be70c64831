"""Judging trajectories of files and arrays: the API, several at once, and refusals with a mend."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from reports import loop

import fgslam as fg
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError, DatasetError
from fgslam.core.geometry import se3_exp
from fgslam.core.log import MeasurementLog
from fgslam.core.sensors import Increment, LoopClosure
from fgslam.core.types import Trajectory, pose_rows
from fgslam.factors.models import Position, Range
from fgslam.runs.judge import part_of

FRAMES = 80
SIGMA = np.repeat([0.004, 0.05], 3)
TRUTH = loop(FRAMES)


def located(seed: int = 0) -> Trajectory:
    """Each pose with an error of its own; the first one is exact."""
    errors = SIGMA * np.random.default_rng(seed).normal(size=(FRAMES, 6))
    errors[0] = 0.0
    return Trajectory(TRUTH.timestamps, TRUTH.poses @ np.array([se3_exp(-e) for e in errors]))


def covariances(factor: float = 1.0) -> FloatArray:
    out = np.tile(np.diag((factor * SIGMA) ** 2), (FRAMES, 1, 1))
    out[0] = 0.0
    return out


def written(path: Path, matrices: FloatArray, late_s: float = 0.0) -> Path:
    poses = located()
    upper = matrices[:, *np.triu_indices(6)]
    np.savetxt(path, np.column_stack([poses.timestamps + late_s, pose_rows(poses.poses), upper]))
    return path


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    TRUTH.save(tmp_path / "truth.tum")
    return tmp_path / "truth.tum"


def test_several_estimates_are_a_table_with_what_mends_each() -> None:
    given = {name: (located(k), covariances(factor)) for k, (name, factor) in enumerate(
        {"right": 1.0, "bold": 0.5}.items())}  # fmt: skip
    judged = fg.judge(given, TRUTH)
    table = judged.table()
    assert table.index.tolist() == ["right", "bold"]
    assert table.loc["right", "sigma_factor"] == pytest.approx(1.0, abs=0.1)
    assert table.loc["bold", "sigma_factor"] == pytest.approx(2.0, abs=0.2)
    assert table.verdict.tolist() == ["consistent", "overconfident"]
    mended = fg.judge((located(1), covariances(0.5 * table.loc["bold", "sigma_factor"])), TRUTH)
    assert mended.table().loc["estimate", "nees_pose"] == pytest.approx(1.0, abs=1e-9)


def test_a_file_gives_what_its_arrays_give_and_a_guess_is_marked(
    tmp_path: Path, truth: Path
) -> None:
    file = written(tmp_path / "vio.txt", covariances())
    arrays = fg.judge((located(), covariances()), TRUTH)
    guessed = fg.judge(file, truth)
    stated = fg.judge(file, truth, tangent="rotation_first,local")
    values = [one.table().nees_pose.iloc[0] for one in (arrays, guessed, stated)]
    assert values[0] == pytest.approx(values[2], abs=1e-6)
    assert values[0] == pytest.approx(values[1], abs=0.1)
    tables = [one.text_tables()[0].rows[0][0] for one in (arrays, guessed, stated)]
    assert tables == ["estimate", "vio (guess)", "vio"]
    assert any("rotation_first" in note and "guess" in note for note in guessed.notes)
    assert any("no joint covariances are known" in note for note in arrays.notes)


def test_the_figure_shows_the_error_and_three_stated_deviations() -> None:
    figure = fg.judge((located(), covariances()), TRUTH).plot()
    names = [trace.name or "" for trace in figure.data]
    assert any("3 sigma" in name for name in names)
    assert "estimate" in names


def test_a_robot_s_axes_are_taken_as_such_and_the_numbers_stay() -> None:
    plain = fg.judge((located(), covariances()), TRUTH)
    axes = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    robot = Trajectory(TRUTH.timestamps, located().poses @ axes.T)
    turned = fg.judge((robot, covariances()), TRUTH)
    assert any("x, y, z are z, -x, -y of the truth (guess)" in note for note in turned.notes)
    np.testing.assert_allclose(
        turned.table().nees_pose, plain.table().nees_pose, rtol=0.0, atol=1e-6
    )


def test_an_uncertain_first_pose_is_no_gauge() -> None:
    """Its own error, passed on to all, would make a right covariance look overconfident."""
    errors = SIGMA * np.random.default_rng(5).normal(size=(FRAMES, 6))
    errors[0] = 3.0 * SIGMA
    poses = TRUTH.poses @ np.array([se3_exp(-e) for e in errors])
    stated = np.tile(np.diag(SIGMA**2), (FRAMES, 1, 1))
    judged = fg.judge((Trajectory(TRUTH.timestamps, poses), stated), TRUTH)
    assert judged.table().loc["estimate", "nees_pose"] == pytest.approx(1.0, abs=0.15)
    assert any("its first pose is uncertain" in note for note in judged.notes)


def test_degrees_are_refused_and_accepted_as_told(tmp_path: Path, truth: Path) -> None:
    scale = np.repeat([np.degrees(1.0), 1.0], 3)
    file = written(tmp_path / "vio.txt", covariances() * np.outer(scale, scale))
    with pytest.raises(DatasetError, match="fit as degrees, not as radians") as refused:
        fg.judge(file, truth, tangent="rotation_first,local")
    advice = str(refused.value).partition("--tangent ")[2].split()[0]
    assert fg.judge(file, truth, tangent=advice).table().loc["vio", "sigma_factor"] < 1.1


def test_a_wrong_order_is_told_and_the_advice_mends_it(tmp_path: Path, truth: Path) -> None:
    file = written(tmp_path / "vio.txt", covariances())
    wrong = fg.judge(file, truth, tangent="translation_first,local")
    note = next(note for note in wrong.notes if "fits the errors far better" in note)
    right = fg.judge(file, truth, tangent=note.partition("--tangent ")[2])
    assert wrong.table().loc["vio", "nees_pose"] > 10.0
    assert right.table().loc["vio", "nees_pose"] == pytest.approx(1.0, abs=0.2)


def test_what_cannot_be_judged_is_refused_in_a_line(tmp_path: Path, truth: Path) -> None:
    file = written(tmp_path / "vio.txt", covariances())
    late = written(tmp_path / "late.txt", covariances(), late_s=1000.0)
    bare = tmp_path / "bare.tum"
    located().save(bare)
    with pytest.raises(
        DatasetError, match=r"late: from 1100.000 .* the truth from 100.000 .* clock"
    ):
        fg.judge(late, truth)
    with pytest.raises(
        DatasetError, match="bare: states no covariances; give them by --covariance"
    ):
        fg.judge(bare, truth)
    with pytest.raises(ConfigError, match=r"vio: is no run of fgslam.* give --truth FILE"):
        fg.judge(file)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text("name: drive")
    with pytest.raises(DatasetError, match="run: holds no results yet; resume the run first"):
        fg.judge(tmp_path / "run", truth)
    with pytest.raises(ConfigError, match="no word 'lokal'; use rotation_first"):
        fg.judge(file, truth, tangent="lokal")
    with pytest.raises(ConfigError, match="--covariance is of one estimate, and 2 are given"):
        fg.judge([file, late], truth, covariance=file)
    with pytest.raises(ConfigError, match=r"covariances of shape \(3, 6, 6\); give \(80, 6, 6\)"):
        fg.judge((located(), covariances()[:3]), TRUTH)


def test_landmarks_that_loops_merge_one_after_another_are_of_one_half() -> None:
    """Landmark 9 turned out to be 4, that to be 3; 6 is another one."""
    log, nothing = MeasurementLog(), Increment.of(0, 0.0, None)
    for k, pairs in enumerate([(), ((9, 4),), ((4, 3),)]):
        loops = [
            LoopClosure(0, np.eye(4), np.eye(6), nothing.observations, np.array([pair]))
            for pair in pairs
        ]
        ids = np.array([9, 4, 3, 6])
        log.append(
            replace(nothing, index=k, timestamp=float(k), missed_ids=ids, loops=tuple(loops))
        )
    halves = [part_of(log, half) for half in (0, 1)]
    assert [one.missed_ids.tolist() for one in halves[0]] == 3 * [[6]]
    assert [one.missed_ids.tolist() for one in halves[1]] == 3 * [[9, 4, 3]]
    assert [len(loop.merged) for one in halves[1] for loop in one.loops] == [1, 1]


def test_landmarks_of_other_sensors_are_divided_and_measured_poses_are_of_both_halves() -> None:
    log = MeasurementLog()
    ranges = Range().measured([[1.0], [2.0], [3.0]], [[0.01]], ids=[4, 7, 9])
    log.append(Increment.of(0, 0.0, None, [ranges, Position().measured([[0.0] * 3], np.eye(3))]))
    (even,), (odd,) = (part_of(log, half) for half in (0, 1))
    assert [one.measured[0].ids.tolist() for one in (even, odd)] == [[4], [7, 9]]
    assert even.measured[0].values.tolist() == [[1.0]]
    assert [len(one.measured[1]) for one in (even, odd)] == [1, 1]
