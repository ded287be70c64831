"""Motion models: odometry moved to the camera, or constant velocity."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, Protocol

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.estimates import Prediction
from fgslam.core.geometry import inverse, odometry_of_camera, se3_exp, se3_log
from fgslam.core.measurements import Odometry
from fgslam.core.recordings import Sequence
from fgslam.core.store import Kept
from fgslam.datasets.settings import ConstantVelocitySettings
from fgslam.slam.gyroscope import GyroscopeError, turn_of_camera, turned_by
from fgslam.slam.motion_noise import MotionNoise

_LARGEST_SIGMA = np.repeat([3.0, 30.0], 3)
"""Radians and metres, of a step that nothing measured: as of one that is free. More would say no
more, and leave a graph that no solver solves."""


class MotionModel(Protocol):
    """Gives the camera's motion from the previous frame to the next one: an extension point."""

    @property
    def uses_odometry(self) -> bool:
        """True if it uses the odometry of the body."""
        ...

    def between(self, timestamp: float, body: Odometry | None) -> Odometry | None:
        """Camera motion since the last frame, measured or a stand-in; None for the first frame.

        Estimators take it as a measurement with its covariance. One that is marked ``measured`` is
        in the log, and so the same in every replay.

        Args:
            timestamp: of the new frame, seconds.
            body: the robot's odometry since the last frame; None where none was measured.
        """
        ...

    def observe(self, timestamp: float, pose: Prediction, measured: bool) -> None:
        """Learns the last frame's pose; ``measured``: tied to odometry or the map, or its first.

        The pose's covariance is what its matches left of it, relative to the map.
        """
        ...

    def displaced(self, timestamp: float, wTc: FloatArray, carried: bool) -> None:
        """Learns a pose that does not go on from the one before: between them lies no motion.

        A closed loop has corrected it; or the camera was ``carried`` and has been found again.
        """
        ...

    def regained(self, timestamp: float, wTc: FloatArray) -> None:
        """Learns a pose that its prediction failed to foresee, though the camera moved there."""
        ...


MOTION_MEMBERS = ("uses_odometry", "between", "observe", "displaced", "regained")
"""What the loop needs of a motion model."""


def description_of(motion: MotionModel) -> dict[str, Any]:
    """What the log holds of a motion model.

    Of one that is not of this package only the name: what it measured is in the log frame by
    frame, and over other frames a replay assumes constant velocity.
    """
    if isinstance(motion, OdometryMotion | ConstantVelocityMotion):
        return motion.description()
    return {"kind": type(motion).__name__, "stand_in": asdict(ConstantVelocitySettings())}


class OdometryMotion:
    """The robot's odometry, moved from its body to the camera (Se et al. 5).

    Over a gap in it, constant velocity stands in; so it does for the translation of a gyroscope's
    turns, which are corrected by what the matches say of its bias.
    """

    _stand_in: Kept[ConstantVelocityMotion]
    gyroscope: Kept[GyroscopeError]

    uses_odometry = True

    def __init__(self, bTc: FloatArray, kind: str, stand_in: ConstantVelocityMotion) -> None:
        """``bTc`` (4, 4) is the camera's lever arm; ``kind`` is `recorded` or `synthetic`."""
        self._bTc = bTc
        self._kind = kind
        self._stand_in = stand_in
        self.gyroscope = GyroscopeError()

    @property
    def acceleration_variance(self) -> FloatArray:
        """(6,) of the stand-in, as in :class:`ConstantVelocityMotion`."""
        return self._stand_in.acceleration_variance

    @property
    def gyroscope_factor(self) -> float:
        """By how much the deviation of turns exceeds what a gyroscope's noise states."""
        return float(np.sqrt(self.gyroscope.noise_factor))

    def between(self, timestamp: float, body: Odometry | None) -> Odometry | None:
        """Camera motion by the odometry, or by the stand-in."""
        if body is None:
            return self._stand_in.between(timestamp)
        if not body.turned:
            return odometry_of_camera(body, self._bTc)
        turn = self.gyroscope.corrected(turn_of_camera(body, self._bTc))
        return self.gyroscope.handed(self._stand_in.between(timestamp, turn))

    def observe(self, timestamp: float, pose: Prediction, measured: bool) -> None:
        """Updates the velocity of the stand-in, how far it is to be trusted, and the bias."""
        self._stand_in.observe(timestamp, pose, measured)
        self.gyroscope.observe(pose)

    def displaced(self, timestamp: float, wTc: FloatArray, carried: bool) -> None:
        """The stand-in goes on from there."""
        self._stand_in.displaced(timestamp, wTc, carried)
        self.gyroscope.displaced()

    def regained(self, timestamp: float, wTc: FloatArray) -> None:
        """The stand-in goes on from there."""
        self._stand_in.regained(timestamp, wTc)
        self.gyroscope.displaced()

    def description(self) -> dict[str, Any]:
        """The kind of odometry and what bridges its gaps."""
        return {"kind": self._kind, "stand_in": self._stand_in.description()}


