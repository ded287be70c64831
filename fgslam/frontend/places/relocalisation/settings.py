"""Settings of relocalisation: the pose of a frame in a map without any prior."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT


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
    neighbours: Annotated[
        int, Field(ge=2, le=64, description="stored views asked of the index for each feature")
    ] = 12
    max_distance: Annotated[
        float,
        Field(gt=0.0, description="largest distance of descriptors, whose norm is 512"),
    ] = 400.0
    ratio: Annotated[
        float,
        Field(
            gt=0.0,
            le=1.0,
            description="a feature's candidates end where the next place's distance is farther by "
            "this ratio; without such a gap the feature says nothing",
        ),
    ] = 0.85
    candidates: Annotated[
        int,
        Field(ge=1, le=16, description="places that may share a feature before it says nothing"),
    ] = 3
    same_place_m: Annotated[
        float, Field(gt=0.0, description="landmarks this near to one another are one place, metres")
    ] = 0.3
    size_ratio: Annotated[
        float,
        Field(gt=1.0, description="largest ratio of a feature's physical size to a landmark's"),
    ] = 1.6
    orientation_deg: Annotated[
        float,
        Field(gt=0.0, le=180.0, description="planar: largest difference of orientations"),
    ] = 30.0
    height_m: Annotated[
        float,
        Field(
            ge=0.0,
            description="planar: largest difference of heights beyond what the covariances allow",
        ),
    ] = 0.05
    samples: Annotated[
        int,
        Field(ge=16, description="minimal samples drawn at a time; most fail the rigidity test"),
    ] = 4096
    hypotheses: Annotated[
        int, Field(ge=4, description="poses scored at a time, from the rigid samples")
    ] = 64
    rounds: Annotated[int, Field(ge=1, description="times that samples are drawn at most")] = 6
    confidence: Annotated[
        float,
        Field(gt=0.0, lt=1.0, description="that one sample was clean, at which the search ends"),
    ] = 0.999
    bin_m: Annotated[
        float, Field(gt=0.0, description="hough: side of an accumulator's bin, metres")
    ] = 0.3
    bin_deg: Annotated[
        float, Field(gt=0.0, le=90.0, description="hough: width of a bin of heading, degrees")
    ] = 5.0
    bins: Annotated[
        int, Field(ge=2, description="hough: fullest bins whose matches are solved for a pose")
    ] = 16
    refined: Annotated[
        int, Field(ge=2, description="distinct best poses that are refined and compared")
    ] = 4
    view_sigma_px: Annotated[
        float,
        Field(
            ge=0.0,
            description="added to a feature's noise: from elsewhere it is found elsewhere, pixels",
        ),
    ] = 0.3
    map_sigma_m: Annotated[
        float,
        Field(
            ge=0.0,
            description="added to a landmark's: what the map's drift hides from its covariances",
        ),
    ] = 0.01
    piece_m: Annotated[
        float,
        Field(
            gt=0.0,
            description="landmarks in one cube of this side drift together and belong to one thing "
            "that may stand elsewhere, too, metres",
        ),
    ] = 0.5
    gate_sigmas: Annotated[
        float,
        Field(gt=0.0, description="largest normalised residual (three numbers) of an inlier"),
    ] = 4.0
    min_inliers: Annotated[
        int,
        Field(ge=3, description="fewer witnesses (inliers, four at most of a piece) are no pose"),
    ] = 8
    enough_witnesses: Annotated[
        int,
        Field(ge=3, description="with so many witnesses nothing but another place contradicts"),
    ] = 36
    max_misfit: Annotated[
        float,
        Field(
            gt=0.0,
            description="with fewer, largest mean squared normalised residual (1: as modelled)",
        ),
    ] = 1.2
    least_agreement: Annotated[
        float,
        Field(
            ge=0.0,
            le=1.0,
            description="with fewer, least agreement of frame and map at the pose: two parts the "
            "share of the features that look like landmarks which it explains, one part the share "
            "of the pieces in view of which something is seen",
        ),
    ] = 0.57
    least_covered: Annotated[
        float,
        Field(
            ge=0.0,
            le=1.0,
            description="with fewer, something must be seen of this share of the pieces in view, "
            "or be known in this share of the directions in which the frame sees things; a rival "
            "of which less is seen is none",
        ),
    ] = 0.5
    ambiguous_share: Annotated[
        float,
        Field(
            gt=0.0,
            le=1.0,
            description="with this share of the best's witnesses another pose makes it ambiguous",
        ),
    ] = 0.5
    ambiguous_own: Annotated[
        float,
        Field(
            ge=0.0,
            description="unless it explains the lesser half of the best's features and beside "
            "them fewer than this for each that only the best explains",
        ),
    ] = 0.2
    view_deg: Annotated[
        float,
        Field(
            gt=0.0,
            le=180.0,
            description="a landmark is expected to be seen from within this angle of a stored view",
        ),
    ] = 20.0
    elsewhere_m: Annotated[
        float, Field(gt=0.0, description="poses farther apart than this are different places")
    ] = 0.5
    elsewhere_deg: Annotated[
        float, Field(gt=0.0, description="poses turned by more than this are different places")
    ] = 15.0
    max_sigma_m: Annotated[
        float, Field(gt=0.0, description="largest standard deviation of an accepted position")
    ] = 0.05
    max_sigma_deg: Annotated[
        float, Field(gt=0.0, description="largest standard deviation of an accepted heading")
    ] = 1.0
