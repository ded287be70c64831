"""Made-up homing pages: a straight homing past a few features, as a run's page would get it."""

from __future__ import annotations

import numpy as np

from fgslam.core.bearings import HomingEstimate, HomingTruth
from fgslam.report.content import Column, Page, TextTable
from fgslam.report.homing_figures import (
    Drive,
    Line,
    catchment_figure,
    claimed_against_true,
    curve_figure,
    drive_figure,
    local_map_figure,
)

FEATURES = np.array([[0.5, 0.8], [1.2, -0.6], [-0.3, 0.9], [0.7, -1.1]])
LEG_M = 2.0


def estimates(count: int = 9) -> list[HomingEstimate]:
    """A robot that drives straight to its target; feature 2 is lost half way."""
    covariance = np.diag([1e-3, 2e-3, 1e-3, 0.0, 4e-3, 2e-3])
    found = []
    for k in range(count):
        kept = np.arange(4) if k < count // 2 else np.array([0, 1, 3])
        found.append(
            HomingEstimate(
                time=0.5 * k,
                robot=np.array([k / count, 0.01, 0.02]),
                target=np.array([1.0, 0.0, 0.1]),
                covariance=covariance,
                ids=kept,
                landmarks=FEATURES[kept],
                landmark_covariances=np.tile(1e-3 * np.eye(2), (len(kept), 1, 1)),
            )
        )
    return found


def truth(count: int = 9) -> HomingTruth:
    robots = np.column_stack([LEG_M * np.arange(count) / count, np.zeros((count, 2))])
    return HomingTruth(np.array([LEG_M, 0.0, 0.1]), robots, LEG_M * FEATURES)


def drive() -> Drive:
    """Two legs around a corner."""
    n = 40
    along = np.linspace(0.0, 4.0, n)
    x, y = np.minimum(along, 2.0), np.maximum(along - 2.0, 0.0)
    heading = np.where(along < 2.0, 0.0, np.pi / 2)
    legs = (along >= 2.0).astype(np.int64)
    headings = np.where(np.arange(n) < 3, np.nan, heading + 0.1)
    targets = np.array([[2.0, 0.0, 0.0], [2.0, 2.0, np.pi / 2]])
    walls = (np.array([[-1.0, -1.0], [3.5, -1.0], [3.5, 3.0]]), np.array([[0.0, 1.0], [1.0, 1.0]]))
    times = np.asarray(0.1 * np.arange(n), np.float64)
    return Drive(times, np.column_stack([x, y, heading]), legs, headings, targets, walls)


def page(title: str = "homing_lab") -> Page:
    """One of everything."""
    time = np.linspace(0.0, 4.0, 30)
    curve = curve_figure(
        ("direction", "Error of the home direction", "Against the truth."),
        [Line("homing_graph", 0, time, 2.0 / (1.0 + time)), Line("homing_ekf", 1, time, time)],
        ("time (s)", "error (degrees)"),
    )
    sigma = {"direction": np.linspace(0.2, 2.0, 20)}
    error = {"direction": np.linspace(-1.0, 3.0, 20)}
    angle = np.linspace(0.0, 6.0, 12)
    offsets = np.column_stack([np.cos(angle), np.sin(angle)]) * (1.0 + angle[:, None])
    return Page(
        title=title,
        subtitle="task homing",
        headline=("2 of 2 targets were reached.",),
        tables=(
            TextTable(
                "estimators",
                "Estimators",
                "estimator",
                (Column("direction deg", "median error of the home direction"),),
                (("homing_graph", ("0.51",)), ("homing_ekf", ("-",))),
            ),
        ),
        figures=(
            local_map_figure(estimates(), truth()),
            drive_figure(drive()),
            curve,
            claimed_against_true(sigma, error),
            catchment_figure(offsets, np.hypot(*offsets.T) < 4.0, [f"seed {k}" for k in range(12)]),
        ),
        config_yaml="task: homing\n",
        versions={"fgslam": "0"},
    )
