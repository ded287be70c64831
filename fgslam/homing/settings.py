"""Settings of the behaviour: homing, steering, avoidance, path following, maps, localisation.

Where the paper leaves a number open, `docs/concepts/homing.md` says where the default comes from.
*Legs* are distances from start to target: the scale of images is not known.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT


@dataclass(frozen=True, config=STRICT)
class HomingControlSettings:
    """When a target is reached, when matching begins anew, and when to stop."""

    switch_fraction: Annotated[
        float,
        Field(
            gt=0.0,
            lt=0.5,
            description="part of the leg that may be left when the target counts as reached",
        ),
    ] = 0.07
    max_turn_deg_s: Annotated[
        float,
        Field(
            gt=0.0,
            description="an image turned faster than this against the last one is rejected",
        ),
    ] = 120.0
    retry_s: Annotated[
        float, Field(ge=0.0, description="between two attempts to match the target anew")
    ] = 0.5
    blind_s: Annotated[
        float,
        Field(ge=0.0, description="longest drive straight on, at reduced speed, without tracks"),
    ] = 1.0
    give_up_s: Annotated[
        float,
        Field(
            ge=0.0,
            description="after refusals for so long, standing, the robot looks from farther on, or "
            "ends the homing",
        ),
    ] = 3.0
    farther_tries: Annotated[
        int, Field(ge=0, description="such drives for one target; 0: refused is refused")
    ] = 3
    stall_s: Annotated[
        float,
        Field(gt=0.0, description="without progress for so long, the target is matched anew"),
    ] = 15.0
    wait_s: Annotated[
        float,
        Field(
            ge=0.0,
            description="on one leg the robot waits so long, on top, for a blocked way to clear",
        ),
    ] = 60.0


@dataclass(frozen=True, config=STRICT)
class SteeringSettings:
    """From the direction of home to speed and turning rate of a wheelchair."""

    max_speed_mps: Annotated[float, Field(gt=0.0, description="on the open way")] = 0.4
    max_turn_deg_s: Annotated[float, Field(gt=0.0, description="largest turning rate")] = 40.0
    acceleration_mps2: Annotated[float, Field(gt=0.0, description="largest change of speed")] = 0.5
    turn_acceleration_deg_s2: Annotated[
        float, Field(gt=0.0, description="largest change of the turning rate")
    ] = 120.0


@dataclass(frozen=True, config=STRICT)
class AvoidanceSettings:
    """A range scan overrides the steering (IV)."""

    method: Annotated[
        Literal["corridors", "none"],
        Field(description="`corridors`: the free direction nearest to home; `none`: no sensor"),
    ] = "corridors"
    half_width_m: Annotated[
        float,
        Field(gt=0.0, description="of the corridor that the robot needs: its radius and a margin"),
    ] = 0.42
    look_ahead_m: Annotated[
        float, Field(gt=0.0, description="length of the corridor that must be free, from standing")
    ] = 0.6
    look_ahead_s: Annotated[
        float, Field(ge=0.0, description="what comes on top at speed, in seconds of driving")
    ] = 1.5
    max_turn_deg_s: Annotated[
        float, Field(gt=0.0, description="largest turning rate of an override")
    ] = 40.0
    body_m: Annotated[
        float, Field(gt=0.0, description="half width of the bare robot, for ways out of corners")
    ] = 0.37


@dataclass(frozen=True, config=STRICT)
class PathFollowingSettings:
    """A path is a chain of homings."""

    skip_unmatched: Annotated[
        bool,
        Field(description="a target that is refused is skipped if the one after it can be matched"),
    ] = True


@dataclass(frozen=True, config=STRICT)
class ClosedLoopSettings:
    """The loop of camera, homing, steering and drive."""

    images_per_s: Annotated[float, Field(gt=0.0, description="images, and commands, a second")] = (
        10.0
    )
    longest_s: Annotated[float, Field(gt=0.0, description="a drive that takes longer is ended")] = (
        900.0
    )


@dataclass(frozen=True, config=STRICT)
class HomingBehaviourSettings:
    """All that the robot does between image and wheels."""

    control: HomingControlSettings = HomingControlSettings()
    steering: SteeringSettings = SteeringSettings()
    avoidance: AvoidanceSettings = AvoidanceSettings()
    path: PathFollowingSettings = PathFollowingSettings()
    loop: ClosedLoopSettings = ClosedLoopSettings()


# --------------------------------------------------------------------------------------------
# Maps


@dataclass(frozen=True, config=STRICT)
class RetrievalSettings:
    """Which images are worth a homing, by visual words of their descriptors."""

    words: Annotated[int, Field(ge=2, description="in the vocabulary, k-means of descriptors")] = (
        400
    )


@dataclass(frozen=True, config=STRICT)
class TopologicalMapSettings:
    """Edges where homing succeeds, and when an edge is accepted."""

    candidates: Annotated[
        int,
        Field(
            ge=0,
            description="images that each one is tried against, the most alike first; 0: all pairs",
        ),
    ] = 0
    retrieval: RetrievalSettings = RetrievalSettings()


@dataclass(frozen=True, config=STRICT)
class LocalisationSettings:
    """Bayesian localisation over a map's nodes."""

    candidates: Annotated[
        int, Field(ge=0, description="nodes that an image is matched with; 0: all")
    ] = 10
    leap: Annotated[
        float,
        Field(gt=0.0, le=1.0, description="chance to be anywhere at all: carried off, or wrong"),
    ] = 0.02
