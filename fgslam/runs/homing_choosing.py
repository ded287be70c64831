"""Which homing estimators a comparison is about: names and overrides to settings."""

from __future__ import annotations

import dataclasses
from typing import Any

from pydantic import TypeAdapter

from fgslam.backend.homing.settings import (
    PAPER,
    AverageLandmarkVectorSettings,
    HomingEkfSettings,
    HomingEstimatorSettings,
    HomingGraphSettings,
    SnapshotSettings,
)
from fgslam.core.errors import ConfigError
from fgslam.runs.choosing import Choice
from fgslam.runs.config_reading import apply_overrides
from fgslam.runs.homing_config import HomingExperiment, parse_homing

_PREFIX = "estimators."
VARIANTS: dict[str, HomingEstimatorSettings] = {
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
"""Estimators that can be named without a configuration: every kind, solver, and the paper's."""


def choose_homing(config: HomingExperiment, choice: Choice) -> tuple[HomingEstimatorSettings, ...]:
    """The estimators of a comparison.

    Args:
        config: of the run whose bearings are replayed.
        choice: what the user asked for; no names: those of the configuration where it compares
            any, else every variant.

    Raises:
        ConfigError: an unknown name, or an override that is no key of that estimator.
    """
    known = VARIANTS | {settings.title: settings for settings in config.estimators}
    names = choice.names
    if names is None:
        own = [settings.title for settings in config.estimators]
        chosen = own if len(own) > 1 else list(known)
    else:
        chosen = list(dict.fromkeys(name.strip() for name in names if name.strip()))
    unknown = [name for name in chosen if name not in known]
    if unknown or not chosen:
        what = f"no estimator {unknown[0]!r}" if unknown else "no estimator named"
        raise ConfigError(f"{what}; give --estimators with some of {', '.join(known)}")
    for override in choice.overrides:
        if not any(_addresses(override, title) for title in chosen):
            raise ConfigError(
                f"--set {override}: not of the form estimators.NAME.key=value with NAME one of "
                f"{', '.join(chosen)}"
            )
    return tuple(_with(known[title], config, choice.overrides) for title in chosen)


def _addresses(override: str, title: str) -> bool:
    return override.strip().startswith(f"{_PREFIX}{title}.")


def _with(
    settings: HomingEstimatorSettings, config: HomingExperiment, overrides: tuple[str, ...]
) -> HomingEstimatorSettings:
    """Settings with their own overrides, checked as those of a configuration."""
    title = settings.title
    own = [o.strip()[len(_PREFIX) + len(title) + 1 :] for o in overrides if _addresses(o, title)]
    if not own:
        return settings
    plain: dict[str, Any] = TypeAdapter(type(settings)).dump_python(settings, mode="json")
    apply_overrides(plain, own)
    if plain["kind"] != settings.kind:
        raise ConfigError(f"--set {own[0]}: the kind is what names it; use --estimators")
    values = config.as_values() | {"estimator": plain, "compare": []}
    return parse_homing(values, f"--set {_PREFIX}{title}.{own[0]}").estimators[0]
