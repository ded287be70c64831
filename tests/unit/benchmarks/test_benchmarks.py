"""The benchmarks' runner, rows and pages; the measurements themselves are slow tests elsewhere."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

import benchmarks.__main__ as runner
from benchmarks.__main__ import EVIDENCE
from benchmarks.curves import IMAGES, PICTURES
from benchmarks.measured import keep, stored
from benchmarks.pages import PAGES, README, SUBJECTS, WIDTH, all_pages, fitted, page, readme
from benchmarks.rows import (
    RESULTS,
    RecordError,
    Relation,
    Row,
    load_record,
    shown_bound,
    shown_number,
)
from benchmarks.speed import homing, images, maps, parts, relocalising, ring, soak, starting, sweeps
from benchmarks.tables import Table
from fgslam.core.types import LandmarkAppearances, LandmarkMap


@pytest.mark.parametrize(
    ("relation", "measured", "met"),
    [
        ("<=", 5.0, True), ("<=", 5.1, False), ("<", 5.0, False), ("<", 4.9, True),
        (">=", 5.0, True), (">=", 4.9, False), (">", 5.0, False), (">", 5.1, True),
    ],
)  # fmt: skip
def test_row_is_met_by_its_relation(relation: Relation, measured: float, met: bool) -> None:
    assert Row("end", measured, "cm", relation, 5.0).met is met


def test_row_without_bound_is_neither_met_nor_missed() -> None:
    row = Row("landmarks", 3130)
    assert row.met is None
    assert (shown_number(row), shown_bound(row)) == ("3130", "")


def test_numbers_of_rows_are_shown_as_they_were_measured() -> None:
    assert shown_number(Row("ATE", 0.4, "cm")) == "0.4 cm"
    assert shown_number(Row("difference", 4e-12)) == "4e-12"
    assert shown_bound(Row("ATE", 0.4, "cm", "<", 2)) == "< 2 cm"


def test_wide_tables_are_turned_or_cut_and_keep_every_cell() -> None:
    columns = ("what", *(f"column number {k}" for k in range(20)))
    many = Table("wide", columns, [(f"row {r}", *range(100 * r, 100 * r + 20)) for r in range(9)])
    for table in (many, Table("one", columns, many.rows[:1])):
        lines = fitted(table)
        assert max(map(len, lines)) <= WIDTH
        text = "\n".join(lines)
        assert all(f" {cell} " in text for row in table.rows for cell in row)


def test_a_record_with_an_unknown_key_is_refused_with_its_file(tmp_path: Path) -> None:
    path = tmp_path / "odd.json"
    path.write_text(json.dumps({"title": "T", "version": "1", "date": "d", "sections": [{"x": 1}]}))
    with pytest.raises(RecordError, match=r"odd\.json.*'x'"):
        load_record(path)


def test_speed_writes_a_flat_map_of_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    name = "all_but_sift_over_sift"
    monkeypatch.setitem(parts.PARTS, "maps", lambda frames: {name: 0.25 + frames})
    out = tmp_path / "bench.json"
    asked = ["speed", "--part", "maps", "--frames", "3", "--out", str(out)]
    assert runner.main(asked) == 0
    assert json.loads(out.read_text()) == {name: 3.25}
    assert f"{parts.LIMITS[name]:g}" in capsys.readouterr().out


@pytest.mark.parametrize("name", sorted(EVIDENCE))
def test_every_name_prints_its_tables_and_writes_them(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    given: list[Path] = []

    def measured(data: Path) -> list[Table]:
        given.append(data)
        return [Table("T", ("what", "value"), [("a", 0.5)])]

    monkeypatch.setitem(EVIDENCE, name, measured)
    out = tmp_path / "t.json"
    assert runner.main([name, "--data", str(tmp_path), "--out", str(out)]) == 0
    assert given == [tmp_path]
    assert "| a | 0.500 |" in capsys.readouterr().out
    assert json.loads(out.read_text()) == {"T": {"what": ["a"], "value": [0.5]}}


def test_a_missing_recording_is_one_line_and_status_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert runner.main(["chess", "--data", str(tmp_path)]) == 2
    line = capsys.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("error: ")
    assert str(tmp_path) in line


def test_pages_of_results_are_those_of_the_committed_measurements() -> None:
    for name, text in all_pages().items():
        page = (PAGES / f"{name}.md").read_text(encoding="utf-8")
        assert page == text, f"stale page {name}: run python -m benchmarks pages"
    assert {path.stem for path in RESULTS.glob("*.json")} == {
        name for _, names in SUBJECTS.values() for name in names
    }
    assert {path.stem for path in PAGES.glob("*.md")} == set(all_pages())


@pytest.mark.parametrize("name", sorted(PICTURES))
def test_pictures_of_results_are_those_of_the_stored_measurements(
    name: str, tmp_path: Path
) -> None:
    PICTURES[name](tmp_path / name)
    now, kept = (cv2.imread(str(folder / name)) for folder in (tmp_path, IMAGES))
    assert now.shape == kept.shape, f"stale {name}: run python -m benchmarks pages"
    assert (np.abs(now.astype(int) - kept) > 32).mean() < 1e-4, f"stale picture {name}"


def test_numbers_in_readme_are_those_of_the_stored_measurements() -> None:
    text = README.read_text(encoding="utf-8")
    assert readme(text) == text, "stale numbers in README: run python -m benchmarks pages"
    kept = text.split("<!-- numbers:")[1].split("<!-- end of numbers -->")[0]
    assert "ORB-SLAM3" in kept
    others = re.findall(r"\d+[.,]?\d* (?:cm|mm|%)|NEES \d", text.replace(kept, ""))
    assert not others, "numbers of accuracy beside the table"


def test_lines_of_result_pages_fit() -> None:
    for name, text in all_pages().items():
        assert max(map(len, text.splitlines())) <= 120, name


def test_overview_counts_what_is_missed() -> None:
    rows = [row for path in RESULTS.glob("*.json") for row in load_record(path).rows]
    missed = sum(not row.met for row in rows)
    assert f"{len(rows)} bounds, {len(rows) - missed} met, {missed} missed" in " ".join(
        all_pages()["index"].split()
    )


@pytest.fixture
def measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the stored numbers of one run and of one set of tables."""
    run = tmp_path / "lab"
    run.mkdir()
    metrics = {"estimators": {"isam2": {"ate_rmse_m": 0.0123456, "update_ms": {"median": 3.0}}},
               "name": "lab", "frames": 3, "remark": None, "notes": ["a folder"]}  # fmt: skip
    (run / "metrics.json").write_text(json.dumps(metrics))
    tables = tmp_path / "seeds.json"
    tables.write_text(json.dumps({"Seeds": {"seed": [1, "worst"], "ATE cm": [-0.5, 2.0]}}))
    folder = tmp_path / "measured"
    folder.mkdir()
    monkeypatch.setattr("benchmarks.measured.MEASURED", folder)
    for path in (run, tables):
        keep(path)
    return folder


