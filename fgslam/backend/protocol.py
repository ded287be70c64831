"""What every estimator, filter or smoother, offers.

The loop is always: ``predict`` with the odometry, match against ``landmarks()``, ``update`` with
the frame's measurements. A live run and a replay of its log call the same three, so any estimator
can steer the front-end and any log can be given to any estimator.
"""

from __future__ import annotations

from typing import ClassVar, Protocol, runtime_checkable

from fgslam.core.arrays import FloatArray, IntArray, StateArrays
from fgslam.core.estimates import EgoMotion, Estimate, LandmarkMap, Prediction, UpdateStats
from fgslam.core.measurements import Increment, MeasurementType, Odometry


class Estimator(Protocol):
    """A SLAM estimator over stereo landmarks.

    Calls come in time order; a time stamp that does not increase raises EstimatorError and leaves
    the state as it was. Arguments are never mutated. Returned arrays must not be written to.
    """

    @property
    def kind(self) -> str:
        """Names the estimator in configurations, tables and messages."""
        ...

    supports: ClassVar[frozenset[MeasurementType]]

    def predict(self, odometry: Odometry | None) -> Prediction:
        """Pose expected after the camera moved by ``odometry``; the prior pose for None.

        Does not change the state: predicting twice gives the same answer.
        """
        ...

    def landmarks(self) -> LandmarkMap:
        """Current landmarks, those initiated and not yet pruned, as matching should see them.

        A smoother's covariances are here those of its tracker, given the poses; marginals are in
        :meth:`estimate` and :meth:`landmark_covariances`.
        """
        ...

    def update(self, increment: Increment, tracking: EgoMotion) -> UpdateStats:
        """Take in one frame.

        Args:
            increment: the frame's measurements; its odometry is what the pose was predicted with,
                None for the first frame alone.
            tracking: least-squares pose of the frame against this estimator's own landmarks. Its
                ``inliers`` run over the increment's matched (not new) observations, in order.

        Returns:
            What it did, with a verdict on each of ``increment.loops``.
        """
        ...

    def estimate(self) -> Estimate:
        """Trajectory, pose covariances and map as known now."""
        ...

    def landmark_covariances(self, ids: IntArray) -> FloatArray:
        """Marginal covariances (k, 3, 3) of the named landmarks. KeyError for an unknown one."""
        ...

    def joint_covariance(self, ids: IntArray) -> FloatArray:
        """Joint covariance (6 + 3k, 6 + 3k) of the last pose and the named landmarks, in order.

        KeyError for an unknown landmark.
        """
        ...

    def state(self) -> StateArrays:
        """Everything needed to continue bit by bit, as plain arrays."""
        ...

    def restore(self, state: StateArrays) -> None:
        """Continue from what :meth:`state` gave."""
        ...


@runtime_checkable
class MapUser(Protocol):
    """An estimator that can begin in a saved map.

    What a map holds of its landmarks' joint covariance are their own blocks: they are taken to be
    independent of one another and of the first pose, as the paper's filter does (Se et al. 6.4).
    """

    @property
    def keeps_maps(self) -> bool:
        """Whether it can leave the map's landmarks as they are, and estimate poses alone."""
        ...

    def begin_in(self, landmarks: LandmarkMap, hits: IntArray, fixed: bool) -> None:
        """Takes the map over, before the first update.

        Args:
            landmarks: in the world of the estimator's prior pose.
            hits: (n,) frames in which each was seen so far.
            fixed: positions and covariances stay as they are; only where :attr:`keeps_maps`.

        Raises:
            EstimatorError: it holds more than the estimator can.
        """
        ...
