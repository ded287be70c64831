"""Estimators side by side as one plotly figure."""

from __future__ import annotations

import dataclasses

import numpy as np
from reports import landmark_map, loop

from fgslam.core.types import Estimate, Trajectory
from fgslam.evaluation.judging import Answer
from fgslam.report.figures import plot

FRAMES = 40


def estimate(shift_m: float) -> Estimate:
    truth = loop(FRAMES)
    poses = truth.poses.copy()
    poses[1:, 0, 3] += shift_m
    covariances = np.tile(0.05**2 * np.eye(6), (FRAMES, 1, 1))
    landmarks = landmark_map(30, np.random.default_rng(0))
    return Estimate(Trajectory(truth.timestamps, poses), covariances, landmarks)


def timed(found: Estimate) -> Answer:
    nothing, dof = np.full(FRAMES, np.nan), np.zeros(FRAMES, np.int64)
    online, times = found.trajectory, np.linspace(1.0, 40.0, FRAMES)
    return Answer(found, online, found.covariances, nothing, dof, times)


def test_paths_errors_nees_and_times_have_a_panel_each() -> None:
    figure = plot({"a": timed(estimate(0.1)), "b": timed(estimate(0.2))}, loop(FRAMES))
    axes = {trace.yaxis for trace in figure.data}
    assert axes == {"y", "y2", "y3", "y4"}
    titles = [figure.layout[f"yaxis{k}"].title.text for k in ("", 2, 3, 4)]
    assert titles == ["ahead (m)", "position error (m)", "NEES per degree of freedom", "time (ms)"]
    errors = next(t for t in figure.data if t.yaxis == "y2" and t.name.startswith("b, final"))
    np.testing.assert_allclose(errors.y[1:], 0.2, atol=1e-6)


def test_the_legend_names_each_estimator_and_the_truth_once() -> None:
    figure = plot({"a": timed(estimate(0.1)), "b<i>": timed(estimate(0.2))}, loop(FRAMES))
    shown = [(t.name, t.legendgroup) for t in figure.data if t.showlegend]
    assert shown == [("a", "a"), ("b&lt;i&gt;", "b<i>"), ("truth", "truth")]
    colours = {t.legendgroup: t.line.color for t in figure.data if t.showlegend}
    assert len(set(colours.values())) == 3


def test_unknown_quantities_have_no_panel() -> None:
    figure = plot({"a": estimate(0.1)})
    assert {trace.yaxis for trace in figure.data} == {"y", "y2"}  # claims stay without a truth
    assert not [t for t in figure.data if t.name == "truth"]
    blind = dataclasses.replace(estimate(0.1), covariances=np.full((FRAMES, 6, 6), np.nan))
    assert {trace.yaxis for trace in plot({"a": blind}).data} == {"y"}
