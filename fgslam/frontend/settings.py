"""Settings of the SLAM front-end: stereo, landmark database, map matching, ego-motion, places."""

from __future__ import annotations

import math
from typing import Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, Count, NonNegative, Positive, Share

# ------------------------------------------------------------------------------------------
# Settings of features: SIFT, how descriptors are compared, omnidirectional features

Appearance: TypeAlias = Literal["descriptor", "paper"]


@dataclass(frozen=True, config=STRICT)
class SiftSettings:
    """SIFT features of one image (Se et al. 2.1)."""

    contrast_threshold: NonNegative = Field(
        default=0.03, description="OpenCV's contrast threshold, halved inside"
    )
    contrast: Literal["relative", "absolute"] = Field(
        default="relative",
        description="`relative`: the threshold falls with an image's contrast, and where features "
        "are few, down to its noise; a noisy image is smoothed",
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


_ROWS_PX = 2.0
"""Rows that partners may be apart and be found by comparing row with row: in the rendered lab as
many as by SIFT, at 3 px two thirds, at 5 px a fifth."""


@dataclass(frozen=True, config=STRICT)
class StereoSettings:
    """Matching over the rig (Se et al. 2.2); gates from the authors' later paper (IJRR 2002)."""

    epipolar_px: Positive = Field(
        default=1.0, description="largest distance from the epipolar line"
    )
    min_disparity_px: Positive = Field(
        default=1.0, description="smallest disparity; below it depth is meaningless"
    )
    max_disparity_px: Positive | None = Field(
        default=None, description="largest disparity; 20 in IJRR 2002; null: any"
    )
    others: Literal["auto", "sift", "patches"] = Field(
        default="auto",
        description="the other cameras: `sift` in all images; `patches` of the reference "
        "image's features, aligned there, if `measurement: fused`; `auto`: patches with two "
        "cameras, if `epipolar_px` is at most 2",
    )
    measurement: Literal["fused", "paper"] = Field(
        default="fused",
        description="`fused`: least squares over all images; `paper`: (row, column), mean "
        "disparity",
    )
    pixel_sigma: Positive = Field(
        default=0.3, description="standard deviation of a SIFT coordinate, pixels"
    )
    disparity_sigma_px: Positive | None = Field(
        default=None, description="sigma of a depth camera's disparity; null: by pixel_sigma"
    )

    def by_patches(self, cameras: int) -> bool:
        """Whether patches measure the other images; the paper's measurement is of SIFT.

        Three images average the errors of SIFT's places, which patches share.
        """
        pair = cameras == 2 and self.epipolar_px <= _ROWS_PX
        wanted = self.others == "patches" or (self.others == "auto" and pair)
        return wanted and self.measurement == "fused"

    @property
    def largest_disparity_px(self) -> float:
        """Largest disparity; infinite without a limit."""
        return math.inf if self.max_disparity_px is None else self.max_disparity_px


@dataclass(frozen=True, config=STRICT)
class MapMatchingSettings:
    """Matching of features to predicted landmarks (Se et al. 3.1)."""

    widen_sigmas: NonNegative = Field(
        default=3.0,
        description="widen search windows by so many sigmas of the prediction; 0: fixed",
    )
    refine: bool = Field(
        default=True, description="match again around the first pose where that moved landmarks far"
    )
    rescue: bool = Field(
        default=True,
        description="where matching fails, or finds little, search without the prediction",
    )


@dataclass(frozen=True, config=STRICT)
class PermanenceSettings:
    """Landmarks that are never pruned for being missed (Se et al. 6.2), and when they lose that."""

    ratio: float = Field(
        default=0.3,
        ge=0.0,
        lt=1.0,
        description="least hits / (hits + misses) of a permanent landmark",
    )
    hits: Count = Field(
        default=5, description="least hits of a permanent landmark, and valid_hits (6.1)"
    )
    blind_below: Share = Field(
        default=0.05, description="below this share of expected landmarks a frame counts no misses"
    )
    contradicted_after: Count | None = Field(
        default=20,
        description="contradicting frames without a hit until it is ordinary again; null: never",
    )


@dataclass(frozen=True, config=STRICT)
class DatabaseSettings:
    """Initiation, validation and pruning of landmarks (Se et al. 4 and 6.1)."""

    prune_after_misses: Count = Field(
        default=20, description="N: consecutive misses until a landmark goes; 20 in 4.3"
    )
    valid_hits: Count = Field(
        default=3, description="hits until a landmark counts as valid; 3 in 6.1"
    )
    forget_unconfirmed_after: Count | None = Field(
        default=None,
        description="frames until a landmark below valid_hits is dropped, in view or not",
    )
    field_of_view: Literal["image", "cone"] = Field(
        default="image",
        description="`image`: within its bounds; `cone`: the paper's 30 degrees (4.4)",
    )
    least_scale_px: Positive | None = Field(
        default=None, description="smaller landmarks are not expected; 0.8 suits base_sigma_px 2"
    )
    permanence: PermanenceSettings | None = Field(
        default=None, description="permanent landmarks (6.2); null: none but those of a map loaded"
    )
    viewpoints: bool = Field(
        default=False, description="several views a landmark (6.3); false: the latest one alone"
    )


@dataclass(frozen=True, config=STRICT)
class EgoMotionSettings:
    """Least-squares pose of a frame against the map (Se et al. 3.3 and 5)."""

    dof: Literal[6, 5, 3] = Field(
        default=6, description="6 general; 5 fixed height (section 5); 3 planar"
    )
    residuals: Literal["image_disparity", "image"] = Field(
        default="image_disparity",
        description="`image`: row and column, as 3.3; `image_disparity`: disparity too",
    )
    weighting: Literal["landmark", "measurement", "uniform"] = Field(
        default="landmark",
        description="of `measurement`, with that of the `landmark`, or `uniform` (3.3)",
    )
    prior: bool = Field(
        default=True, description="stabilise towards the odometry by its covariance (Lowe 1991)"
    )
    outlier_px: Positive = Field(
        default=3.0, description="drop matches with a larger image residual; 3 in 3.3"
    )
    outlier_sigmas: NonNegative = Field(
        default=4.0, description="drop matches beyond so many of their standard deviations; 0: none"
    )
    kernel: Literal["none", "huber", "cauchy"] = Field(
        default="cauchy",
        description="robust kernel on the normalised residual before outliers are dropped",
    )
    min_matches: Count = Field(
        default=6, description="fewer inliers than this: the odometry is the pose (4.1)"
    )
    max_correction_m: Positive = Field(
        default=0.3,
        description="cap on the correction of the odometry (5), or six sigmas if larger",
    )
    max_correction_deg: Positive = Field(default=6.0, description="likewise of the rotation")


@dataclass(frozen=True, config=STRICT)
class RelocalisationSettings:
    """Global localisation from one frame, or from a short submap of frames."""

    map_sigma_m: NonNegative = Field(
        default=0.01, description="added to landmarks': drift of the map"
    )
    max_sigma_m: Positive = Field(
        default=0.05, description="largest standard deviation of an accepted position"
    )
    max_sigma_deg: Positive = Field(
        default=1.0, description="largest standard deviation of an accepted heading"
    )


@dataclass(frozen=True, config=STRICT)
class FrontendSettings:
    """All of the front-end."""

    tracking: Literal["sift", "hybrid"] = Field(
        default="hybrid",
        description="`hybrid`: SIFT on the reference image of key frames, patches (KLT) "
        "between and across; `sift`: SIFT on every frame",
    )
    sift: SiftSettings = SiftSettings()
    stereo: StereoSettings = StereoSettings()
    appearance: AppearanceSettings = AppearanceSettings()
    matching: MapMatchingSettings = MapMatchingSettings()
    database: DatabaseSettings = DatabaseSettings()
    ego_motion: EgoMotionSettings = EgoMotionSettings()
    relocalisation: RelocalisationSettings = RelocalisationSettings()
    loops: bool = Field(default=False, description="close loops")
    lost: bool = Field(
        default=False, description="search the whole map when lost; false: odometry alone"
    )
    watch_cameras: bool = Field(
        default=True, description="leave out frames of late or swapped cameras, report darker ones"
    )
    self_calibration: bool = Field(
        default=True,
        description="correct the rig's calibration from the drive; needs stereo.measurement fused",
    )


# ------------------------------------------------------------------------------------------
# Settings of the homing vector: RANSAC, refinement, and when to refuse


@dataclass(frozen=True, config=STRICT)
class HomingVectorSettings:
    """Two-point RANSAC, refinement by least squares, refusals (III-B)."""

    samples: Count = Field(default=200, description="at most so many samples (paper: 200)")
    confidence: float = Field(
        default=0.999, gt=0.0, lt=1.0, description="probability at which sampling stops earlier"
    )
    inliers: Literal["epipolar", "ratio"] = Field(
        default="epipolar",
        description="test of a sample's support: `epipolar` against the noise of the angles; "
        "`ratio` of the distances, as printed (III-B)",
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
        description="match again with all candidates, at a third of a second: answers unclear "
        "images, confirms clear ones",
    )
    direction_floor_deg: NonNegative = Field(
        default=0.0,
        description="added to the direction's sigma in quadrature, as for stitched panoramas",
    )
    rotation_floor_deg: NonNegative = Field(default=0.0, description="likewise for the rotation")
    at_target_parallax_deg: NonNegative = Field(
        default=0.5, description="median parallax below which both views are from one place"
    )
