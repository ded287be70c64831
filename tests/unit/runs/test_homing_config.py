"""Configurations of homing: distinguished by their task, as strict as those of SLAM."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from fgslam.backend.homing.settings import HomingEkfSettings, HomingGraphSettings
from fgslam.core.errors import ConfigError
from fgslam.runs.config import (
    TASKS,
    Experiment,
    ExperimentConfig,
    HomingTrialsConfig,
    is_homing,
    load_config,
    load_experiment,
    load_homing,
    make_experiment,
    read_mapping,
)

EXPERIMENTS = [
    path
    for path in sorted((Path(__file__).parents[3] / "experiments").glob("*.yaml"))
    if "task" in read_mapping(path)
]
TRIALS: dict[str, Any] = {"task": "homing_trials", "name": "x"}
SLAM: dict[str, Any] = {"name": "x", "dataset": {"kind": "rendered_lab"}}


def written(tmp_path: Path, values: object) -> Path:
    path = tmp_path / "c.yaml"
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    return path


def message_of(values: object, tmp_path: Path, *overrides: str) -> str:
    with pytest.raises(ConfigError) as caught:
        load_experiment(written(tmp_path, values), overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_configuration_class_follows_from_the_task(tmp_path: Path) -> None:
    assert isinstance(load_experiment(written(tmp_path, TRIALS)), HomingTrialsConfig)
    assert isinstance(load_experiment(written(tmp_path, SLAM)), ExperimentConfig)
    assert is_homing(written(tmp_path, TRIALS))
    assert not is_homing(written(tmp_path, SLAM))


@pytest.mark.parametrize(
    ("values", "overrides", "words"),
    [
        (TRIALS | {"task": "homing_trial"}, (), "is 'homing_trial'; did you mean homing_trials?"),
        (TRIALS | {"task": "slam"}, (), "use one of localisation, homing_"),
        (TRIALS | {"task": None}, (), "task is None"),
        (TRIALS | {"task": ["a"]}, (), "task is ['a']"),
        (SLAM, ("task=homing_trals",), "did you mean homing_trials?"),
        (TRIALS, ("trial=3",), "unknown key trial; did you mean trials?"),
        (TRIALS, ("dataset.feature=3",), "unknown key dataset.feature; did you mean features?"),
        (TRIALS, ("homing_vector.sample=3",), "unknown key homing_vector.sample; did you"),
        (TRIALS, ("estimator.kind=homing_graf",), "use one of homing_ekf, paper_ekf, homing_graph"),
        (TRIALS, ("estimator.solvr=batch",), "unknown key estimator.solvr; did you mean solver?"),
        (TRIALS, ("compare=[homing_ekf, isam2]",), "compare[1].kind is 'isam2'; use one of"),
        (TRIALS, ("outliers=[0.1, 1.0]",), "outliers[1] = 1.0 is not usable"),
        (TRIALS, ("trials=0",), "trials = 0 is not usable"),
        (TRIALS, ("estimator.label=logs",), "cannot be called logs, a folder of the run"),
        (TRIALS, ("estimator.label=units",), "cannot be called units, a folder of the run"),
        (
            TRIALS,
            ("compare=[{kind: homing_graph, solver: batch}]",),
            "two different estimators are called homing_graph",
        ),
        ({"task": "homing_trials"}, (), "key name is missing"),
    ],
)
def test_mistakes_are_reported(
    values: dict[str, Any], overrides: tuple[str, ...], words: str, tmp_path: Path
) -> None:
    assert words in message_of(values, tmp_path, *overrides)


def test_slam_s_own_commands_refuse_homing_and_the_other_way_round(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="task homing_trials is a homing experiment"):
        load_config(written(tmp_path, TRIALS))
    with pytest.raises(ConfigError, match="has no task"):
        load_homing(written(tmp_path, SLAM))


def test_another_kind_drops_the_keys_of_the_old_one(tmp_path: Path) -> None:
    values = TRIALS | {"estimator": {"solver": "batch"}}
    first = load_homing(written(tmp_path, values))
    assert first.estimators == (HomingGraphSettings(solver="batch"),)
    other = load_homing(written(tmp_path, values), ["estimator.kind=homing_ekf"])
    assert other.estimators == (HomingEkfSettings(),)


def test_the_same_estimator_twice_counts_once() -> None:
    config = make_experiment(TRIALS | {"compare": ["homing_graph", "alv"]}, "x")
    assert [settings.title for settings in config.estimators] == ["homing_graph", "alv"]


@pytest.mark.parametrize("path", EXPERIMENTS, ids=lambda path: path.stem)
def test_every_experiment_is_valid_and_survives_a_round_trip(path: Path, tmp_path: Path) -> None:
    config = load_experiment(path)
    assert config.name == path.stem
    again = load_experiment(written(tmp_path, config.as_values() | {"provenance": {"a": 1}}))
    assert again.as_values() == config.as_values()


def test_every_task_is_its_model_s_own() -> None:
    for task, model in TASKS.items():
        found = model.model_json_schema()["properties"].get("task", {"const": None})
        assert found["const"] == task


def silent(schema: dict[str, Any]) -> list[str]:
    """Keys of any group that say nothing about themselves."""
    groups = {"": schema, **schema["$defs"]}
    return [
        f"{title}.{name}"
        for title, group in groups.items()
        for name, node in group.get("properties", {}).items()
        if name != "kind"
        and "description" not in node
        and not {"$ref", "oneOf", "anyOf", "allOf"} & node.keys()
    ]


@pytest.mark.parametrize("model", TASKS.values(), ids=map(str, TASKS))
def test_every_key_says_what_it_means(model: type[Experiment]) -> None:
    assert silent(model.model_json_schema()) == []
