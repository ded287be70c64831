"""A sweep's axes and cases, its journal, its table, and what table and page show of it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pytest

from fgslam.core.errors import ConfigError, OutputError
from fgslam.evaluation.judging import holm
from fgslam.report.content import write_parquet
from fgslam.runs import sweep
from fgslam.runs.engine import Task
from fgslam.runs.folder import ExistingFolder, Owner, begin_folder
from fgslam.runs.sweep import (
    JOURNAL_FILE,
    SWEEP,
    TABLE_FILE,
    Axis,
    Case,
    CaseResult,
    Findings,
    Journal,
    Plan,
    Row,
    Source,
    check_cases,
    find,
    make_axes,
    make_table,
    read_axes,
    read_source,
    summarise,
    table_of_means,
    table_of_pairs,
    write_sweep_page,
)

VALUES = {"name": "drive", "dataset": {"kind": "simulated_measurements", "stop": 5}}
IMAGES: dict[str, Any] = {"dataset": {"kind": "rendered_lab"}}
SEEDS = 8


@pytest.mark.parametrize(
    ("given", "texts", "settings"),
    [
        ("seed=0:3", ["0", "1", "2"], [0, 1, 2]),
        ("seed=2:9:3", ["2", "5", "8"], [2, 5, 8]),
        ("a.b=2,3,4.5", ["2", "3", "4.5"], [2.0, 3.0, 4.5]),
        ("a=true,false", ["true", "false"], [True, False]),
        ("a=ekf", ["ekf"], ["ekf"]),
        ("a=[1, 2],[3]", ["[1, 2]", "[3]"], ["[1, 2]", "[3]"]),
        ("a='x,y',z", ["'x,y'", "z"], ["'x,y'", "z"]),
        ("a=1,none", ["1", "none"], ["1", "none"]),
        ("a=!!int ''", ["!!int ''"], ["!!int ''"]),
    ],
)
def test_axes_are_read(given: str, texts: list[str], settings: list[Any]) -> None:
    (axis,) = read_axes([given])
    assert list(axis.values) == texts
    assert axis.settings == settings
    assert [type(value) for value in axis.settings] == [type(value) for value in settings]


@pytest.mark.parametrize(
    ("sets", "words"),
    [
        (["seed"], "not of the form KEY=VALUES"),
        (["=3"], "not of the form KEY=VALUES"),
        (["seed=5:5"], "0 values"),
        (["seed=0:9:0"], "0 values"),
        (["seed=0:99999999999"], "99,999,999,999 values; give FIRST:END"),
        (["a=1,,2"], "a value is empty"),
        (["a=1,1"], "a value is given twice"),
        (["a=1", "a=2"], "a is given twice; write a=A,B"),
    ],
)
def test_malformed_axes_are_refused_in_a_line(sets: list[str], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        read_axes(sets)


def test_axes_are_made_of_values() -> None:
    axes = make_axes({"seed": range(2), "a": np.array([0.5, 2.0]), "b": "x,y", "c": [[1, 2]]})
    assert [list(axis.values) for axis in axes] == [["0", "1"], ["0.5", "2.0"], ["x,y"], ["[1, 2]"]]
    for wrong in ([], [1, 1]):
        with pytest.raises(ConfigError, match="settings: seed"):
            make_axes({"seed": wrong})


def test_the_last_axis_turns_fastest_and_experiments_slowest() -> None:
    sources = (Source("x", VALUES, "x"), Source("y", VALUES, "y"))
    cases = Plan(sources, (Axis("a", ["1", "2"]), Axis("b", ["3", "4", "5"]))).cases
    found = [(case.source.name, case.overrides) for case in cases]
    assert len(found) == len(set(found)) == 12
    assert [found[k] for k in (0, 1, 3, -1)] == [
        ("x", ("a=1", "b=3")),
        ("x", ("a=1", "b=4")),
        ("x", ("a=2", "b=3")),
        ("y", ("a=2", "b=5")),
    ]


def test_plans_that_cannot_be_told_apart_or_done_are_refused() -> None:
    one = Source("x", VALUES, "x")
    long = [str(k) for k in range(1001)]
    for plan, words in (
        (Plan((one, one), ()), "two experiments are called x"),
        (Plan((one,), (Axis("a", long), Axis("b", long))), "1,002,001 cases"),
    ):
        with pytest.raises(ConfigError, match=words):
            len(plan.cases)


@pytest.mark.parametrize("existing", ["resume", "overwrite"])
def test_a_folder_in_which_another_process_sweeps_is_left_alone(
    existing: ExistingFolder, tmp_path: Path
) -> None:
    with Owner(tmp_path) as first:
        begin_folder(tmp_path, "refuse", first, SWEEP)
        for name in (JOURNAL_FILE, SWEEP.marker):
            (tmp_path / name).write_text("a case")
        with pytest.raises(OutputError, match="is writing there; wait for it to end"):
            begin_folder(tmp_path, existing, Owner(tmp_path), SWEEP)
        assert (tmp_path / JOURNAL_FILE).read_text() == "a case"
    with Owner(tmp_path) as second:
        begin_folder(tmp_path, existing, second, SWEEP)
    assert (tmp_path / JOURNAL_FILE).exists() == (existing == "resume")


def test_paths_of_recordings_hold_wherever_a_worker_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "data").mkdir()
    file = tmp_path / "x.yaml"
    file.write_text(
        "name: x\ndataset: {kind: image_folder, path: data, camera_file: absent.json}\n"
    )
    source = read_source(file)
    assert source.values["dataset"]["path"] == str(tmp_path / "data")
    assert source.values["dataset"]["camera_file"] == "absent.json"
    (case,) = Plan((source,), (Axis("dataset.path", ["data"]),)).cases
    assert case.overrides == (f"dataset.path={tmp_path / 'data'}",)


# --------------------------------------------------------------------------------------------
# One case


def case(*overrides: str, names: tuple[str, ...] | None = None, **values: Any) -> Case:
    made_with = values.pop("made_with", {})
    return Case(Source("x", VALUES | values, "x"), (), overrides, names, made_with)


def test_a_case_is_told_by_all_that_its_numbers_depend_on() -> None:
    same = (case("seed=1"), case("seed=1", name="another", output={"report": False}))
    others = (
        case("seed=2"),
        case("seed=1", names=("ekf",)),
        case("seed=1", made_with={"fgslam": "0"}),
    )
    keys = {one.key("identity", one.settled()) for one in (*same, *others)}
    assert len(keys | {same[0].key("changed", same[0].settled())}) == 5


def test_estimators_are_chosen_and_have_settings_of_their_own() -> None:
    _, own = case().settled()
    assert [one.title for one in own] == ["landmark_kalman"]
    _, chosen = case("estimators.isam2.update_every=3", names=("isam2", "odometry")).settled()
    assert [one.title for one in chosen] == ["isam2", "odometry"]
    assert chosen[0].update_every == 3
    with pytest.raises(ConfigError, match="no estimator 'isam3'"):
        case(names=("isam3",)).settled()


def test_dead_reckoning_is_left_out_of_the_configuration_s_own_where_nothing_was_measured() -> None:
    still = {"odometry": {"kind": "constant_velocity"}, "compare": ["odometry", "isam2"]}
    _, own = case(**IMAGES | still).settled()
    assert [one.title for one in own] == ["landmark_kalman", "isam2"]
    with pytest.raises(ConfigError, match="--estimators odometry: the run had no odometry"):
        case(names=("odometry",), **IMAGES | still).settled()


@pytest.mark.parametrize("where", ["as an axis", "in the experiment"])
def test_a_map_that_every_case_would_overwrite_is_refused(where: str) -> None:
    axis = ("map.save=a.fgmap",) if where == "as an axis" else ()
    saving = case(*axis, **IMAGES, **({} if axis else {"map": {"save": "a.fgmap"}}))
    with pytest.raises(ConfigError, match=r"x: map\.save: a sweep saves no map; leave it out"):
        saving.settled()
    assert case("map.save=null", **IMAGES, map={"save": "a.fgmap"}).settled()[1]


def test_results_in_a_map_that_was_replaced_are_not_taken_up_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, opened = tmp_path / "place.fgmap", Task({"dataset": {"identity": "d"}}, lambda _: None)
    monkeypatch.setattr(sweep, "opener_of", lambda _: lambda *_: opened)
    plan = Plan((Source("x", VALUES | IMAGES | {"map": {"load": str(place)}}, "x"),), ())
    keys = []
    for content in (b"one", b"another", b"one"):
        place.write_bytes(content)
        keys += check_cases(plan)[0]
    assert keys[0] == keys[2] != keys[1]


# --------------------------------------------------------------------------------------------
# The journal


def kept(path: Path) -> dict[str, Any]:
    with Journal(path) as journal:
        return dict(journal)


def test_results_are_read_back_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "cases.jsonl"
    rows = (Row("x", {"n": 0.1 + 0.2, "none": None, "text": "ü\n"}, {"ms": 3}),)
    with Journal(path) as journal:
        journal.add("a", CaseResult(1.5, rows))
        assert journal["a"] == CaseResult(1.5, rows)
        journal.add("b", CaseResult(2.5, ()))
        assert journal["a"] == CaseResult(1.5, rows)
    assert kept(path) == {"a": CaseResult(1.5, rows), "b": CaseResult(2.5, ())}


@pytest.mark.parametrize("cut", range(1, 60, 7))
def test_a_line_that_was_cut_off_is_done_again_and_nothing_else(tmp_path: Path, cut: int) -> None:
    path = tmp_path / "cases.jsonl"
    with Journal(path) as journal:
        journal.add("a", CaseResult(1.5, ()))
        journal.add("b", CaseResult(1.5, (Row("x", {"number": 1.25}, {"milliseconds": 1.0}),)))
    path.write_bytes(path.read_bytes()[:-cut])
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


# --------------------------------------------------------------------------------------------
# The table, and what it shows


def test_holm_is_as_worked_out_by_hand() -> None:
    # Sorted 0.005, 0.01, 0.03, 0.04: times 4, 3, 2, 1, none below the one before.
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02], abs=1e-15)
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


@pytest.fixture
def plan() -> Plan:
    axes = read_axes([f"seed=0:{SEEDS}", "m.gate=2,3"])
    return Plan((Source("drive", {"name": "drive"}, "drive"),), axes)


def result(plan: Plan, number: int, **more: Any) -> CaseResult:
    """Estimator b is better than a by 1 in each world; the gate of 3 better than that of 2 by 5."""
    seed, gate = plan.cases[number].settings
    rows = [
        Row(
            name,
            {"kind": name, "ate_final_m": 10.0 + math.sin(seed) + off - 5.0 * (gate - 2.0), **more},
            {"ms": 1},
        )
        for name, off in (("a", 1.0), ("b", 0.0))
    ]
    return CaseResult(0.1, tuple(rows))


def table_of(plan: Plan, failing: int = -1) -> dict[str, list[Any]]:
    numbers = range(len(plan.cases))
    found = [(k, "it fell" if k == failing else result(plan, k)) for k in numbers]
    return make_table(plan, found)[0]


def test_the_table_opens_in_pandas_with_settings_metrics_and_failures(
    plan: Plan, tmp_path: Path
) -> None:
    write_parquet(tmp_path / TABLE_FILE, table_of(plan, failing=3), {})
    found = pandas.read_parquet(tmp_path / TABLE_FILE)
    assert len(found) == 2 * len(plan.cases) - 1
    assert list(found.columns) == [
        *("case", "experiment", "seed", "m.gate", "estimator", "kind", "ate_final_m", "failure")
    ]
    assert found["seed"].dtype == np.int64
    failed = found[found.failure.notna()]
    assert (failed.case.item(), failed.seed.item(), failed.failure.item()) == (3, 1, "it fell")
    assert np.isnan(failed.ate_final_m.item())
    first = (tmp_path / TABLE_FILE).read_bytes()
    write_parquet(tmp_path / TABLE_FILE, table_of(plan, failing=3), {})
    assert (tmp_path / TABLE_FILE).read_bytes() == first


def test_variants_are_compared_over_the_seeds_that_both_have(plan: Plan) -> None:
    found = find(table_of(plan, failing=3), plan)
    assert found is not None
    assert found.variants == ["gate=2 a", "gate=2 b", "gate=3 a", "gate=3 b"]
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
    whole = find(table_of(plan), plan)
    assert whole is not None
    assert {(c.a, c.b): c.better for c in whole.comparisons}["gate=2 a", "gate=3 b"] == "gate=3 b"


def test_a_metric_without_numbers_is_refused(plan: Plan) -> None:
    with pytest.raises(
        ConfigError, match="--metric kind: no column of numbers; known: ate_final_m"
    ):
        find(table_of(plan), plan, "kind")
    assert find(make_table(plan, [(0, "it fell")])[0], plan) is None


def test_an_estimator_that_gave_up_is_in_no_mean(plan: Plan) -> None:
    lost = CaseResult(0.1, (Row("a", {"ate_final_m": 0.0, "failure": "lost"}, {}),))
    found = find(make_table(plan, [(0, lost), (2, result(plan, 2))])[0], plan)
    assert found is not None
    expected = f"{11.0 + math.sin(1):.4g}"
    assert table_of_means(found).rows[0] == ("gate=2 a", ("1", expected, "1"))


def test_the_page_says_what_the_table_says(plan: Plan, tmp_path: Path) -> None:
    found = find(table_of(plan), plan)
    assert found is not None
    lines = summarise(found, 16, 16, 0)
    assert lines[0] == "16 of 16 cases done"
    assert "gate=3 b" in lines[1]
    assert lines[2].startswith("6 of 6 paired comparisons differ")
    mean = np.mean([11.0 + math.sin(seed) for seed in range(SEEDS)])
    name, cells = table_of_means(found).rows[0]
    assert (name, cells[0]) == ("gate=2 a", str(SEEDS))
    assert cells[1].startswith(f"{mean:.4g}\n[")
    assert len(table_of_pairs(found).rows) == 6
    path = tmp_path / "report.html"
    write_sweep_page(path, lines, {7: "it <fell>"}, found, "axes: {}")
    text = path.read_text(encoding="utf-8")
    assert "case 7: it &lt;fell&gt;" in text
    assert 'id="plot-effect_ate_final_m_m_gate"' in text
    assert 'id="plot-spread"' in text


def test_poses_and_odometry_that_are_not_measured_are_marked_wherever_a_sweep_shows_them(
    plan: Plan, tmp_path: Path
) -> None:
    results = []
    for k in range(len(plan.cases)):  # with the smaller gate `a` has poses that are predicted
        a, b = result(plan, k, odometry="synthetic", predicted_frames=0).rows
        a = a._replace(numbers={**a.numbers, "predicted_frames": 2 * (k % 2 == 0)})
        results.append((k, CaseResult(0.1, (a, b))))
    found = find(make_table(plan, results)[0], plan)
    assert found is not None
    worst = f"gate=2 a ({2 * SEEDS} poses predicted, synthetic odometry)"
    best = "gate=3 b (synthetic odometry)"
    shown = [worst, "gate=2 b (synthetic odometry)", "gate=3 a (synthetic odometry)", best]
    assert [name for name, _ in table_of_means(found).rows] == shown
    assert dict(table_of_pairs(found).rows)[f"{worst} | {best}"][-1] == best
    assert summarise(found, 16, 16, 0)[1].endswith(best)
    path = tmp_path / "report.html"
    write_sweep_page(path, [], {}, found, "")
    text = path.read_text(encoding="utf-8")
    assert f"a ({2 * SEEDS} poses predicted, synthetic odometry)" in text  # the curve of both gates


# --------------------------------------------------------------------------------------------
# Estimators in many worlds of noise

KINDS = {"kalman": "landmark_kalman", "worse": "ekf", "smooth": "isam2"}


def trials(ate: list[tuple[float, float]], failing: int = -1, **more: Any) -> Findings:
    """Filters and a smoother in as many worlds; final ATE of the better filter and the smoother."""
    plan = Plan(
        (Source("drive", {"name": "drive"}, "drive"),), read_axes([f"seed=0:{len(ate) + 1}"])
    )
    nees = {"nees_pose_final_per_dof": 3.0, "nees_pose_dof": 6, "nees_pose_items": 2}
    found = []
    for number, (of_filter, of_smoother) in enumerate(ate):
        rows = []
        of_all = zip(KINDS.items(), (of_filter, of_filter + 1.0, of_smoother), strict=True)
        for (title, kind), error in of_all:
            failed = title == "smooth" and number == failing
            failure = {"failure": "frame 2: no"} if failed else {}
            rows.append(
                Row(title, {"kind": kind, "ate_final_m": error, **nees, **more, **failure}, {})
            )
        found.append((number, CaseResult(0.1, tuple(rows))))
    table = find(make_table(plan, found)[0], plan)
    assert table is not None
    return table


def test_a_sweep_over_seeds_reports_which_estimator_is_better() -> None:
    found = trials([(0.02 + 0.001 * k, 0.01 + 0.0005 * k) for k in range(8)])
    first, second = found.compare_families()
    assert first.startswith("smooth beats kalman (the best filter) in 8 of 8 trials; ")
    assert "final ATE is lower by 1.175 cm, 95 % [1.0" in first
    assert "0.50 times; p = 0.0078" in first
    assert second.startswith("smooth beats worse in 8 of 8 trials; ")
    assert summarise(found, 8, 8, 0)[-2:] == (first, second)
    pooled = found.pooled("nees_pose_final_per_dof")["kalman"]
    assert (pooled.per_dof, pooled.independent, pooled.items) == (3.0, 8, 16)
    # 8 samples of 3 degrees of freedom each: chi-square with 24, at 2.5 and 97.5 %.
    assert pooled.lower == pytest.approx(12.401 / 24, abs=1e-4)
    assert pooled.upper == pytest.approx(39.364 / 24, abs=1e-4)
    assert found.means("ate_final_m")["kalman"].mean == pytest.approx(0.0235)
    cells = dict(table_of_means(found).rows)["kalman"]
    assert cells[-2] == "3 overconfident\n[0.52, 1.64]"


@pytest.mark.parametrize(
    ("ate", "start", "words"),
    [
        (
            [(0.01 + 0.001 * k, 0.03) for k in range(8)],
            "kalman (the best filter) beats smooth in 8 of 8 trials; ",
            "higher by",
        ),
        (
            [(0.02, 0.01 + 0.001 * k) for k in range(3)],
            "no difference shown between smooth and kalman",
            "better in 3, worse in 0 of 3 trials",
        ),
        ([(0.02, 0.01)], "no difference shown", "one trial has no interval"),
    ],
)
def test_the_filter_can_be_better_and_few_trials_show_no_difference(
    ate: list[tuple[float, float]], start: str, words: str
) -> None:
    sentence = trials(ate).compare_families()[0]
    assert sentence.startswith(start)
    assert words in sentence


def test_a_failed_trial_is_in_no_test_and_not_pooled() -> None:
    found = trials([(0.02, 0.01), (0.02, 0.01), (0.02, 0.0001)], failing=2)
    assert "better in 2, worse in 0 of 2 trials" in found.compare_families()[0]
    assert found.means("ate_final_m")["smooth"].mean == pytest.approx(0.01)
    assert found.pooled("nees_pose_final_per_dof")["smooth"].independent == 2


def test_trials_name_predicted_poses_and_synthetic_odometry() -> None:
    found = trials([(0.02, 0.01)] * 3, predicted_frames=2, odometry="synthetic")
    marks = "(6 poses predicted, synthetic odometry)"
    assert found.variants == [f"{title} {marks}" for title in KINDS]
    assert found.compare_families()[0].startswith(f"no difference shown between smooth {marks}")


def test_families_are_not_compared_over_different_settings(plan: Plan) -> None:
    found = find(table_of(plan), plan)
    assert found is not None
    assert found.compare_families() == []
