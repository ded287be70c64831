"""FastSLAM 2.0: particles of paths, in each one 3x3 Kalman filter a landmark.

Montemerlo, Thrun, Koller and Wegbreit (2002, 2003). Given the path, landmarks are independent: with
one particle this is the paper's structure (Se, Lowe and Little 2001, 6.4), and what that drops, the
landmarks' common errors, is in the spread of the particles. In each, with odometry's covariance
Q = L L^T about the pose that odometry leads to, and all matches of a frame (v, H_x, H_l, R),

    Z = H_l S H_l^T + R,    A = 1 + L^T (sum H_x^T Z^-1 H_x) L,    b = L^T sum H_x^T Z^-1 v
    x ~ x_odometry Exp(N(L A^-1 b, L A^-1 L^T))                         (_propose)
    log w += -(sum v^T Z^-1 v - b^T A^-1 b + sum log|Z| + log|A|) / 2   the matches' likelihood
    l, S by the Kalman filter at x                                      (_filter_landmarks)

Images are so much more precise than odometry that particles drawn from odometry alone, as in the
version of 2002, would hardly ever be where the images are. What is reported is the particles'
mixture before the draw. Draws depend on the seed and the frame alone.
"""

from __future__ import annotations

from typing import ClassVar, NamedTuple

import numpy as np

from fgslam.backend.filters.filtered import (
    FilteredTrajectory,
    require_finite,
    triangulated,
)
from fgslam.backend.filters.landmark_update import Landmarks, kalman_update
from fgslam.backend.settings import FastSlamSettings
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import (
    congruence,
    inverse,
    inverse_spd3,
    moved_apart,
    reorthonormalise,
    se3_exp,
    se3_log,
    transform_to_world,
)
from fgslam.core.sensors import CameraRig, Increment, MeasurementType, Observations, Odometry
from fgslam.core.store import Kept
from fgslam.core.types import EgoMotion, Estimate, Floor, LandmarkMap, Prediction, UpdateStats
from fgslam.factors.measurement import LinearRows, linearise, products

_ITERATIONS = 3  # of Gauss and Newton, to the proposal
_UNKNOWN = 100.0  # by which a pose found without a prior is less certain before its landmarks count


class Proposal(NamedTuple):
    """Of n particles: poses (n, 4, 4), root factors (n, 6, 6), log likelihoods (n,), innovation."""

    poses: FloatArray
    roots: FloatArray
    likelihoods: FloatArray
    nis: FloatArray


