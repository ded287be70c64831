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
    pass_fraction: Annotated[
        float,
        Field(
            ge=0.0,
            lt=1.0,
            description="a target nearer than this part of the leg that has fallen behind the "
            "robot counts as reached: passed by",
        ),
    ] = 0.25
    min_tracks: Annotated[
        int, Field(ge=3, description="with fewer tracks than this, the target is matched anew")
    ] = 10
    fewest_tracks: Annotated[
        int,
        Field(
            ge=1,
            description="with fewer than this the estimate is not believed any more (a third "
            "view needs three bearings)",
        ),
    ] = 4
    max_across: Annotated[
        float,
        Field(
            gt=0.0,
            description="deviation of the target's place across the way, in parts of the leg, "
            "beyond which the target is matched anew",
        ),
    ] = 0.1
    max_residual_deg: Annotated[
        float,
        Field(
            gt=0.0,
            description="median difference of the bearings from the estimate's prediction beyond "
            "which the estimate counts as diverged",
        ),
    ] = 5.0
    max_turn_deg_s: Annotated[
        float,
        Field(
            gt=0.0,
            description="an image turned faster than this against the last one is not believed",
        ),
    ] = 120.0
    retry_s: Annotated[
        float, Field(ge=0.0, description="between two attempts to match the target anew")
    ] = 0.5
    blind_s: Annotated[
        float,
        Field(ge=0.0, description="longest drive straight on, at reduced speed, without tracks"),
    ] = 1.0
    blind_heading_deg: Annotated[
        float,
        Field(
            ge=0.0,
            le=90.0,
            description="without tracks the robot drives on only if home was so nearly ahead",
        ),
    ] = 20.0
    give_up_s: Annotated[
        float,
        Field(
            ge=0.0,
            description="after refusals for so long, standing, the robot looks from farther on, or "
            "ends the homing",
        ),
    ] = 3.0
    farther_s: Annotated[
        float,
        Field(
            gt=0.0,
            description="drive straight on, at reduced speed, to look for a refused target from "
            "elsewhere; 0.4 m with the default steering",
        ),
    ] = 2.5
    farther_tries: Annotated[
        int, Field(ge=0, description="such drives for one target; 0: refused is refused")
    ] = 3
    near_fraction: Annotated[
        float,
        Field(
            ge=0.0,
            lt=1.0,
            description="from this part of the leg on, another look must show the target where the "
            "estimate has it before it counts as reached; 0: it need not",
        ),
    ] = 0.3
    contradiction_deg: Annotated[
        float,
        Field(
            gt=0.0,
            description="a new homing vector that differs by more from a sound estimate (and by "
            "more than four deviations) must be confirmed by another image",
        ),
    ] = 30.0
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
    max_stalls: Annotated[
        int,
        Field(
            ge=1,
            description="so often without progress, or with an estimate given up, ends the homing",
        ),
    ] = 3


@dataclass(frozen=True, config=STRICT)
class SteeringSettings:
    """From the direction of home to speed and turning rate of a wheelchair."""

    max_speed_mps: Annotated[float, Field(gt=0.0, description="on the open way")] = 0.4
    max_turn_deg_s: Annotated[float, Field(gt=0.0, description="largest turning rate")] = 40.0
    gain_per_s: Annotated[
        float, Field(gt=0.0, description="turning rate over the direction of home")
    ] = 1.2
    acceleration_mps2: Annotated[float, Field(gt=0.0, description="largest change of speed")] = 0.5
    turn_acceleration_deg_s2: Annotated[
        float, Field(gt=0.0, description="largest change of the turning rate")
    ] = 120.0
    turn_in_place_deg: Annotated[
        float,
        Field(
            gt=0.0,
            le=180.0,
            description="home farther off than this: turn without driving, until it is within "
            "half of it",
        ),
    ] = 60.0
    slow_fraction: Annotated[
        float,
        Field(
            gt=0.0,
            le=1.0,
            description="part of the leg that is left from which on the robot slows down",
        ),
    ] = 0.3
    least_share: Annotated[
        float,
        Field(gt=0.0, le=1.0, description="of the speed, at the last target"),
    ] = 0.25
    passing_share: Annotated[
        float,
        Field(gt=0.0, le=1.0, description="of the speed, at targets on the way"),
    ] = 0.6
    blind_share: Annotated[
        float, Field(gt=0.0, le=1.0, description="of the speed, without tracks")
    ] = 0.4


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
    directions: Annotated[
        int, Field(ge=8, le=720, description="corridors that are looked at, all around")
    ] = 72
    keep_weight: Annotated[
        float,
        Field(
            ge=0.0,
            description="weight of staying with the last choice, against turning towards home",
        ),
    ] = 0.5
    max_turn_deg_s: Annotated[
        float, Field(gt=0.0, description="largest turning rate of an override")
    ] = 40.0
    gain_per_s: Annotated[
        float, Field(gt=0.0, description="turning rate over the chosen direction")
    ] = 2.0
    body_m: Annotated[
        float, Field(gt=0.0, description="half width of the bare robot, for ways out of corners")
    ] = 0.37
    escape_after: Annotated[
        int, Field(ge=1, description="steps held up until a way out is taken; 2 s at 10 a second")
    ] = 20
    escape_steps: Annotated[
        int, Field(ge=1, description="steps of driving along it; 2 s at 10 a second")
    ] = 20
    escape_m: Annotated[
        float, Field(gt=0.0, description="ways longer than this are equally good ways out")
    ] = 1.2
    escape_mps: Annotated[float, Field(gt=0.0, description="speed on the way out")] = 0.25


