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
    sigma_px: Annotated[
        float, Field(gt=0.0, description="of a tracked point, in pixels of the view")
    ] = 0.2
