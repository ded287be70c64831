"""Committed numbers and what a comparison finds now."""

from __future__ import annotations

from pathlib import Path

import pandas
import pytest

from benchmarks.baseline import deviations, read_means, with_numbers

BASELINE = {
    "relative_tolerances": {"ate_final_m": 0.05, "nees_pose_final_per_dof": 0.1},
    "runs": {"lab": {"isam2": {"ate_final_m": 0.01, "nees_pose_final_per_dof": 1.5}}},
}


def found(ate: float | None = 0.01, nees: float = 1.5) -> dict[str, dict[str, float | None]]:
    return {"isam2": {"ate_final_m": ate, "nees_pose_final_per_dof": nees}}


@pytest.mark.parametrize(
    ("numbers", "worse"),
    [
        (found(), []),
        (found(0.0104, 1.6), []),
        (found(0.011), [True]),
        (found(0.005), [False]),
        (found(nees=1.0), [False]),
        (found(nees=0.5), [True]),
        (found(None), [True]),
        ({}, [True, True]),
    ],
)
def test_what_is_outside_its_tolerance_got_worse_or_better(
    numbers: dict[str, dict[str, float | None]], worse: list[bool]
) -> None:
    assert [one for one, _ in deviations(BASELINE, numbers)] == worse


def test_written_numbers_are_those_of_the_comparison() -> None:
    written = with_numbers(BASELINE, found(0.02, 1.2))
    assert list(deviations(written, found(0.02, 1.2))) == []
    assert written["runs"]["lab"]["isam2"]["ate_final_m"] == 0.02


def test_means_are_of_the_trials_that_ended_well(tmp_path: Path) -> None:
    table = {
        "estimator": ["isam2", "isam2", "isam2"],
        "ate_final_m": [0.01, 0.03, 9.0],
        "failure": [None, None, "frame 2: no"],
    }
    pandas.DataFrame(table).to_parquet(tmp_path / "results.parquet")
    assert read_means(tmp_path) == {"isam2": {"ate_final_m": pytest.approx(0.02)}}
