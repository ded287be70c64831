"""Figures of SLAM: what they draw, what waits for a click, and what their notes add."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from reports import estimator_report, full_report, landmark_map, loop, without_truth

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import so3_exp
from fgslam.core.types import Estimate, Trajectory
from fgslam.evaluation.judging import Answer
from fgslam.report.content import Figure, level_axes
from fgslam.report.figures import (
    Detail,
    calibration_over_time,
    cost_by_stage,
    drive_along,
    drive_from_above,
    error_by_axis,
    error_over_time,
    map_to_turn,
    nees_over_time,
    noise_over_time,
    plot,
)
from fgslam.report.results import ReportData


def named(figure: Figure, name: str) -> Any:
    return next(trace for trace in figure.drawing.data if trace.name == name)


def shown(figure: Figure) -> set[str]:
    return {trace.name for trace in figure.drawing.data if trace.visible is True}


def with_values(data: ReportData, **values: Any) -> ReportData:
    """The same with every estimator's values replaced."""
    changed = tuple(dataclasses.replace(e, **values) for e in data.estimators if not e.failure)
    return dataclasses.replace(data, estimators=changed)


def two(sigma_m: float, covariances: FloatArray | None = None) -> ReportData:
    """A good estimator, and one with these errors and these claims."""
    rng, truth = np.random.default_rng(2), loop(60)
    good = estimator_report("good", truth, rng, sigma_m=0.005)
    other = estimator_report("other", truth, rng, sigma_m=sigma_m)
    if covariances is not None:
        other = dataclasses.replace(other, covariances=covariances)
    return ReportData("", "", estimators=(good, other), truth=truth)


# --------------------------------------------------------------------------------------------
# The drive and the map


def test_ellipses_hold_three_sigma_of_the_covariance_turned_into_the_world() -> None:
    """A pose turned by 90 degrees: its own z axis, with the large sigma, is the world's x."""
    pose = np.eye(4)
    pose[:3, :3] = so3_exp(np.array([0.0, np.pi / 2, 0.0]))
    covariance = np.diag([9.0, 9.0, 9.0, 0.01**2, 0.02**2, 0.5**2])
    both = {"final_poses": np.stack([pose] * 2), "covariances": np.stack([covariance] * 2)}
    ellipse = named(drive_from_above(with_values(full_report(2), **both)), "isam2, 3 sigma")
    assert np.nanmax(ellipse.x) == pytest.approx(3 * 0.5, rel=0.01)
    assert np.nanmax(ellipse.y) == pytest.approx(3 * 0.01, rel=0.01)


def test_scales_start_so_that_the_best_can_be_seen() -> None:
    """Next to dead reckoning, errors are logarithmic and ellipses of true size at first."""
    similar, unlike = two(0.008), two(0.15)
    assert error_over_time(similar).drawing.layout.yaxis.type == "linear"
    factor = re.search(r"Ellipses are drawn (\d+) times larger", drive_from_above(similar).note)
    assert factor is not None
    widths = [widest_ellipse(drive_from_above(data)) for data in (similar, unlike)]
    assert widths[1] > 0.0
    assert widths[0] == pytest.approx(int(factor[1]) * widths[1])
    assert error_over_time(unlike).drawing.layout.yaxis.type == "log"
    assert "larger" not in drive_from_above(unlike).note
    assert {"good, 3 sigma", "other, 3 sigma"} <= shown(drive_from_above(unlike))


def widest_ellipse(figure: Figure) -> float:
    x = np.asarray(named(figure, "good, 3 sigma").x, np.float64)
    outlines = np.split(x, np.flatnonzero(np.isnan(x)))
    return max(float(np.ptp(one[np.isfinite(one)])) for one in outlines if np.isfinite(one).any())


def test_ellipses_that_would_hide_the_view_wait_until_asked_for() -> None:
    figure = drive_from_above(two(0.02, np.tile(4.0 * np.eye(6), (60, 1, 1))))
    assert "larger" in figure.note  # as the good one alone needs it
    assert "good, 3 sigma" in shown(figure)
    assert "other, 3 sigma" not in shown(figure)


def test_covariances_that_are_not_known_have_no_ellipse() -> None:
    data = with_values(full_report(), covariances=np.full((60, 6, 6), np.nan))
    assert not len(named(drive_from_above(data), "isam2, 3 sigma").x)
    assert np.isnan(data.estimators[0].position_sigma_m).all()


def test_large_maps_and_long_runs_are_thinned_with_a_note() -> None:
    data = full_report(frames=300, landmarks=900)
    assert "evenly spread" not in drive_from_above(data).note
    above = drive_from_above(data, Detail(poses=100, dots_above=500))
    assert "100 of up to 300 poses and 500 of up to 900 landmarks" in above.note
    assert len(named(above, "isam2, final").x) == 100
    assert len(named(above, "landmarks of isam2").x) == 500


