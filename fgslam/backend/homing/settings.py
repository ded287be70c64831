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
            description="deviation of the heading after a second, degrees: a random walk. The "
            "filter expects no turning, so that this must cover the robot's turns",
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
            description="what fixes the scale: `one_distance` that of one feature, the best known, "
            "as printed; `unit_leg` the distance from start to target"
        ),
    ] = "unit_leg"
    exact_bearings: Annotated[
        bool,
        Field(
            description="the bearings from the start have no variance, as printed; else "
            "that of the image"
        ),
    ] = False
    target: Annotated[
        Literal["separate", "joint"],
        Field(
            description="`separate`: a filter of its own, given the target's bearings anew with "
            "every image, as printed; `joint`: the target is part of the state and its "
            "bearings count once, in the initial triangulation"
        ),
    ] = "joint"
    map_covariance: Annotated[
        bool,
        Field(
            description="target separate: the map's covariance is added to that of the target's "
            "bearings; as printed it is not"
        ),
    ] = True
    gate_sigmas: Annotated[
        float,
        Field(
            ge=0.0,
            description="bearings whose innovation exceeds so many deviations are left out; 0: "
            "none is, as printed",
        ),
    ] = 3.0
    max_relative_distance_sigma: Annotated[
        float,
        Field(
            ge=0.0,
            description="features whose distance has a larger deviation, relative to itself, do "
            "not enter the map; 0: all enter, as printed",
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
        Field(
            description="`schur` the whole homing anew with every image, in plain arrays: exact "
            "and fastest; `isam2` GTSAM's, incremental over the whole homing; `fixed_lag` the same "
            "over the last images, older ones marginalised; `batch` GTSAM's Levenberg-Marquardt "
            "anew with every image"
        ),
    ] = "schur"
    kernel: KernelSettings = KernelSettings("cauchy", 2.0)
    elevations: Annotated[
        Literal["none", "two_views", "all"],
        Field(
            description="`two_views`: those from start and target, a factor for each landmark, in "
            "place of the direction and rotation that the initialisation found with them: nothing "
            "counts twice. `none`: direction and rotation as a prior instead. `all`: those of the "
            "images on the way, too, with a height for each landmark (twice as slow)"
        ),
    ] = "two_views"
    max_relative_distance_sigma: Annotated[
        float,
        Field(
            gt=0.0,
            description="a feature enters once its distance, triangulated from the start and the "
            "target or the present place, has a deviation below this part of itself: worse ones "
            "may cross the camera's centre and take the solution along",
        ),
    ] = 0.3
    gate_sigmas: Annotated[
        float,
        Field(
            ge=0.0,
            description="bearings that miss the landmark, seen from where all of them together "
            "say the robot is, by more than so many deviations do not enter; where that would be "
            "most of them, all enter. 0: all do, and the kernel alone deals with wrong ones",
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
