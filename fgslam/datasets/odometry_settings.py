"""Settings of a recording's odometry, tagged unions over ``kind``; imported without a reader."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT, NonNegative, Positive

PositiveVector3: TypeAlias = tuple[
    Annotated[float, Field(gt=0.0)],
    Annotated[float, Field(gt=0.0)],
    Annotated[float, Field(gt=0.0)],
]


@dataclass(frozen=True, config=STRICT)
class ConstantVelocitySettings:
    """No odometry: the camera is expected to keep its velocity, up to a random acceleration.

    Over a step of ``dt`` seconds the prediction's standard deviation is ``sigma * dt**2``, more
    while the camera is blind: ``sigma * T * dt``, T since the velocity was last measured. How large
    the acceleration is, is estimated from the frames so far (docs/derivations/motion_noise.md);
    the first frames are tracked with the values below. They are those of a flying or hand-held
    camera, wide for any other (cars of KITTI: 12, 6, 8 degrees/s^2 and 0.35, 0.43, 2.3 m/s^2).
    """

    kind: Literal["constant_velocity"] = "constant_velocity"
    rotation_sigma_dps2: PositiveVector3 = Field(
        default=(100.0, 100.0, 100.0),
        description="at first, about the camera's axes x, y, z, degrees/s^2",
    )
    translation_sigma_mps2: PositiveVector3 = Field(
        default=(3.0, 3.0, 3.0), description="at first, along the camera's axes x, y, z, m/s^2"
    )
    start_speed_sigma_mps: Positive = Field(
        default=15.0, description="speed per axis before the first motion is known, m/s"
    )
    start_rotation_sigma_dps: Positive = Field(
        default=20.0, description="turn per axis before the first motion is known, deg/s"
    )
    adapt: bool = Field(default=True, description="estimate the acceleration from the frames")


@dataclass(frozen=True, config=STRICT)
class RecordedOdometrySettings:
    """Use the recording's own odometry, with this noise.

    The rates are taken as constant over one step, so each standard deviation is multiplied by the
    step's duration. Defaults: measured on KITTI raw 2011_09_26 against its truth (step 0.206 s,
    7.5 m/s), where truth's own noise is included; docs/datasets/image_folder.md has the numbers.
    """

    kind: Literal["recorded"] = "recorded"
    gap: ConstantVelocitySettings = Field(
        default=ConstantVelocitySettings(), description="what stands in over steps without odometry"
    )
    time_offset_s: float = Field(
        default=0.0, ge=-10.0, le=10.0, description="added to the odometry's time stamps, seconds"
    )
    max_gap_s: Positive = Field(
        default=0.5, description="longest gap in the odometry that is bridged"
    )
    max_speed_mps: Positive = Field(
        default=60.0, description="a faster sample is refused as absurd, m/s"
    )
    max_turn_dps: Positive = Field(
        default=720.0, description="a faster turn is refused as absurd, degrees/s"
    )
    track_m: Positive | None = Field(
        default=None, description="speeds or ticks of two wheels: their distance, m"
    )
    metres_per_tick: Positive | None = Field(
        default=None, description="ticks of two wheels: how far one of them goes, m"
    )
    speed_sigma_mps: Positive = Field(
        default=0.10, description="speed and yaw rate: noise of the forward speed, m/s"
    )
    lateral_sigma_mps: Positive = Field(
        default=0.08, description="speed and yaw rate: unmeasured sideways speed, m/s"
    )
    vertical_sigma_mps: Positive = Field(
        default=0.12, description="speed and yaw rate: unmeasured vertical speed, m/s"
    )
    yaw_rate_sigma_dps: Positive = Field(
        default=0.30, description="speed and yaw rate: noise of the yaw rate, degrees/s"
    )
    pitch_rate_sigma_dps: Positive = Field(
        default=1.9, description="speed and yaw rate: unmeasured pitch rate, degrees/s"
    )
    roll_rate_sigma_dps: Positive = Field(
        default=1.3, description="speed and yaw rate: unmeasured roll rate, degrees/s"
    )
    translation_sigma_fraction: NonNegative = Field(
        default=0.02, description="poses: noise per axis as a fraction of the step's length"
    )
    rotation_sigma_fraction: NonNegative = Field(
        default=0.05, description="poses: noise per axis as a fraction of the step's angle"
    )


@dataclass(frozen=True, config=STRICT)
class SyntheticOdometrySettings:
    """Ground truth plus stated noise stands in for odometry; every output says so.

    Independent normal noise per body axis on each step, drawn from the experiment's seed.
    """

    kind: Literal["synthetic"] = "synthetic"
    translation_sigma_fraction: NonNegative = Field(
        default=0.02, description="per axis, as a fraction of the step's length"
    )
    rotation_sigma_deg: NonNegative = Field(default=1.0, description="per axis and step, degrees")


OdometrySettings: TypeAlias = Annotated[
    RecordedOdometrySettings | ConstantVelocitySettings | SyntheticOdometrySettings,
    Field(discriminator="kind"),
]
