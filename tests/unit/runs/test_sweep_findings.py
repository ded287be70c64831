"""What a sweep says: tables of cases, means, paired tests and their correction; its journal."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest

from fgslam.core.errors import ConfigError
from fgslam.evaluation.judging import holm
from fgslam.runs.sweeps.case import CaseResult, Row
from fgslam.runs.sweeps.findings import find
from fgslam.runs.sweeps.grid import Case, Grid, Source, read_axes
from fgslam.runs.sweeps.journal import Journal
from fgslam.runs.sweeps.page import comparison_tables, sentences, write_sweep_page
from fgslam.runs.sweeps.running import RunningMeans
from fgslam.runs.sweeps.table import TABLE_FILE, SweepTable, make_table

SOURCE = Source("drive", {"name": "drive"}, "drive")
SEEDS = 8


def test_holm_is_as_worked_out_by_hand() -> None:
    # Sorted 0.005, 0.01, 0.03, 0.04: times 4, 3, 2, 1, none below the one before.
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02], abs=1e-15)
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


def result(seed: int, gate: float) -> CaseResult:
    """Estimator b is better than a by 1 in each world; the gate of 3 better than that of 2 by 5."""
    world = math.sin(seed)
    rows = [
        Row(name, {"kind": name, "ate_final_m": 10.0 + world + off - 5.0 * (gate - 2.0)}, {"ms": 1})
        for name, off in (("a", 1.0), ("b", 0.0))
    ]
    return CaseResult(0.1, tuple(rows))


def given(case: Case) -> CaseResult:
    return result(case.place[0], 2.0 + case.place[1])


@pytest.fixture
def grid() -> Grid:
    return Grid((SOURCE,), read_axes([f"seed=0:{SEEDS}", "m.gate=2,3"]))


def table_of(grid: Grid, failing: int = -1) -> SweepTable:
    return make_table(
        grid,
        (
            (
                case,
                "it fell" if case.number == failing else result(case.place[0], 2 + case.place[1]),
            )
            for case in grid
        ),
    )


def test_the_table_opens_in_pandas_with_settings_metrics_and_failures(
    grid: Grid, tmp_path: Path
) -> None:
    table_of(grid, failing=3).write(tmp_path, grid)
    found = pandas.read_parquet(tmp_path / TABLE_FILE)
    assert len(found) == 2 * len(grid) - 1
    assert list(found.columns) == [
        *("case", "experiment", "seed", "m.gate", "estimator", "kind", "ate_final_m", "failure")
    ]
    assert found["seed"].dtype == np.int64
    failed = found[found.failure.notna()]
    assert (failed.case.item(), failed.seed.item(), failed.failure.item()) == (3, 1, "it fell")
    assert np.isnan(failed.ate_final_m.item())
    first = (tmp_path / TABLE_FILE).read_bytes()
    table_of(grid, failing=3).write(tmp_path, grid)
    assert (tmp_path / TABLE_FILE).read_bytes() == first


def test_variants_are_compared_over_the_seeds_that_both_have(grid: Grid) -> None:
    found = find(table_of(grid, failing=3), grid)
    assert found is not None
    assert [variant.label for variant in found.variants] == [
        *("gate=2 a", "gate=2 b", "gate=3 a", "gate=3 b")
    ]
    assert found.axes == ("m.gate",)
    by_pair = {(one.a, one.b): one for one in found.comparisons}
    assert len(by_pair) == 6
    one = by_pair["gate=2 a", "gate=3 b"]
    assert one.test.difference.count == SEEDS - 1
    assert one.test.difference.mean == pytest.approx(6.0, abs=1e-12)
    # All 7 pairs on one side: an exact p of 2 / 2^7; the smallest of six is that of
    # all 8 pairs, so these are times 5 and above 0.05; with all 8 pairs in each they are below.
    assert one.test.p_value == pytest.approx(2.0 / 2**7, abs=1e-12)
    assert one.p_value == pytest.approx(5 * 2.0 / 2**7, abs=1e-12)
    assert one.better == ""
    whole = find(table_of(grid), grid)
    assert whole is not None
    assert {(c.a, c.b): c.better for c in whole.comparisons}["gate=2 a", "gate=3 b"] == "gate=3 b"


def test_a_metric_without_numbers_is_refused(grid: Grid) -> None:
    with pytest.raises(
        ConfigError, match="--metric kind: no column of numbers; known: ate_final_m"
    ):
        find(table_of(grid), grid, "kind")
    assert find(make_table(grid, iter([(grid[0], "it fell")])), grid) is None


def test_an_estimator_that_gave_up_is_in_no_mean(grid: Grid) -> None:
    lost = CaseResult(0.1, (Row("a", {"ate_final_m": 0.0, "failure": "lost"}, {}),))
    found = find(make_table(grid, iter([(grid[0], lost), (grid[2], result(1, 2.0))])), grid)
    assert found is not None
    variant = found.variants[0]
    assert (variant.label, variant.failures) == ("gate=2 a", 1)
    assert list(variant.values["ate_final_m"].values()) == [11.0 + math.sin(1)]


def test_the_page_says_what_the_table_says(grid: Grid, tmp_path: Path) -> None:
    found = find(table_of(grid), grid)
    lines = sentences(found, len(grid), len(grid), 0)
    assert lines[0] == "16 of 16 cases done"
    assert "gate=3 b" in lines[1]
    assert lines[2].startswith("6 of 6 paired comparisons differ")
    means, pairs = comparison_tables(found)
    assert next(name for name, _ in means.rows) == "gate=2 a"
    assert len(pairs.rows) == 6
    path = tmp_path / "report.html"
    write_sweep_page(path, lines, {7: "it <fell>"}, found, "axes: {}")
    text = path.read_text(encoding="utf-8")
    assert "case 7: it &lt;fell&gt;" in text
    assert 'id="plot-effect_ate_final_m_m_gate"' in text
    assert 'id="plot-spread"' in text


def bridged(case: Case) -> CaseResult:
    """As :func:`result`; with the smaller gate `a` has poses that no landmark measured."""
    rows = [
        Row(
            row.estimator,
            row.numbers
            | {
                "odometry": "synthetic",
                "predicted_frames": 2 if (row.estimator, case.place[1]) == ("a", 0) else 0,
            },
            row.times,
        )
        for row in given(case).rows
    ]
    return CaseResult(0.1, tuple(rows))


def test_poses_and_odometry_that_are_not_measured_are_marked_wherever_a_sweep_shows_them(
    grid: Grid, tmp_path: Path
) -> None:
    found = find(make_table(grid, ((case, bridged(case)) for case in grid)), grid)
    assert found is not None
    worst = f"gate=2 a ({2 * SEEDS} poses predicted, synthetic odometry)"
    best = "gate=3 b (synthetic odometry)"
    shown = [worst, "gate=2 b (synthetic odometry)", "gate=3 a (synthetic odometry)", best]
    means, pairs = comparison_tables(found)
    assert [name for name, _ in means.rows] == shown
    assert f"{worst} | {best}" in dict(pairs.rows)
    assert dict(pairs.rows)[f"{worst} | {best}"][-1] == best
    assert sentences(found, len(grid), len(grid), 0)[1].endswith(best)
    path = tmp_path / "report.html"
    write_sweep_page(path, [], {}, found, "")
    text = path.read_text(encoding="utf-8")
    assert f"a ({2 * SEEDS} poses predicted, synthetic odometry)" in text  # the curve of both gates
    running = RunningMeans(grid, None)
    for case in grid[:5]:
        running.add(case, bridged(case))
    assert "gate=2 a (6 poses predicted, synthetic odometry)" in dict(running.table().rows)


def test_means_while_it_runs_are_those_of_the_cases_so_far(grid: Grid) -> None:
    running = RunningMeans(grid, None)
    for case in grid[:5]:
        running.add(case, given(case))
    rows = dict(running.table().rows)
    expected = np.mean([11.0 + math.sin(seed) for seed in range(3)])
    assert rows["gate=2 a"] == (f"{expected:.4g}", "3", "")


# --------------------------------------------------------------------------------------------
# The journal


def kept(path: Path) -> dict[str, Any]:
    with Journal(path) as journal:
        return {key: journal.result(key) for key in ("a", "b", "c") if key in journal}


def test_results_are_read_back_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "cases.jsonl"
    rows = (Row("x", {"n": 0.1 + 0.2, "none": None, "text": "ü\n"}, {"ms": 3}),)
    with Journal(path) as journal:
        journal.add("a", CaseResult(1.5, rows))
        assert journal.result("a") == CaseResult(1.5, rows)
        journal.add("b", CaseResult(2.5, ()))
        assert journal.result("a") == CaseResult(1.5, rows)
    assert kept(path) == {"a": CaseResult(1.5, rows), "b": CaseResult(2.5, ())}


@pytest.mark.parametrize("cut", range(1, 60, 7))
def test_a_line_that_was_cut_off_is_done_again_and_nothing_else(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "cases.jsonl"
    with Journal(path) as journal:
        journal.add("a", CaseResult(1.5, ()))
        journal.add("b", CaseResult(1.5, (Row("x", {"number": 1.25}, {"milliseconds": 1.0}),)))
    whole = path.read_bytes()
    path.write_bytes(whole[:-cut])
    assert kept(path) == {"a": CaseResult(1.5, ())}
    with Journal(path) as journal:
        journal.add("c", CaseResult(3.5, ()))
    assert kept(path) == {"a": CaseResult(1.5, ()), "c": CaseResult(3.5, ())}


def test_a_line_of_something_else_is_passed_over(tmp_path: Path) -> None:
    path = tmp_path / "cases.jsonl"
    with Journal(path) as journal:
        journal.add("a", CaseResult(1.5, ()))
    path.write_bytes(b'\xff{"no"\n[1]\n' + path.read_bytes())
    assert kept(path) == {"a": CaseResult(1.5, ())}
