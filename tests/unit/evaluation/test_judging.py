"""Comparing estimators, paired tests, loop closures beside the truth."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from reports import landmark_map, loop
from scipy import stats
from simulated import RIG, Drive, simulate

from fgslam.backend.settings import DeadReckoningSettings, EkfSettings
from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.errors import ConfigError, DatasetError
from fgslam.core.geometry import inverse, se3_exp, transform_to_world
from fgslam.core.log import LandmarkTruth, MeasurementLog
from fgslam.core.sensors import Increment, LoopClosure, Observations
from fgslam.core.types import Estimate, LandmarkMap, Trajectory
from fgslam.evaluation.judging import (
    COLUMNS,
    Answer,
    Truth,
    compare,
    judge_answer,
    judge_closures,
    judge_replay,
    landmark_errors,
    lone_answer,
    mean_interval,
    paired_test,
)
from fgslam.evaluation.statistics import estimate_from_truth, pose_nees, time_growth
from fgslam.runs.library import replay
from fgslam.runs.report import LOOPS_FILE, closures_of, place_numbers, read_closures, write_closures
from fgslam.slam.results import RunRecorder


def estimate(shift_m: float, frames: int = 40) -> Estimate:
    """The loop with the later half of it shifted sideways, and a covariance of that size."""
    truth = loop(frames)
    poses = truth.poses.copy()
    poses[frames // 2 :, 0, 3] += shift_m
    covariances = np.tile(0.05**2 * np.eye(6), (frames, 1, 1))
    landmarks = landmark_map(12, np.random.default_rng(0))
    return Estimate(Trajectory(truth.timestamps, poses), covariances, landmarks)


def with_times(found: Estimate, update_ms: FloatArray) -> Answer:
    nothing = np.full(len(update_ms), np.nan)
    dof = np.zeros(len(update_ms), np.int64)
    return Answer(found, found.trajectory, found.covariances, nothing, dof, update_ms)


def test_each_estimator_has_a_row_in_the_order_given() -> None:
    table = compare({"worse": estimate(0.4), "better": estimate(0.1)}, loop(40), full=True)
    assert table.index.tolist() == ["worse", "better"]
    assert table.columns.tolist() == [name for name, _ in COLUMNS]
    assert table.loc["better", "ate_m"] == pytest.approx(table.loc["worse", "ate_m"] / 4, rel=0.05)
    assert table.loc["worse", "end_error_m"] == pytest.approx(0.4)
    assert table.loc["worse", "frames"] == 40
    assert table["failure"].tolist() == ["", ""]


def test_what_a_person_compares_fits_a_terminal() -> None:
    table = compare({"landmark_kalman": estimate(0.4), "isam2": estimate(0.1)}, loop(40))
    assert table.columns.tolist() == ["ate_m", "rpe_trans_m", "rpe_rot_deg", "nees", "ms"]
    assert max(map(len, table.to_string().splitlines())) <= 80


def test_a_failure_is_never_left_out() -> None:
    log = MeasurementLog(RIG, {}, simulate(Drive(frames=6), np.random.default_rng(4)).increments)
    answers = {
        "ends": replay(log, EkfSettings(max_landmarks=3)),
        "goes_on": replay(log, DeadReckoningSettings()),
    }
    with pytest.warns(UserWarning, match="ends ended early: frame ") as told:
        table = compare(answers)
    assert table.columns[-1] == "failure"
    assert str(told[0].message) == f"ends ended early: {table.loc['ends', 'failure']}"
    assert table.loc["goes_on", "failure"] == ""


def test_consistency_follows_the_size_of_the_error() -> None:
    table = compare({"sure": estimate(2.0), "right": estimate(0.05)}, loop(40), full=True)
    assert table["consistency"].tolist()[0] == "overconfident"
    assert table.loc["sure", "nees"] > 100.0 * table.loc["right", "nees"]


def test_times_and_online_poses_come_from_the_answer() -> None:
    answer = with_times(estimate(0.1), np.linspace(1.0, 40.0, 40))
    table = compare({"timed": answer, "untimed": estimate(0.1)}, loop(40), full=True)
    assert table.loc["timed", "ms"] == pytest.approx(20.5)
    assert table.loc["timed", "ate_online_m"] == pytest.approx(table.loc["timed", "ate_m"])
    assert np.isnan(table.loc["untimed", "ms"])
    assert np.isnan(table.loc["untimed", "ate_online_m"])


def test_a_bare_estimate_has_no_motions_on_the_way() -> None:
    motions = {1: np.tile(1e-4 * np.eye(6), (39, 1, 1))}
    found = dataclasses.replace(estimate(0.01), relative=motions, online_relative=motions)
    assert compare({"bare": found}, loop(40)).loc["bare", "ate_m"] < 0.01


def test_without_truth_the_errors_are_not_known() -> None:
    table = compare({"a": estimate(0.1)}, full=True)
    assert np.isnan(table.loc["a", "ate_m"])
    assert table.loc["a", "consistency"] == ""
    assert table.loc["a", "landmarks"] == 12


def test_landmarks_are_compared_with_their_true_positions() -> None:
    found = estimate(0.0)
    off = found.landmarks.positions + np.array([0.0, 0.0, 0.3])
    table = compare({"a": found}, loop(40), LandmarkTruth(found.landmarks.ids, off), full=True)
    assert table.loc["a", "landmark_rmse_m"] == pytest.approx(0.3)


def test_truth_of_another_frame_is_judged_as_its_own_tools_do(tmp_path: Path) -> None:
    """evo, on the exported left path and the data set's own file, gives the comparison's number."""
    found = estimate(0.3)
    turned = found.trajectory.poses @ se3_exp(np.array([0.0, 0.4, 0.1, 0.0, 0.0, 0.0]))
    found = dataclasses.replace(found, trajectory=Trajectory(found.trajectory.timestamps, turned))
    loop(40).of("left", RIG).save(tmp_path / "truth.tum")
    found.trajectory.of("left", RIG).save(tmp_path / "left.tum")
    truth = Trajectory.load(tmp_path / "truth.tum")
    table = compare({"a": found}, truth, truth_of="left", rig=RIG)
    assert table.loc["a", "ate_m"] == pytest.approx(evo_ape(tmp_path, "left.tum"), abs=1e-9)
    found.trajectory.save(tmp_path / "right.tum")
    assert abs(table.loc["a", "ate_m"] - evo_ape(tmp_path, "right.tum")) > 1e-3
    assert table.loc["a", "nees"] == pytest.approx(compare({"a": found}, loop(40)).loc["a", "nees"])
    # Its file states what it is of; a truth without rig is refused.
    assert compare({"a": found}, truth, rig=RIG).equals(table)
    with pytest.raises(
        ConfigError, match=r"the truth is wTl: pose of the left camera.*give the rig"
    ):
        compare({"a": found}, truth)


def test_verdicts_leave_out_a_truth_that_settles() -> None:
    """The first poses' truth is turned by 2 degrees: judged from there all else would be wrong."""
    found, true = estimate(0.0), loop(40)
    poses = true.poses.copy()
    poses[:4] = poses[:4] @ se3_exp(np.array([0.0, np.radians(2.0), 0.0, 0.0, 0.0, 0.0]))
    answer = with_times(found, np.ones(40))
    judged = judge_answer(answer, Truth(Trajectory(true.timestamps, poses))).metrics
    assert judged.more["truth_left_out"] == [0, 1, 2, 3]
    assert (judged.more["matched_poses"], judged.more["judged_poses"]) == (40, 36)
    assert judged.nees_pose_per_dof == pytest.approx(0.0, abs=1e-9)
    assert judged.end_error_m == pytest.approx(0.0, abs=1e-9)
    assert judged.more["remarks"][-1] == judged.more["truth_remark"]
    assert "truth of frames 0 to 3 is off by 2.0 degrees" in judged.more["truth_remark"]


