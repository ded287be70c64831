"""Which estimators a comparison is about: names and overrides to settings."""

from __future__ import annotations

import typing
from dataclasses import dataclass
from typing import Any

from fgslam.backend.settings import EstimatorSettings
from fgslam.core.errors import ConfigError
from fgslam.runs.config import ExperimentConfig, make_config

_PREFIX = "estimators."


@dataclass(frozen=True, slots=True)
class Choice:
    """What the user asked for.

    Attributes:
        names: titles of the configuration's estimators, or kinds; None: those of the configuration
            where it compares any, else every kind.
        overrides: `estimators.TITLE.key=value`.
    """

    names: tuple[str, ...] | None = None
    overrides: tuple[str, ...] = ()


EVERY = Choice()


def all_kinds() -> dict[str, EstimatorSettings]:
    """Every kind of estimator with its defaults, by kind."""
    union = typing.get_args(EstimatorSettings)[0]
    return {settings.kind: settings() for settings in typing.get_args(union)}


def estimators_of(config: ExperimentConfig) -> tuple[EstimatorSettings, ...]:
    """The live estimator, then those of `compare`; the same one twice counts once."""
    return tuple(dict.fromkeys((config.estimator, *config.compare)))


def compared_with(config: ExperimentConfig) -> tuple[EstimatorSettings, ...]:
    """Those of `compare` besides the live one."""
    return estimators_of(config)[1:]


def choose(config: ExperimentConfig, choice: Choice) -> tuple[EstimatorSettings, ...]:
    """The estimators of a comparison.

    Args:
        config: of the run whose log is replayed.
        choice: what the user asked for.

    Raises:
        ConfigError: an unknown name, or an override that is no key of that estimator.
    """
    known = all_kinds() | {settings.title: settings for settings in estimators_of(config)}
    names = choice.names
    if names is None:
        chosen = [s.title for s in estimators_of(config)] if config.compare else list(known)
    else:
        chosen = list(dict.fromkeys(name.strip() for name in names if name.strip()))
    unknown = [name for name in chosen if name not in known]
    if unknown or not chosen:
        what = f"no estimator {unknown[0]!r}" if unknown else "no estimator named"
        raise ConfigError(f"{what}; give --estimators with some of {', '.join(known)}")
    return _overridden({name: known[name] for name in chosen}, config, choice.overrides)


def _overridden(
    chosen: dict[str, EstimatorSettings], config: ExperimentConfig, overrides: tuple[str, ...]
) -> tuple[EstimatorSettings, ...]:
    """Each estimator's settings with its own overrides, checked as those of a configuration."""
    for override in overrides:
        if not any(_addresses(override, title) for title in chosen):
            raise ConfigError(
                f"--set {override}: not of the form estimators.NAME.key=value with NAME one of "
                f"{', '.join(chosen)}"
            )
    return tuple(
        _with(settings, config, [o for o in overrides if _addresses(o, title)])
        for title, settings in chosen.items()
    )


def _addresses(override: str, title: str) -> bool:
    return override.strip().startswith(f"{_PREFIX}{title}.")


def _with(
    settings: EstimatorSettings, config: ExperimentConfig, overrides: list[str]
) -> EstimatorSettings:
    if not overrides:
        return settings
    title = settings.title
    values: dict[str, Any] = config.model_copy(update={"estimator": settings}).as_values()
    values["compare"] = []
    moved = [f"estimator{o.strip()[len(_PREFIX) + len(title) :]}" for o in overrides]
    found = make_config(values, moved, f"--set {overrides[0]}").estimator
    if found.kind != settings.kind:
        raise ConfigError(f"--set {overrides[0]}: the kind is what names it; use --estimators")
    return found
