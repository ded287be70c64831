"""What is taken to be so of a recording: entries with their source, their option, and guesses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from bags import stereo, write_bag
from dataset_builders import HEIGHT, WIDTH, loose, picture, save, write_calibration

from fgslam.datasets.layouts import recognise_layout
from fgslam.datasets.ledger import PAIRING, Entry, as_values, of_values, rests_on_guess
from fgslam.datasets.opening import open_recording
from fgslam.runs.config import make_config
from fgslam.runs.report import on_guesses
from fgslam.runs.tables import page_tables


def ledger(given: Path, **changes: Any) -> dict[str, Entry]:
    keys = recognise_layout(given) | changes
    found = open_recording(make_config({"name": "x", "dataset": keys}, "test").dataset)  # type: ignore[arg-type]
    return {entry.what: entry for entry in found.ledger}


def test_times_are_stated_given_or_guessed(tmp_path: Path) -> None:
    root = loose(tmp_path, lambda k: (f"cam0/{k}.png", f"cam1/{k}.png"))
    assert ledger(root)["times"] == Entry("times", "even", "nothing states them", "--fps", True)
    assert ledger(root, fps=20.0)["times"].source == "--fps"
    (root / "times.txt").write_text("0.0\n0.1\n0.3\n", encoding="utf-8")
    assert ledger(root)["times"] == Entry("times", "stamps", str(root / "times.txt"), "--fps")


def test_a_unit_of_length_that_opencv_does_not_state_is_a_guess(tmp_path: Path) -> None:
    loose(tmp_path, lambda k: (f"cam0/{k}.png", f"cam1/{k}.png"))
    assert not ledger(tmp_path)["unit of length"].guessed
    matrix = [[30.0, 0.0, 15.5], [0.0, 30.0, 11.5], [0.0, 0.0, 1.0]]
    values = {"image_size": [WIDTH, HEIGHT], "R": np.eye(3).tolist(), "T": [-0.2, 0.0, 0.0]}
    values |= {f"M{k}": matrix for k in (1, 2)} | {f"D{k}": [0.01, 0, 0, 0, 0] for k in (1, 2)}
    (tmp_path / "calib.json").write_text(json.dumps(values), encoding="utf-8")
    found = ledger(tmp_path)
    assert found["unit of length"].guessed
    assert found["unit of length"].option == "--unit"
    assert found["lens model"].value == "radtan"
    assert not ledger(tmp_path, unit_m=0.5)["unit of length"].guessed


def test_the_unit_of_depth_is_a_guess_until_it_is_stated(tmp_path: Path) -> None:
    for k in range(3):
        save(tmp_path / "rgb" / f"{k}.png", np.dstack([picture(10 + k)] * 3))
        save(tmp_path / "depth" / f"{k}.png", np.full((HEIGHT, WIDTH), 2000, np.uint16))
    write_calibration(tmp_path)
    assert ledger(tmp_path)["unit of depth"].guessed
    found = ledger(tmp_path, depth_scale=1000.0)["unit of depth"]
    assert (found.value, found.guessed) == ("1000 units a metre", False)
    assert "unit of length" not in ledger(tmp_path)


def test_topics_are_guessed_or_named(tmp_path: Path) -> None:
    alone = ledger(write_bag(tmp_path / "one.bag", stereo()))["images"]
    assert alone.value == "/cam/left/image_raw is left, /cam/right/image_raw right"
    assert not alone.guessed
    two = stereo() + stereo(names=("/rear/left", "/rear/right"))
    bag = write_bag(tmp_path / "a.bag", two)
    assert ledger(bag)["images"].guessed
    named = ("/cam/left/image_raw", "/cam/right/image_raw")
    assert not ledger(bag, topics=named)["images"].guessed


def test_pairs_by_order_or_an_offset_are_guesses_and_entries_are_kept(tmp_path: Path) -> None:
    by_name = ledger(loose(tmp_path / "a", lambda k: (f"cam0/{k}.png", f"cam1/{k}.png")))[PAIRING]
    assert (by_name.value, by_name.guessed) == ("by name", False)
    late = loose(tmp_path / "b", lambda k: (f"left/a{k}.png", f"right/b{2 * k}c.png"))
    by_order = ledger(late)[PAIRING]
    assert by_order.guessed
    assert "guessed: left and right" in by_order.shown
    bag = write_bag(tmp_path / "late.bag", stereo(skew_ns=7_000_000_000))
    assert ledger(bag)[PAIRING].value == "by stamps less a constant offset"
    assert ledger(bag)[PAIRING].guessed
    stored = json.loads(json.dumps(as_values([by_order])))
    assert of_values(stored) == (by_order,)
    assert of_values(None) == of_values([{"what": 1}]) == ()


def test_figures_in_metres_rest_on_the_unit_and_angles_do_not() -> None:
    unit = Entry("unit of length", "1 m", "OpenCV states none", "--unit", guessed=True)
    order = Entry(PAIRING, "by their order", "names", guessed=True)
    assert rests_on_guess("12.34 cm", [unit])
    assert rests_on_guess("final ATE (cm)", [unit])
    assert not rests_on_guess("0.012 deg", [unit])
    assert not rests_on_guess("23 of 24 frames", [unit, order])
    assert rests_on_guess("yaw 0.01 deg", [order])
    assert not rests_on_guess("12.34 cm", [unit._replace(guessed=False)])


def test_columns_of_a_page_that_rest_on_a_guess_have_a_mark() -> None:
    known = {"ate_rmse_m": 0.1, "rpe_rot_deg": 0.2, "landmarks": 3}
    tables = page_tables({"landmark_kalman": known})
    unit = Entry("unit of length", "1 m", "OpenCV states none", "--unit", guessed=True)
    marked = [
        c.name for table in tables for c in on_guesses(table, [unit]).columns if "*" in c.name
    ]
    plain = [c.name for table in tables for c in table.columns]
    assert [name.removesuffix(" *") for name in marked] == [n for n in plain if "cm" in n]
    assert len(marked) > 0
    assert on_guesses(tables[0], [unit._replace(guessed=False)]) == tables[0]
