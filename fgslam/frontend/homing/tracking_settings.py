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
            description="of a point's patch with its first one, gain and offset taken out; a point "
            "that looks less like it is lost",
        ),
    ] = 0.7
    patch_px: Annotated[
        int,
        Field(ge=5, le=63, description="side of the patch that holds a point in place"),
    ] = 13
    patch_noise_grey: Annotated[
        float,
        Field(gt=0.0, description="sigma of its grey values: noise, and what no affine map does"),
    ] = 4.0
    patch_deformation: Annotated[
        float,
        Field(gt=0.0, description="sigma of its stretching and shearing from image to image"),
    ] = 0.05
    max_deformation: Annotated[
        float,
        Field(
            gt=0.0,
            description="a point whose patch is stretched and sheared by more (Frobenius norm of "
            "the affine map less one) is lost",
        ),
    ] = 1.0
    sigma_px: Annotated[
        float, Field(gt=0.0, description="of a tracked point, in pixels of the view")
    ] = 0.2
    sigma_deformed_px: Annotated[
        float,
        Field(
            ge=0.0,
            description="for each unit of its patch's deformation, added in squares: measured on "
            "the rendered house (docs/derivations/omni_tracking.md)",
        ),
    ] = 1.0
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
