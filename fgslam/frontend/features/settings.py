"""Settings of features: SIFT, how descriptors are compared, omnidirectional features."""

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
        Field(ge=1, le=8, description="levels an octave; 2: factor 1.41 (paper: 1.5)"),
    ] = 2
    contrast_threshold: Annotated[
        float,
        Field(ge=0.0, description="OpenCV's contrast threshold, divided by octave_layers inside"),
    ] = 0.03
    contrast: Annotated[
        Literal["relative", "absolute"],
        Field(
            description="`relative`: the threshold falls with an image's contrast, down to its "
            "noise"
        ),
    ] = "relative"
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
        Field(description="`descriptor`: the closest admissible wins; `paper`: none are used"),
    ] = "descriptor"
    max_distance: Annotated[
        float,
        Field(gt=0.0, description="largest distance of descriptors, whose norm is 512"),
    ] = 350.0
    ratio: Annotated[
        float,
        Field(gt=0.0, le=1.0, description="best distance at most this fraction of second best"),
    ] = 0.85


@dataclass(frozen=True, config=STRICT)
class ColourMomentSettings:
    """Colour of a patch or segment: eq. 1 with centred bands."""

    form: Annotated[
        Literal["ratio", "correlation"],
        Field(description="`ratio`: blind to gain; `correlation`: to gain and offset"),
    ] = "ratio"


@dataclass(frozen=True, config=STRICT)
class UprightSiftSettings:
    """Rotation-reduced SIFT (III-A1)."""

    contrast_threshold: Annotated[
        float,
        Field(
            ge=0.0,
            description="OpenCV's contrast threshold (its default is 0.04)",
        ),
    ] = 0.015
    max_features: Annotated[
        int, Field(ge=0, le=1_000_000, description="keep the strongest so many; 0 keeps all")
    ] = 3000
    min_elevation_deg: Annotated[
        float, Field(ge=-90.0, lt=90.0, description="below it: the floor at our feet, the tripod")
    ] = -60.0
    max_elevation_deg: Annotated[
        float, Field(gt=-90.0, le=90.0, description="above it: the ceiling overhead")
    ] = 60.0
    view: Annotated[
        Literal["unwrapped", "raw"],
        Field(description="of mirrors and fisheyes: `raw` image, or `unwrapped` panorama"),
    ] = "unwrapped"


@dataclass(frozen=True, config=STRICT)
class OmniMatchingSettings:
    """Matching of two views' features (III-A)."""

    ratio: Annotated[
        float,
        Field(
            gt=0.0,
            le=1.0,
            description="SIFT: nearest over second nearest distance below this",
        ),
    ] = 0.9
    root: Annotated[
        bool,
        Field(description="compare square roots of descriptors (Arandjelovic, Zisserman 2012)"),
    ] = True
    max_colour_distance: Annotated[
        float,
        Field(gt=0.0, description="Euclidean, of (C_RB, C_RG, C_GB); larger ones are discarded"),
    ] = 0.2
    planar_gates: Annotated[
        bool,
        Field(description="leave out candidates that no planar motion explains"),
    ] = True


@dataclass(frozen=True, config=STRICT)
class OmniFeatureSettings:
    """All of the omnidirectional features."""

    sift: UprightSiftSettings = UprightSiftSettings()
    colour: ColourMomentSettings = ColourMomentSettings()
    matching: OmniMatchingSettings = OmniMatchingSettings()
    kinds: Annotated[
        Literal["both", "sift", "columns"],
        Field(description="which features are sought; the paper uses both kinds together"),
    ] = "both"