class ConstantVelocityMotion:
    """The camera keeps its last velocity, up to a random acceleration; no sensor needed."""

    _noise: Kept[MotionNoise]
    _timestamp: Kept[float | None]
    _measured_at: Kept[float]
    _founded: Kept[bool]
    _pose: Kept[FloatArray]
    _velocity: Kept[FloatArray | None]

    uses_odometry = False

    def __init__(self, settings: ConstantVelocitySettings) -> None:
        """Knows nothing until two poses were observed; at first the camera is expected to rest."""
        self._settings = settings
        rotation, translation = settings.rotation_sigma_dps2, settings.translation_sigma_mps2
        self._noise = MotionNoise(np.concatenate([np.deg2rad(rotation), translation]))
        self._start_sigma = np.repeat(
            [np.deg2rad(settings.start_rotation_sigma_dps), settings.start_speed_sigma_mps], 3
        )
        self._timestamp = None
        self._measured_at = 0.0
        self._founded = False
        self._pose = np.eye(4)
        self._velocity = None

    @property
    def acceleration_variance(self) -> FloatArray:
        """(6,) of the random acceleration, [rotation, translation], rad^2/s^4 and m^2/s^4."""
        return self._noise.variance

    def between(self, timestamp: float, body: Odometry | None = None) -> Odometry | None:
        """Motion at the last velocity over the new interval ``dt``.

        Where ``body`` is a turn of the camera, its rotation takes the place of the velocity's;
        other odometry is not used.

        The velocity has wandered by ``sigma * T`` over the time T since it was last measured, so
        the step's standard deviation is ``sigma * T * dt``: ``sigma * dt^2`` from frame to frame,
        and growing while the camera is blind. Then the velocity fades, too.
        """
        guess = None if self._timestamp is None else self._guess(timestamp - self._timestamp)
        if guess is None or body is None or not body.turned:
            return guess
        return turned_by(guess, body)

    def _guess(self, dt: float) -> Odometry:
        if self._velocity is None or self._timestamp is None:
            return Odometry(np.eye(4), np.diag((self._start_sigma * dt) ** 2), measured=False)
        timestamp = self._timestamp + dt
        wandered = self._noise.variance * (timestamp - self._measured_at) ** 2
        variance = np.minimum(wandered * dt**2, _LARGEST_SIGMA**2)
        blind = self._measured_at < self._timestamp
        velocity = _faded(self._velocity, wandered) if blind else self._velocity
        return Odometry(se3_exp(velocity * dt), np.diag(variance), measured=False)

    def observe(self, timestamp: float, pose: Prediction, measured: bool) -> None:
        """Updates the velocity from the last two measured poses, its noise from how it changed.

        The frame that initialises the map counts as one, whatever its pose: what follows is
        measured against it. Until then the start moves on with the frames.
        """
        wTc = pose.wTc
        if measured and self._founded:
            step, dt = inverse(self._pose) @ wTc, timestamp - self._measured_at
            self._learn(step, np.diagonal(pose.covariance), dt)
            self._velocity = se3_log(step) / dt
        if measured or not self._founded:
            self._measured_at, self._pose = timestamp, wTc
        self._founded |= measured
        self._timestamp = timestamp

    def _learn(self, step: FloatArray, left: FloatArray, dt: float) -> None:
        """A step (4, 4) over ``dt`` seconds relative to the one that the velocity made expect."""
        if self._velocity is not None and self._settings.adapt:
            innovation = se3_log(se3_exp(-self._velocity * dt) @ step)
            self._noise.learn(innovation, left, dt**2)

    def displaced(self, timestamp: float, wTc: FloatArray, carried: bool) -> None:
        """Goes on from there with the velocity so far; of one that was carried none is known."""
        if carried:
            self._velocity = None
        self._founded = True
        self._timestamp = self._measured_at = timestamp
        self._pose = wTc

    def regained(self, timestamp: float, wTc: FloatArray) -> None:
        """Goes on from there with the velocity of the step; after blind frames none is known.

        The noise learns nothing: what was not foreseen once need not come again.
        """
        if self._founded and self._measured_at == self._timestamp:
            step, dt = inverse(self._pose) @ wTc, timestamp - self._measured_at
            self._velocity = se3_log(step) / dt
            self.displaced(timestamp, wTc, carried=False)
        else:
            self.displaced(timestamp, wTc, carried=True)

    def description(self) -> dict[str, Any]:
        """Kind and numbers."""
        return asdict(self._settings)


def _faded(velocity: FloatArray, wandered: FloatArray) -> FloatArray:
    """What is left (6,) of a velocity that has since wandered with these variances (6,).

    The estimate of least variance between the old one and rest, turn and way each by itself: a
    drone that may have changed by more than it moved is better expected where it was.
    """
    square = (velocity**2).reshape(2, 3).sum(axis=1)
    lost = wandered.reshape(2, 3).sum(axis=1)
    return np.asarray(velocity * np.repeat(square / np.maximum(square + lost, 1e-300), 3))


def body_motion(sequence: Sequence, i: int, motion: MotionModel) -> Odometry | None:
    """The recording's odometry to frame ``i``; None for the first, and where it is of no use.

    Raises:
        OdometryError: the recording's odometry is malformed.
    """
    return sequence.odometry(i) if i and motion.uses_odometry else None
