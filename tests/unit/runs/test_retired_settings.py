"""Configurations of version 0.1 name settings that are constants now."""

from __future__ import annotations

from typing import Any

import pytest

from fgslam.core.errors import ConfigError
from fgslam.runs.config import make_config, make_experiment
from fgslam.runs.retired_settings import RETIRED


def values(**groups: Any) -> dict[str, Any]:
    dataset = {"kind": "image_folder", "path": "somewhere"}
    return {"name": "old", "dataset": dataset, **groups}


def test_a_retired_key_with_its_constant_means_nothing() -> None:
    old = {"kind": "batch", "max_iterations": RETIRED["BatchSettings"]["max_iterations"]}
    assert make_config(values(estimator=old), "old.yaml") == make_config(
        values(estimator={"kind": "batch"}), "old.yaml"
    )


def test_a_retired_key_in_a_list_means_nothing() -> None:
    old = {"kind": "batch", "max_iterations": RETIRED["BatchSettings"]["max_iterations"]}
    assert make_config(values(compare=["isam2", old]), "old.yaml") == make_config(
        values(compare=["isam2", "batch"]), "old.yaml"
    )


def test_a_retired_key_with_another_value_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"unknown key estimator\.max_iterations"):
        make_config(values(estimator={"kind": "batch", "max_iterations": 7}), "old.yaml")


def test_a_retired_key_in_another_group_is_refused() -> None:
    old = {"kind": "isam2", "max_iterations": RETIRED["BatchSettings"]["max_iterations"]}
    with pytest.raises(ConfigError, match=r"unknown key estimator\.max_iterations"):
        make_config(values(estimator=old), "old.yaml")


def homing(**groups: Any) -> dict[str, Any]:
    return {"task": "path_following", "name": "old", **groups}


def test_a_retired_group_with_its_constants_means_nothing() -> None:
    tracking = dict(RETIRED["PathFollowingConfig"]["tracking"])
    old = homing(tracking=tracking, behaviour={"path": {"skip_unmatched": True}})
    assert make_experiment(old, "old.yaml") == make_experiment(homing(), "old.yaml")


def test_a_retired_group_with_another_value_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"unknown key behaviour\.path"):
        make_experiment(homing(behaviour={"path": {"skip_unmatched": False}}), "old.yaml")
    with pytest.raises(ConfigError, match="unknown key tracking"):
        make_experiment(homing(tracking={"max_points": 30}), "old.yaml")
