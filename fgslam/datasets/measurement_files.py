"""What all recordings of measurements share: the motion model of their logs."""

from __future__ import annotations

import dataclasses
from dataclasses import asdict
from typing import Any

from fgslam.errors import ConfigError
from fgslam.measurement_log import MeasurementLog
from fgslam.settings.datasets import (
    ConstantVelocitySettings,
    OdometrySettings,
    RecordedOdometrySettings,
    SyntheticOdometrySettings,
)
from fgslam.types import Increment, Sensor


def make_log(
    sensor: Sensor, increments: list[Increment], odometry: OdometrySettings
) -> MeasurementLog:
    """A log whose motion model is what the settings of odometry ask for.

    Under ``constant_velocity`` the recording's own odometry is left out. A recording without any
    is predicted by constant velocity, whatever the kind: nothing else could be.

    Raises:
        ConfigError: synthetic odometry is asked for.
    """
    if isinstance(odometry, SyntheticOdometrySettings):
        raise ConfigError(
            "odometry.kind synthetic needs a recording of images; measurements bring their own "
            "odometry: choose recorded or constant_velocity"
        )
    if isinstance(odometry, ConstantVelocitySettings):
        log = MeasurementLog(sensor, asdict(odometry))
        increments = [_without_odometry(increment) for increment in increments]
    else:
        log = MeasurementLog(sensor, _recorded(increments, odometry))
    for increment in increments:
        log.append(increment)
    return log


def _recorded(increments: list[Increment], odometry: RecordedOdometrySettings) -> dict[str, Any]:
    stand_in = asdict(odometry.gap)
    measured = any(increment.odometry is not None for increment in increments)
    return {"kind": "recorded", "stand_in": stand_in} if measured else stand_in


def _without_odometry(increment: Increment) -> Increment:
    return dataclasses.replace(increment, odometry=None)
