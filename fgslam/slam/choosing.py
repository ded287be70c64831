"""The estimator that a user names, describes or brings along."""

from __future__ import annotations

import difflib
from typing import Any, TypeGuard, cast, get_args

from pydantic import TypeAdapter

from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import EstimatorSettings
from fgslam.core.errors import ConfigError

_ESSENTIAL = ("kind", "supports", "predict", "landmarks", "update", "estimate")
"""What the loop needs of an estimator; the protocol's other members serve resuming and tests."""


def estimator_kinds() -> tuple[str, ...]:
    """Names of the estimators, the simplest first."""
    return tuple(str(settings.kind) for settings in _classes())


def is_settings(value: object) -> TypeGuard[EstimatorSettings]:
    """True if the value is the settings of an estimator of this package."""
    return isinstance(value, _classes())


def _classes() -> tuple[type[Any], ...]:
    union, _ = get_args(EstimatorSettings)
    return get_args(union)


def chosen_estimator(
    estimator: str | EstimatorSettings | Estimator,
) -> EstimatorSettings | Estimator:
    """Settings of the estimator that is named, or what was given.

    Raises:
        ConfigError: there is no such kind, or the object lacks members of an estimator.
    """
    if isinstance(estimator, str):
        return _named(estimator)
    if is_settings(estimator):
        return estimator
    if isinstance(estimator, type):
        raise ConfigError(f"estimator: {estimator.__name__} is a class; give an object of it")
    lacking = [name for name in _ESSENTIAL if not hasattr(estimator, name)]
    if lacking:
        raise ConfigError(
            f"estimator: {type(estimator).__name__} lacks {', '.join(lacking)}; give a kind "
            f"({', '.join(estimator_kinds())}), its settings, or an object with the members of "
            "fgslam.Estimator"
        )
    return cast("Estimator", estimator)


def _named(kind: str) -> EstimatorSettings:
    known = estimator_kinds()
    if kind not in known:
        close = difflib.get_close_matches(kind, known, n=1, cutoff=0.4)
        hint = f"did you mean {close[0]}? " if close else ""
        raise ConfigError(f"estimator: no kind {kind!r}; {hint}known: {', '.join(known)}")
    adapter: TypeAdapter[Any] = TypeAdapter(EstimatorSettings)
    settings: EstimatorSettings = adapter.validate_python({"kind": kind})
    return settings
