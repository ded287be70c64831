"""A ring of range finders on the wheelchair."""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.planar import unit, wrap
from fgslam.worlds.house.settings import RangeSensorSettings
from fgslam.worlds.rendering.raycaster import RayCaster


class RangeSensor:
    """Measures how far things are, from the wheelchair's middle.

    A beam reports the nearest of what it meets at several heights, so that table tops are seen.
    """

    def __init__(self, settings: RangeSensorSettings, caster: RayCaster) -> None:
        self._settings, self._caster = settings, caster
        angle = 2.0 * np.pi * np.arange(settings.beams) / settings.beams
        self.angles: FloatArray = wrap(angle)

    def scan(
        self, pose: FloatArray, discs: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Angles (n,) in the robot's axes, radians, and ranges (n,), metres.

        A range of ``max_range_m`` means that nothing was seen.

        Args:
            pose: (3,) true pose.
            discs: (k, 3) x, y and radius of people.
            rng: of the noise.
        """
        s = self._settings
        direction = unit(self.angles + pose[2])
        ranges = np.minimum(self._to_things(pose, direction), _to_discs(pose[:2], direction, discs))
        seen = ranges < s.max_range_m
        noise = s.noise_m * rng.standard_normal(s.beams)
        noisy = np.clip(ranges + noise, 0.0, s.max_range_m)
        return self.angles.copy(), np.where(seen, noisy, s.max_range_m)

    def _to_things(self, pose: FloatArray, direction: FloatArray) -> FloatArray:
        rays = np.column_stack([direction, np.zeros(len(direction))]).astype(np.float32)
        nearest = np.full(len(rays), np.inf)
        for height in self._settings.heights_m:
            _, distance = self._caster.cast(np.array([pose[0], pose[1], height]), rays)
            nearest = np.minimum(nearest, distance)
        return nearest


def _to_discs(place: FloatArray, direction: FloatArray, discs: FloatArray) -> FloatArray:
    """(n,) distance along unit directions (n, 2) to upright cylinders; 0 inside one."""
    nearest = np.full(len(direction), np.inf)
    for x, y, radius in discs:
        offset = np.array([x, y]) - place
        along = direction @ offset
        aside2 = np.sum(offset * offset) - along**2
        hit = (aside2 < radius**2) & (along > 0.0)
        distance = along - np.sqrt(np.maximum(radius**2 - aside2, 0.0))
        nearest = np.where(hit, np.minimum(nearest, np.maximum(distance, 0.0)), nearest)
    return nearest
