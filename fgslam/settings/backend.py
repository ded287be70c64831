"""Settings of the estimators, as a tagged union over ``kind``."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.settings.base import STRICT


@dataclass(frozen=True, config=STRICT)
class LandmarkKalmanSettings:
    """The paper's estimator: one 3x3 Kalman filter per landmark (Se et al. 4.1 and 6.4)."""

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


EstimatorSettings: TypeAlias = LandmarkKalmanSettings
