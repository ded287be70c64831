"""Settings of homing: behaviour, front-end, maps, localisation.

Where the paper leaves a number open, `docs/concepts/homing.md` states where the default comes from.
*Legs* are distances from start to target: the scale of images is not known.
"""

from __future__ import annotations

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, Index, Positive
from fgslam.frontend.settings import HomingVectorSettings, OmniFeatureSettings


@dataclass(frozen=True, config=STRICT)
class SteeringSettings:
    """From the direction of home to speed and turning rate of a wheelchair."""

    max_speed_mps: Positive = Field(default=0.4, description="on the open way")
    max_turn_deg_s: Positive = Field(default=40.0, description="largest turning rate")


@dataclass(frozen=True, config=STRICT)
class ClosedLoopSettings:
    """The loop of camera, homing, steering and drive."""

    images_per_s: Positive = Field(default=10.0, description="images, and commands, a second")
    longest_s: Positive = Field(default=900.0, description="a drive that takes longer is ended")


@dataclass(frozen=True, config=STRICT)
class HomingBehaviourSettings:
    """All that the robot does between image and wheels."""

    steering: SteeringSettings = SteeringSettings()
    loop: ClosedLoopSettings = ClosedLoopSettings()


# --------------------------------------------------------------------------------------------
# Front-end


@dataclass(frozen=True, config=STRICT)
class FrontEndSettings:
    """What every stage of the front-end is set to."""

    features: OmniFeatureSettings = OmniFeatureSettings()
    homing_vector: HomingVectorSettings = HomingVectorSettings()
    wrong_matches: float = Field(
        default=0.0,
        ge=0.0,
        lt=0.9,
        description="share of wrong matches mixed in, to test robustness",
    )


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

    candidates: Index = Field(
        default=0, description="images that each one is tried against, by similarity; 0: all"
    )


@dataclass(frozen=True, config=STRICT)
class LocalisationSettings:
    """Bayesian localisation over a map's nodes."""

    candidates: Index = Field(default=10, description="nodes that an image is matched with; 0: all")
    leap: float = Field(
        default=0.02,
        gt=0.0,
        le=1.0,
        description="chance to be anywhere at all: carried off, or wrong",
    )
