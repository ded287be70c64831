"""Turns of a gyroscope as motion of the camera, corrected for its bias, which matches reveal.

docs/derivations/gyroscope.md.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from fgslam.core.arrays import FloatArray
from fgslam.core.estimates import Prediction
from fgslam.core.geometry import compose_covariance, inverse, se3_exp, se3_log, so3_exp, so3_log
from fgslam.core.measurements import Odometry
from fgslam.core.store import Kept

_FADING = float(np.exp(-0.1))  # frames remembered, as of the noise of constant velocity: ten
_STATED_WEIGHT = 3.0  # one turn's worth of the stated noise, which is never undercut


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

    def displaced(self) -> None:
        """Between the last pose and the next lies no motion."""
        self._step = self._before = None
