"""Settings of the homing estimators, as a tagged union over ``kind``."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.backend.settings import NamedSettings
from fgslam.core.settings import STRICT, NonNegative


@dataclass(frozen=True, config=STRICT)
class HomingEkfSettings(NamedSettings):
    """One filter of robot, target and features (section IV, its errors corrected)."""

    kind: Literal["homing_ekf"] = "homing_ekf"
    gate_sigmas: NonNegative = Field(
        default=3.0, description="gate on the innovation of a bearing; 0: none"
    )


@dataclass(frozen=True, config=STRICT)
class PaperEkfSettings(NamedSettings):
    """The two filters of section IV as printed, the model corrected."""

    kind: Literal["paper_ekf"] = "paper_ekf"
    gate_sigmas: NonNegative = Field(
        default=0.0, description="gate on the innovation of a bearing; 0: none, as printed"
    )


@dataclass(frozen=True, config=STRICT)
class HomingGraphSettings(NamedSettings):
    """The same problem as one graph of bearings."""

    kind: Literal["homing_graph"] = "homing_graph"
    solver: Literal["schur", "isam2", "batch"] = Field(
        default="schur", description="`schur` exact, all images; `isam2`, `batch` by GTSAM"
    )


@dataclass(frozen=True, config=STRICT)
class AverageLandmarkVectorSettings(NamedSettings):
    """Average landmark vector (Lambrinos et al. 2000): direction alone, no distance."""

    kind: Literal["alv"] = "alv"


@dataclass(frozen=True, config=STRICT)
class SnapshotSettings(NamedSettings):
    """Average displacement of the bearings against the target's snapshot: no distance."""

    kind: Literal["snapshot"] = "snapshot"


HomingEstimatorKind: TypeAlias = (
    HomingEkfSettings
    | PaperEkfSettings
    | HomingGraphSettings
    | AverageLandmarkVectorSettings
    | SnapshotSettings
)
HomingEstimatorSettings: TypeAlias = Annotated[HomingEstimatorKind, Field(discriminator="kind")]
