"""Settings of the estimators, as a tagged union over ``kind``."""

from __future__ import annotations

from typing import Annotated, TypeAlias, get_args

from pydantic import Field

from fgslam.backend.common_settings import Family
from fgslam.backend.filters.settings import (
    DeadReckoningSettings,
    EkfSettings,
    LandmarkKalmanGraphSettings,
    LandmarkKalmanSettings,
)
from fgslam.backend.smoothers.settings import BatchSettings, FixedLagSettings, Isam2Settings

EstimatorSettings: TypeAlias = Annotated[
    DeadReckoningSettings
    | LandmarkKalmanSettings
    | LandmarkKalmanGraphSettings
    | EkfSettings
    | FixedLagSettings
    | Isam2Settings
    | BatchSettings,
    Field(discriminator="kind"),
]


def family_of(kind: str) -> Family:
    """Whether estimators of a kind are filters, smoothers or neither."""
    families: dict[str, Family] = {
        settings.kind: settings.family for settings in get_args(get_args(EstimatorSettings)[0])
    }
    return families.get(kind, "other")
