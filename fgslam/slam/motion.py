"""Motion models: odometry moved to the camera, or constant velocity."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.geometry import compose_covariance, inverse, se3_exp, se3_log, so3_exp, so3_log
from fgslam.core.log import ImageSequence
from fgslam.core.sensors import Odometry, odometry_of_camera
from fgslam.core.store import Kept
from fgslam.core.types import Prediction

_LARGEST_SIGMA = np.repeat([3.0, 30.0], 3)
"""Radians and metres, of a step that nothing measured: as of one that is free. More would say no
more, and leave a graph that no solver solves."""


START_ACCELERATION_SIGMA = np.repeat([np.deg2rad(100.0), 3.0], 3)
"""At first, about and along the camera's axes x, y, z, rad/s^2 and m/s^2: of a flying or hand-held
camera, wide for any other (cars of KITTI: 12, 6, 8 degrees/s^2 and 0.35, 0.43, 2.3 m/s^2)."""
START_VELOCITY_SIGMA = np.repeat([np.deg2rad(20.0), 15.0], 3)
"""Per axis before the first motion is known, rad/s and m/s."""


class ConstantVelocityMotion:
    """The camera keeps its last velocity, up to a random acceleration; no sensor needed."""

    _noise: Kept[MotionNoise]
    _timestamp: Kept[float | None]
    _measured_at: Kept[float]
    _founded: Kept[bool]
    _pose: Kept[FloatArray]
    _velocity: Kept[FloatArray | None]

    uses_odometry = False

    def __init__(self) -> None:
        """Knows nothing until two poses were observed; at first the camera is expected to rest."""
        self._noise = MotionNoise(START_ACCELERATION_SIGMA)
        self._timestamp = None
        self._measured_at = 0.0
        self._founded = False
        self._pose = np.eye(4)
        self._velocity = None

    def between(self, timestamp: float, body: Odometry | None = None) -> Odometry | None:
        """Motion at the last velocity over the new interval ``dt``.

        Where ``body`` is a turn of the camera, its rotation takes the place of the velocity's;
        other odometry is not used.

        The velocity has wandered by ``sigma * T`` over the time T since it was last measured, so
        the step's standard deviation is ``sigma * T * dt``: ``sigma * dt^2`` from frame to frame,
        and growing while the camera is blind. Then the velocity fades, too.
        """
        if self._timestamp is None:
            return None
        dt, velocity = timestamp - self._timestamp, self._velocity
        variance, step = (START_VELOCITY_SIGMA * dt) ** 2, np.eye(4)
        if velocity is not None:
            wandered = self._noise.variance * (self._timestamp + dt - self._measured_at) ** 2
            variance = np.minimum(wandered * dt**2, _LARGEST_SIGMA**2)
            if self._measured_at < self._timestamp:
                velocity = _faded(velocity, wandered)
            step = se3_exp(velocity * dt)
        guess = Odometry(step, np.diag(variance), measured=False)
        return guess if body is None or not body.turned else turned_by(guess, body)

    def observe(self, timestamp: float, pose: Prediction, measured: bool) -> None:
        """Updates the velocity from the last two measured poses, its noise from how it changed.

        The frame that initialises the map counts as one, whatever its pose: what follows is
        measured against it. Until then the start moves on with the frames.
        """
        wTc = pose.wTc
        if measured and self._founded:
            step, dt = inverse(self._pose) @ wTc, timestamp - self._measured_at
            if self._velocity is not None:
                innovation = se3_log(se3_exp(-self._velocity * dt) @ step)
                self._noise.learn(innovation, np.diagonal(pose.covariance), dt**2)
            self._velocity = se3_log(step) / dt
        if measured or not self._founded:
            self._measured_at, self._pose = timestamp, wTc
        self._founded |= measured
        self._timestamp = timestamp

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

    @property
    def acceleration_variance(self) -> FloatArray:
        """(6,) of the random acceleration, [rotation, translation], rad^2/s^4 and m^2/s^4."""
        return self._noise.variance

    def description(self) -> dict[str, Any]:
        """Kind and numbers."""
        return {"kind": "constant_velocity"}


def _faded(velocity: FloatArray, wandered: FloatArray) -> FloatArray:
    """What is left (6,) of a velocity that has since wandered with these variances (6,).

    The estimate of least variance between the old one and rest, turn and way each by itself: a
    drone that may have changed by more than it moved is better expected where it was.
    """
    square = (velocity**2).reshape(2, 3).sum(axis=1)
    lost = wandered.reshape(2, 3).sum(axis=1)
    return np.asarray(velocity * np.repeat(square / np.maximum(square + lost, 1e-300), 3))


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
        self.gyroscope.displaced(None if carried else wTc)

    def regained(self, timestamp: float, wTc: FloatArray) -> None:
        """The stand-in goes on from there."""
        self._stand_in.regained(timestamp, wTc)
        self.gyroscope.displaced()

    @property
    def acceleration_variance(self) -> FloatArray:
        """(6,) of the stand-in, as in :class:`ConstantVelocityMotion`."""
        return self._stand_in.acceleration_variance

    @property
    def gyroscope_factor(self) -> float:
        """By how much the deviation of turns exceeds what a gyroscope's noise states."""
        return float(np.sqrt(self.gyroscope.noise_factor))

    def description(self) -> dict[str, Any]:
        """The kind of odometry and what bridges its gaps."""
        return {"kind": self._kind}


