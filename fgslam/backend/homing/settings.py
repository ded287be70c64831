"""Settings of the homing estimators, as a tagged union over ``kind``.

Lengths are in legs, the distance from start to target, so that speeds are in legs a second: a
wheelchair at 0.4 m/s on a leg of 2 m drives 0.2 legs a second.
"""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.backend.settings import KernelSettings, NamedSettings
from fgslam.core.settings import STRICT


@dataclass(frozen=True, config=STRICT)
class FilterMotionSettings:
    """Noise of the filter's motion (eqs 4 and 5), on the acceleration; the paper states none."""

    heading_deg: Annotated[
        float,
        Field(
            gt=0.0,
            description="deviation of the heading after a second, degrees; must cover the "
            "robot's turns",
        ),
    ] = 20.0
    speed: Annotated[
        float, Field(gt=0.0, description="deviation of the speed after a second, legs/s")
    ] = 0.1
    slip: Annotated[
        float,
        Field(gt=0.0, description="deviation of the position after a second, legs: wheels slip"),
    ] = 0.02


@dataclass(frozen=True, config=STRICT)
class HomingEkfSettings(NamedSettings):
    """The two filters of section IV with the corrected model.

    The defaults are the honest variant; :data:`PAPER` holds what the paper says.
    """

    kind: Literal["homing_ekf"] = "homing_ekf"
    gauge: Annotated[
        Literal["one_distance", "unit_leg"],
        Field(
            description="scale: `one_distance` that of one feature, as printed; `unit_leg` start to"
            " target"
        ),
    ] = "unit_leg"
    exact_bearings: Annotated[
        bool,
        Field(description="bearings from the start without variance, as printed"),
    ] = False
    target: Annotated[
        Literal["separate", "joint"],
        Field(
            description="`joint`: part of the state, bearings used once; `separate`: own filter, as"
            " printed"
        ),
    ] = "joint"
    map_covariance: Annotated[
        bool,
        Field(description="target separate: add the map's covariance; not printed"),
    ] = True
    gate_sigmas: Annotated[
        float,
        Field(
            ge=0.0,
            description="gate on the innovation of a bearing; 0: none, as printed",
        ),
    ] = 3.0
    max_relative_distance_sigma: Annotated[
        float,
        Field(
            ge=0.0,
            description="largest relative deviation of a feature's distance in the map; 0: any",
        ),
    ] = 0.3
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

    forward: Annotated[
        float, Field(gt=0.0, description="deviation of the speed after a second, legs/s")
    ] = 0.1
    sideways: Annotated[
        float, Field(gt=0.0, description="the same of the sideways speed: slip")
    ] = 0.03
    turning_deg: Annotated[
        float, Field(gt=0.0, description="the same of the turning rate, degrees/s")
    ] = 60.0


@dataclass(frozen=True, config=STRICT)
class HomingGraphSettings(NamedSettings):
    """The same problem as one graph of bearings (design H)."""

    kind: Literal["homing_graph"] = "homing_graph"
    solver: Annotated[
        Literal["schur", "isam2", "fixed_lag", "batch"],
        Field(description="`schur` exact, all images; `isam2`, `fixed_lag`, `batch` by GTSAM"),
    ] = "schur"
    kernel: KernelSettings = KernelSettings("cauchy", 2.0)
    elevations: Annotated[
        Literal["none", "two_views", "all"],
        Field(
            description="`two_views`: of start and target; `none`: a prior instead; `all`: of every"
            " image"
        ),
    ] = "two_views"
    max_relative_distance_sigma: Annotated[
        float,
        Field(
            gt=0.0,
            description="a feature enters once its relative distance deviation is below this",
        ),
    ] = 0.3
    gate_sigmas: Annotated[
        float,
        Field(
            ge=0.0,
            description="gate on the misfit of a bearing; 0: none",
        ),
    ] = 4.0
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
