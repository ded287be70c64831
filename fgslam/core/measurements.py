"""Measurements, as every estimator consumes them and as the log keeps them."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from fgslam.core.arrays import BoolArray, Brief, FloatArray, IntArray, Rows

FREE_TRANSLATION_M = 30.0
"""Standard deviation per axis of a step's translation of which nothing is known."""


class MeasurementType(str, Enum):
    """Kinds of measurement that an estimator may support; checked before a run starts."""

    ODOMETRY = "odometry"
    STEREO = "stereo"
    LOOP = "loop"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class BiasEffect(Brief):
    """What the bias of a gyroscope does to a step that it measured.

    Attributes:
        jacobian: (3, 3) of the step's rotation vector, at its end, by the bias: rad by rad/s.
        start_variance: of the bias per axis before the drive, (rad/s)^2.
        walk: by how much that variance grows in the step, (rad/s)^2.
        applied: (3,) bias that the step's motion is corrected for, rad/s; zero as measured.
        left: (3, 3) covariance of what is unknown of it, which the step's covariance contains;
            zero as measured.
    """

    jacobian: FloatArray
    start_variance: float
    walk: float
    applied: FloatArray = field(default_factory=lambda: np.zeros(3))
    left: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Odometry(Brief):
    """Motion between two consecutive frames, with its uncertainty.

    Attributes:
        motion: (4, 4) ``pTn``: the pose at the new frame, in the frame of the previous one.
        covariance: (6, 6) of the tangent vector at the new pose, [rotation, translation].
        measured: by wheels or another sensor; else a motion model's stand-in, such as constant
            velocity, which belongs in no log.
        turned: its rotation alone was measured, by a gyroscope; the translation is a stand-in's, or
            free (:meth:`turn`), and ``measured`` is false.
        bias: of that gyroscope; None where nothing is known of it.
    """

    motion: FloatArray
    covariance: FloatArray
    measured: bool = True
    turned: bool = False
    bias: BiasEffect | None = None

    @staticmethod
    def turn(
        rotation: FloatArray, covariance: FloatArray, bias: BiasEffect | None = None
    ) -> Odometry:
        """A rotation (3, 3) and its covariance (3, 3); nothing is known of the translation."""
        motion, full = np.eye(4), np.diag(np.repeat([0.0, FREE_TRANSLATION_M**2], 3))
        motion[:3, :3], full[:3, :3] = rotation, covariance
        return Odometry(motion, full, measured=False, turned=True, bias=bias)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Observations(Rows):
    """Landmark observations of one frame, with their identity.

    Attributes:
        ids: (k,) landmark identities, unique within the frame.
        measurement: (k, 3) (column, row, disparity), pixels.
        covariance: (k, 3, 3) of the measurement.
        pixels: (k, 3, 2) raw pixels in right, left, top; NaN where there is no such camera, or
            its image did not show the landmark.
        is_new: (k,) True where this observation initiates the landmark (Type IV).
    """

    ids: IntArray
    measurement: FloatArray
    covariance: FloatArray
    pixels: FloatArray
    is_new: BoolArray


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class LoopClosure(Brief):
    """A place seen again: the frame sees landmarks of an earlier frame, under new identities.

    Attributes:
        frame: position in the log of the earlier frame (0 is the log's first). Of a part of a saved
            map that the run has yet to see: that in which it entered the map, held still between.
        oTc: (4, 4) pose of the present camera in the earlier frame's camera.
        covariance: (6, 6) of ``oTc``, [rotation, translation], in the tangent space at it.
        observations: the earlier landmarks as the present frame measures them, under their old
            identities.
        merged: (m, 2) pairs (identity that ends, identity that stays) of landmarks that are one if
            this is the same place; the frame observes the first. Where the live estimator took the
            closure, it is pruned in the next frame.
    """

    frame: int
    oTc: FloatArray
    covariance: FloatArray
    observations: Observations
    merged: IntArray


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class SettledRig(Brief):
    """What a rig that calibrates itself is known to be off by, for all frames alike.

    Attributes:
        values: (p,) of the correction (:func:`fgslam.core.rig_correction.term_names`); None where
            each frame's own is no worse.
        knocks: how often the rig was found to have moved before.
        field_px: what no term of the correction follows, taken off nothing: standard deviation of
            one coordinate in each image (:mod:`fgslam.core.rig_field`).
    """

    values: FloatArray | None
    knocks: int
    field_px: float = 0.0


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Increment(Brief):
    """Everything that one frame adds to the problem: what the log stores, what estimators consume.

    Attributes:
        index: the recording's frame number.
        timestamp: seconds.
        odometry: camera motion since the previous increment, measured or a motion model's; None
            for the first one, and in a log where none was measured.
        observations: matched (Type III) and new (Type IV) landmarks.
        rejected: (k,) matched observations that the live run's pose rejected as outliers.
        missed_ids: landmarks expected in view and not matched (Type II).
        pruned_ids: landmarks that the database dropped after this frame; those merged into others
            because of the last frame's loop closure among them.
        loops: places recognised in this frame, verified; each estimator judges them for itself.
        relocalised: placed by its landmarks alone, without a prior; its odometry is meaningless.
        rig_correction: (p,) of the rig against its calibration
            (:func:`fgslam.core.rig_correction.term_names`), taken off the measurements already, not
            off the raw pixels; None where the calibration was taken as it is.
        settled_rig: what was known then of the rig for all frames alike, taken off nothing; None
            where the calibration was taken as it is.
    """

    index: int
    timestamp: float
    odometry: Odometry | None
    observations: Observations
    rejected: BoolArray
    missed_ids: IntArray
    pruned_ids: IntArray
    loops: tuple[LoopClosure, ...] = ()
    relocalised: bool = False
    rig_correction: FloatArray | None = None
    settled_rig: SettledRig | None = None

    @property
    def kept(self) -> Observations:
        """The observations but for the rejected ones."""
        return self.observations.select(~self.rejected)


def moved_pixels(earlier: Increment | None, now: Increment) -> tuple[FloatArray, FloatArray]:
    """(column, row) (k, 2), before and now, of the landmarks that both frames saw and kept."""
    if earlier is None:
        return np.empty((0, 2)), np.empty((0, 2))
    before, after = earlier.kept, now.kept
    _, a, b = np.intersect1d(before.ids, after.ids, return_indices=True)
    return before.measurement[a, :2], after.measurement[b, :2]
