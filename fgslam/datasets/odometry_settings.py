"""Settings of a recording's odometry, tagged unions over ``kind``; imported without a reader."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from pydantic import Field
from pydantic.dataclasses import dataclass

from fgslam.core.settings import STRICT

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
    rotation_sigma_dps2: Annotated[
        PositiveVector3,
        Field(description="at first, about the camera's axes x, y, z, degrees/s^2"),
    ] = (100.0, 100.0, 100.0)
    translation_sigma_mps2: Annotated[
        PositiveVector3, Field(description="at first, along the camera's axes x, y, z, m/s^2")
    ] = (3.0, 3.0, 3.0)
    start_speed_sigma_mps: Annotated[
        float, Field(gt=0.0, description="speed per axis before the first motion is known, m/s")
    ] = 15.0
    start_rotation_sigma_dps: Annotated[
        float, Field(gt=0.0, description="turn per axis before the first motion is known, deg/s")
    ] = 20.0
    adapt: Annotated[
        bool,
        Field(description="estimate the acceleration from the frames"),
    ] = True


@dataclass(frozen=True, config=STRICT)
class RecordedOdometrySettings:
    """Use the recording's own odometry, with this noise.

    The rates are taken as constant over one step, so each standard deviation is multiplied by the
    step's duration. Defaults: measured on KITTI raw 2011_09_26 against its truth (step 0.206 s,
    7.5 m/s), where truth's own noise is included; docs/datasets/image_folder.md has the numbers.
    """

    kind: Literal["recorded"] = "recorded"
    gap: Annotated[
        ConstantVelocitySettings,
        Field(description="what stands in over steps without odometry"),
    ] = ConstantVelocitySettings()
    time_offset_s: Annotated[
        float, Field(ge=-10.0, le=10.0, description="added to the odometry's time stamps, seconds")
    ] = 0.0
    max_gap_s: Annotated[
        float,
        Field(
            gt=0.0,
            description="longest gap in the odometry that is bridged",
        ),
    ] = 0.5
    max_speed_mps: Annotated[
        float, Field(gt=0.0, description="a faster sample is refused as absurd, m/s")
    ] = 60.0
    max_turn_dps: Annotated[
        float, Field(gt=0.0, description="a faster turn is refused as absurd, degrees/s")
    ] = 720.0
    track_m: Annotated[
        float | None, Field(gt=0.0, description="speeds or ticks of two wheels: their distance, m")
    ] = None
    metres_per_tick: Annotated[
        float | None, Field(gt=0.0, description="ticks of two wheels: how far one of them goes, m")
    ] = None
    speed_sigma_mps: Annotated[
        float, Field(gt=0.0, description="speed and yaw rate: noise of the forward speed, m/s")
    ] = 0.10
    lateral_sigma_mps: Annotated[
        float, Field(gt=0.0, description="speed and yaw rate: unmeasured sideways speed, m/s")
    ] = 0.08
    vertical_sigma_mps: Annotated[
        float, Field(gt=0.0, description="speed and yaw rate: unmeasured vertical speed, m/s")
    ] = 0.12
    yaw_rate_sigma_dps: Annotated[
        float, Field(gt=0.0, description="speed and yaw rate: noise of the yaw rate, degrees/s")
    ] = 0.30
    pitch_rate_sigma_dps: Annotated[
        float, Field(gt=0.0, description="speed and yaw rate: unmeasured pitch rate, degrees/s")
    ] = 1.9
    roll_rate_sigma_dps: Annotated[
        float, Field(gt=0.0, description="speed and yaw rate: unmeasured roll rate, degrees/s")
    ] = 1.3
    translation_sigma_fraction: Annotated[
        float, Field(ge=0.0, description="poses: noise per axis as a fraction of the step's length")
    ] = 0.02
    rotation_sigma_fraction: Annotated[
        float, Field(ge=0.0, description="poses: noise per axis as a fraction of the step's angle")
    ] = 0.05


@dataclass(frozen=True, config=STRICT)
class SyntheticOdometrySettings:
    """Ground truth plus stated noise stands in for odometry; every output says so.

    Independent normal noise per body axis on each step, drawn from the experiment's seed.
    """

    kind: Literal["synthetic"] = "synthetic"
    translation_sigma_fraction: Annotated[
        float, Field(ge=0.0, description="per axis, as a fraction of the step's length")
    ] = 0.02
    rotation_sigma_deg: Annotated[
        float, Field(ge=0.0, description="per axis and step, degrees")
    ] = 1.0


OdometrySettings: TypeAlias = Annotated[
    RecordedOdometrySettings | ConstantVelocitySettings | SyntheticOdometrySettings,
    Field(discriminator="kind"),
]