def test_of_a_run_its_repeatable_numbers_are_kept(measured: Path) -> None:
    assert stored("lab").numbers == {
        "estimators": {"isam2": {"ate_rmse_m": 0.0123456}},
        "frames": 3,
    }


def written(path: Path, section: dict[str, object]) -> Path:
    record = {"title": "T", "version": "1", "date": "2026-01-01", "sections": [section]}
    path.write_text(json.dumps(record))
    return path


def test_pages_compute_numbers_from_stored_measurements(measured: Path, tmp_path: Path) -> None:
    ate = "lab/estimators/isam2/ate_rmse_m"
    section = {
        "title": "S", "commands": ["measure"],
        "rows": [
            {"name": "ATE", "from": ate, "times": 100, "unit": "cm", "relation": "<", "bound": 1},
            {"name": "ratio", "from": ate, "over": ate, "relation": "<=", "bound": 1},
            {"name": "size", "from": "seeds/Seeds/ATE cm/0", "size": True},
            {"name": "written down", "measured": 7.25},
        ],
        "tables": [{"from": "seeds/Seeds", "columns": ["ATE cm", "seed"], "lines": [1]},
                   {"columns": ["", "cm"], "rows": [["lab", {"from": ate, "times": 100}]]}],
    }  # fmt: skip
    record = load_record(written(tmp_path / "page.json", section))
    rows = record.sections[0].rows
    assert [row.measured for row in rows] == [1.23456, 1.0, 0.5, 7.25]
    assert [row.met for row in rows[:2]] == [False, True]
    text = page("T", [record])
    assert "| ATE | 1.23 cm | < 1 cm, **missed** |" in text
    assert "| written down | 7.25 (by hand) |" in text
    assert "| 2.00 | worst |" in text
    assert record.sections[0].tables[0].rows == [(2.0, "worst")]
    assert "| lab | 1.23 |" in text
    assert "Computed from `benchmarks/measured`: `lab` (" in text
    assert "Measured by hand on 2026-01-01 with fgslam 1 unless stated otherwise." in text


