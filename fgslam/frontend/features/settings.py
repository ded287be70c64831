"""Settings of SIFT and of how descriptors are compared."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT

Appearance: TypeAlias = Literal["descriptor", "paper"]


@dataclass(frozen=True, config=STRICT)
class SiftSettings:
    """SIFT features of one image (Se et al. 2.1)."""

    scale_levels: Annotated[
        int,
        Field(ge=1, le=64, description="scale levels searched, finest first; 8 in the paper"),
    ] = 8
    octave_layers: Annotated[
        int,
        Field(ge=1, le=8, description="levels an octave; 2 is a factor 1.41 a level (paper: 1.5)"),
    ] = 2
    contrast_threshold: Annotated[
        float,
        Field(ge=0.0, description="OpenCV's contrast threshold, divided by octave_layers inside"),
    ] = 0.03
    base_sigma_px: Annotated[
        float, Field(gt=0.5, le=3.0, description="Gaussian of the first level, doubled image")
    ] = 1.6
    max_features: Annotated[
        int,
        Field(
            ge=0, le=1_000_000, description="keep this many of the strongest features; 0 keeps all"
        ),
    ] = 0


@dataclass(frozen=True, config=STRICT)
class AppearanceSettings:
    """Use of SIFT descriptors, which the 2001 paper does without."""

    mode: Annotated[
        Appearance,
        Field(
            description="`descriptor`: among candidates that pass all gates the closest descriptor "
            "wins; `paper`: no descriptors, more than one candidate means none"
        ),
    ] = "descriptor"
    max_distance: Annotated[
        float,
        Field(gt=0.0, description="largest distance of descriptors, whose norm is 512"),
    ] = 350.0
    ratio: Annotated[
        float,
        Field(gt=0.0, le=1.0, description="best distance at most this fraction of second best"),
    ] = 0.85
