"""Settings of the SLAM front-end: stereo, landmark database, map matching, ego-motion, places."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT
from fgslam.frontend.features.settings import AppearanceSettings, SiftSettings


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
            description="largest disparity; 20 in IJRR 2002 (1.4 m at 320x240). null: any, "
            "descriptors tell the right partner",
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
    measurement: Annotated[
        Literal["fused", "paper"],
        Field(
            description="`paper`: reference (row, column) and the mean of both disparities; "
            "`fused`: least squares over all coordinates of the two or three images"
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
            description="standard deviation of the disparity, pixels, where a depth camera gives "
            "it and not a second image; null: by pixel_sigma",
        ),
    ] = None

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
            description="widen window and disparity gate by this many standard deviations of the "
            "predicted measurement; 0 keeps the paper's fixed window",
        ),
    ] = 3.0
    refine: Annotated[
        bool,
        Field(
            description="match again around the first pose where that has moved the landmarks far "
            "in the image, with its smaller uncertainty"
        ),
    ] = True
    rescue: Annotated[
        bool,
        Field(
            description="where too few match, search the largest window by descriptor; where "
            "most of it contradicts the pose, too, all that was seen lately, wherever predicted, "
            "before falling back to the odometry; needs appearance.mode descriptor"
        ),
    ] = True


@dataclass(frozen=True, config=STRICT)
class PermanenceSettings:
    """Landmarks that are never pruned for being missed (Se et al. 6.2), and when they lose that."""

    ratio: Annotated[
        float,
        Field(
            ge=0.0,
            lt=1.0,
            description="a landmark becomes permanent when hits / (hits + misses) exceeds this; "
            "unstated in 6.2, chosen by measurement (docs/results)",
        ),
    ] = 0.3
    hits: Annotated[
        int,
        Field(ge=1, description="and when it has at least so many hits, and valid_hits (6.1)"),
    ] = 5
    when: Annotated[
        Literal["running", "saved"],
        Field(
            description="`running`: with the hit that makes it so; `saved`: all together when the "
            "map is saved, as 6.2 does beforehand"
        ),
    ] = "running"
    blind_below: Annotated[
        float,
        Field(
            ge=0.0,
            le=1.0,
            description="a frame that matches less than this share of the landmarks expected well "
            "in view is blocked or lost: it is no evidence that a landmark is gone; 0 believes all",
        ),
    ] = 0.05
    contradicted_after: Annotated[
        int | None,
        Field(
            ge=1,
            description="frames that contradict a permanent landmark (rejected as an outlier, or "
            "missed where the cameras see past its place), no hit between them, until it is an "
            "ordinary one again; null: never",
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
            description="views of a landmark; a further one replaces that matched longest ago",
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
            description="frames after which a landmark with fewer than valid_hits hits that was "
            "not seen again is dropped, in view or not: what a passer-by leaves behind; null keeps "
            "it until it is missed in view, as the paper",
        ),
    ] = None
    field_of_view: Annotated[
        Literal["image", "cone"],
        Field(
            description="`image`: expected in view within the image's bounds; `cone`: the paper's "
            "30 degrees on both axes (4.4), which exceeds a 320x240 image's height"
        ),
    ] = "image"
    border_px: Annotated[
        float,
        Field(
            ge=0.0,
            description="this near to an image's edge a landmark may be matched but is not missed",
        ),
    ] = 8.0
    least_scale_px: Annotated[
        float | None,
        Field(
            gt=0.0,
            description="landmarks that would look smaller than this are not expected: SIFT's "
            "finest scale over 1.5, the largest ratio matched. 0.8 where base_sigma_px is 2 loses "
            "no match and keeps large maps fast; null expects them at any distance",
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
        Field(description="6 general; 5 height fixed (section 5); 3 planar: x, z and yaw"),
    ] = 6
    residuals: Annotated[
        Literal["image_disparity", "image"],
        Field(description="`image`: row and column, as 3.3; `image_disparity`: disparity too"),
    ] = "image_disparity"
    weighting: Annotated[
        Literal["landmark", "measurement", "uniform"],
        Field(
            description="covariance of a residual: `uniform` as in 3.3, `measurement` from the "
            "matching, `landmark` the landmark's own added"
        ),
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
            description="drop matches whose residual exceeds this many standard deviations of "
            "itself as well; 0 switches it off",
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
            description="cap on the correction of the odometry (5), where six standard deviations "
            "of the prediction are not more",
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
        Field(description="how poses are proposed: from minimal samples of matches, or by votes"),
    ] = "ransac"
    descriptors: Annotated[
        bool,
        Field(
            description="propose matches by SIFT descriptor; false: by size, height and "
            "orientation alone, as features without descriptors would"
        ),
    ] = True
    map_sigma_m: Annotated[
        float,
        Field(
            ge=0.0,
            description="added to a landmark's: what the map's drift hides from its covariances",
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
            description="frames in a row that the landmarks did not locate, until the whole map is "
            "searched",
        ),
    ] = 2
    give_up_after: Annotated[
        int,
        Field(
            ge=1,
            description="frames lost until mapping goes on from the odometry; until then nothing "
            "new enters the map, which would be misplaced if the robot was carried off",
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
            description="frames unseen until seeing a landmark again is a return; more recent ones "
            "are the tracker's business",
        ),
    ] = 60
    confirm: Annotated[
        int,
        Field(
            ge=1,
            description="frames in a row that must find the same offset between map and estimate",
        ),
    ] = 3
    max_drift_share: Annotated[
        float,
        Field(
            ge=0.0,
            description="drift of position that is believed, as a share of the way since; poor "
            "wheels with a gyro-less heading reach 0.05",
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
            description="`sift`: SIFT on every frame; `hybrid`: on key frames, between them the "
            "landmarks are carried by their patches (KLT), at a fraction of the cost"
        ),
    ] = "sift"
    sift: SiftSettings = SiftSettings()
    stereo: StereoSettings = StereoSettings()
    appearance: AppearanceSettings = AppearanceSettings()
    matching: MapMatchingSettings = MapMatchingSettings()
    database: DatabaseSettings = DatabaseSettings()
    ego_motion: EgoMotionSettings = EgoMotionSettings()
    relocalisation: RelocalisationSettings = RelocalisationSettings()
    loops: Annotated[
        LoopSettings | None,
        Field(description="look for returns to mapped places and close the loop; null does not"),
    ] = None
    lost: Annotated[
        LostSettings | None,
        Field(description="search the whole map when lost; null goes on by odometry alone"),
    ] = None
    watch_cameras: Annotated[
        bool,
        Field(
            description="leave out frames in which a camera delivers old images, or cameras are "
            "swapped, and say where one is darker; false uses every frame"
        ),
    ] = True
    self_calibration: Annotated[
        bool,
        Field(
            description="estimate from the drive what the rig's calibration leaves uncorrected, "
            "and take it off every frame's features; needs stereo.measurement fused"
        ),
    ] = True
