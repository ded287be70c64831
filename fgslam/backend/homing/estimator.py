"""What every homing estimator offers, and how it checks its input.

Started once, updated with each image, asked at any time.
"""

from __future__ import annotations

from typing import ClassVar, Protocol

import numpy as np

from fgslam.core.arrays import BoolArray, IntArray
from fgslam.core.checks import later_time
from fgslam.core.errors import EstimatorError
from fgslam.core.homing import HomingEstimate, HomingStart, TrackedBearings, among


class HomingEstimator(Protocol):
    """Estimates robot, target and local map from bearings alone; made from one HomingStart.

    A time that does not increase, or an identity that the map never had, raises EstimatorError
    and leaves the state as it was. Arguments are never mutated.
    """

    kind: ClassVar[str]

    def update(self, tracked: TrackedBearings) -> None:
        """Takes in one image; features that are absent are deleted from the map."""
        ...

    def estimate(self, landmarks: bool = True) -> HomingEstimate:
        """The present state; changes nothing.

        Args:
            landmarks: whether their covariances are wanted, too; they may be NaN where not. For a
                graph they cost more than all the rest of an image.
        """
        ...


class TrackedFeatures:
    """Time and identities of a homing: which features were known, which are lost."""

    def __init__(self, start: HomingStart) -> None:
        """All features of the start's local map are alive.

        Raises:
            EstimatorError: the start's parts do not belong together.
        """
        ids = start.local_map.ids
        if len(start.matches) != len(ids) or not _ascend(ids):
            raise EstimatorError(
                f"homing start: {len(start.matches)} matches for {len(ids)} features of the local "
                "map; give one match a feature, identities ascending"
            )
        self._known = ids
        self.alive = ids
        self.time = start.time

    def take(self, tracked: TrackedBearings) -> tuple[float, BoolArray]:
        """Notes one image: seconds since the last, and which of its rows are features alive.

        Features absent from it are lost from now on; one that comes back later is not taken up.

        Raises:
            EstimatorError: time does not increase, an identity the map never had, or a value
                that is no number. Nothing is noted then.
        """
        step = later_time(tracked.time, self.time, "homing", EstimatorError) - self.time
        self._require_sound(tracked)
        self.time = tracked.time
        self.alive = self.alive[among(self.alive, tracked.ids)]
        return float(step), among(tracked.ids, self.alive)

    def _require_sound(self, tracked: TrackedBearings) -> None:
        unknown = tracked.ids[~among(tracked.ids, self._known)]
        if len(unknown):
            raise EstimatorError(
                f"image at {tracked.time:.3f} s: feature {unknown.min()} is not in the local map; "
                "track the map's features only"
            )
        if not _ascend(tracked.ids):
            raise EstimatorError(
                f"image at {tracked.time:.3f} s: identities do not ascend; sort them, each once"
            )
        sound = np.isfinite(tracked.bearing) & (tracked.sigma_bearing > 0.0)
        if not sound.all():
            raise EstimatorError(
                f"image at {tracked.time:.3f} s: feature {tracked.ids[~sound][0]} has no finite "
                "bearing with a positive deviation; leave it out"
            )


def _ascend(ids: IntArray) -> bool:
    return bool((np.diff(ids) > 0).all())
