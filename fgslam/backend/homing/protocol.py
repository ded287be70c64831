"""What every homing estimator offers: started once, updated with each image, asked at any time."""

from __future__ import annotations

from typing import ClassVar, Protocol

from fgslam.core.homing import HomingEstimate, TrackedBearings


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
