"""Axes and cases of a sweep: what is typed, what comes of it, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgslam.core.errors import ConfigError, OutputError
from fgslam.runs.engine import Task
from fgslam.runs.folder import OWNER_NAME, ExistingFolder, Owner
from fgslam.runs.sweeps import sweep
from fgslam.runs.sweeps.case import CaseTask
from fgslam.runs.sweeps.folder import JOURNAL_FILE, Plan, begin_sweep
from fgslam.runs.sweeps.grid import Axis, Grid, Source, make_axes, read_axes, read_source

VALUES = {"name": "drive", "dataset": {"kind": "simulated_measurements", "stop": 5}}
IMAGES: dict[str, Any] = {"dataset": {"kind": "rendered_lab"}}


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
    grid = Grid(sources, (Axis("a", ["1", "2"]), Axis("b", ["3", "4", "5"])))
    assert len(grid) == 12
    found = [(case.source, case.overrides) for case in grid]
    assert found[0] == (0, ("a=1", "b=3"))
    assert found[1] == (0, ("a=1", "b=4"))
    assert found[3] == (0, ("a=2", "b=3"))
    assert found[-1] == (1, ("a=2", "b=5"))
    assert len(set(found)) == 12


def test_grids_that_cannot_be_told_apart_or_done_are_refused() -> None:
    one = Source("x", VALUES, "x")
    with pytest.raises(ConfigError, match="two experiments are called x"):
        Grid((one, one), ())
    long = Axis("a", [str(k) for k in range(1001)])
    with pytest.raises(ConfigError, match="1,002,001 cases"):
        Grid((one,), (long, Axis("b", long.values)))


@pytest.mark.parametrize("existing", ["resume", "overwrite"])
def test_a_folder_in_which_another_process_sweeps_is_left_alone(
    existing: ExistingFolder, tmp_path: Path
) -> None:
    plan = Plan(Grid((Source("x", {}, "x"),), read_axes(["seed=0:2"])))
    (tmp_path / OWNER_NAME).touch()  # of one that was killed before it wrote anything
    with Owner(tmp_path) as first:
        begin_sweep(tmp_path, "refuse", plan, first)
        (tmp_path / JOURNAL_FILE).write_text("a case")
        with pytest.raises(OutputError, match="is writing there; wait for it to end"):
            begin_sweep(tmp_path, existing, plan, Owner(tmp_path))
        assert (tmp_path / JOURNAL_FILE).read_text() == "a case"
    with Owner(tmp_path) as second:
        begin_sweep(tmp_path, existing, plan, second)


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
    (case,) = Grid((source,), (Axis("dataset.path", ["data"]),))
    assert case.overrides == (f"dataset.path={tmp_path / 'data'}",)


def task(*overrides: str, names: tuple[str, ...] | None = None, **values: Any) -> CaseTask:
    return CaseTask(VALUES | values, "x", overrides, names)


def test_a_case_is_told_by_all_that_its_numbers_depend_on() -> None:
    key = task("seed=1").key("identity")
    assert key == task("seed=1", name="another", output={"report": False}).key("identity")
    others = (
        task("seed=2").key("identity"),
        task("seed=1").key("changed"),
        task("seed=1", names=("ekf",)).key("identity"),
        CaseTask(VALUES, "x", ("seed=1",), None, {"fgslam": "0"}).key("identity"),
    )
    assert len({key, *others}) == 5


def test_estimators_are_chosen_and_have_settings_of_their_own() -> None:
    _, own = task().settled()
    assert [one.title for one in own] == ["landmark_kalman"]
    _, chosen = task("estimators.isam2.update_every=3", names=("isam2", "odometry")).settled()
    assert [one.title for one in chosen] == ["isam2", "odometry"]
    assert chosen[0].update_every == 3
    with pytest.raises(ConfigError, match="no estimator 'isam3'"):
        task(names=("isam3",)).settled()


def test_dead_reckoning_is_left_out_of_the_configuration_s_own_where_nothing_was_measured() -> None:
    still = {"odometry": {"kind": "constant_velocity"}, "compare": ["odometry", "isam2"]}
    _, own = task(**IMAGES | still).settled()
    assert [one.title for one in own] == ["landmark_kalman", "isam2"]
    with pytest.raises(ConfigError, match="--estimators odometry: the run had no odometry"):
        task(names=("odometry",), **IMAGES | still).settled()


@pytest.mark.parametrize("where", ["as an axis", "in the experiment"])
def test_a_map_that_every_case_would_overwrite_is_refused(where: str) -> None:
    axis = ("map.save=a.fgmap",) if where == "as an axis" else ()
    saving = task(*axis, **IMAGES, **({} if axis else {"map": {"save": "a.fgmap"}}))
    with pytest.raises(ConfigError, match=r"x: map\.save: a sweep saves no map; leave it out"):
        saving.settled()
    assert task("map.save=null", **IMAGES, map={"save": "a.fgmap"}).settled()[1]


def test_results_in_a_map_that_was_replaced_are_not_taken_up_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place, opened = tmp_path / "place.fgmap", Task({"dataset": {"identity": "d"}}, lambda _: None)
    monkeypatch.setattr(sweep, "opener_of", lambda _: lambda *_: opened)
    values = VALUES | IMAGES | {"map": {"load": str(place)}}
    plan = Plan(Grid((Source("x", values, "x"),), ()), None)
    keys = []
    for content in (b"one", b"another", b"one"):
        place.write_bytes(content)
        keys += sweep._checked(plan, sweep.UNWATCHED)[0]
    assert keys[0] == keys[2] != keys[1]
