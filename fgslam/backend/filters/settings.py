"""Settings of the filters."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.backend.common_settings import Family, FloorSettings, NamedSettings
from fgslam.core.settings import STRICT


@dataclass(frozen=True, config=STRICT)
class LoopCorrectionSettings:
    """Which loop closures an estimator accepts (docs/derivations/submaps.md)."""

    gate_sigmas: Annotated[
        float,
        Field(
            ge=0.0,
            description="a loop closure is refused where it raises the cost by more than the "
            "square of this (ekf: its innovation squared beyond what is expected); 0: none is",
        ),
    ] = 10.0


@dataclass(frozen=True, config=STRICT)
class DeadReckoningSettings(NamedSettings):
    """Odometry alone: poses are never corrected, landmarks stay where they were first seen."""

    kind: Literal["odometry"] = "odometry"


@dataclass(frozen=True, config=STRICT)
class PerLandmarkSettings(NamedSettings):
    """What the paper's filter and the same filter as factor graphs share."""

    family: ClassVar[Family] = "filter"
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
class LandmarkKalmanSettings(PerLandmarkSettings):
    """The paper's estimator: least-squares pose, one 3x3 filter per landmark (6.4)."""

    kind: Literal["landmark_kalman"] = "landmark_kalman"
    update: Annotated[
        Literal["pixel", "world", "running_mean", "half"],
        Field(
            description="how a matched landmark moves: `pixel` Kalman update on (column, row, "
            "disparity), the most accurate measured; `world` Kalman fusion of 3-D positions "
            "(6.4); `running_mean` and `half` the plain averaging of 4.1 (with and without a count)"
        ),
    ] = "pixel"


@dataclass(frozen=True, config=STRICT)
class LandmarkKalmanGraphSettings(PerLandmarkSettings):
    """The same estimator as factor graphs: equal to ``landmark_kalman`` up to rounding."""

    kind: Literal["landmark_kalman_graph"] = "landmark_kalman_graph"
    update: Annotated[
        Literal["pixel", "world"],
        Field(description="as landmark_kalman's; the averaging of 4.1 is no least-squares problem"),
    ] = "pixel"


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
    loops: LoopCorrectionSettings = LoopCorrectionSettings()
    max_landmarks: Annotated[
        int,
        Field(
            ge=1,
            description="refuse to hold more: the joint covariance takes 72 n^2 bytes, 1.2 GB for "
            "4000 landmarks, and up to half as much again in reserve",
        ),
    ] = 4000