@pytest.mark.parametrize("turned_deg", [0.0, 1.0])
def test_orientations_that_alone_contradict_the_truth_are_named(turned_deg: float) -> None:
    """Each true pose is turned in its place: lengths of motions stay as they are."""
    found, true, rng = estimate(0.0), loop(40), np.random.default_rng(0)
    turns = np.radians(turned_deg) * rng.normal(size=(40, 3))
    turns = np.array([se3_exp(np.concatenate([turn, np.zeros(3)])) for turn in turns])
    relative = {k: np.tile(0.001**2 * np.eye(6), (40 - k, 1, 1)) for k in (1, 5)}
    answer = with_times(dataclasses.replace(found, relative=relative), np.ones(40))
    truth = Truth(Trajectory(true.timestamps, true.poses @ turns))
    why = judge_answer(answer, truth).metrics.more["truth_remark"]
    assert ("the truth's orientations are off" in (why or "")) == (turned_deg > 0.0)


@pytest.mark.parametrize(
    ("kind", "ends", "online"),
    [
        ("odometry", [23, 19, 4], None),
        ("landmark_kalman", [23, 19, 4], [23, 19, 4]),
        ("batch", [23, 19, 4], [23, 19, 4]),  # on the way it is a landmark filter
        ("isam2", [23, 19, 4], [4, 4, 1]),  # solved every fifth frame
        ("fixed_lag", None, [23, 19, 0]),  # of ten frames
    ],
)
def test_motions_err_as_the_joint_covariances_of_both_poses_say(
    kind: str, ends: list[int] | None, online: list[int] | None
) -> None:
    drive = Drive(frames=24, points=70)
    simulated = simulate(drive, np.random.default_rng(5))
    log = MeasurementLog(RIG, {"kind": "recorded"}, simulated.increments)
    truth = Truth(Trajectory(log.timestamps, np.array(simulated.poses)))
    more = judge_replay(replay(log, kind), truth).metrics.more
    for items, found in ((ends, more["nees_relative"]), (online, more["online"]["nees_relative"])):
        if items is None:
            assert found == {}
            continue
        assert [(found[lag] or {"items": 0})["items"] for lag in ("1", "5", "20")] == items
        for lag in ("1", "5"):
            assert 0.4 < found[lag]["per_dof"] < 2.0
            assert 0.1 < found[lag]["lengths"] < 3.0