def turn_of_camera(body: Odometry, bTc: FloatArray) -> Odometry:
    """The turn of a body as that of its camera: all points of a rigid body turn alike."""
    cRb = bTc[:3, :3].T
    bias = body.bias
    if bias is not None:
        bias = dataclasses.replace(bias, jacobian=cRb @ bias.jacobian)
    rotation = cRb @ body.motion[:3, :3] @ cRb.T
    return Odometry.turn(rotation, cRb @ body.covariance[:3, :3] @ cRb.T, bias)


def turned_by(guess: Odometry, turn: Odometry) -> Odometry:
    """A guessed step with a measured turn in place of its own; the velocity is the guess's."""
    rotation = so3_log(turn.motion[:3, :3])
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = turn.covariance[:3, :3]
    covariance[3:, 3:] = guess.covariance[3:, 3:]
    motion = se3_exp(np.append(rotation, se3_log(guess.motion)[3:]))
    return Odometry(motion, covariance, measured=False, turned=True, bias=turn.bias)


def body_motion(sequence: ImageSequence, i: int, motion: MotionModel) -> Odometry | None:
    """The recording's odometry to frame ``i``; None for the first, and where it is of no use.

    Raises:
        OdometryError: the recording's odometry is malformed.
    """
    return sequence.odometry(i) if i and motion.uses_odometry else None


def description_of(motion: MotionModel) -> dict[str, Any]:
    """What the log holds of a motion model.

    Of one that is not of this package only the name: what it measured is in the log frame by
    frame, and over other frames a replay assumes constant velocity.
    """
    if isinstance(motion, OdometryMotion | ConstantVelocityMotion):
        return motion.description()
    return {"kind": type(motion).__name__}


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

        The estimator has corrected it, or the camera was ``carried`` and has been found again.
        """
        ...

    def regained(self, timestamp: float, wTc: FloatArray) -> None:
        """Learns a pose that its prediction failed to foresee, though the camera moved there."""
        ...


MOTION_MEMBERS = ("uses_odometry", "between", "observe", "displaced", "regained")
"""What the loop needs of a motion model."""


# ------------------------------------------------------------------------------------------
# Noise of the constant-velocity model, estimated from how far it was off

_MEMORY = 10.0  # frames after which a sample has lost all but 1/e of its weight
_MOTION_NOISE_FADING = float(np.exp(-1.0 / _MEMORY))
_START_FADING = 1.0 / 3.0  # the start is wide on purpose: five innovations outweigh a tenfold one
_SHARED_WEIGHT = 1.0  # samples that the mean of a block's axes counts for in each of them
_LEAST_SIGMA = np.repeat([np.deg2rad(0.05), 0.001], 3)
"""rad/s^2 and m/s^2; below what any matching measures: the estimate never collapses."""


class MotionNoise:
    """Variances of the random acceleration about and along the camera's axes."""

    _sum: Kept[FloatArray]
    _weight: Kept[float]
    _start_weight: Kept[float]

    def __init__(self, start_sigma: FloatArray) -> None:
        """``start_sigma`` (6,): [rotation, translation], rad/s^2 and m/s^2, before any sample."""
        self._start = start_sigma**2
        self._start_weight = 1.0
        self._sum = np.zeros(6)
        self._weight = 0.0

    @property
    def variance(self) -> FloatArray:
        """(6,) of the acceleration, rad^2/s^4 and m^2/s^4."""
        weight = self._weight + self._start_weight
        total = self._sum + self._start_weight * self._start
        shared = np.repeat(total.reshape(2, 3).mean(axis=1), 3) / weight
        own = (total + _SHARED_WEIGHT * shared) / (weight + _SHARED_WEIGHT)
        return np.asarray(np.maximum(own, _LEAST_SIGMA**2))

    def learn(self, innovation: FloatArray, left: FloatArray, span: float) -> None:
        """Takes in one step.

        Args:
            innovation: (6,) tangent vector from the predicted step to the one found.
            left: (6,) variance that is left in it.
            span: seconds squared by which an acceleration becomes a change of the step.
        """
        self._sum = _MOTION_NOISE_FADING * self._sum + (innovation**2 + left) / span**2
        self._weight = _MOTION_NOISE_FADING * self._weight + 1.0
        self._start_weight *= _START_FADING


