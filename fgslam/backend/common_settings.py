"""Settings that several estimators share: the floor, robust kernels, names and families."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT

Family: TypeAlias = Literal["filter", "smoother", "other"]
"""Whether past poses are revised; paired tests compare smoothers with filters, and no others.

An `other` corrects nothing by landmarks seen again: dead reckoning.
"""


@dataclass(frozen=True, config=STRICT)
class FloorSettings:
    """How an estimator uses the floor under the robot."""

    mode: Annotated[
        Literal["auto", "none", "soft", "hard"],
        Field(
            description="`auto` the degrees of freedom of frontend.ego_motion.dof, exactly; `none` "
            "all six; `hard` and `soft` those of dof (height, pitch and roll where it is 6), "
            "exactly or up to the deviations below"
        ),
    ] = "auto"
    height_sigma_m: Annotated[
        float, Field(gt=0.0, description="soft: deviation of the camera's height a frame, metres")
    ] = 0.005
    tilt_sigma_deg: Annotated[
        float, Field(gt=0.0, description="soft: deviation of pitch and of roll a frame, degrees")
    ] = 0.2


@dataclass(frozen=True, config=STRICT)
class KernelSettings:
    """Robust loss over a whitened residual, so that single wrong matches lose their pull."""

    name: Annotated[
        Literal["none", "huber", "cauchy", "geman_mcclure", "tukey"],
        Field(description="the M-estimator; `none` is least squares"),
    ] = "cauchy"
    width: Annotated[
        float,
        Field(gt=0.0, description="its scale, in standard deviations of the whole measurement"),
    ] = 3.0


@dataclass(frozen=True, config=STRICT)
class NamedSettings:
    """What every estimator has."""

    family: ClassVar[Family] = "other"

    label: Annotated[
        str | None,
        Field(
            pattern=r"^[A-Za-z0-9][\w.+-]*$",
            description="name of its folder and of its row in tables; null: its kind",
        ),
    ] = None

    @property
    def title(self) -> str:
        """The label, or the kind where there is none."""
        return self.label or str(getattr(self, "kind", ""))