class FastSlam:
    """Estimator of kind ``fast_slam``, on :class:`fgslam.backend.protocol.Estimator`."""

    kind: ClassVar[str] = "fast_slam"
    supports: ClassVar[frozenset[MeasurementType]] = frozenset(
        {MeasurementType.STEREO, MeasurementType.ODOMETRY}
    )
    _past: Kept[FilteredTrajectory]
    _poses: Kept[FloatArray]
    _weights: Kept[FloatArray]
    _ids: Kept[IntArray]
    _positions: Kept[FloatArray]
    _covariances: Kept[FloatArray]

    def __init__(
        self, rig: CameraRig, settings: FastSlamSettings, floor: Floor, prior: Prediction
    ) -> None:
        """All particles at the prior pose, which the first frame spreads, with an empty map."""
        n = settings.particles
        self._rig, self._settings, self._floor = rig, settings, floor
        self._prior = prior
        self._poses = self._retracted(np.tile(prior.wTc, (n, 1, 1)), np.zeros((n, 6)))
        self._weights = np.full(n, 1.0 / n)
        self._ids = np.empty(0, np.int64)
        self._positions, self._covariances = np.empty((n, 0, 3)), np.empty((n, 0, 3, 3))
        self._past = FilteredTrajectory()
        self._map: LandmarkMap | None = None

    def predict(self, odometry: Odometry | None) -> Prediction:
        """The particles' mean moved by ``odometry``; the spread is theirs and odometry's."""
        poses, noise = self._moved(odometry)
        return self._mixture(poses, np.tile(noise, (len(poses), 1, 1)))

    def update(self, increment: Increment, tracking: EgoMotion) -> UpdateStats:
        """Draws the poses by the matches that tracking used, weighs and filters by them, resamples.

        Raises EstimatorError where time does not increase, a number is not finite, or the frame
        has measurements of other sensors; the state is then as before.
        """
        if increment.relocalised:
            self._past.require_later(increment)
        else:
            self._past.require_step(increment)
        require_finite(increment)
        if increment.measured:
            raise EstimatorError(
                f"frame {increment.index}: fast_slam takes cameras and odometry, no measurement of "
                f"kind {increment.measured[0].kind!r}; use ekf or isam2"
            )
        known = increment.observations.select(~increment.observations.is_new)
        used = known.select(tracking.inliers)
        used = used.select(np.isin(used.ids, self._ids))
        at = np.searchsorted(self._ids, used.ids)
        if increment.relocalised:
            start = np.tile(self._floor.constrain(tracking.wTc), (len(self._poses), 1, 1))
            noise = _UNKNOWN**2 * tracking.covariance
        else:
            start, noise = self._moved(increment.odometry)
        found = self._propose(start, noise, used, at)
        if len(used):
            weights = self._weights * np.exp(found.likelihoods - found.likelihoods.max())
            self._weights = weights / weights.sum()
        current = self._mixture(found.poses, congruence(found.roots, np.eye(6)[None]))
        nis = float(self._weights @ found.nis) if len(used) else float("nan")
        self._poses = self._drawn(found, len(self._past))
        self._filter_landmarks(used, at)
        self._drop(increment)
        self._add(increment)
        self._resample(len(self._past))
        self._map = None
        self._past.append(increment.timestamp, current)
        return UpdateStats(
            current.wTc,
            current.covariance,
            len(self._ids),
            nis,
            3 * len(used),
            (False,) * len(increment.loops),
        )

    def _moved(self, odometry: Odometry | None) -> tuple[FloatArray, FloatArray]:
        """All poses moved, and the covariance (6, 6) that it adds to each: at first the prior's."""
        if odometry is None:
            return self._poses, np.zeros((6, 6)) if len(self._past) else self._prior.covariance
        poses = self._poses @ odometry.motion
        return self._retracted(poses, np.zeros((len(poses), 6))), odometry.covariance

    def _retracted(self, poses: FloatArray, steps: FloatArray) -> FloatArray:
        """Poses (n, 4, 4) moved by steps (n, 6), staying on a hard floor."""
        if self._floor.rigid_dof == 6:
            return reorthonormalise(poses @ np.array([se3_exp(step) for step in steps]))
        pairs = zip(poses, steps, strict=True)
        return np.array([self._floor.constrain(moved_apart(wTc, step)) for wTc, step in pairs])

    def _linearised(
        self, poses: FloatArray, observed: Observations, at: IntArray
    ) -> tuple[LinearRows, Landmarks]:
        """Observations by every particle, one particle after the other; and its landmarks."""
        n, k = len(poses), len(at)
        known = Landmarks(
            self._positions[:, at].reshape(n * k, 3), self._covariances[:, at].reshape(n * k, 3, 3)
        )
        measured = np.tile(observed.measurement, (n, 1))
        rows = linearise(self._rig, poses.repeat(k, axis=0), known.positions, measured)
        return rows, known

    def _propose(
        self, start: FloatArray, noise: FloatArray, observed: Observations, at: IntArray
    ) -> Proposal:
        """Poses by odometry and matches, each particle by its own map."""
        n, k = len(start), len(at)
        allowed = np.array([self._floor.allowed_part(wTc, noise) for wTc in start])
        values, vectors = np.linalg.eigh(0.5 * (allowed + np.swapaxes(allowed, 1, 2)))
        roots = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
        poses, step = start, np.zeros((n, 6))
        if not k:
            return Proposal(poses, roots, np.zeros(n), np.zeros(n))
        for _ in range(_ITERATIONS):
            rows, known = self._linearised(poses, observed, at)
            off = -rows.residual + products(rows.by_pose, step.repeat(k, axis=0))
            own = np.tile(observed.covariance, (n, 1, 1))
            own = congruence(rows.by_point, known.covariances) + own
            weight = inverse_spd3(own) * rows.usable[:, None, None]
            by_pose = (rows.by_pose.reshape(n, k, 3, 6) @ roots[:, None]).reshape(n, 3 * k, 6)
            weighed = (weight.reshape(n, k, 3, 3) @ by_pose.reshape(n, k, 3, 6)).reshape(n, -1, 6)
            a = np.eye(6) + np.swapaxes(by_pose, 1, 2) @ weighed
            b = np.einsum("nij,ni->nj", weighed, off.reshape(n, -1))
            y = np.linalg.solve(a, b[:, :, None])[:, :, 0]
            step = products(roots, y)
            poses = self._retracted(start, step)
        lower = np.linalg.inv(np.linalg.cholesky(a))
        squared = np.einsum("ki,kij,kj->k", off, weight, off).reshape(n, k).sum(axis=1)
        nis = squared - (b * y).sum(axis=1)
        spread = np.where(rows.usable, np.linalg.slogdet(own)[1], 0.0).reshape(n, k).sum(axis=1)
        likelihoods = -0.5 * (nis + spread + np.linalg.slogdet(a)[1])
        return Proposal(poses, roots @ np.swapaxes(lower, 1, 2), likelihoods, nis)

    def _drawn(self, found: Proposal, frame: int) -> FloatArray:
        """A pose for each particle; the draws' mean is zero, so a single one is at its mean."""
        n = len(found.poses)
        draws = np.random.default_rng([self._settings.seed, frame, 0]).standard_normal((n, 6))
        draws = (draws - draws.mean(axis=0)) * np.sqrt(n / max(n - 1, 1))
        return self._retracted(found.poses, products(found.roots, draws))

    def _filter_landmarks(self, observed: Observations, at: IntArray) -> None:
        if len(at):
            n = len(self._poses)
            rows, known = self._linearised(self._poses, observed, at)
            noise = np.tile(observed.covariance, (n, 1, 1))
            found = kalman_update(known, rows.by_point, -rows.residual, noise)
            self._positions[:, at] = found.positions.reshape(n, -1, 3)
            self._covariances[:, at] = found.covariances.reshape(n, -1, 3, 3)

    def _add(self, increment: Increment) -> None:
        """New landmarks, where each particle sees them."""
        new = increment.observations.select(increment.observations.is_new)
        new = new.select(~np.isin(new.ids, [*self._ids, *increment.pruned_ids]))
        new, points, local = triangulated(self._rig, new)
        ids = np.concatenate([self._ids, new.ids])
        order = np.argsort(ids, kind="stable")
        placed = np.array([transform_to_world(wTc, points) for wTc in self._poses])
        turned = congruence(self._poses[:, None, :3, :3], local)
        self._ids = ids[order]
        self._positions = np.concatenate([self._positions, placed], axis=1)[:, order]
        self._covariances = np.concatenate([self._covariances, turned], axis=1)[:, order]

    def _drop(self, increment: Increment) -> None:
        kept = ~np.isin(self._ids, increment.pruned_ids)
        if not kept.all():
            self._ids = self._ids[kept]
            self._positions = self._positions[:, kept]
            self._covariances = self._covariances[:, kept]

    def _resample(self, frame: int) -> None:
        """Systematic, where less than half of the particles count."""
        n = len(self._weights)
        if 1.0 / (self._weights**2).sum() < 0.5 * n:
            first = np.random.default_rng([self._settings.seed, frame, 1]).uniform()
            steps = (first + np.arange(n)) / n
            chosen = np.minimum(np.searchsorted(np.cumsum(self._weights), steps), n - 1)
            self._poses, self._weights = self._poses[chosen], np.full(n, 1.0 / n)
            self._positions = self._positions[chosen]
            self._covariances = self._covariances[chosen]

    def _mixture(self, poses: FloatArray, covariances: FloatArray) -> Prediction:
        """Mean and covariance of weighed normal distributions (n, 4, 4), (n, 6, 6)."""
        centre = poses[int(np.argmax(self._weights))]
        cTw = inverse(centre)
        off = np.array([se3_log(cTw @ wTc) for wTc in poses])
        mean = self._weights @ off
        spread = np.einsum("n,ni,nj->ij", self._weights, off - mean, off - mean)
        wTc = self._retracted(centre[None], mean[None])[0]
        inside = np.einsum("n,nij->ij", self._weights, covariances)
        return Prediction(wTc, self._floor.allowed_part(wTc, inside + spread))

    def landmarks(self) -> LandmarkMap:
        """Mean and covariance of each landmark over the particles."""
        if self._map is None:
            mean = np.einsum("n,nlj->lj", self._weights, self._positions)
            off = self._positions - mean
            spread = np.einsum("n,nli,nlj->lij", self._weights, off, off)
            inside = np.einsum("n,nlij->lij", self._weights, self._covariances)
            self._map = LandmarkMap(self._ids, mean, inside + spread)
        return self._map

    def estimate(self) -> Estimate:
        """Trajectory as filtered, and the map."""
        return Estimate(
            self._past.trajectory(),
            self._past.pose_covariances(),
            self.landmarks(),
            noise_factor=1.0,
        )

    def remake(self) -> None:
        """Rebuilds the map from what was put back."""
        self._map = None
