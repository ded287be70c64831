"""Disturbances of the house's pictures: light, exposure, noise, and the camera's tilt."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import FloatArray
from fgslam.worlds.house.settings import (
    HouseExposureSettings,
    HouseLightSettings,
    HouseTiltSettings,
)
from fgslam.worlds.rendering.scene import Layer

_WAVE_PERIOD_S = 20.0  # automatic exposure follows the scene slowly
_SWAY_PERIOD_S = 7.0  # of a wheelchair on a soft floor

Float32 = npt.NDArray[np.float32]


def lit(layer: Layer, evening: Float32, settings: HouseLightSettings) -> Layer:
    """The same layer in another light: a mix of its own with the evening's, at some level."""
    mixed = (1.0 - settings.evening) * layer.light + settings.evening * evening
    return layer.lit(np.asarray(settings.level * mixed, dtype=np.float32))


def white_balance(settings: HouseLightSettings) -> Float32:
    """(3, 1) factors of red, green, blue."""
    return np.array([[1.0 + settings.warmth], [1.0], [1.0 - settings.warmth]], dtype=np.float32)


def exposed(levels: Float32, settings: HouseExposureSettings, time: float) -> Float32:
    """(3, n) levels as the camera's exposure makes them at a time in seconds."""
    wave = 1.0 + settings.wave * np.sin(2.0 * np.pi * time / _WAVE_PERIOD_S)
    return np.asarray(levels * np.float32(settings.gain * wave))


def noisy(levels: Float32, sigma: float, seed: tuple[int, ...]) -> Float32:
    """Levels with Gaussian noise; the seed names the picture, so that it is always the same."""
    if sigma == 0.0:
        return levels
    rng = np.random.Generator(np.random.SFC64(seed))
    noise = rng.standard_normal(levels.shape, dtype=np.float32)
    noise *= np.float32(sigma)
    noise += levels
    return noise


class CameraTilt:
    """Roll and pitch of the camera over time: a constant part and a slow oscillation."""

    def __init__(self, settings: HouseTiltSettings, rng: np.random.Generator) -> None:
        """Draws to which side the camera leans, and the swaying's phases."""
        self._settings = settings
        side = float(rng.uniform(0.0, 2.0 * np.pi))
        self._constant = np.deg2rad(settings.constant_deg) * np.array([np.cos(side), np.sin(side)])
        self._phase = rng.uniform(0.0, 2.0 * np.pi, 2)

    def angles(self, time: float) -> FloatArray:
        """(2,) roll about the forward axis and pitch about the left one, radians."""
        s = self._settings
        turn = 2.0 * np.pi * time / _SWAY_PERIOD_S * np.array([1.0, 0.77]) + self._phase
        return np.asarray(self._constant + np.deg2rad(s.sway_deg) * np.sin(turn))


def camera_pose(pose: FloatArray, height: float, tilt: FloatArray) -> FloatArray:
    """(4, 4) pose of a camera at ``height`` metres above a planar pose (3,), tilted.

    ``tilt`` (2,) is roll about the robot's forward axis and pitch about its left one, in radians.
    """
    (cy, sy), (cr, sr), (cp, sp) = (
        (np.cos(angle), np.sin(angle)) for angle in (pose[2], tilt[0], tilt[1])
    )
    yaw = np.array([[cy, -sy, 0.0], [sy, cy, 0.0], [0.0, 0.0, 1.0]])
    pitch = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    roll = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    out = np.eye(4)
    out[:3, :3] = yaw @ pitch @ roll
    out[:3, 3] = pose[0], pose[1], height
    return out
