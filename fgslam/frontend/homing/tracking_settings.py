"""Settings of feature tracking on the way (Goedemé et al. IV-A)."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT


@dataclass(frozen=True, config=STRICT)
class OmniTrackingSettings:
    """KLT tracking on an unwrapped view of each image, and the choice of trackable points."""

    max_points: Annotated[
        int,
        Field(
            ge=3,
            description="tracked in one homing, the surest of all directions alike; the paper "
            "finds 30 to 50, and an image's cost grows with them",
        ),
    ] = 50
    max_view_width: Annotated[
        int, Field(ge=64, le=4096, description="columns of the view; less for coarser cameras")
    ] = 720
    window_px: Annotated[
        int, Field(ge=5, le=63, description="side of the tracked window, in the view")
    ] = 9
    min_correlation: Annotated[
        float,
        Field(
            ge=-1.0,
            le=1.0,
            description="of a point's patch with its first one, gain and offset taken out; a point "
            "that looks less like it is lost",
        ),
    ] = 0.7
    patch_noise_grey: Annotated[
        float,
        Field(gt=0.0, description="sigma of its grey values: noise, and what no affine map does"),
    ] = 4.0
    sigma_px: Annotated[
        float, Field(gt=0.0, description="of a tracked point, in pixels of the view")
    ] = 0.2
