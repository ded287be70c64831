"""Loop closures against the truth, and their way to file and report."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from simulated import RIG

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import DatasetError
from fgslam.core.estimates import Trajectory
from fgslam.core.measurement_log import MeasurementLog
from fgslam.core.measurements import Increment, LoopClosure, Observations
from fgslam.evaluation.judging import judge_closures
from fgslam.runs.tasks.slam_metrics import (
    LOOPS_FILE,
    closures_of,
    place_numbers,
    read_closures,
    write_closures,
)
from fgslam.slam.results import RunRecorder

COUNT = 12


def nothing_seen() -> Observations:
    none = np.empty(0, np.int64)
    return Observations(
        none, np.empty((0, 3)), np.empty((0, 3, 3)), np.empty((0, 3, 2)), np.empty(0, np.bool_)
    )


def closure(to: int, oTc: FloatArray) -> LoopClosure:
    return LoopClosure(to, oTc, np.eye(6), nothing_seen(), np.array([[7, 3]]))


def circle() -> FloatArray:
    """Round a circle of 2 m, back to the start."""
    angles = np.linspace(0.0, 2.0 * np.pi, COUNT)
    return np.array(
        [
            g.pose(
                g.so3_exp(np.array([0.0, a, 0.0])), 2.0 * np.array([1 - np.cos(a), 0, np.sin(a)])
            )
            for a in angles
        ]
    )


def drifted(poses: FloatArray) -> FloatArray:
    out = poses.copy()
    out[:, 0, 3] += np.linspace(0.0, 0.8, len(poses))
    return out


def test_error_before_and_after_a_true_closure_is_reported() -> None:
    true, before = circle(), drifted(circle())
    online = before.copy()
    online[-1] = true[-1]
    stamps = np.arange(COUNT, dtype=np.float64)
    found = judge_closures(
        [(COUNT - 1, closure(0, g.inverse(true[0]) @ true[-1]), True)],
        before,
        Trajectory(stamps, online),
        Trajectory(stamps, g.pose(g.so3_exp(np.ones(3)), np.ones(3)) @ true),
    )
    assert len(found) == 1
    assert found[0].false is False
    assert found[0].error_m == pytest.approx(0.0, abs=1e-9)
    assert found[0].before_m == pytest.approx(0.8)
    assert found[0].after_m == pytest.approx(0.0, abs=1e-9)
    assert found[0].correction_m == pytest.approx(0.8)
    assert found[0].merged == 1


def test_a_refused_closure_corrects_nothing() -> None:
    true, before = circle(), drifted(circle())
    stamps = np.arange(COUNT, dtype=np.float64)
    offered = [(COUNT - 1, closure(0, g.inverse(true[0]) @ true[-1]), False)]
    found = judge_closures(offered, before, Trajectory(stamps, before), Trajectory(stamps, true))
    assert not found[0].taken
    assert found[0].false is False, "it was a return all the same"
    assert found[0].before_m == pytest.approx(0.8)
    assert np.isnan(found[0].after_m)
    assert np.isnan(found[0].correction_m)
    assert found[0].merged == 0


@pytest.mark.parametrize(
    ("moved", "turned_deg", "false"), [(0.4, 0.0, False), (0.6, 0.0, True), (0.0, 11.0, True)]
)
def test_a_closure_far_from_the_truth_is_false(
    moved: float, turned_deg: float, false: bool
) -> None:
    true, stamps = circle(), np.arange(COUNT, dtype=np.float64)
    wrong = g.pose(g.so3_exp(np.array([0.0, np.deg2rad(turned_deg), 0.0])), np.array([0, 0, moved]))
    measured = closure(2, g.inverse(true[2]) @ true[-1] @ wrong)
    trajectory = Trajectory(stamps, true)
    assert judge_closures([(11, measured, True)], true, trajectory, trajectory)[0].false is false


def test_without_truth_nothing_is_called_false() -> None:
    true, stamps = circle(), np.arange(COUNT, dtype=np.float64)
    offered = [(11, closure(0, np.eye(4)), True)]
    found = judge_closures(offered, true, Trajectory(stamps, true), None)
    assert found[0].false is None
    assert np.isnan(found[0].before_m)


def recorded(loops: dict[int, tuple[LoopClosure, ...]]) -> RunRecorder:
    recorder = RunRecorder(MeasurementLog(RIG, {}))
    none = np.empty(0, np.int64)
    for k, wTc in enumerate(circle()):
        step = Increment(10 + k, float(k), None, nothing_seen(), np.empty(0, np.bool_), none, none)
        recorder.log.append(dataclasses.replace(step, loops=loops.get(k, ()), relocalised=k == 4))
        recorder.tracked_poses.append(wTc)
        recorder.online_poses.append(wTc)
    return recorder


def test_closures_of_a_run_come_back_from_their_file(tmp_path: Path) -> None:
    recorder = recorded({9: (closure(0, np.eye(4)),), 11: (closure(1, np.eye(4)),)})
    truth = Trajectory(np.arange(COUNT, dtype=np.float64), circle())
    closures = closures_of(recorder, (False, True), truth)
    assert place_numbers(recorder, closures) == {
        "closures": 1,
        "false_closures": 1,
        "refused_closures": 1,
        "relocalised": 1,
    }
    write_closures(tmp_path, recorder, closures)
    table, pairs = read_closures(tmp_path / LOOPS_FILE)
    assert pairs == [(11, 1)], "the drive from above shows what was closed"
    assert [title for title, _ in table.rows] == ["frame 19 (false)", "frame 21 (false)"]
    assert table.rows[0][1][:5] == ("no", "10", "0", "0", "-")
    assert table.rows[1][1][:5] == ("yes", "11", "0", "1", "0.0")
    after = [column.name for column in table.columns].index("error after (cm)")
    assert table.rows[0][1][after] == "-"
    assert table.rows[1][1][after] == "0.0"
    assert all(len(values) == len(table.columns) for _, values in table.rows)


def test_no_closure_leaves_no_file(tmp_path: Path) -> None:
    recorder = recorded({})
    closures = closures_of(recorder, (), None)
    (tmp_path / LOOPS_FILE).write_text("of an earlier run")
    write_closures(tmp_path, recorder, closures)
    assert not (tmp_path / LOOPS_FILE).exists()
    assert place_numbers(recorder, closures)["false_closures"] == 0


def test_a_foreign_table_is_refused(tmp_path: Path) -> None:
    (tmp_path / LOOPS_FILE).write_text("a,b\n1,2\n")
    with pytest.raises(DatasetError, match="not a table of closed loops"):
        read_closures(tmp_path / LOOPS_FILE)
