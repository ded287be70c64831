"""Settings of the homing estimators, as a tagged union over ``kind``.

Lengths are in legs, the distance from start to target, so that speeds are in legs a second: a
wheelchair at 0.4 m/s on a leg of 2 m drives 0.2 legs a second.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.backend.settings import KernelSettings, NamedSettings
from fgslam.core.settings import STRICT, NonNegative, Positive


@dataclass(frozen=True, config=STRICT)
class FilterMotionSettings:
    """Noise of the filter's motion (eqs 4 and 5), on the acceleration; the paper states none."""

    heading_deg: Positive = Field(
        default=20.0,
        description="deviation of the heading after a second, degrees; must cover the "
        "robot's turns",
    )
    speed: Positive = Field(
        default=0.1, description="deviation of the speed after a second, legs/s"
    )
    slip: Positive = Field(
        default=0.02, description="deviation of the position after a second, legs: wheels slip"
    )


@dataclass(frozen=True, config=STRICT)
class HomingEkfSettings(NamedSettings):
    """The two filters of section IV with the corrected model.

    The defaults are the honest variant; :data:`PAPER` holds what the paper says.
    """

    kind: Literal["homing_ekf"] = "homing_ekf"
    gauge: Literal["one_distance", "unit_leg"] = Field(
        default="unit_leg",
        description="scale: `one_distance` that of one feature, as printed; `unit_leg` start to"
        " target",
    )
    exact_bearings: bool = Field(
        default=False, description="bearings from the start without variance, as printed"
    )
    target: Literal["separate", "joint"] = Field(
        default="joint",
        description="`joint`: part of the state, bearings used once; `separate`: own filter, as"
        " printed",
    )
    map_covariance: bool = Field(
        default=True, description="target separate: add the map's covariance; not printed"
    )
    gate_sigmas: NonNegative = Field(
        default=3.0, description="gate on the innovation of a bearing; 0: none, as printed"
    )
    max_relative_distance_sigma: NonNegative = Field(
        default=0.3,
        description="largest relative deviation of a feature's distance in the map; 0: any",
    )
    motion: FilterMotionSettings = FilterMotionSettings()


PAPER = HomingEkfSettings(
    label="paper_ekf",
    gauge="one_distance",
    exact_bearings=True,
    target="separate",
    map_covariance=False,
    gate_sigmas=0.0,
    max_relative_distance_sigma=0.0,
)
"""The filters as the paper describes them, the model corrected."""


@dataclass(frozen=True, config=STRICT)
class GraphMotionSettings:
    """White noise on the acceleration between two images."""

    forward: Positive = Field(
        default=0.1, description="deviation of the speed after a second, legs/s"
    )
    sideways: Positive = Field(default=0.03, description="the same of the sideways speed: slip")
    turning_deg: Positive = Field(
        default=60.0, description="the same of the turning rate, degrees/s"
    )


@dataclass(frozen=True, config=STRICT)
class HomingGraphSettings(NamedSettings):
    """The same problem as one graph of bearings (design H)."""

    kind: Literal["homing_graph"] = "homing_graph"
    solver: Literal["schur", "isam2", "batch"] = Field(
        default="schur",
        description="`schur` exact, all images; `isam2`, `batch` by GTSAM",
    )
    kernel: KernelSettings = KernelSettings("cauchy", 2.0)
    elevations: Literal["none", "two_views", "all"] = Field(
        default="two_views",
        description="`two_views`: of start and target; `none`: a prior instead; `all`: of every"
        " image",
    )
    max_relative_distance_sigma: Positive = Field(
        default=0.3,
        description="a feature enters once its relative distance deviation is below this",
    )
    gate_sigmas: NonNegative = Field(
        default=4.0, description="gate on the misfit of a bearing; 0: none"
    )
    motion: GraphMotionSettings = GraphMotionSettings()


@dataclass(frozen=True, config=STRICT)
class AverageLandmarkVectorSettings(NamedSettings):
    """Average landmark vector (Lambrinos et al. 2000): direction alone, no distance."""

    kind: Literal["alv"] = "alv"


@dataclass(frozen=True, config=STRICT)
class SnapshotSettings(NamedSettings):
    """Average displacement of the bearings against the target's snapshot: no distance."""

    kind: Literal["snapshot"] = "snapshot"


HomingEstimatorKind: TypeAlias = (
    HomingEkfSettings | HomingGraphSettings | AverageLandmarkVectorSettings | SnapshotSettings
)
HomingEstimatorSettings: TypeAlias = Annotated[HomingEstimatorKind, Field(discriminator="kind")]
