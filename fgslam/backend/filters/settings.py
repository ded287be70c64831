"""Settings of the filters."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.backend.common_settings import Family, FloorSettings, NamedSettings
from fgslam.core.settings import STRICT


@dataclass(frozen=True, config=STRICT)
class LoopCorrectionSettings:
    """What closing a loop does to the drive so far (docs/derivations/submaps.md)."""

    submap_frames: Annotated[
        int,
        Field(
            ge=1,
            description="frames to a submap, whose beginnings are the variables of the pose graph "
            "that corrects the drive backwards; within one the change is spread",
        ),
    ] = 10
    drift_factor: Annotated[
        float,
        Field(
            gt=0.0,
            description="deviations of a frame's tracked pose are multiplied by this for the step "
            "to it: the tracked pose's own covariance takes the landmarks as they are",
        ),
    ] = 1.0
    closure_factor: Annotated[
        float,
        Field(
            gt=0.0,
            description="deviations of a closure are multiplied by this: its own covariance takes "
            "the map around both frames as rigid",
        ),
    ] = 3.0
    gate_sigmas: Annotated[
        float,
        Field(
            ge=0.0,
            description="a loop closure is refused where it raises the cost by more than the "
            "square of this; 0: none is",
        ),
    ] = 10.0


@dataclass(frozen=True, config=STRICT)
class DeadReckoningSettings(NamedSettings):
    """Odometry alone: poses are never corrected, landmarks stay where they were first seen."""

    kind: Literal["odometry"] = "odometry"


@dataclass(frozen=True, config=STRICT)
class LandmarkKalmanSettings(NamedSettings):
    """The paper's estimator: one 3x3 Kalman filter per landmark (Se et al. 4.1 and 6.4)."""

    family: ClassVar[Family] = "filter"
    kind: Literal["landmark_kalman"] = "landmark_kalman"
    update: Annotated[
        Literal["pixel", "world", "running_mean", "half"],
        Field(
            description="how a matched landmark moves: `pixel` Kalman update on (column, row, "
            "disparity), the most accurate measured; `world` Kalman fusion of 3-D positions "
            "(6.4); `running_mean` and `half` the plain averaging of 4.1 (with and without a count)"
        ),
    ] = "pixel"
    pose_covariance: Annotated[
        bool,
        Field(
            description="add the pose's covariance to the observation's (6.4 read with IJRR 2002)"
        ),
    ] = True
    miss_growth_m: Annotated[
        float,
        Field(
            ge=0.0, description="standard deviation in metres added to a landmark on a miss (6.4)"
        ),
    ] = 0.0001
    loops: LoopCorrectionSettings = LoopCorrectionSettings()


@dataclass(frozen=True, config=STRICT)
class LandmarkKalmanGraphSettings(NamedSettings):
    """The same estimator as factor graphs: equal to ``landmark_kalman`` up to rounding."""

    family: ClassVar[Family] = "filter"
    kind: Literal["landmark_kalman_graph"] = "landmark_kalman_graph"
    update: Annotated[
        Literal["pixel", "world"],
        Field(description="as landmark_kalman's; the averaging of 4.1 is no least-squares problem"),
    ] = "pixel"
    pose_covariance: Annotated[bool, Field(description="as landmark_kalman's")] = True
    miss_growth_m: Annotated[float, Field(ge=0.0, description="as landmark_kalman's")] = 0.0001
    loops: LoopCorrectionSettings = LoopCorrectionSettings()


@dataclass(frozen=True, config=STRICT)
class EkfSettings(NamedSettings):
    """Full stochastic mapping: one joint covariance of pose and landmarks, no relinearisation."""

    family: ClassVar[Family] = "filter"
    kind: Literal["ekf"] = "ekf"
    floor: FloorSettings = FloorSettings()
    gate_sigmas: Annotated[
        float,
        Field(
            ge=0.0,
            description="a match is left out when its own innovation exceeds this many standard "
            "deviations (Mahalanobis distance); 0: no gate",
        ),
    ] = 5.0
    loop_gate_sigmas: Annotated[
        float,
        Field(
            ge=0.0,
            description="a loop closure is refused where its innovation squared exceeds its "
            "degrees of freedom by more than the square of this; 0: none is",
        ),
    ] = 10.0
    max_landmarks: Annotated[
        int,
        Field(
            ge=1,
            description="refuse to hold more: the joint covariance takes 72 n^2 bytes, 1.2 GB for "
            "4000 landmarks, and up to half as much again in reserve",
        ),
    ] = 4000
