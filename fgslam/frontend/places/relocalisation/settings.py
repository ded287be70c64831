"""Settings of relocalisation: the pose of a frame in a map without any prior."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT


@dataclass(frozen=True, config=STRICT)
class RelocalisationSettings:
    """Global localisation from one frame, or from a short submap of frames."""

    method: Annotated[
        Literal["ransac", "hough"],
        Field(description="how poses are proposed: from minimal samples of matches, or by votes"),
    ] = "ransac"
    descriptors: Annotated[
        bool,
        Field(
            description="propose matches by SIFT descriptor; false: by size, height and "
            "orientation alone, as features without descriptors would"
        ),
    ] = True
    samples: Annotated[
        int,
        Field(ge=16, description="minimal samples drawn at a time; most fail the rigidity test"),
    ] = 4096
    view_sigma_px: Annotated[
        float,
        Field(
            ge=0.0,
            description="added to a feature's noise: from elsewhere it is found elsewhere, pixels",
        ),
    ] = 0.3
    map_sigma_m: Annotated[
        float,
        Field(
            ge=0.0,
            description="added to a landmark's: what the map's drift hides from its covariances",
        ),
    ] = 0.01
    min_inliers: Annotated[
        int,
        Field(
            ge=3,
            description="fewer independent inliers are no pose; at most four count of one piece "
            "of the map, which may be one object",
        ),
    ] = 8
    max_sigma_m: Annotated[
        float, Field(gt=0.0, description="largest standard deviation of an accepted position")
    ] = 0.05
    max_sigma_deg: Annotated[
        float, Field(gt=0.0, description="largest standard deviation of an accepted heading")
    ] = 1.0