def test_far_landmarks_lie_outside_the_map() -> None:
    data = full_report(landmarks=400)
    positions = data.estimators[1].landmarks.positions.copy()
    positions[:3] = [900.0, 0.0, 900.0]
    landmarks = dataclasses.replace(data.estimators[1].landmarks, positions=positions)
    far = with_values(data, landmarks=landmarks)
    low, high = drive_from_above(far).drawing.layout.xaxis.range
    assert high - low < 15.0
    assert named(map_to_turn(far), "landmarks of isam2").x.max() < 15.0
    assert re.search(r"outside the box, not drawn: up to \d+\.", map_to_turn(far).note)


def test_the_map_of_the_best_estimator_is_shown_first() -> None:
    assert full_report().best == 1
    assert without_truth(full_report()).best == 0
    assert ReportData("t", "", estimators=()).best == 0
    landmarks = {name for name in shown(map_to_turn(full_report())) if "landmarks" in name}
    assert landmarks == {"landmarks of isam2"}


@pytest.mark.parametrize("draw", [drive_from_above, map_to_turn])
def test_poses_that_no_landmark_measured_are_marked(draw: Any) -> None:
    predicted = np.arange(60) == 7
    data = full_report()
    (mark,) = [t for t in draw(with_values(data, predicted=predicted)).drawing.data
               if t.name == "isam2, predicted poses"]  # fmt: skip
    assert mark.x[0] == pytest.approx(data.estimators[1].final_poses[7, 0, 3], abs=1e-6)
    marked = drive_from_above(with_values(data, predicted=predicted)).description
    assert "no landmark measured" in marked
    assert "no landmark measured" not in drive_from_above(data).description


def test_closures_lead_from_the_frame_to_the_place_that_it_recognised() -> None:
    data = dataclasses.replace(full_report(), closures=((50, 3),))
    line = named(drive_from_above(data), "loops closed")
    ends = data.estimators[0].final_poses[[50, 3], 0, 3]
    np.testing.assert_allclose(line.x[:2], ends, atol=1e-6)


# --------------------------------------------------------------------------------------------
# Curves over time


def test_errors_along_the_axes_are_those_of_the_level_world() -> None:
    data = two(0.02, np.tile(1e-4 * np.eye(6), (60, 1, 1)))
    assert data.truth is not None
    poses = data.truth.poses.copy()
    poses[1:, 1, 3] -= 0.02  # the world's y points down
    moved = dataclasses.replace(data.estimators[1], final_poses=poses)
    figure = error_by_axis(dataclasses.replace(data, estimators=(moved,)))
    lines = {t.yaxis: t for t in figure.drawing.data if "rmse" in t.name}
    np.testing.assert_allclose(lines["y3"].y[1:], 2.0, atol=1e-5)  # up, in centimetres
    np.testing.assert_allclose(lines["y"].y, 0.0, atol=1e-5)
    bands = {t.yaxis: t for t in figure.drawing.data if t.name == "3 sigma"}
    assert np.abs(bands["y3"].y).max() == pytest.approx(3.0, rel=1e-5)  # of 1 cm each


def test_nees_of_exact_poses_is_left_out_of_a_logarithmic_axis() -> None:
    data = full_report()
    nees = data.estimators[0].nees.copy()
    nees[:4] = 0.0
    figure = nees_over_time(with_values(data, nees=nees))
    assert np.isnan(named(figure, "isam2").y[:4]).all()
    assert "0.07 to 3.12" in figure.description


def test_bands_that_differ_name_their_estimators() -> None:
    data = full_report()
    first, second, _ = data.estimators
    wide = dataclasses.replace(second, nees_band=(0.21, 2.41))
    words = nees_over_time(dataclasses.replace(data, estimators=(first, wide))).description
    assert f"(0.07 to 3.12 of {first.title}; 0.21 to 2.41 of {second.title})" in words


def test_noise_is_drawn_where_it_is_known_each_kind_with_its_unit() -> None:
    noise: Mapping[str, FloatArray] = {
        "rotation_sigma_dps2": np.r_[np.nan, np.linspace(100.0, 5.0, 19)],
        "translation_sigma_mps2": np.full(20, 0.4),
        "gyroscope_factor": np.full(20, np.nan),
        "match_factor": np.ones(20),
        "single_factor": np.full(20, 0.9),
        "correlated_factor": np.full(20, 2.5),
    }
    figure = noise_over_time(with_values(full_report(20), noise=noise))
    layout = figure.drawing.layout
    titles = [layout[axis].title.text for axis in sorted(layout) if "yaxis" in axis]
    assert titles == [
        "rotation (deg/s\u00b2)",
        "translation (m/s\u00b2)",
        "matches (\u00d7 stated)",
        "graph (\u00d7 stated)",
    ]
    drawn = named(figure, "isam2, rotation").y
    np.testing.assert_allclose(drawn, noise["rotation_sigma_dps2"], rtol=1e-6)
    assert named(figure, "isam2, weighed by").yaxis == "y4"
    assert named(figure, "isam2, single measurement").yaxis == "y4"
    assert not figure.note
    still = noise_over_time(with_values(full_report(20), noise={"match_factor": np.ones(20)}))
    assert still.note.startswith("No noise of a motion model is shown")


