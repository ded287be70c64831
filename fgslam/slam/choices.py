"""Reads what a user names or hands over: an estimator, settings of the front-end, odometry."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any, TypeGuard, cast, get_args

from pydantic import TypeAdapter, ValidationError

from fgslam.backend.protocol import Estimator
from fgslam.backend.settings import EstimatorSettings
from fgslam.core.errors import ConfigError
from fgslam.core.measurements import MeasurementType
from fgslam.datasets.settings import (
    OdometrySettings,
    RecordedOdometrySettings,
)
from fgslam.frontend.settings import FrontendSettings
from fgslam.slam.motion import MOTION_MEMBERS, MotionModel

_ESSENTIAL = ("kind", "supports", "predict", "landmarks", "update", "estimate")
"""What the loop needs of an estimator; the protocol's other members serve resuming and tests."""


def estimator_kinds() -> tuple[str, ...]:
    """Names of the estimators, the simplest first."""
    return tuple(str(settings.kind) for settings in _classes())


def is_settings(value: object) -> TypeGuard[EstimatorSettings]:
    """True if the value is the settings of an estimator of this package."""
    return isinstance(value, _classes())


def _classes() -> tuple[type[Any], ...]:
    return _members(EstimatorSettings)


def _members(tagged: Any) -> tuple[type[Any], ...]:
    """Settings classes of a tagged union."""
    union, _ = get_args(tagged)
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
        raise ConfigError(
            f"estimator: {estimator.__name__} is a class; give an object of it, made for this rig"
        )
    lacking = [name for name in _ESSENTIAL if not hasattr(estimator, name)]
    if lacking:
        raise ConfigError(
            f"estimator: {type(estimator).__name__} lacks {', '.join(lacking)}; give a kind "
            f"({', '.join(estimator_kinds())}), its settings, or an object with the members of "
            "fgslam.Estimator"
        )
    _require_supports(estimator)
    return cast("Estimator", estimator)


def chosen_frontend(given: FrontendSettings | Mapping[str, Any] | None) -> FrontendSettings:
    """Settings of the front-end as given; None: the defaults; a mapping: what differs from these.

    Raises:
        ConfigError: a key of the mapping is not known, or its value is not usable.
    """
    if isinstance(given, FrontendSettings):
        return given
    adapter: TypeAdapter[FrontendSettings] = TypeAdapter(FrontendSettings)
    try:
        return adapter.validate_python(dict(given or {}))
    except (ValidationError, TypeError, ValueError) as error:
        first = error.errors()[0] if isinstance(error, ValidationError) else None
        what = "not a mapping" if first is None else f"{_dotted(first['loc'])}: {first['msg']}"
        raise ConfigError(
            f"frontend: {what}; give settings by group, e.g. "
            '{"stereo": {"max_disparity_px": 80}}, as in the settings reference'
        ) from None


def chosen_odometry(
    given: OdometrySettings | MotionModel | None,
) -> OdometrySettings | MotionModel:
    """Settings of the odometry, or a motion model, as given; None: the default settings.

    Raises:
        ConfigError: it is neither.
    """
    if given is None:
        return RecordedOdometrySettings()
    if _is_odometry_settings(given):
        return given
    lacking = [name for name in MOTION_MEMBERS if not hasattr(given, name)]
    if lacking or isinstance(given, type):
        why = f"lacks {', '.join(lacking)}" if lacking else "is a class"
        name = given.__name__ if isinstance(given, type) else type(given).__name__
        raise ConfigError(
            f"odometry: {name} {why}; give settings, e.g. "
            "fgslam.datasets.settings.ConstantVelocitySettings(), or an object with the members of "
            "fgslam.MotionModel"
        )
    return given


def _is_odometry_settings(value: object) -> TypeGuard[OdometrySettings]:
    return isinstance(value, _members(OdometrySettings))


def _dotted(location: tuple[int | str, ...]) -> str:
    return ".".join(map(str, location))


def _require_supports(estimator: object) -> None:
    supports = getattr(estimator, "supports", None)
    known = isinstance(supports, set | frozenset) and all(
        isinstance(one, MeasurementType) for one in supports
    )
    if not known:
        raise ConfigError(
            f"estimator: supports of {type(estimator).__name__} is {supports!r}; give a frozenset "
            "of fgslam.core.measurements.MeasurementType"
        )


def _named(kind: str) -> EstimatorSettings:
    known = estimator_kinds()
    if kind not in known:
        close = difflib.get_close_matches(kind, known, n=1, cutoff=0.4)
        hint = f"did you mean {close[0]}? " if close else ""
        raise ConfigError(f"estimator: no kind {kind!r}; {hint}known: {', '.join(known)}")
    adapter: TypeAdapter[Any] = TypeAdapter(EstimatorSettings)
    settings: EstimatorSettings = adapter.validate_python({"kind": kind})
    return settings
