"""Settings of homing: behaviour, front-end, maps, localisation.

Where the paper leaves a number open, `docs/concepts/homing.md` says where the default comes from.
*Legs* are distances from start to target: the scale of images is not known.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT
from fgslam.frontend.features.settings import OmniFeatureSettings
from fgslam.frontend.homing.settings import HomingVectorSettings


@dataclass(frozen=True, config=STRICT)
class HomingControlSettings:
    """When a target is reached, when matching begins anew, and when to stop."""

    switch_fraction: Annotated[
        float,
        Field(
            gt=0.0,
            lt=0.5,
            description="part of the leg left when the target counts as reached",
        ),
    ] = 0.07
    retry_s: Annotated[
        float, Field(ge=0.0, description="between two attempts to match the target anew")
    ] = 0.5


@dataclass(frozen=True, config=STRICT)
class SteeringSettings:
    """From the direction of home to speed and turning rate of a wheelchair."""

    max_speed_mps: Annotated[float, Field(gt=0.0, description="on the open way")] = 0.4
    max_turn_deg_s: Annotated[float, Field(gt=0.0, description="largest turning rate")] = 40.0


@dataclass(frozen=True, config=STRICT)
class AvoidanceSettings:
    """A range scan overrides the steering (IV)."""

    method: Annotated[
        Literal["corridors", "none"],
        Field(description="`corridors`: the free direction nearest to home; `none`: no sensor"),
    ] = "corridors"
    half_width_m: Annotated[
        float,
        Field(gt=0.0, description="half the corridor needed: the robot's radius and a margin"),
    ] = 0.42
    body_m: Annotated[
        float, Field(gt=0.0, description="half width of the bare robot, for ways out of corners")
    ] = 0.37


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
    loop: ClosedLoopSettings = ClosedLoopSettings()


# --------------------------------------------------------------------------------------------
# Front-end


@dataclass(frozen=True, config=STRICT)
class FrontEndSettings:
    """What every stage of the front-end is set to."""

    features: OmniFeatureSettings = OmniFeatureSettings()
    homing_vector: HomingVectorSettings = HomingVectorSettings()
    wrong_matches: Annotated[
        float,
        Field(
            ge=0.0,
            lt=0.9,
            description="share of wrong matches mixed in, to test robustness",
        ),
    ] = 0.0


DRIVING = FrontEndSettings(
    homing_vector=HomingVectorSettings(
        samples=600,
        confidence=0.999999,
        rival_angle_deg=40.0,
        rival_log_odds=8.0,
    ),
)
"""For driving: a start that is 10 degrees off does no harm, the estimator corrects it on the way.

Between images that are only compared the defaults are stricter.
"""


# --------------------------------------------------------------------------------------------
# Maps


@dataclass(frozen=True, config=STRICT)
class TopologicalMapSettings:
    """Edges where homing succeeds, and when an edge is accepted."""

    candidates: Annotated[
        int,
        Field(
            ge=0,
            description="images that each one is tried against, by similarity; 0: all",
        ),
    ] = 0


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
