"""Settings of features: SIFT, how descriptors are compared, omnidirectional features."""

from __future__ import annotations

from typing import Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, NonNegative, Positive

Appearance: TypeAlias = Literal["descriptor", "paper"]


@dataclass(frozen=True, config=STRICT)
class SiftSettings:
    """SIFT features of one image (Se et al. 2.1)."""

    contrast_threshold: NonNegative = Field(
        default=0.03, description="OpenCV's contrast threshold, halved inside"
    )
    contrast: Literal["relative", "absolute"] = Field(
        default="relative",
        description="`relative`: the threshold falls with an image's contrast, down to its noise",
    )
    base_sigma_px: float = Field(
        default=1.6, gt=0.5, le=3.0, description="Gaussian of the first level, doubled image"
    )
    max_features: int = Field(
        default=0,
        ge=0,
        le=1_000_000,
        description="keep this many of the strongest features; 0 keeps all",
    )


@dataclass(frozen=True, config=STRICT)
class AppearanceSettings:
    """Use of SIFT descriptors, which the 2001 paper does without."""

    mode: Appearance = Field(
        default="descriptor",
        description="`descriptor`: the closest admissible wins; `paper`: none are used",
    )


@dataclass(frozen=True, config=STRICT)
class UprightSiftSettings:
    """Rotation-reduced SIFT (III-A1)."""

    contrast_threshold: NonNegative = Field(
        default=0.015, description="OpenCV's contrast threshold (its default is 0.04)"
    )


@dataclass(frozen=True, config=STRICT)
class OmniMatchingSettings:
    """Matching of two views' features (III-A)."""

    ratio: float = Field(
        default=0.9,
        gt=0.0,
        le=1.0,
        description="SIFT: nearest over second nearest distance below this",
    )
    root: bool = Field(
        default=True,
        description="compare square roots of descriptors (Arandjelovic, Zisserman 2012)",
    )
    max_colour_distance: Positive = Field(
        default=0.2, description="Euclidean, of (C_RB, C_RG, C_GB); larger ones are discarded"
    )
    planar_gates: bool = Field(
        default=True, description="leave out candidates that no planar motion explains"
    )


@dataclass(frozen=True, config=STRICT)
class OmniFeatureSettings:
    """All of the omnidirectional features."""

    sift: UprightSiftSettings = UprightSiftSettings()
    matching: OmniMatchingSettings = OmniMatchingSettings()
    kinds: Literal["both", "sift", "columns"] = Field(
        default="both", description="which features are sought; the paper uses both kinds together"
    )
