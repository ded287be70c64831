"""Settings of the homing vector: RANSAC, refinement, and when to refuse."""

from __future__ import annotations

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, Count, NonNegative, Positive


@dataclass(frozen=True, config=STRICT)
class HomingVectorSettings:
    """Two-point RANSAC, refinement by least squares, refusals (III-B)."""

    samples: Count = Field(default=200, description="at most so many samples (paper: 200)")
    confidence: float = Field(
        default=0.999, gt=0.0, lt=1.0, description="probability at which sampling stops earlier"
    )
    tilt_sigma_deg: NonNegative = Field(
        default=0.5, description="prior of the camera's roll and pitch"
    )
    height_sigma: NonNegative = Field(
        default=0.01, description="difference of the cameras' heights, in legs; estimated, too"
    )
    min_inliers: int = Field(default=8, ge=3, description="fewer are refused")
    max_false_alarms: Positive = Field(
        default=1e-9, description="expected number of such vectors if all matches were wrong"
    )
    rival_log_odds: NonNegative = Field(
        default=15.0,
        description="least lead (natural log) over any different solution; else ambiguous",
    )
    rival_angle_deg: Positive = Field(
        default=15.0, description="solutions closer than this are one and the same"
    )
    max_direction_sigma_deg: Positive = Field(
        default=12.0, description="less certain directions are refused"
    )
    second_look: bool = Field(
        default=True,
        description="match unclear images again with all candidates, at a third of a second",
    )
    direction_floor_deg: NonNegative = Field(
        default=0.0,
        description="added to the direction's sigma in quadrature, as for stitched panoramas",
    )
    rotation_floor_deg: NonNegative = Field(default=0.0, description="likewise for the rotation")
    at_target_parallax_deg: NonNegative = Field(
        default=0.5, description="median parallax below which both views are from one place"
    )
