"""Settings of the homing vector: RANSAC, refinement, and when to refuse."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT


@dataclass(frozen=True, config=STRICT)
class HomingVectorSettings:
    """Two-point RANSAC, refinement by least squares, refusals (III-B)."""

    samples: Annotated[
        int, Field(ge=1, description="at most so many random pairs of matches (200 in the paper)")
    ] = 200
    confidence: Annotated[
        float,
        Field(
            gt=0.0,
            lt=1.0,
            description="stop earlier once a better answer is this unlikely to have been missed",
        ),
    ] = 0.999
    tilt_sigma_deg: Annotated[
        float,
        Field(
            ge=0.0,
            description="camera's roll and pitch at each view, estimated along with this prior",
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
            description="expected number of equally likely vectors if all matches were wrong; so "
            "small because wrong matches have common causes (measured on `omni_home`)",
        ),
    ] = 1e-9
    rival_log_odds: Annotated[
        float,
        Field(
            ge=0.0,
            description="the answer must be this much likelier (natural log) than any different "
            "solution; else it is ambiguous",
        ),
    ] = 15.0
    rival_angle_deg: Annotated[
        float, Field(gt=0.0, description="solutions closer than this are one and the same")
    ] = 15.0
    max_direction_sigma_deg: Annotated[
        float, Field(gt=0.0, description="less certain directions are refused")
    ] = 4.0
    second_look: Annotated[
        bool,
        Field(
            description="two images whose matches do not decide clearly are looked at again with "
            "all candidate matches: wider baselines, for a third of a second a pair"
        ),
    ] = True
    direction_floor_deg: Annotated[
        float,
        Field(
            ge=0.0,
            description="added to the direction's sigma in quadrature: what the images themselves "
            "cannot tell: panoramas stitched from several viewpoints, an inexact reference",
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
