"""Settings of the estimators, as a tagged union over ``kind``."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from pydantic import Field

from fgslam.backend.filters.settings import (
    DeadReckoningSettings,
    EkfSettings,
    LandmarkKalmanGraphSettings,
    LandmarkKalmanSettings,
)
from fgslam.backend.smoothers.settings import BatchSettings, FixedLagSettings, Isam2Settings

# --------------------------------------------------------------------------------------------
# What several kinds share


# --------------------------------------------------------------------------------------------
# The estimators


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