@dataclass(frozen=True, config=STRICT)
class PathFollowingSettings:
    """A path is a chain of homings."""

    skip_unmatched: Annotated[
        bool,
        Field(description="a target that is refused is skipped if the one after it can be matched"),
    ] = True
    max_skips: Annotated[
        int, Field(ge=0, description="targets left out one after another, at most")
    ] = 1


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
    sample: Annotated[
        int, Field(ge=2, description="descriptors that the vocabulary is made of, at most")
    ] = 10_000
    iterations: Annotated[int, Field(ge=1, description="of k-means")] = 6


@dataclass(frozen=True, config=STRICT)
class TopologicalMapSettings:
    """Edges where homing succeeds, and what makes an edge believed."""

    candidates: Annotated[
        int,
        Field(
            ge=0,
            description="images that each one is tried against, the most alike first; 0: all pairs",
        ),
    ] = 0
    retrieval: RetrievalSettings = RetrievalSettings()
    min_support: Annotated[int, Field(ge=3, description="inliers of an edge, in either answer")] = (
        12
    )
    one_way_support: Annotated[
        int,
        Field(
            ge=3,
            description="inliers of an edge that is answered in one direction and ambiguous in the "
            "other",
        ),
    ] = 25
    lone_support: Annotated[
        int,
        Field(
            ge=3,
            description="inliers of an edge that no third image confirms, unless its images follow "
            "each other in an ordered set (false ones had up to 39 on `omni_home`)",
        ),
    ] = 50
    order_reach: Annotated[
        int,
        Field(
            ge=1,
            description="ordered sets: images farther apart than this in the order need third "
            "views, these neighbours of theirs, that confirm their link's features",
        ),
    ] = 3
    third_views: Annotated[
        float,
        Field(
            ge=0.0,
            description="such confirmations an inlier, on average, that a link so far needs; "
            "`docs/concepts/homing.md` has what true and false ones got",
        ),
    ] = 1.0
    mutual_deg: Annotated[
        float,
        Field(
            gt=0.0,
            description="largest difference between the answers there and back, beyond three "
            "deviations",
        ),
    ] = 5.0
    loop_deg: Annotated[
        float,
        Field(
            gt=0.0,
            description="largest sum of the rotations around a triangle, and largest misfit of its "
            "directions, beyond three deviations",
        ),
    ] = 6.0
    heading_deg: Annotated[
        float,
        Field(
            gt=0.0,
            description="largest misfit of an edge's rotation with all others' together",
        ),
    ] = 15.0
    doubling_support: Annotated[
        float,
        Field(gt=0.0, description="inliers at which an edge costs twice what many inliers cost"),
    ] = 25.0


@dataclass(frozen=True, config=STRICT)
class LocalisationSettings:
    """Bayesian localisation over a map's nodes."""

    candidates: Annotated[
        int, Field(ge=0, description="nodes that an image is matched with; 0: all")
    ] = 10
    stay: Annotated[
        float, Field(ge=0.0, le=1.0, description="chance to be still at the node of the last image")
    ] = 0.5
    leap: Annotated[
        float,
        Field(gt=0.0, le=1.0, description="chance to be anywhere at all: carried off, or wrong"),
    ] = 0.02
    background: Annotated[
        float, Field(gt=0.0, description="inliers that a wrong place may get, on average")
    ] = 4.0
