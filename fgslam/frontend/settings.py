"""Settings of the SLAM front-end: stereo, landmark database, map matching, ego-motion, places."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT
from fgslam.frontend.features.settings import AppearanceSettings, SiftSettings

_ROWS_PX = 2.0
"""Rows that partners may be apart and be found by comparing row with row: in the rendered lab as
many as by SIFT, at 3 px two thirds, at 5 px a fifth."""


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
        float | None,
        Field(
            gt=0.0,
            description="largest disparity; 20 in IJRR 2002; null: any",
        ),
    ] = None
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
    others: Annotated[
        Literal["auto", "sift", "patches"],
        Field(
            description="the other cameras: `sift` in all images; `patches` of the reference "
            "image's features, aligned there, if `measurement: fused`; `auto`: patches with two "
            "cameras, if `epipolar_px` is at most 2"
        ),
    ] = "auto"
    measurement: Annotated[
        Literal["fused", "paper"],
        Field(
            description="`fused`: least squares over all images; `paper`: (row, column), mean "
            "disparity"
        ),
    ] = "fused"
    pixel_sigma: Annotated[
        float,
        Field(gt=0.0, description="standard deviation of a SIFT coordinate, pixels"),
    ] = 0.3
    disparity_sigma_px: Annotated[
        float | None,
        Field(
            gt=0.0,
            description="sigma of a depth camera's disparity; null: by pixel_sigma",
        ),
    ] = None

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

    widen_sigmas: Annotated[
        float,
        Field(
            ge=0.0,
            description="widen search windows by so many sigmas of the prediction; 0: fixed",
        ),
    ] = 3.0
    refine: Annotated[
        bool,
        Field(description="match again around the first pose where that moved landmarks far"),
    ] = True
    rescue: Annotated[
        bool,
        Field(description="where matching fails, or finds little, search without the prediction"),
    ] = True


@dataclass(frozen=True, config=STRICT)
class PermanenceSettings:
    """Landmarks that are never pruned for being missed (Se et al. 6.2), and when they lose that."""

    ratio: Annotated[
        float,
        Field(
            ge=0.0,
            lt=1.0,
            description="least hits / (hits + misses) of a permanent landmark",
        ),
    ] = 0.3
    hits: Annotated[
        int,
        Field(ge=1, description="least hits of a permanent landmark, and valid_hits (6.1)"),
    ] = 5
    when: Annotated[
        Literal["running", "saved"],
        Field(description="flag set with the hit (`running`), or on saving (`saved`, 6.2)"),
    ] = "running"
    blind_below: Annotated[
        float,
        Field(
            ge=0.0,
            le=1.0,
            description="below this share of expected landmarks a frame counts no misses",
        ),
    ] = 0.05
    contradicted_after: Annotated[
        int | None,
        Field(
            ge=1,
            description="contradicting frames without a hit until it is ordinary again; null: "
            "never",
        ),
    ] = 20


@dataclass(frozen=True, config=STRICT)
class ViewpointSettings:
    """Several views of a landmark, from different directions (Se et al. 6.3)."""

    max_views: Annotated[
        int,
        Field(
            ge=2,
            le=64,
            description="views a landmark; a further one replaces that matched longest ago",
        ),
    ] = 8


@dataclass(frozen=True, config=STRICT)
class DatabaseSettings:
    """Initiation, validation and pruning of landmarks (Se et al. 4 and 6.1)."""

    prune_after_misses: Annotated[
        int, Field(ge=1, description="N: consecutive misses until a landmark goes; 20 in 4.3")
    ] = 20
    valid_hits: Annotated[
        int, Field(ge=1, description="hits until a landmark counts as valid; 3 in 6.1")
    ] = 3
    forget_unconfirmed_after: Annotated[
        int | None,
        Field(
            ge=1,
            description="frames until a landmark below valid_hits is dropped, in view or not",
        ),
    ] = None
    field_of_view: Annotated[
        Literal["image", "cone"],
        Field(description="`image`: within its bounds; `cone`: the paper's 30 degrees (4.4)"),
    ] = "image"
    border_px: Annotated[
        float,
        Field(
            ge=0.0,
            description="nearer to an image's edge a landmark is not missed",
        ),
    ] = 8.0
    least_scale_px: Annotated[
        float | None,
        Field(
            gt=0.0,
            description="smaller landmarks are not expected; 0.8 suits base_sigma_px 2",
        ),
    ] = None
    permanence: Annotated[
        PermanenceSettings | None,
        Field(description="permanent landmarks (6.2); null: none but those of a map loaded"),
    ] = None
    viewpoints: Annotated[
        ViewpointSettings | None,
        Field(description="several views a landmark (6.3); null: the latest one alone"),
    ] = None


@dataclass(frozen=True, config=STRICT)
class EgoMotionSettings:
    """Least-squares pose of a frame against the map (Se et al. 3.3 and 5)."""

    dof: Annotated[
        Literal[6, 5, 3],
        Field(description="6 general; 5 fixed height (section 5); 3 planar"),
    ] = 6
    residuals: Annotated[
        Literal["image_disparity", "image"],
        Field(description="`image`: row and column, as 3.3; `image_disparity`: disparity too"),
    ] = "image_disparity"
    weighting: Annotated[
        Literal["landmark", "measurement", "uniform"],
        Field(description="of `measurement`, with that of the `landmark`, or `uniform` (3.3)"),
    ] = "landmark"
    prior: Annotated[
        bool,
        Field(description="stabilise towards the odometry by its covariance (Lowe 1991)"),
    ] = True
    outlier_px: Annotated[
        float, Field(gt=0.0, description="drop matches with a larger image residual; 3 in 3.3")
    ] = 3.0
    outlier_sigmas: Annotated[
        float,
        Field(
            ge=0.0,
            description="drop matches beyond so many of their standard deviations; 0: none",
        ),
    ] = 4.0
    kernel: Annotated[
        Literal["none", "huber", "cauchy"],
        Field(description="robust kernel on the normalised residual before outliers are dropped"),
    ] = "cauchy"
    min_matches: Annotated[
        int, Field(ge=1, description="fewer inliers than this: the odometry is the pose (4.1)")
    ] = 6
    max_correction_m: Annotated[
        float,
        Field(
            gt=0.0,
            description="cap on the correction of the odometry (5), or six sigmas if larger",
        ),
    ] = 0.3
    max_correction_deg: Annotated[float, Field(gt=0.0, description="likewise of the rotation")] = (
        6.0
    )


@dataclass(frozen=True, config=STRICT)
class RelocalisationSettings:
    """Global localisation from one frame, or from a short submap of frames."""

    method: Annotated[
        Literal["ransac", "hough"],
        Field(description="poses by minimal samples, or by votes"),
    ] = "ransac"
    descriptors: Annotated[
        bool,
        Field(description="match by descriptor; false: by size, height and orientation alone"),
    ] = True
    map_sigma_m: Annotated[
        float,
        Field(
            ge=0.0,
            description="added to landmarks': drift of the map",
        ),
    ] = 0.01
    max_sigma_m: Annotated[
        float, Field(gt=0.0, description="largest standard deviation of an accepted position")
    ] = 0.05
    max_sigma_deg: Annotated[
        float, Field(gt=0.0, description="largest standard deviation of an accepted heading")
    ] = 1.0


@dataclass(frozen=True, config=STRICT)
class LostSettings:
    """When a robot counts as lost, and what it then does."""

    after: Annotated[
        int,
        Field(
            ge=1,
            description="unlocated frames in a row until the whole map is searched",
        ),
    ] = 2
    give_up_after: Annotated[
        int,
        Field(
            ge=1,
            description="frames lost until mapping goes on from the odometry",
        ),
    ] = 10


@dataclass(frozen=True, config=STRICT)
class LoopSettings:
    """When a return is looked for, and what it takes to be believed."""

    every: Annotated[
        int,
        Field(ge=1, description="frames between looks; after a place was recognised, every frame"),
    ] = 4
    forgotten_after: Annotated[
        int,
        Field(
            ge=2,
            description="frames unseen until a landmark counts as old",
        ),
    ] = 60
    confirm: Annotated[
        int,
        Field(
            ge=1,
            description="frames in a row that find the same offset",
        ),
    ] = 3
    max_drift_share: Annotated[
        float,
        Field(
            ge=0.0,
            description="largest drift as a share of the way since (poor wheels: 0.05)",
        ),
    ] = 0.08
    min_matches: Annotated[
        int, Field(ge=3, description="old landmarks that must agree on the closure in the end")
    ] = 12
    max_sigma_m: Annotated[
        float,
        Field(gt=0.0, description="largest standard deviation of a closure's position, metres"),
    ] = 0.10
    max_sigma_deg: Annotated[
        float,
        Field(gt=0.0, description="largest standard deviation of a closure's heading, degrees"),
    ] = 1.0
    rest: Annotated[
        int, Field(ge=0, description="frames after a closure in which no other is looked for")
    ] = 15


@dataclass(frozen=True, config=STRICT)
class FrontendSettings:
    """All of the front-end."""

    tracking: Annotated[
        Literal["sift", "hybrid"],
        Field(
            description="`hybrid`: SIFT on the reference image of key frames, patches (KLT) "
            "between and across; `sift`: SIFT on every frame"
        ),
    ] = "hybrid"
    sift: SiftSettings = SiftSettings()
    stereo: StereoSettings = StereoSettings()
    appearance: AppearanceSettings = AppearanceSettings()
    matching: MapMatchingSettings = MapMatchingSettings()
    database: DatabaseSettings = DatabaseSettings()
    ego_motion: EgoMotionSettings = EgoMotionSettings()
    relocalisation: RelocalisationSettings = RelocalisationSettings()
    loops: Annotated[
        LoopSettings | None,
        Field(description="close loops; null: off"),
    ] = None
    lost: Annotated[
        LostSettings | None,
        Field(description="search the whole map when lost; null: odometry alone"),
    ] = None
    watch_cameras: Annotated[
        bool,
        Field(description="leave out frames of late or swapped cameras, report darker ones"),
    ] = True
    self_calibration: Annotated[
        bool,
        Field(
            description="correct the rig's calibration from the drive; needs "
            "stereo.measurement fused"
        ),
    ] = True
