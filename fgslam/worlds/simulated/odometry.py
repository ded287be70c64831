"""Wheel odometry of simulated drives, with a fault that nothing flags."""

from __future__ import annotations

import numpy as np

from fgslam.core import geometry as g
from fgslam.core.arrays import FloatArray
from fgslam.core.measurements import Odometry
from fgslam.worlds.driving import wheel_odometry
from fgslam.worlds.simulated.settings import SimulatedMeasurementsSettings


def simulate_odometry(
    settings: SimulatedMeasurementsSettings, body: FloatArray, rng: np.random.Generator
) -> list[Odometry]:
    """Body motions between consecutive true poses (n, 4, 4): n - 1 of them.

    Noise as stated times ``detection.noise_scale``; while ``odometry_fault`` lasts, true motions
    are reported scaled (along their screw) under the same covariance.
    """
    noise_scale, fault = settings.detection.noise_scale, settings.odometry_fault
    true = g.inverse(body[:-1]) @ body[1:]
    out = []
    for i, step in enumerate(wheel_odometry.simulate(settings.odometry, body, rng)):
        noise = g.inverse(true[i]) @ step.motion
        if noise_scale != 1.0:
            noise = g.se3_exp(noise_scale * g.se3_log(noise))
        motion = true[i]
        if fault is not None and 0 <= i + 1 - fault.start < fault.frames:
            motion = g.se3_exp(fault.scale * g.se3_log(motion))
        out.append(Odometry(np.asarray(motion @ noise), step.covariance))
    return out
