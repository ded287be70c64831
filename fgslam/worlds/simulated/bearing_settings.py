"""Settings of simulated homings that consist of bearings alone."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT


@dataclass(frozen=True, config=STRICT)
class SimulatedBearingsSettings:
    """A room of points, a start, a target, and a robot that drives from one towards the other."""

    features: Annotated[
        int,
        Field(ge=3, description="points that are matched rightly; wrong matches come on top"),
    ] = 30
    surrounding: Annotated[
        Literal["isotropic", "anisotropic"],
        Field(
            description="`isotropic`: points lie all around, at all distances; `anisotropic`: four "
            "in five on one side, where they are near, the others far, as beside a wall"
        ),
    ] = "isotropic"
    nearest_m: Annotated[
        float, Field(gt=0.0, description="distance of the nearest points from the way, metres")
    ] = 0.8
    farthest_m: Annotated[float, Field(gt=0.0, description="and of the farthest ones")] = 2.5
    leg_m: Annotated[
        float, Field(gt=0.0, description="from start to target, metres (paper: about 2 m)")
    ] = 2.0
    part: Annotated[
        float, Field(gt=0.0, lt=1.0, description="part of the way after which the drive ends")
    ] = 0.8
    images_per_s: Annotated[
        float, Field(gt=0.0, description="tracked images a second (paper: 10)")
    ] = 10.0
    bearing_sigma_deg: Annotated[
        float, Field(gt=0.0, description="noise of all bearings (0.5 to 1)")
    ] = 1.0
    elevation_sigma_deg: Annotated[float, Field(gt=0.0, description="noise of all elevations")] = (
        1.0
    )
    tracked_elevations: Annotated[
        bool, Field(description="images on the way state elevations, too")
    ] = False
    wrong_matches: Annotated[
        float,
        Field(
            ge=0.0,
            lt=1.0,
            description="part of all matches between start and target that is wrong: the target "
            "end belongs to another point",
        ),
    ] = 0.0
    jumping_tracks: Annotated[
        float,
        Field(
            ge=0.0,
            lt=1.0,
            description="part of the tracks that jump to another point of the room once, at any "
            "time, and follow that one from then on",
        ),
    ] = 0.0
    gross_bearings: Annotated[
        float,
        Field(
            ge=0.0,
            lt=1.0,
            description="part of the tracked bearings, each for itself, that point anywhere",
        ),
    ] = 0.0
    lost_per_s: Annotated[
        float, Field(ge=0.0, description="part of the tracks that get lost in a second")
    ] = 0.02


def with_outliers(settings: SimulatedBearingsSettings, part: float) -> SimulatedBearingsSettings:
    """The same with so many outliers: of matches, and of the bearings tracked at the drive's end.

    Half of the latter come from tracks that jumped, half are single gross errors.
    """
    return dataclasses.replace(
        settings, wrong_matches=part, jumping_tracks=0.5 * part, gross_bearings=0.5 * part
    )
