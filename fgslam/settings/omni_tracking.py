"""Settings of feature tracking on the way (Goedemé et al. IV-A)."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.settings.base import STRICT


@dataclass(frozen=True, config=STRICT)
class OmniTrackingSettings:
    """KLT tracking on an unwrapped view of each image, and the choice of trackable points."""

    max_view_width: Annotated[
        int, Field(ge=64, le=4096, description="columns of the view; less for coarser cameras")
    ] = 720
    window_px: Annotated[
        int, Field(ge=5, le=63, description="side of the tracked window, in the view")
    ] = 15
    pyramid_levels: Annotated[
        int, Field(ge=0, le=6, description="halvings of the view above the view itself")
    ] = 2
    iterations: Annotated[int, Field(ge=1, description="of Newton's method on each level")] = 15
    precision_px: Annotated[
        float, Field(gt=0.0, description="a smaller step ends the iteration")
    ] = 0.03
    max_back_px: Annotated[
        float,
        Field(gt=0.0, description="a point tracked back that misses its origin by more is lost"),
    ] = 1.0
    min_eigenvalue: Annotated[
        float,
        Field(
            ge=0.0,
            description="smaller eigenvalue of eq. 2 over the window, a pixel, grey values 0 to 1",
        ),
    ] = 1e-4
    min_correlation: Annotated[
        float,
        Field(
            ge=-1.0,
            le=1.0,
            description="of a window with the same point's window in the image before",
        ),
    ] = 0.8
    sigma_px: Annotated[
        float, Field(gt=0.0, description="of a tracked point, in pixels of the view")
    ] = 0.35
    search_px: Annotated[
        float,
        Field(
            ge=1.0,
            description="the best trackable point is sought within the feature's scale, at least "
            "this far from its centre and at most three times as far",
        ),
    ] = 3.0
    plane_error: Annotated[
        float,
        Field(
            ge=0.0,
            description="part of that offset by which its place in the target view is uncertain: "
            "features are not flat, nor seen head on",
        ),
    ] = 0.2
    distinct_px: Annotated[
        float, Field(ge=0.0, description="of two trackable points nearer than this one is kept")
    ] = 3.0