def test_the_calibration_is_drawn_with_its_band() -> None:
    changes = [f"left_{name}" for name in ("yaw_deg", "pitch_deg", "roll_deg", "focal_percent")]
    found = {"timestamp": np.array([1.0, 2.0]), "knocks": np.array([0.0, 1.0])}
    found |= {name: np.array([0.1, 0.2]) for name in changes}
    found |= {f"{name}_sigma": np.array([0.02, 0.01]) for name in changes}
    figure = calibration_over_time(found, 1.0)
    band, line = figure.drawing.data[:2]
    assert len(figure.drawing.data) == 8
    np.testing.assert_allclose(line.y, [0.1, 0.2], rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(band.y, [0.16, 0.23, 0.17, 0.04], rtol=0.0, atol=1e-6)
    assert "moved 1 times" in figure.note


# --------------------------------------------------------------------------------------------
# Estimators side by side

FRAMES = 40


def estimate(shift_m: float) -> Estimate:
    truth = loop(FRAMES)
    poses = truth.poses.copy()
    poses[FRAMES // 2 :, 0, 3] += shift_m
    covariances = np.tile(0.05**2 * np.eye(6), (FRAMES, 1, 1))
    landmarks = landmark_map(30, np.random.default_rng(0))
    return Estimate(Trajectory(truth.timestamps, poses), covariances, landmarks)


def timed(found: Estimate) -> Answer:
    nothing, dof = np.full(FRAMES, np.nan), np.zeros(FRAMES, np.int64)
    online, times = found.trajectory, np.linspace(1.0, 40.0, FRAMES)
    return Answer(found, online, found.covariances, nothing, dof, times)


def test_paths_errors_nees_and_times_have_a_panel_each_and_one_legend() -> None:
    figure = plot({"a": timed(estimate(0.1)), "b<i>": timed(estimate(0.2))}, loop(FRAMES))
    assert {trace.yaxis for trace in figure.data} == {"y", "y2", "y3", "y4"}
    titles = [figure.layout[f"yaxis{k}"].title.text for k in ("", 2, 3, 4)]
    assert titles == ["ahead (m)", "position error (m)", "NEES per degree of freedom", "time (ms)"]
    errors = next(t for t in figure.data if t.yaxis == "y2" and t.name == "b&lt;i&gt;, final")
    np.testing.assert_allclose(errors.y[FRAMES // 2 :], 0.2, atol=1e-6)
    entries = [(t.name, t.legendgroup) for t in figure.data if t.showlegend]
    assert entries == [("a", "a"), ("b&lt;i&gt;", "b<i>"), ("truth", "truth")]
    colours = {t.legendgroup: t.line.color for t in figure.data if t.showlegend}
    assert len(set(colours.values())) == 3


def test_unknown_quantities_have_no_panel() -> None:
    figure = plot({"a": estimate(0.1)})
    assert {trace.yaxis for trace in figure.data} == {"y", "y2"}  # claims stay without a truth
    assert not [t for t in figure.data if t.name == "truth"]
    blind = dataclasses.replace(estimate(0.1), covariances=np.full((FRAMES, 6, 6), np.nan))
    assert {trace.yaxis for trace in plot({"a": blind}).data} == {"y"}


# --------------------------------------------------------------------------------------------
# Along the drive


def test_the_slider_is_where_the_paths_are() -> None:
    data = dataclasses.replace(full_report(60), views={0: b"first", 30: b"middle"})
    drive = drive_along(data)
    assert drive is not None
    first = data.estimators[0]
    np.testing.assert_allclose(drive.seconds, first.timestamps - data.start)
    world = drive.places[0] @ level_axes(data.up)
    np.testing.assert_allclose(world, first.final_poses[:, :3, 3], atol=1e-12)
    assert np.isnan(drive.places[2]).all()  # the one that failed
    assert drive.views == {0: b"first", 30: b"middle"}


def test_a_long_drive_is_moved_along_in_few_steps() -> None:
    data = dataclasses.replace(full_report(1000), views={0: b"first", 999: b"last"})
    drive = drive_along(data)
    assert drive is not None
    assert len(drive.seconds) == drive.places.shape[1] == 300
    assert drive.views == {0: b"first", 299: b"last"}
    assert drive_along(ReportData("t", "", estimators=())) is None


def test_cost_by_stage_holds_all_but_waiting() -> None:
    stages = {
        "timestamp": 10.0 + np.arange(4.0),
        "wait": np.full(4, 50.0),
        "sift": np.array([40.0, 0.0, 0.0, 0.0]),
        "track": np.full(4, 5.0),
        "places": np.zeros(4),
    }
    figure = cost_by_stage(stages, 10.0)
    assert [trace.name for trace in figure.drawing.data] == [
        "SIFT features, 10.0 ms",
        "tracking, matching, motion, 5.0 ms",
    ]
    np.testing.assert_allclose(figure.drawing.data[0].x, np.arange(4.0))
    assert figure.note == "median of all together 5 ms, longest 45 ms"
