"""Reads the configuration of an experiment: one YAML file and dotted overrides, strictly.

The key `task` says which model of :mod:`fgslam.runs.config_models` it is; without it, SLAM's.
Unknown keys are refused with the nearest known one suggested.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any, TypeVar

from fgslam.core.errors import ConfigError
from fgslam.runs.config_models import (
    HOMING_TASKS,
    TASKS,
    Experiment,
    ExperimentConfig,
    HomingExperiment,
    LocalisationConfig,
)
from fgslam.runs.config_reading import Override, parse, read_mapping

__all__ = [
    "Experiment",
    "ExperimentConfig",
    "HomingExperiment",
    "LocalisationConfig",
    "as_task",
    "is_homing",
    "load_config",
    "load_experiment",
    "load_homing",
    "make_config",
    "make_experiment",
]

_Model = TypeVar("_Model", bound=Experiment)


def load_experiment(path: Path, overrides: Iterable[str] = ()) -> Experiment:
    """Reads an experiment of any task and applies ``a.b=value`` overrides.

    Raises:
        ConfigError: the file is missing or no YAML mapping, or a key or value is wrong.
    """
    return make_experiment(read_mapping(path), str(path), overrides)


def make_experiment(
    values: Mapping[str, Any], where: str, overrides: Iterable[str] = ()
) -> Experiment:
    """Plain values of any task with overrides applied, checked; ``where`` names their source.

    Raises:
        ConfigError: an override is malformed, or a key or value is wrong.
    """
    overrides = tuple(overrides)
    chosen = [o.value for o in map(Override.of, overrides) if o.keys == ("task",)]
    asked = {"task": chosen[-1]} if chosen else values
    config = parse(_model_of(asked, where), values, where, overrides)
    problem = config.problem()
    if problem:
        raise ConfigError(f"{where}: {problem}")
    return config


def load_config(path: Path, overrides: Iterable[str] = ()) -> ExperimentConfig:
    """Reads an experiment of SLAM. Raises ConfigError, also where it is of another task."""
    return make_config(read_mapping(path), str(path), overrides)


def make_config(
    values: Mapping[str, Any], where: str, overrides: Iterable[str] = ()
) -> ExperimentConfig:
    """As :func:`make_experiment`, of SLAM alone."""
    _require_slam(values, where)
    return as_task(ExperimentConfig, make_experiment(values, where, overrides), where)


def load_homing(path: Path, overrides: Iterable[str] = ()) -> HomingExperiment:
    """Reads a homing experiment. Raises ConfigError, also where it is of another task."""
    return as_task(HomingExperiment, load_experiment(path, overrides), str(path))


def is_homing(path: Path) -> bool:
    """Whether a configuration file is of a homing experiment. Raises ConfigError."""
    return read_mapping(path).get("task") in HOMING_TASKS


def _model_of(values: Mapping[str, Any], where: str) -> type[Experiment]:
    """Model of a task. Raises ConfigError where there is no such task."""
    if "task" not in values:
        return TASKS[None]
    task = values["task"]
    model = TASKS.get(task) if isinstance(task, str) else None
    if model is None:
        known = [name for name in TASKS if name is not None]
        close = get_close_matches(str(task), known, n=1, cutoff=0.5)
        hint = f"did you mean {close[0]}?" if close else f"use one of {', '.join(known)}"
        raise ConfigError(f"{where}: task is {task!r}; {hint} (SLAM has no key task)")
    return model


def _require_slam(values: Mapping[str, Any], where: str) -> None:
    """Refuses another task before its keys are: they would be unknown to SLAM."""
    task = values.get("task")
    if task == "localisation":
        raise ConfigError(
            f"{where}: task localisation drives nothing, and this needs an experiment of SLAM; "
            "`fgslam run` takes both"
        )
    if task is not None:
        raise ConfigError(
            f"{where}: task {task} is a homing experiment, and this needs one of SLAM; `fgslam "
            "run` and `fgslam compare` take both"
        )


def as_task(model: type[_Model], config: Experiment, where: str) -> _Model:
    """The experiment itself, if it is of this model. Raises ConfigError where it is not."""
    if isinstance(config, model):
        return config
    if model is HomingExperiment and config.task_name is None:
        raise ConfigError(f"{where}: has no task, so it is no homing experiment; give one")
    raise ConfigError(f"{where}: task is {config.task_name}, which this does not take")