def test_numbers_without_a_measurement_are_said_to_be_by_hand(tmp_path: Path) -> None:
    section = {"title": "S", "rows": [{"name": "ATE", "measured": 1.0}]}
    text = page("T", [load_record(written(tmp_path / "page.json", section))])
    assert "Measured by hand on 2026-01-01 with fgslam 1." in text
    assert "| ATE | 1 |" in text


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("lab/estimators/ekf", "has no 'ekf'"),
        ("lab/estimators", "is not a number"),
        ("seeds/Seeds/ATE cm/2", "has no '2'"),
        ("nothing/x", "no measurement .*nothing.json"),
    ],
)
def test_a_number_that_is_not_stored_is_refused(
    measured: Path, tmp_path: Path, path: str, message: str
) -> None:
    section = {"title": "S", "rows": [{"name": "ATE", "from": path}]}
    with pytest.raises(RecordError, match=message):
        load_record(written(tmp_path / "page.json", section))


def test_keep_without_a_measurement_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert runner.main(["keep"]) == 2
    assert runner.main(["keep", str(tmp_path / "none.json")]) == 2
    assert capsys.readouterr().err.count("error: ") == 2


def test_too_few_frames_over_images_are_refused_in_one_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    asked = ["speed", "--part", "images", "--frames", str(images.LEAST - 1)]
    assert runner.main(asked) == 2
    assert f"give {images.LEAST} or more" in capsys.readouterr().err


def test_a_building_holds_copies_of_a_map_of_any_size() -> None:
    one = LandmarkMap(np.arange(5), np.ones((5, 3)), np.zeros((5, 3, 3)))
    zeros = np.zeros(5)
    looks = LandmarkAppearances(
        one.ids, np.zeros((5, 128), np.uint8), zeros, zeros, np.zeros((5, 3))
    )
    driven = relocalising.Driven(one, looks, [], np.empty((0, 4, 4)), [])
    whole, every = relocalising.building(driven, 998)
    assert len(whole) == len(every) == 998
    rooms = np.unique(whole.positions, axis=0)
    assert len(rooms) == 200
    assert np.linalg.norm(rooms[:, None] - rooms, axis=2)[~np.eye(200, dtype=bool)].min() > 11.0


@pytest.mark.slow
@pytest.mark.parametrize("part", parts.PARTS)
def test_every_part_of_speed_ends_with_numbers(part: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the smallest size that it has."""
    for module, small in (
        (maps, {"SIZES": (1_000, 100_000), "FRAMES": 3}),
        (relocalising, {"SIZES": (1_000, 10_000), "FRAMES": 16, "ROUNDS": 1}),
        (homing, {"SEEDS": (0,), "IMAGES": 6, "REPEATS": 1}),
        (starting, {"_REPEATS": 1}),
    ):
        for name, value in small.items():
            monkeypatch.setattr(module, name, value)
    found = parts.measure(part, images.LEAST)
    assert found
    assert all(np.isfinite(value) for value in found.values())


@pytest.mark.slow
def test_a_soak_gives_time_and_memory_of_every_block() -> None:
    found = soak._trace(("landmark_kalman", 200, 50))
    blocks = [found[f"soak_landmark_kalman_{stop}_ms"] for stop in (50, 100, 150, 200)]
    assert min(blocks) > 0.0
    assert found["soak_landmark_kalman_ms_last_over_second_block"] == blocks[-1] / blocks[1]
    grown = found["soak_landmark_kalman_200_mb"] - found["soak_landmark_kalman_100_mb"]
    assert found["soak_landmark_kalman_kb_a_frame_second_half"] == pytest.approx(1e3 * grown / 100)


@pytest.mark.parametrize("frames", [100, 400, 1000, 10_000])
def test_a_street_of_any_length_is_a_ring_that_the_robot_is_carried_back_into(frames: int) -> None:
    course = ring.Course(frames, 0.8 * frames * 0.25, carries=ring.CARRIES)
    first_round = int(0.8 * frames)
    assert (np.diff(course.carried) > 0).all()
    assert frames - first_round < course.carried[0]
    assert course.carried[-1] < first_round
    start, back = course.at(np.array([0, first_round]))
    np.testing.assert_allclose(back, start, rtol=0, atol=1e-6)


def test_overhead_of_a_sweep_is_what_the_workers_had_less_what_the_cases_took() -> None:
    """20 cases of 80 ms, one every 50 ms by two workers, from 3 s after the start on."""
    took, came = np.full(20, 0.08), [3.0 + 0.05 * k for k in range(20)]
    found = sweeps.of_sweep("two", 2, 5.0, took, came)
    assert found["two_cases_a_second"] == pytest.approx(20.0, rel=0, abs=1e-9)
    assert found["two_overhead_ms"] == pytest.approx(2 * 50.0 - 80.0, rel=0, abs=1e-9)
    assert found["two_overhead_ms_in_all"] == pytest.approx(2 * 250.0 - 80.0, rel=0, abs=1e-9)
