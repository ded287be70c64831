"""The configuration: strict at every depth, messages that name the fix, overrides, round trip."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

from fgslam.core.errors import ConfigError
from fgslam.datasets.settings import ConstantVelocitySettings, ImageFolderSettings
from fgslam.runs.config import (
    TASKS,
    Experiment,
    ExperimentConfig,
    HomingExperiment,
    HomingTrialsConfig,
    as_task,
    load_config,
    load_experiment,
    make_config,
    make_experiment,
)

EXPERIMENTS = sorted((Path(__file__).parents[3] / "experiments").glob("*.yaml"))
MINIMAL: dict[str, Any] = {"name": "x", "dataset": {"kind": "image_folder", "path": "there"}}
LAB: dict[str, Any] = {"name": "x", "dataset": {"kind": "rendered_lab"}}
TRIALS: dict[str, Any] = {"task": "homing_trials", "name": "x"}


def nested(base: dict[str, Any], dotted: str, value: object) -> dict[str, Any]:
    """A copy of ``base`` with one dotted key set."""
    first, _, rest = dotted.partition(".")
    inner = base.get(first, {})
    return base | {first: nested(inner, rest, value) if rest else value}


def written(tmp_path: Path, values: object) -> Path:
    path = tmp_path / "c.yaml"
    path.write_text(yaml.safe_dump(values), encoding="utf-8")
    return path


def message_of(values: object, tmp_path: Path, *overrides: str) -> str:
    path = written(tmp_path, values)
    with pytest.raises(ConfigError) as caught:
        load_experiment(path, overrides)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith((str(path), "--set"))
    return message


# --------------------------------------------------------------------------------------------
# Unknown, missing and wrong keys


@pytest.mark.parametrize(
    ("base", "typo", "meant"),
    [
        (MINIMAL, "front_end", "frontend"),
        (MINIMAL, "dataset.resize", "dataset.resized"),
        (MINIMAL, "frontend.sift.max_feature", "frontend.sift.max_features"),
        (MINIMAL, "odometry.time_offset", "odometry.time_offset_s"),
        (MINIMAL, "lever_arm_m", "dataset.lever_arm_m"),
        (LAB, "dataset.rig.baseline", "dataset.rig.baseline_m"),
    ],
)
def test_an_unknown_key_brings_the_nearest_one(
    base: dict[str, Any], typo: str, meant: str, tmp_path: Path
) -> None:
    if typo.startswith("odometry"):
        base = nested(base, "odometry.kind", "recorded")
    message = message_of(nested(base, typo, 1), tmp_path)
    assert f"unknown key {typo}; did you mean {meant}?" in message


def test_an_unknown_key_like_nothing_lists_the_known_ones(tmp_path: Path) -> None:
    message = message_of(nested(MINIMAL, "output.zzz", 1), tmp_path)
    assert "unknown key output.zzz; known here: checkpoint_seconds, pictures" in message


def test_a_misspelt_required_key_is_reported_as_such(tmp_path: Path) -> None:
    values = {"name": "x", "dataset": {"kind": "image_folder", "paht": "there"}}
    message = message_of(values, tmp_path)
    assert "unknown key dataset.paht; did you mean dataset.path? (and 1 more)" in message


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ({"name": "x"}, "key dataset is missing; add it"),
        ({"dataset": LAB["dataset"]}, "key name is missing; add it"),
        ({"name": "x", "dataset": {"kind": "image_folder"}}, "key dataset.path is missing; add it"),
        ({"name": "x", "dataset": {"path": "there"}}, "dataset.kind is missing; add one of"),
        (nested(MINIMAL, "dataset.kind", "kiti"), "dataset.kind is 'kiti'; use one of"),
        (nested(MINIMAL, "odometry.kind", "wheel"), "odometry.kind is 'wheel'; use one of"),
        (nested(MINIMAL, "estimator.kind", "magic"), "estimator.kind is 'magic'; use one of"),
    ],
)
def test_missing_keys_and_bad_kinds(values: dict[str, Any], expected: str, tmp_path: Path) -> None:
    assert expected in message_of(values, tmp_path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("name", "a/b"),
        ("name", ".."),
        ("name", ""),
        ("seed", -1),
        ("dataset", "there"),
        ("dataset.path", ""),
        ("dataset.stop", 0),
        ("dataset.lever_arm_m", 1.0),
        ("frontend", None),
        ("frontend.sift.contrast_threshold", float("nan")),
        ("frontend.sift.base_sigma_px", 3.01),
        ("frontend.ego_motion.dof", 4),
    ],
)
def test_a_wrong_value_is_named_with_its_key(key: str, value: object, tmp_path: Path) -> None:
    message = message_of(nested(MINIMAL, key, value), tmp_path)
    assert f"{key} = {value!r} is not usable: " in message


def test_a_wrong_item_of_a_vector_is_named_by_its_place(tmp_path: Path) -> None:
    values = nested(MINIMAL, "dataset.lever_arm_m", [1.0, 2.0, float("inf")])
    assert "dataset.lever_arm_m[2] = inf is not usable" in message_of(values, tmp_path)
    values = nested(MINIMAL, "dataset.lever_arm_m", [1.0, 2.0])
    assert "dataset.lever_arm_m[2] is missing" in message_of(values, tmp_path)


# --------------------------------------------------------------------------------------------
# Files


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "holds no `key: value` pairs"),
        (b"- 1\n- 2\n", "holds no `key: value` pairs"),
        (b"name: [1, 2\n", ", line 2: not valid YAML"),
        (b"name: !!python/object/apply:os.system ['true']\n", ", line 1: not valid YAML"),
        (b"name: a\x00b\n", "not valid YAML"),
        (b"[" * 5000, ", line 1: not valid YAML (nested over 50 deep)"),
    ],
)
def test_files_that_are_no_configuration(content: bytes, expected: str, tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_bytes(content)
    with pytest.raises(ConfigError) as caught:
        load_config(path)
    separator = "" if expected.startswith(",") else ": "
    assert str(caught.value).startswith(f"{path}{separator}{expected}")
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_text(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_bytes(b"\x89PNG\r\n\x1a\n\x00\xff\xfe")
    with pytest.raises(ConfigError, match="not text in UTF-8; give a YAML text file") as caught:
        load_config(path)
    assert str(caught.value).startswith(f"cannot read {path}: ")


def test_a_folder_and_nothing_at_all(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"cannot read .*: it is a folder; give a YAML text file"):
        load_config(tmp_path)
    with pytest.raises(ConfigError, match="no such file; give a YAML file"):
        load_config(tmp_path / "absent.yaml")


def test_a_key_given_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.yaml"
    path.write_text("name: x\nseed: 1\ndataset: {kind: rendered_lab}\nseed: 2\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"line 4.*seed.*twice"):
        load_config(path)


# --------------------------------------------------------------------------------------------
# Overrides


def load(tmp_path: Path, *overrides: str, base: dict[str, Any] = MINIMAL) -> ExperimentConfig:
    return load_config(written(tmp_path, base), overrides)


def test_overrides_reach_any_depth_and_are_yaml(tmp_path: Path) -> None:
    config = load(
        tmp_path,
        "seed=3",
        "frontend.sift.max_features=4",
        "dataset.lever_arm_m=[1, -2.5, 1e-1]",
        "dataset.stop=null",
        "dataset.resized=true",
        "output.checkpoint_seconds=0",
        "dataset.path=a folder/with=sign",
        "frontend.matching={refine: true}",
    )
    assert config.seed == 3
    assert config.frontend.sift.max_features == 4
    assert isinstance(config.dataset, ImageFolderSettings)
    assert config.dataset.lever_arm_m == (1.0, -2.5, 0.1)
    assert config.dataset.stop is None
    assert config.dataset.resized is True
    assert config.dataset.path == "a folder/with=sign"
    assert config.output.checkpoint_seconds == 0.0
    assert config.frontend.matching.refine is True


KITTI = {"name": "x", "dataset": {"kind": "kitti", "path": "there", "sequence": "00"}}


@pytest.mark.parametrize(
    ("typed", "expected"),
    [
        ("01", "01"),  # YAML: a whole number
        ('"01"', "01"),
        ("[1, 2]", "[1, 2]"),
        ("a: b", "a: b"),
        ("{x", "{x"),  # no YAML
        ("now # and here", "now # and here"),  # YAML: a comment
        ("no", "no"),  # YAML: false
        ("null", "null"),
    ],
)
def test_a_setting_that_is_text_takes_the_text_as_typed(
    typed: str, expected: str, tmp_path: Path
) -> None:
    assert load(tmp_path, f"dataset.path={typed}").as_values()["dataset"]["path"] == expected
    if expected == "01":
        config = load(tmp_path, f"dataset.sequence={typed}", base=KITTI)
        assert config.as_values()["dataset"]["sequence"] == "01"


def test_text_or_null_takes_null(tmp_path: Path) -> None:
    for typed, expected in (("null", None), ("~", None), ("01", "01"), ("maps/no", "maps/no")):
        assert load(tmp_path, f"map.load={typed}").map.load == expected


def test_a_list_of_texts_holds_texts(tmp_path: Path) -> None:
    panoramas = {"kind": "panoramas", "path": "there"}
    base = {"name": "x", "task": "topological_map", "dataset": panoramas}
    config = make_experiment(base, "x", ["routes=[[12, 7], [a, b]]"])
    assert config.as_values()["routes"] == [["12", "7"], ["a", "b"]]


def test_the_type_is_that_of_the_kind_chosen(tmp_path: Path) -> None:
    """In whatever order the kind and its key are given."""
    chosen = ["dataset.kind=kitti", "dataset.path=1e3", "dataset.sequence=01"]
    for overrides in (chosen, chosen[::-1]):
        dataset = load(tmp_path, *overrides, base=LAB).as_values()["dataset"]
        assert (dataset["path"], dataset["sequence"]) == ("1e3", "01")


def test_a_name_among_several_is_no_number_or_truth(tmp_path: Path) -> None:
    message = message_of(LAB, tmp_path, "odometry.kind=no")
    assert "odometry.kind is 'no'; use one of recorded" in message


@pytest.mark.parametrize("override", ["seed", "=3", "a..b=1", ".seed=1", "seed.=1", ""])
def test_malformed_overrides(override: str, tmp_path: Path) -> None:
    assert "not of the form a.b=value" in message_of(MINIMAL, tmp_path, override)


def test_overrides_that_cannot_be_applied(tmp_path: Path) -> None:
    assert "seed = '[1' is not usable: give a whole" in message_of(MINIMAL, tmp_path, "seed=[1")
    message = message_of(MINIMAL, tmp_path, "name.first=1")
    assert "--set name.first=1: name holds a value, not a group" in message
    message = message_of(MINIMAL, tmp_path, "frontend.sift.max_featurs=3")
    assert (
        "unknown key frontend.sift.max_featurs; did you mean frontend.sift.max_features?" in message
    )


def test_another_kind_drops_the_keys_of_the_old_one_but_no_misspelling(tmp_path: Path) -> None:
    base = nested(nested(MINIMAL, "odometry.kind", "recorded"), "odometry.speed_sigma_mps", 0.3)
    config = load(tmp_path, "odometry.kind=constant_velocity", base=base)
    assert isinstance(config.odometry, ConstantVelocitySettings)
    message = message_of(base, tmp_path, "odometry.kind=synthetic", "odometry.rotation_sigma_dg=1")
    assert (
        "unknown key odometry.rotation_sigma_dg; did you mean odometry.rotation_sigma_deg?"
        in message
    )


# --------------------------------------------------------------------------------------------
# Round trip


@pytest.mark.parametrize("path", EXPERIMENTS, ids=lambda path: path.stem)
def test_every_experiment_is_valid_and_survives_a_round_trip(path: Path, tmp_path: Path) -> None:
    config = load_experiment(path)
    assert config.name == path.stem
    provenance = {"fgslam": "0", "dataset": {"identity": "ab"}}
    again = load_experiment(written(tmp_path, config.as_values() | {"provenance": provenance}))
    assert again.as_values() == config.as_values()
    assert again.model_copy(update={"provenance": None}) == config


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


# --------------------------------------------------------------------------------------------
# Estimators to compare


@pytest.mark.parametrize(
    ("compare", "words"),
    [
        (["isam3"], "compare[0].kind is 'isam3'; use one of odometry, landmark_kalman"),
        (["batch", {"update_every": 3}], "compare[1].kind is missing; add one of odometry"),
        (
            [{"kind": "isam2", "updat_every": 3}],
            "compare[0].updat_every; did you mean compare[0].update_ev",
        ),
        (
            [{"kind": "isam2", "kernel": {"nam": "x"}}],
            "compare[0].kernel.nam; did you mean compare[0].kernel.name?",
        ),
        (["batch", {"kind": "isam2", "update_every": 0}], "compare[1].update_every = 0 is not"),
        ([3], "compare[0] = 3 is not usable: give a group of keys, or the name of a kind"),
        ("isam2", "compare = 'isam2' is not usable: give a list, e.g. [a, b]"),
    ],
)
def test_items_of_compare_are_named_by_their_place(
    compare: object, words: str, tmp_path: Path
) -> None:
    assert words in message_of(LAB | {"compare": compare}, tmp_path)


@pytest.mark.parametrize("folder", ["pictures", "compare", "trials", "first", "units"])
def test_no_estimator_is_called_as_a_folder_of_the_run(folder: str, tmp_path: Path) -> None:
    taken = LAB | {"estimator": {"label": folder}}
    assert f"cannot be called {folder}, a folder of the run" in message_of(taken, tmp_path)


def test_every_estimator_has_a_folder_of_its_own(tmp_path: Path) -> None:
    other = {"kind": "landmark_kalman", "update": "world"}
    message = message_of(LAB | {"compare": [other]}, tmp_path)
    assert "two different estimators are called landmark_kalman; give one of them a" in message
    assert len(make_config(LAB | {"compare": [other | {"label": "w"}]}, "x").compare) == 1
    assert len(make_config(LAB | {"compare": ["landmark_kalman"]}, "x").compare) == 1


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [
        ("dataset.stride", "two", "give a whole number"),
        ("output.pictures", "perhaps", "give true or false"),
        ("frontend.ego_motion.outlier_px", "much", "give a number"),
    ],
)
def test_wrong_types_are_reported_in_plain_words(
    key: str, value: object, words: str, tmp_path: Path
) -> None:
    message = message_of(nested(MINIMAL, key, value), tmp_path)
    assert f"{key} = {value!r} is not usable: {words}" in message


def test_a_name_with_bytes_that_are_no_utf_8_is_told() -> None:
    """As archives made elsewhere leave names of folders."""
    with pytest.raises(ConfigError, match="has bytes that are no UTF-8; give the file or folder"):
        make_config(nested(MINIMAL, "dataset.path", "dri\udcffe"), "x")


# --------------------------------------------------------------------------------------------
# Maps


@pytest.mark.parametrize(
    ("maps", "expected"),
    [
        ({"start": "last"}, "mean nothing without a map"),
        ({"extend": False}, "mean nothing without a map"),
        ({"load": "a", "made_from": {"dataset": MINIMAL["dataset"]}}, "exclude each other"),
        ({"load": "a", "save": "b", "extend": False}, "no new map to save"),
        ({"load": "a", "save": "a"}, "are one file"),
        ({"load": "maps/../a", "save": "./a"}, "are one file"),
    ],
)
def test_maps_that_contradict_themselves(maps: dict[str, Any], expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        make_config({**MINIMAL, "map": maps}, "test")


# --------------------------------------------------------------------------------------------
# Tasks: each has a model of its own, as strict as that of SLAM


def test_configuration_class_follows_from_the_task(tmp_path: Path) -> None:
    assert isinstance(load_experiment(written(tmp_path, TRIALS)), HomingTrialsConfig)
    assert isinstance(load_experiment(written(tmp_path, LAB)), ExperimentConfig)


@pytest.mark.parametrize(
    ("values", "overrides", "words"),
    [
        (TRIALS | {"task": "homing_trial"}, (), "is 'homing_trial'; did you mean homing_trials?"),
        (TRIALS | {"task": ["a"]}, (), "task is ['a']"),
        (LAB, ("task=homing_trals",), "did you mean homing_trials?"),
        (
            TRIALS,
            ("dataset.feature=3",),
            "unknown key dataset.feature; did you mean dataset.features?",
        ),
        (TRIALS, ("estimator.kind=homing_graf",), "use one of homing_ekf, paper_ekf, homing_graph"),
        (TRIALS, ("compare=[homing_ekf, isam2]",), "compare[1].kind is 'isam2'; use one of"),
        (TRIALS, ("outliers=[0.1, 1.0]",), "outliers[1] = 1.0 is not usable"),
        (TRIALS, ("estimator.label=logs",), "cannot be called logs, a folder of the run"),
        (
            TRIALS,
            ("compare=[{kind: homing_graph, solver: batch}]",),
            "two different estimators are called homing_graph",
        ),
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
        as_task(HomingExperiment, load_experiment(written(tmp_path, LAB)), "test")


@pytest.mark.parametrize("typed", ["ekf", '"ekf"', "'ekf'"])
def test_a_kind_may_be_quoted_as_options_write_it(typed: str) -> None:
    config = make_config(MINIMAL, "test", [f"estimator.kind={typed}"])
    assert config.estimator.kind == "ekf"


def test_a_run_knows_its_recording_from_any_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "there" / "drive").mkdir(parents=True)
    values = {"name": "x", "dataset": {"kind": "image_folder", "path": "drive"}}
    known = {"provenance": {"directory": str(tmp_path / "there")}}
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(values | known), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    dataset = load_config(Path("config.yaml")).dataset
    assert vars(dataset)["path"] == str(tmp_path / "there" / "drive")
    monkeypatch.chdir(tmp_path / "there")
    assert vars(load_config(Path("../config.yaml")).dataset)["path"] == "drive"
