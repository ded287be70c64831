"""Which estimators a comparison is about: names and overrides to settings."""

from __future__ import annotations

import dataclasses
import typing
from dataclasses import dataclass
from typing import Any

from fgslam.backend.homing.settings import (
    PAPER,
    AverageLandmarkVectorSettings,
    HomingEkfSettings,
    HomingGraphSettings,
    SnapshotSettings,
)
from fgslam.backend.settings import EstimatorSettings
from fgslam.core.errors import ConfigError
from fgslam.runs.config import make_experiment
from fgslam.runs.config_models import Experiment, HomingExperiment

_PREFIX = "estimators."

HOMING_VARIANTS = {
    settings.title: settings
    for settings in (
        HomingGraphSettings(),
        HomingGraphSettings(label="graph_fixed_lag", solver="fixed_lag"),
        HomingGraphSettings(label="graph_batch", solver="batch"),
        HomingEkfSettings(),
        PAPER,
        dataclasses.replace(PAPER, label="paper_ekf_gated", gate_sigmas=3.0),
        AverageLandmarkVectorSettings(),
        SnapshotSettings(),
    )
}
"""Homing estimators that can be named without a configuration: kinds, solvers, the paper's."""


@dataclass(frozen=True, slots=True)
class Choice:
    """What the user asked for.

    Attributes:
        names: titles of the configuration's estimators, or kinds; None: those of the configuration
            where it compares any, else every kind.
        overrides: `estimators.TITLE.key=value` of an estimator, `key=value` of the experiment.
    """

    names: tuple[str, ...] | None = None
    overrides: tuple[str, ...] = ()

    @property
    def of_experiment(self) -> tuple[str, ...]:
        """Overrides of the experiment's own keys."""
        return tuple(o for o in self.overrides if not o.strip().startswith(_PREFIX))

    @property
    def of_estimators(self) -> Choice:
        """The same without the overrides of the experiment's own keys."""
        own = set(self.of_experiment)
        return Choice(self.names, tuple(o for o in self.overrides if o not in own))


EVERY = Choice()


def all_kinds() -> dict[str, EstimatorSettings]:
    """Every kind of SLAM estimator with its defaults, by kind."""
    union = typing.get_args(EstimatorSettings)[0]
    return {settings.kind: settings() for settings in typing.get_args(union)}


def choose(config: Experiment, choice: Choice) -> tuple[Any, ...]:
    """Settings of the estimators of a comparison.

    Args:
        config: of the run whose log is replayed; of SLAM or of homing.
        choice: what the user asked for.

    Raises:
        ConfigError: an unknown name, or an override that is no key of that estimator.
    """
    variants: dict[str, Any] = dict(
        HOMING_VARIANTS if isinstance(config, HomingExperiment) else all_kinds()
    )
    known = variants | {settings.title: settings for settings in config.estimators}
    if choice.names is None:
        own = [settings.title for settings in config.estimators]
        chosen = own if getattr(config, "compare", ()) else list(known)
    else:
        chosen = list(dict.fromkeys(name.strip() for name in choice.names if name.strip()))
    unknown = [name for name in chosen if name not in known]
    if unknown or not chosen:
        what = f"no estimator {unknown[0]!r}" if unknown else "no estimator named"
        raise ConfigError(f"{what}; give --estimators with some of {', '.join(known)}")
    for override in choice.of_experiment:
        raise ConfigError(
            f"--set {override}: what was measured stays as it is; estimators.NAME.key=value with "
            f"NAME one of {', '.join(chosen)}, or --trials to run the experiment again"
        )
    for override in choice.overrides:
        if not any(_addresses(override, title) for title in chosen):
            raise ConfigError(
                f"--set {override}: not of the form estimators.NAME.key=value with NAME one of "
                f"{', '.join(chosen)}"
            )
    return tuple(_with(known[title], config, choice.overrides) for title in chosen)


def _addresses(override: str, title: str) -> bool:
    return override.strip().startswith(f"{_PREFIX}{title}.")


def _with(settings: Any, config: Experiment, overrides: tuple[str, ...]) -> Any:
    """Settings with their own overrides, checked as those of a configuration."""
    title = settings.title
    own = [o.strip() for o in overrides if _addresses(o, title)]
    if not own:
        return settings
    values = config.model_copy(update={"estimator": settings}).as_values() | {"compare": []}
    moved = [f"estimator{override[len(_PREFIX) + len(title) :]}" for override in own]
    found = make_experiment(values, moved, f"--set {own[0]}").estimators[0]
    if found.kind != settings.kind:
        raise ConfigError(f"--set {own[0]}: the kind is what names it; use --estimators")
    return found