# ------------------------------------------------------------------------------------------
# Turns of a gyroscope as motion of the camera, corrected for its bias, which matches reveal

_FADING = float(np.exp(-0.1))  # frames remembered, as of the noise of constant velocity: ten
_STATED_WEIGHT = 3.0  # one turn's worth of the stated noise, which is never undercut


class GyroscopeError:
    """Bias of the gyroscope, and by how much its noise exceeds what is stated.

    A Kalman filter of its own. The pose of a frame was predicted by the step, whose error
    the bias is part of; what matches then corrected is by that part the bias's. Neither the
    matches nor their noise need be known for it: the correction and the covariances before and
    after it say the same.
    """

    _bias: Kept[FloatArray]
    _covariance: Kept[FloatArray | None]
    _jacobian: Kept[FloatArray | None]
    _step: Kept[Odometry | None]
    _before: Kept[Prediction | None]
    _found: Kept[float]
    _expected: Kept[float]

    def __init__(self) -> None:
        """Knows nothing but that it is about zero, within what the first step states."""
        self._bias = np.zeros(3)
        self._covariance = None
        self._jacobian = None
        self._step = None
        self._before = None
        self._found, self._expected = _STATED_WEIGHT, _STATED_WEIGHT

    @property
    def bias(self) -> FloatArray:
        """(3,) rad/s in the gyroscope's own axes, as far as known."""
        return self._bias

    @property
    def noise_factor(self) -> float:
        """By how much the variance of turns exceeds what was stated; 1 where it does not."""
        return max(1.0, self._found / self._expected)

    def corrected(self, turn: Odometry) -> Odometry:
        """The camera's turn without the bias; its covariance has what is unknown of that."""
        self._jacobian = None
        covariance = self.noise_factor * turn.covariance[:3, :3]
        if turn.bias is None:
            return Odometry.turn(turn.motion[:3, :3], covariance)
        if self._covariance is None:
            self._covariance = turn.bias.start_variance * np.eye(3)
        self._covariance = self._covariance + turn.bias.walk * np.eye(3)
        jacobian = self._jacobian = turn.bias.jacobian
        rotation = turn.motion[:3, :3] @ so3_exp(jacobian @ self._bias)
        unknown = jacobian @ self._covariance @ jacobian.T
        known = dataclasses.replace(turn.bias, applied=self._bias, left=self._covariance)
        return Odometry.turn(rotation, covariance + unknown, known)

    def handed(self, step: Odometry | None) -> Odometry | None:
        """The step itself; it is what the next pose is predicted with."""
        self._step = step
        return step

    def observe(self, pose: Prediction) -> None:
        """Learns from the pose that followed; the prediction itself is no measurement."""
        step, before = self._step, self._before
        self._step, self._before = None, pose
        if step is None or before is None:
            return
        prior = compose_covariance(step.motion, before.covariance, step.covariance)
        correction = se3_log(inverse(before.wTc @ step.motion) @ pose.wTc)
        gained = prior - pose.covariance
        self._learn_noise(correction[:3], prior[:3, :3], gained[:3, :3])
        if self._jacobian is not None and self._covariance is not None:
            effect = np.zeros((6, 3))
            effect[:3] = self._jacobian
            gain = np.linalg.solve(prior, effect @ self._covariance).T
            self._bias = self._bias + gain @ correction
            left = self._covariance - gain @ gained @ gain.T
            self._covariance = 0.5 * (left + left.T)

    def _learn_noise(self, correction: FloatArray, prior: FloatArray, gained: FloatArray) -> None:
        """The corrections' squares relative to those that the covariances make expect, fading."""
        found = float(correction @ np.linalg.solve(prior, correction))
        expected = max(float(np.trace(np.linalg.solve(prior, gained))), 0.0)
        self._found = _FADING * self._found + self.noise_factor * found
        self._expected = _FADING * self._expected + expected
        if self._expected < _STATED_WEIGHT:  # weight of what is stated
            missing = _STATED_WEIGHT - self._expected
            self._found, self._expected = self._found + missing, _STATED_WEIGHT

    def displaced(self, wTc: FloatArray | None = None) -> None:
        """Goes on from a pose as well known as the last one; from none where that is not known."""
        before, self._step, self._before = self._before, None, None
        if before is not None and wTc is not None:
            self._before = Prediction(wTc, before.covariance)
