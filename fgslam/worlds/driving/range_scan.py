"""A ring of range finders on the wheelchair."""

from __future__ import annotations

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.planar import unit, wrap
from fgslam.worlds.rendering.raycaster import RayCaster

BEAMS = 32
"""Evenly spread, the first ahead: as many as the sonars below the paper's obstacle avoidance."""
MAX_RANGE_M = 5.0
NOISE_M = 0.02
_HEIGHTS_M = (0.15, 0.45, 0.72, 1.0)  # of chair legs, seats, table tops and shelves


class RangeSensor:
    """Measures how far things are, from the wheelchair's middle.

    A beam reports the nearest of what it meets at several heights, so that table tops are seen.
    """

    def __init__(self, caster: RayCaster, noise_m: float = NOISE_M) -> None:
        """Scans the scene of ``caster``; ``noise_m`` is the standard deviation of a range."""
        self._caster, self._noise_m = caster, noise_m
        angle = 2.0 * np.pi * np.arange(BEAMS) / BEAMS
        self.angles: FloatArray = wrap(angle)

    def scan(
        self, pose: FloatArray, discs: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Angles (n,) in the robot's axes, radians, and ranges (n,), metres.

        A range of ``MAX_RANGE_M`` means that nothing was seen.

        Args:
            pose: (3,) true pose.
            discs: (k, 3) x, y and radius of people.
            rng: of the noise.
        """
        direction = unit(self.angles + pose[2])
        ranges = np.minimum(self._to_things(pose, direction), _to_discs(pose[:2], direction, discs))
        seen = ranges < MAX_RANGE_M
        noise = self._noise_m * rng.standard_normal(BEAMS)
        noisy = np.clip(ranges + noise, 0.0, MAX_RANGE_M)
        return self.angles.copy(), np.where(seen, noisy, MAX_RANGE_M)

    def _to_things(self, pose: FloatArray, direction: FloatArray) -> FloatArray:
        rays = np.column_stack([direction, np.zeros(len(direction))]).astype(np.float32)
        nearest = np.full(len(rays), np.inf)
        for height in _HEIGHTS_M:
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
