"""Settings of place recognition: finding oneself again, closing loops (Se et al. 7)."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT


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
    max_drift_m: Annotated[
        float, Field(gt=0.0, description="drift that needs no way to have come about, metres")
    ] = 0.5
    max_drift_share: Annotated[
        float,
        Field(
            ge=0.0,
            description="drift of position that is believed, as a share of the way since; poor "
            "wheels with a gyro-less heading reach 0.05",
        ),
    ] = 0.08
    max_drift_deg: Annotated[
        float, Field(gt=0.0, description="drift of heading that needs no way, degrees")
    ] = 10.0
    max_drift_deg_m: Annotated[
        float, Field(ge=0.0, description="drift of heading that is believed, degrees a metre")
    ] = 0.25
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
    fuse_m: Annotated[
        float,
        Field(
            ge=0.0,
            description="after a closure, landmarks that look alike and lie this near to each "
            "other become one; 0 leaves them",
        ),
    ] = 0.10
