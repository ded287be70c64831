"""Settings of stereo matching."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT


@dataclass(frozen=True, config=STRICT)
class StereoSettings:
    """Matching over the rig (Se et al. 2.2); gates from the authors' later paper (IJRR 2002)."""

    epipolar_px: Annotated[
        float, Field(gt=0.0, description="largest distance from the epipolar line")
    ] = 1.0
    min_disparity_px: Annotated[
        float, Field(gt=0.0, description="smallest disparity; below it depth is meaningless")
    ] = 1.0
    max_disparity_px: Annotated[
        float, Field(gt=0.0, description="largest disparity; 20 in IJRR 2002 (1.4 m at 320x240)")
    ] = 40.0
    scale_ratio: Annotated[
        float, Field(gt=1.0, description="largest ratio of scales; one level is 1.5 in IJRR 2002")
    ] = 1.5
    orientation_deg: Annotated[
        float, Field(gt=0.0, le=180.0, description="largest difference of orientations")
    ] = 20.0
    disparity_agreement_px: Annotated[
        float,
        Field(gt=0.0, description="largest difference of horizontal and vertical disparity"),
    ] = 1.0
    measurement: Annotated[
        Literal["fused", "paper"],
        Field(
            description="`paper`: reference (row, column) and the mean of both disparities; "
            "`fused`: least squares over all coordinates of the two or three images"
        ),
    ] = "fused"
    pixel_sigma: Annotated[
        float,
        Field(gt=0.0, description="standard deviation of a SIFT coordinate, pixels"),
    ] = 0.3
