"""What every estimator, filter or smoother, offers: the protocol to write another one.

The loop is always: ``predict`` with the odometry, match against ``landmarks()``, ``update`` with
the frame's measurements. A live run and a replay of its log call the same three, so any estimator
can steer the front-end and any log can be given to any estimator.

To add an estimator:

1. Write a class with the members of :class:`Estimator`. It needs no base class. It is handed plain
   values (:mod:`fgslam.core.sensors`, :mod:`fgslam.core.types`): poses ``wTc`` in metres,
   covariances in the pose's tangent space, rotation first. ``examples/`` shows a small one; an
   object of it can be given to ``fgslam.Slam(rig, estimator=...)`` as it is.
2. Where it can do more, add the members of :class:`~fgslam.core.store.Resumable` (interrupted runs;
   or mark what it keeps as :class:`~fgslam.core.store.Kept`) or :class:`MapUser` (beginning in a
   saved map). What asks for them refuses an estimator without, in one line. A
   ``recalibrate(correction, since)`` follows a rig that calibrates itself (:func:`recalibrated`);
   ``noise_factors``, on the stated deviations of a single measurement and as it is weighed, is
   only shown.
3. To choose it in configurations, too: a frozen dataclass in :mod:`fgslam.backend.settings`,
   derived from ``NamedSettings``, with its own ``kind`` and, for the paired tests of many trials,
   its ``family``; add it to the union there, and one row to the table of makers in
   :mod:`fgslam.slam.build`.

``tests/contract/test_estimators.py`` then holds it to the protocol without further ado: predicting
changes nothing, time must increase, arguments stay as they were, a restored one continues to the
same bits. A graph can be had without writing one: hand a
:class:`~fgslam.backend.smoothers.graph.GraphSolver` to
:class:`~fgslam.backend.smoothers.smoother.Smoother`.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

import numpy as np

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.sensors import Increment, MeasurementType, Odometry
from fgslam.core.types import EgoMotion, Estimate, LandmarkMap, Prediction, UpdateStats


class Estimator(Protocol):
    """A SLAM estimator over landmarks of a stereo or trinocular rig.

    Calls come in time order; a time stamp that does not increase raises EstimatorError and leaves
    the state as it was. Arguments are never mutated. Returned arrays must not be written to.
    """

    @property
    def kind(self) -> str:
        """Names the estimator in configurations, tables and messages."""
        ...

    @property
    def supports(self) -> frozenset[MeasurementType]:
        """Kinds of measurement that it can use; a log that holds others is refused at once."""
        ...

    def predict(self, odometry: Odometry | None) -> Prediction:
        """Pose expected after the camera moved by ``odometry``; the last (or prior) one for None.

        Does not change the state: predicting twice gives the same answer.
        """
        ...

    def landmarks(self) -> LandmarkMap:
        """Current landmarks, those initiated and not yet pruned, as matching should see them.

        Identities ascend; positions (n, 3) and covariances (n, 3, 3) in world axes. A smoother's
        covariances are here those of its tracker, given the poses; :meth:`estimate` has marginals.
        """
        ...

    def update(self, increment: Increment, tracking: EgoMotion) -> UpdateStats:
        """Takes in one frame: landmarks matched, missed, new and pruned, and loops recognised.

        Args:
            increment: the frame's measurements; its odometry is what the pose was predicted with,
                None for the first frame alone.
            tracking: least-squares pose of the frame against this estimator's own landmarks. Its
                ``inliers`` run over the increment's matched (not new) observations, in order.

        Returns:
            Pose ``wTc`` and covariance of the frame as known now, the number of landmarks, the
            normalised innovation squared with its degrees of freedom (NaN and 0 where there is
            none), and for each of ``increment.loops`` whether it was closed.

        Raises:
            EstimatorError: time does not increase, a number is not finite, or no solution exists.
        """
        ...

    def estimate(self) -> Estimate:
        """Trajectory, pose covariances (n, 6, 6) and map as known now; may be asked at any time.

        A frame for each update; ``remarks`` say in words what a reader of the result must know.
        """
        ...


@runtime_checkable
class MapUser(Protocol):
    """An estimator that can begin in a saved map.

    What a map holds of its landmarks' joint covariance are their own blocks: they are taken to be
    independent of one another and of the first pose, as the paper's filter does (Se et al. 6.4).
    """

    @property
    def keeps_maps(self) -> bool:
        """True if it can leave the map's landmarks as they are, and estimate poses alone."""
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


def predicted(estimator: Estimator, odometry: Odometry | None) -> Prediction:
    """What the estimator predicts. Raises EstimatorError where that is no pose with covariance."""
    prediction = estimator.predict(odometry)
    _require_pose(estimator, "predict", prediction, Prediction)
    return prediction


def recalibrated(estimator: Estimator, correction: FloatArray | None, since: int) -> None:
    """Hands the correction (p,) of the next frame to an estimator that has a ``recalibrate``.

    Landmarks that were measured with another one move to where this one would have put them; those
    of a saved map stay, and those seen last before frame ``since`` (from 0), from which on the rig
    is as it is now. None: there is no correction.
    """
    if correction is not None and hasattr(estimator, "recalibrate"):
        estimator.recalibrate(correction, since)


def updated(estimator: Estimator, increment: Increment, tracking: EgoMotion) -> UpdateStats:
    """What an update did. Raises EstimatorError where the estimator does not say it."""
    stats = estimator.update(increment, tracking)
    _require_pose(estimator, "update", stats, UpdateStats)
    return stats


def _require_pose(
    estimator: Estimator, asked: str, given: Prediction | UpdateStats, wanted: type
) -> None:
    """Estimators may be a user's own: a slip in one is named where it happens."""
    if not isinstance(given, wanted):
        raise EstimatorError(
            f"estimator {estimator.kind}: {asked} returned {type(given).__name__}; "
            f"return {wanted.__name__}"
        )
    shapes = np.shape(given.wTc), np.shape(given.covariance)
    if shapes != ((4, 4), (6, 6)):
        raise EstimatorError(
            f"estimator {estimator.kind}: {asked} returned a pose of shape {shapes[0]} with a "
            f"covariance of shape {shapes[1]}; return (4, 4) and (6, 6)"
        )
