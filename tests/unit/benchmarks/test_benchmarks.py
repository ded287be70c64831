"""The benchmarks' runner, rows and pages; the measurements themselves are slow tests elsewhere."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import benchmarks.__main__ as runner
from benchmarks.bounds import BOUNDS
from benchmarks.catalogue import EVIDENCE
from benchmarks.pages import PAGES, WIDTH, all_pages, fitted
from benchmarks.rows import (
    RESULTS,
    RecordError,
    Relation,
    Row,
    load_record,
    shown_bound,
    shown_number,
)
from benchmarks.speed import parts
from benchmarks.tables import Table


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
    monkeypatch.delitem(runner.BOUNDS, name, raising=False)
    out = tmp_path / "t.json"
    assert runner.main([name, "--data", str(tmp_path), "--out", str(out)]) == 0
    assert given == [tmp_path]
    assert "| a | 0.500 |" in capsys.readouterr().out
    written = json.loads(out.read_text())
    assert written["commands"] == [f"python -m benchmarks {name}"]
    assert written["tables"][0]["rows"] == [["a", 0.5]]


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
    assert {path.stem for path in RESULTS.glob("*.json")} | {"index"} == set(all_pages())
    assert {path.stem for path in PAGES.glob("*.md")} == set(all_pages())


def test_lines_of_result_pages_fit() -> None:
    for name, text in all_pages().items():
        assert max(map(len, text.splitlines())) <= 120, name


def test_overview_counts_what_is_missed() -> None:
    rows = [row for path in RESULTS.glob("*.json") for row in load_record(path).rows]
    missed = sum(not row.met for row in rows)
    assert f"{len(rows)} bounds, {len(rows) - missed} met, {missed} missed" in " ".join(
        all_pages()["index"].split()
    )


def test_bounds_of_the_paper_s_drive_are_read_from_its_tables() -> None:
    ends = Table("End pose", ("distance cm", "yaw deg", "ATE cm"), [(4.4, 0.3, None), (6, -0.6, 1)])
    columns = ("landmarks", "matched to the map: 5 %", "stereo precision")
    landmarks = Table("Landmarks and matches", columns, [(3590, "40", None), (2001, 39, 0.97)])
    rows = BOUNDS["paper_tables"]([ends, landmarks])
    assert [row.met for row in rows] == [False, False, True, False, True, True]


def test_bounds_of_the_seeds_take_the_worst() -> None:
    columns = ("seed", "ATE cm", "end cm", "yaw deg", "matched, 5 %", "landmarks", "precision")
    table = Table("seeds", columns, [
        (1, 0.1, 0.1, 0.1, 90, 9000, 1.0), ("worst", 2.0, 5.0, 0.6, 40, 2000, 0.97),
        ("bound", "a", "b", "c", "d", "e", "f"),
    ])  # fmt: skip
    assert [row.met for row in BOUNDS["seeds"]([table])] == [False, True, False, True, False, True]