def test_lengths_of_motions_need_no_orientation_of_the_truth() -> None:
    simulated = simulate(Drive(frames=24, points=70), np.random.default_rng(5))
    log = MeasurementLog(RIG, {"kind": "recorded"}, simulated.increments)
    true, turned = np.array(simulated.poses), np.array(simulated.poses)
    turned[:, :3, :3] = turned[:, :3, :3] @ se3_exp(np.array([0.0, 0.1, 0.0, 0, 0, 0]))[:3, :3]
    found = replay(log, "landmark_kalman")
    right, wrong = (
        judge_replay(found, Truth(Trajectory(log.timestamps, poses))).metrics.more["nees_relative"]
        for poses in (true, turned)
    )
    assert wrong["5"]["per_dof"] > 10.0 * right["5"]["per_dof"]
    assert wrong["5"]["lengths"] == pytest.approx(right["5"]["lengths"], rel=1e-9)


def test_motions_of_the_left_camera_have_the_same_nees() -> None:
    simulated = simulate(Drive(frames=8, points=70), np.random.default_rng(5))
    log = MeasurementLog(RIG, {"kind": "recorded"}, simulated.increments)
    right, true = replay(log, "odometry").estimate, np.array(simulated.poses)
    left, left_true = right.of("left", RIG), Trajectory(log.timestamps, true).of("left", RIG).poses
    values = [
        pose_nees(inverse(p[:-5]) @ p[5:], one.relative[5], inverse(t[:-5]) @ t[5:]).values
        for one, t in ((right, true), (left, left_true))
        for p in (one.trajectory.poses,)
    ]
    np.testing.assert_allclose(values[1], values[0], rtol=1e-6)


def evo_ape(folder: Path, name: str) -> float:
    from evo.core import metrics, sync
    from evo.tools import file_interface

    files = (str(folder / one) for one in ("truth.tum", name))
    truth, path = sync.associate_trajectories(*map(file_interface.read_tum_trajectory_file, files))
    path.align(truth)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((truth, path))
    return float(ape.get_statistic(metrics.StatisticsType.rmse))


def test_what_is_no_result_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="filter: int is no estimator's result; give what replay"):
        compare({"filter": 3}, loop(40))  # type: ignore[dict-item]


ALIGNED = se3_exp(np.array([0.1, -0.2, 0.3, 1.0, 2.0, -3.0]))


def test_landmarks_are_compared_in_the_estimates_world(rng: np.random.Generator) -> None:
    true = rng.normal(size=(5, 3))
    errors = 0.1 * rng.normal(size=(5, 3))
    ids = np.array([1, 3, 5, 7, 9])
    landmarks = LandmarkMap(
        np.array([0, 1, 3, 5, 7, 9]),
        np.vstack([[[9.0, 9.0, 9.0]], transform_to_world(ALIGNED, true) + errors]),
        np.tile(0.04 * np.eye(3), (6, 1, 1)),
    )
    truth = LandmarkTruth(np.array([*ids, 11]), np.vstack([true, [[0.0, 0.0, 0.0]]]))
    found, nees = landmark_errors(landmarks, truth, ALIGNED)
    distances = np.linalg.norm(errors, axis=1)
    np.testing.assert_allclose(found, distances, atol=1e-12)
    np.testing.assert_allclose(nees.values, distances**2 / 0.04, atol=1e-9)
    assert nees.dof.tolist() == 5 * [3]
    path = Trajectory(np.arange(2.0), np.array([np.eye(4), np.eye(4)]))
    true_path = Trajectory(np.arange(2.0), inverse(ALIGNED) @ path.poses)
    answer = lone_answer(Estimate(path, np.full((2, 6, 6), np.nan), landmarks))
    more = judge_answer(answer, Truth(true_path, truth)).metrics.more
    assert more["landmark_rmse_m"] == pytest.approx(np.sqrt((distances**2).mean()))
    assert more["landmark_median_m"] == pytest.approx(np.median(distances))
    assert more["landmarks_with_truth"] == 5


