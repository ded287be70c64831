"""Settings of the homing vector: RANSAC, refinement, and when to refuse."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT


@dataclass(frozen=True, config=STRICT)
class HomingVectorSettings:
    """Two-point RANSAC, refinement by least squares, refusals (III-B)."""

    samples: Annotated[int, Field(ge=1, description="at most so many samples (paper: 200)")] = 200
    confidence: Annotated[
        float,
        Field(
            gt=0.0,
            lt=1.0,
            description="probability at which sampling stops earlier",
        ),
    ] = 0.999
    tilt_sigma_deg: Annotated[
        float,
        Field(
            ge=0.0,
            description="prior of the camera's roll and pitch",
        ),
    ] = 0.5
    height_sigma: Annotated[
        float,
        Field(ge=0.0, description="difference of the cameras' heights, in legs; estimated, too"),
    ] = 0.01
    min_inliers: Annotated[int, Field(ge=3, description="fewer are refused")] = 8
    max_false_alarms: Annotated[
        float,
        Field(
            gt=0.0,
            description="expected number of such vectors if all matches were wrong",
        ),
    ] = 1e-9
    rival_log_odds: Annotated[
        float,
        Field(
            ge=0.0,
            description="least lead (natural log) over any different solution; else ambiguous",
        ),
    ] = 15.0
    rival_angle_deg: Annotated[
        float, Field(gt=0.0, description="solutions closer than this are one and the same")
    ] = 15.0
    max_direction_sigma_deg: Annotated[
        float, Field(gt=0.0, description="less certain directions are refused")
    ] = 12.0
    second_look: Annotated[
        bool,
        Field(description="match unclear images again with all candidates, at a third of a second"),
    ] = True
    direction_floor_deg: Annotated[
        float,
        Field(
            ge=0.0,
            description="added to the direction's sigma in quadrature, as for stitched panoramas",
        ),
    ] = 0.0
    rotation_floor_deg: Annotated[float, Field(ge=0.0, description="likewise for the rotation")] = (
        0.0
    )
    at_target_parallax_deg: Annotated[
        float,
        Field(
            ge=0.0,
            description="median parallax below which both views are from one place",
        ),
    ] = 0.5
