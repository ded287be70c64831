"""Pairs: truth of direction and rotation, errors, coverage, and the columns of pairs.csv."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from fgslam.core.arrays import FloatArray
from fgslam.core.bearings import Refusal, RefusalReason, TwoViewVector
from fgslam.runs.tasks.homing_views import (
    PairAnswer,
    answer_numbers,
    error_numbers,
    error_tables,
    pair_errors,
    true_pair,
    write_pairs,
)

SIGMA = np.deg2rad(1.0)


def vector(direction: float, rotation: float, sigma: float = SIGMA) -> TwoViewVector:
    inliers = np.array([True, True, False])
    return TwoViewVector(direction, rotation, sigma**2 * np.eye(2), inliers, 0)


def test_the_true_pair_is_counter_clockwise_from_the_heading_of_the_first() -> None:
    ahead_left = true_pair(np.array([1.0, 1.0, np.pi / 2]), np.array([1.0, 3.0, np.pi]))
    np.testing.assert_allclose(ahead_left, (0.0, np.pi / 2), atol=1e-12)
    left = true_pair(np.array([0.0, 0.0, 0.0]), np.array([0.0, 2.0, -0.3]))
    np.testing.assert_allclose(left, (np.pi / 2, -0.3), atol=1e-12)


def test_errors_wrap_and_are_judged_by_the_stated_covariance() -> None:
    poses = np.array([[0.0, 0.0, 0.0], [-2.0, 1e-9, 0.1]])  # straight behind: +-180 degrees
    found = vector(-np.pi + 2.0 * SIGMA, 0.1)
    errors = pair_errors([PairAnswer(0, 1, found, 9)], poses, ("a", "b"))
    np.testing.assert_allclose(errors.direction, 2.0, atol=1e-6)
    np.testing.assert_allclose(errors.mahalanobis2, 4.0, atol=1e-5)
    numbers = error_numbers(errors)
    assert numbers["answered"] == 1
    assert numbers["same_room"] == {"answered": 0}
    assert numbers["different_rooms"]["answered"] == 1


def noisy_answers(scale: float, count: int = 4000) -> tuple[list[PairAnswer], FloatArray]:
    rng = np.random.default_rng(7)
    poses = np.column_stack([rng.normal(size=(2 * count, 2)), rng.uniform(-3, 3, 2 * count)])
    answers = []
    for k in range(count):
        direction, rotation = true_pair(poses[2 * k], poses[2 * k + 1])
        d, r = scale * SIGMA * rng.standard_normal(2)
        answers.append(PairAnswer(2 * k, 2 * k + 1, vector(direction + d, rotation + r), 9))
    return answers, poses


def test_coverage_is_right_for_honest_errors_and_low_for_overconfident_ones() -> None:
    honest = error_numbers(pair_errors(*noisy_answers(1.0)))
    assert honest["covered_joint_95"] == pytest.approx(0.95, abs=0.012)
    assert honest["covered_direction_2_sigma"] == pytest.approx(0.9545, abs=0.012)
    assert honest["nees_per_dof"] == pytest.approx(1.0, abs=0.06)
    assert "same_room" not in honest
    bold = error_numbers(pair_errors(*noisy_answers(2.0)))
    assert bold["covered_joint_95"] < 0.6


def test_shares_are_shown_as_percentages_and_what_is_not_known_as_a_dash() -> None:
    answers = []
    for k, sigmas in enumerate((0.0, 1.0, 0.5, 9.0)):  # three within the region, one far out
        answers.append(PairAnswer(2 * k, 2 * k + 1, vector(sigmas * SIGMA, 0.0), 9))
    poses = np.zeros((8, 3))
    poses[1::2, 0] = 1.0
    (table,) = error_tables(error_numbers(pair_errors(answers, poses, ("a",) * 8)))
    column = [column.name for column in table.columns].index("covered joint 95 %")
    cells = {name: cells[column] for name, cells in table.rows}
    assert list(cells.values()) == ["75.0 %", "75.0 %", "-"]  # all, of one room, of different ones


def test_refusals_are_counted_by_reason_and_written_with_them(tmp_path: Path) -> None:
    few = Refusal(RefusalReason.TOO_FEW_MATCHES, "2 matches, of 8 needed")
    here = Refusal(RefusalReason.AT_TARGET, "median parallax 0.1 degrees", rotation=np.pi / 6)
    answers = [
        PairAnswer(0, 1, vector(0.5, -0.25), 9),
        PairAnswer(0, 2, few, 2),
        PairAnswer(1, 2, here, 40),
    ]
    numbers = answer_numbers(answers)
    assert numbers["pairs"] == 3
    assert numbers["answered"] == 1
    assert numbers["refused"] == {"at_target": 1, "too_few_matches": 1}
    write_pairs(tmp_path / "pairs.csv", answers, ("2", "3", "4"))
    text = (tmp_path / "pairs.csv").read_text(encoding="utf-8")
    assert text.splitlines()[0] == (
        "from,to,answered,direction_deg,sigma_direction_deg,rotation_deg,sigma_rotation_deg,"
        "inliers,reason"
    )
    rows = list(csv.DictReader(text.splitlines()))
    assert [(r["from"], r["to"], r["answered"], r["reason"]) for r in rows] == [
        ("2", "3", "true", ""),
        ("2", "4", "false", "too_few_matches"),
        ("3", "4", "false", "at_target"),
    ]
    assert float(rows[0]["direction_deg"]) == pytest.approx(np.rad2deg(0.5))
    assert float(rows[0]["sigma_rotation_deg"]) == pytest.approx(1.0)
    assert rows[0]["inliers"] == "2"
    assert rows[1]["direction_deg"] == rows[1]["rotation_deg"] == ""
    assert float(rows[2]["rotation_deg"]) == pytest.approx(30.0)


def test_no_answer_at_all_has_numbers_too() -> None:
    few = Refusal(RefusalReason.TOO_FEW_INLIERS, "none")
    answers = [PairAnswer(0, 1, few, 12)]
    assert answer_numbers(answers)["inliers_median"] is None
    assert error_numbers(pair_errors(answers, np.zeros((2, 3)), ("a", "a")))["answered"] == 0
