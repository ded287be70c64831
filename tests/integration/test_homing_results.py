"""What docs/results states, held to its bounds. Slow: minutes."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fgslam.runs.config import load_experiment
from fgslam.runs.run import run_experiment

pytestmark = pytest.mark.slow
EXPERIMENTS = Path(__file__).parents[2] / "experiments"


def metrics_of(name: str, out: Path, *overrides: str) -> dict[str, Any]:
    config = load_experiment(EXPERIMENTS / f"{name}.yaml", (*overrides, "output.pictures=0"))
    run_experiment(config, out, "refuse", lambda what, done, total: None, lambda: False)
    values = json.loads((out / "metrics.json").read_text(encoding="utf-8"))
    assert isinstance(values, dict)
    return values


@pytest.mark.data
def test_pairs_of_real_panoramas(shared_data: Path, tmp_path: Path) -> None:
    folder = shared_data / "omni_home"
    if not folder.is_dir():
        pytest.skip(f"no recording {folder}: this test needs it")
    values = metrics_of("homing_panoramas", tmp_path / "run", f"dataset.path={folder}")
    errors = values["errors"]
    assert values["pairs"] == 120
    assert values["answered"] >= 1.5 * values["reference"]["answered"]
    assert values["answered"] >= 36
    assert errors["direction_median_deg"] <= 1.1
    assert errors["rotation_median_deg"] <= 0.45
    assert errors["direction_worst_deg"] <= 6.0
    assert errors["worse_than_10_deg"] == 0
    assert errors["covered_direction_2_sigma"] >= 0.9
    assert errors["covered_rotation_2_sigma"] >= 0.9


def test_a_path_in_the_rendered_house(tmp_path: Path) -> None:
    values = metrics_of("path_following", tmp_path / "run", "trials=2")
    assert values["arrived"] == 2
    assert values["pass_distance_max_m"] <= 0.2


def test_a_robot_whose_mirror_is_calibrated_wrongly_comes_home(tmp_path: Path) -> None:
    wrong = ("dataset.calibration.mirror=0.05", "dataset.calibration.centre_px=4")
    exact = metrics_of("homing_lab", tmp_path / "exact", "trials=2")
    values = metrics_of("homing_lab", tmp_path / "wrong", "trials=2", *wrong)
    assert values["arrived"] == 2
    assert values["pass_distance_max_m"] <= 0.3
    assert values["pass_distance_max_m"] != exact["pass_distance_max_m"]


def test_a_robot_beside_its_path_is_on_it_after_a_leg(tmp_path: Path) -> None:
    aside = ("trials=2", "dataset.path.legs=2", "start_offset_m=1.5")
    values = metrics_of("path_following", tmp_path / "run", *aside)
    assert values["arrived"] == 2
    # The second target is the last: the robot stops where 7 % of the leg of 2 m are left.
    assert values["pass_distance_median_m"] <= 0.12