def test_without_common_landmarks_nothing_is_known() -> None:
    none = LandmarkTruth(np.array([4]), np.zeros((1, 3)))
    landmarks = LandmarkMap(np.array([1]), np.zeros((1, 3)), np.eye(3)[None])
    found, nees = landmark_errors(landmarks, none, np.eye(4))
    assert (len(found), nees.per_dof) == (0, None)
    path = Trajectory(np.arange(1.0), np.eye(4)[None])
    answer = lone_answer(Estimate(path, np.full((1, 6, 6), np.nan), landmarks))
    more = judge_answer(answer, Truth(path, none)).metrics.more
    names = ("landmarks_with_truth", "landmark_rmse_m", "landmark_median_m")
    assert [more[name] for name in names] == [0, None, None]


def test_the_first_pose_aligns_the_worlds() -> None:
    poses = np.array([se3_exp(k * np.array([0.0, 0.1, 0.0, 0.0, 0.0, 1.0])) for k in range(4)])
    truth = Trajectory(np.arange(4.0), inverse(ALIGNED) @ poses)
    estimate = Trajectory(np.arange(4.0), poses)
    found = estimate_from_truth(estimate, truth)
    assert found is not None
    np.testing.assert_allclose(found, ALIGNED, atol=1e-12)
    late = Trajectory(np.arange(4.0) + 100.0, poses)
    assert estimate_from_truth(late, truth) is None


def test_growth_of_a_line_and_of_a_flat_time() -> None:
    frames = np.arange(1000.0)
    line = time_growth(2.0 + 0.01 * frames)
    assert line is not None
    assert line["slope_ms_per_1000"] == pytest.approx(10.0)
    # Medians lie in the middle of their fifths: frames 299.5 and 899.5.
    assert line["ratio"] == pytest.approx((2.0 + 8.995) / (2.0 + 2.995))
    flat = time_growth(np.full(1000, 3.0))
    assert flat is not None
    assert flat["ratio"] == 1.0
    assert flat["slope_ms_per_1000"] == pytest.approx(0.0, abs=1e-9)
    assert time_growth(np.ones(24)) is None
    assert time_growth(np.zeros(100)) is None


def test_the_interval_is_students(rng: np.random.Generator) -> None:
    values = rng.normal(3.0, 2.0, 20)
    found = mean_interval(np.append(values, np.nan))
    assert found is not None
    expected = stats.t.interval(0.95, 19, values.mean(), values.std(ddof=1) / np.sqrt(20))
    assert (found.mean, found.count) == (pytest.approx(values.mean()), 20)
    assert (found.lower, found.upper) == pytest.approx(expected)
    one = mean_interval(np.array([2.0]))
    assert one is not None
    assert (one.mean, one.lower, one.upper) == (2.0, None, None)
    assert mean_interval(np.array([np.nan])) is None


def test_pairs_are_compared_pair_by_pair(rng: np.random.Generator) -> None:
    b = rng.uniform(1.0, 2.0, 12)
    a = b - rng.uniform(0.1, 0.2, 12)
    a[0] = b[0] + 0.05
    a = np.append(a, [np.nan, 1.0])
    b = np.append(b, [1.0, np.nan])
    found = paired_test(a, b)
    assert found is not None
    assert (found.wins, found.losses, found.difference.count) == (11, 1, 12)
    assert found.p_value == pytest.approx(stats.wilcoxon(a[:12], b[:12]).pvalue)
    assert found.p_value is not None
    assert found.p_value < 0.01
    assert found.difference.upper is not None
    assert found.difference.upper < 0.0
    assert found.ratio == pytest.approx(a[:12].mean() / b[:12].mean())


def test_ties_are_no_evidence_of_a_difference() -> None:
    found = paired_test(np.ones(5), np.ones(5))
    assert found is not None
    assert (found.wins, found.losses, found.p_value) == (0, 0, None)
    assert paired_test(np.full(3, np.nan), np.ones(3)) is None


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
    assert pairs == ((11, 1),), "the drive from above shows what was closed"
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
    with pytest.raises(DatasetError, match="lacks column frame"):
        read_closures(tmp_path / LOOPS_FILE)
