"""The evidence of a few frames on a rig's correction: their poses and points are eliminated.

Bundle adjustment of one short window with errors in all images at both ends of every track. The
residuals are linear in the correction; poses and points are minimised over, then eliminated by
Schur complements (Triggs et al. 2000, Bundle adjustment, 6.1). Derived in
docs/derivations/self_calibration.md.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.geometry import (
    moved_apart,
    point_pose_jacobian,
    project,
    projection_jacobian,
    triangulate,
)
from fgslam.core.measurements import Observations
from fgslam.core.rig_correction import displacements
from fgslam.core.rig_field import field_displacements, field_modes
from fgslam.core.sensors import (
    CameraRig,
    pixel_covariance,
    pixel_model,
    rig_map,
    vertical_to_horizontal,
)

_KERNEL_WIDTH = 2.0  # standard deviations at which Cauchy's kernel bends, as the ego-motion's
_GROSS = 50.0  # standard deviations: no error of a point seen once, but another point
_ITERATIONS = 3  # more change the correction by a tenth of its sigma
_TOLERANCE = 1e-4  # relative change of the cost at which a window has come to rest
_LEAST_DAMPING = 1e-9
_NEAREST_M = 1e-2
_LEAST_DISPARITY_PX = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class RigEvidence:
    """Quadratic cost of a correction: half its Hessian and gradient at ``at``.

    Attributes:
        information: (p, p), poses and points eliminated.
        score: (p,) ``information @ (best - at)``: where this window alone would go.
        at: (p,) the correction at which both are taken.
        landmarks: that were seen in two frames or more.
        lean: (p, q) Hessian of the correction against the modes of a field
            (:mod:`fgslam.core.rig_field`), which are zero at ``at``.
        field: (q, q) Hessian of those.
        pull: (q,) where they would go.
    """

    information: FloatArray
    score: FloatArray
    at: FloatArray
    landmarks: int
    lean: FloatArray
    field: FloatArray
    pull: FloatArray

    def over(self, factor: float) -> RigEvidence:
        """The same with a variance that is larger by a factor."""
        scaled = ("information", "score", "lean", "field", "pull")
        parts = {name: getattr(self, name) / factor for name in scaled}
        return dataclasses.replace(self, **parts)


@dataclass(slots=True, eq=False)
class _State:
    poses: FloatArray
    points: FloatArray
    correction: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Prediction:
    """What is measured at a state.

    Attributes:
        local: (m, 3) points in the cameras that see them.
        residual: (m, 2 * cameras) predicted less raw pixels, whitened: of one sigma, independent.
        unit: (m, 2 * cameras, p) displacements of the predicted pixels.
        exact: (m, cameras, 2) those pixels.
    """

    state: _State
    local: FloatArray
    residual: FloatArray
    unit: FloatArray
    exact: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations with the points eliminated; poses 1.. first, then the correction."""

    hessian: FloatArray
    gradient: FloatArray
    point_inverse: FloatArray
    coupling: FloatArray
    point_gradient: FloatArray


def _of_last(normal: _Normal, count: int) -> tuple[FloatArray, FloatArray]:
    """Information and score of the last unknowns, poses eliminated. Raises LinAlgError."""
    poses, mixed = normal.hessian[:-count, :-count], normal.hessian[:-count, -count:]
    gain = np.linalg.solve(poses, np.column_stack([mixed, normal.gradient[:-count]]))
    information = normal.hessian[-count:, -count:] - mixed.T @ gain[:, :-1]
    score = -(normal.gradient[-count:] - mixed.T @ gain[:, -1])
    return (information + information.T) / 2.0, score


def _without_last(normal: _Normal, count: int) -> _Normal:
    """The same with the last unknowns held where they are."""
    kept = slice(None, len(normal.gradient) - count)
    hessian, gradient = normal.hessian[kept, kept], normal.gradient[kept]
    return dataclasses.replace(normal, hessian=hessian, gradient=gradient)


class RigAlignment:
    """One window of frames: a list of observations, by landmark and then by frame."""

    def __init__(
        self,
        rig: CameraRig,
        frames: Sequence[tuple[FloatArray, Observations]],
        pixel_sigma: float,
        free: BoolArray,
    ) -> None:
        """Frames are (wTc, what the ego-motion accepted), in order of time.

        Of the correction's terms (p,) those that are not ``free`` are held at zero.
        """
        self._rig, self._sigma, self._free = rig, pixel_sigma, free
        self._last: _Prediction | None = None
        self._poses = np.array([wTc for wTc, _ in frames])
        ids = np.concatenate([seen.ids for _, seen in frames])
        frame = np.repeat(np.arange(len(frames)), [len(seen) for _, seen in frames])
        pixels = np.concatenate([seen.pixels[:, : rig.cameras] for _, seen in frames])
        order = np.lexsort((frame, ids))
        self._landmark, self._frame = ids[order], frame[order]
        self._pixels = pixels[order]
        # What one image does not show is little evidence, and would take a model of its own.
        self._keep(np.isfinite(self._pixels).all(axis=(1, 2)))
        ratio = vertical_to_horizontal(rig)
        self._model = pixel_model(rig.cameras, ratio)
        self._white = np.linalg.inv(np.linalg.cholesky(pixel_covariance(rig.cameras, rig.places)))
        self._fuse = rig_map(rig)

    def evidence(self, correction: FloatArray, prior: FloatArray) -> RigEvidence | None:
        """The window's evidence on the correction; None where it shows too little.

        Args:
            correction: (p,) as known so far; the minimisation starts and is held there.
            prior: (p, p) its information.
        """
        state = self._start(correction)
        if state is None:
            return None
        state = self._minimise(state, correction, prior)
        if state is None:
            return None
        p, modes = len(correction), field_modes(self._rig)
        normal = self._with_field(state)
        try:
            information, score = _of_last(_without_last(normal, modes), p)
            joint, pull = _of_last(normal, p + modes)
        except np.linalg.LinAlgError:
            return None
        lean, field = joint[:p, p:], joint[p:, p:]
        count = len(self._first)
        return RigEvidence(information, score, state.correction, count, lean, field, pull[p:])

    # ----------------------------------------------------------------------------------------

    def _keep(self, which: BoolArray) -> None:
        """Drops the other observations, and landmarks of which less than two are left."""
        landmark = self._landmark[which]
        _, at, count = np.unique(landmark, return_inverse=True, return_counts=True)
        often = count[at] >= 2
        self._landmark = np.unique(landmark[often], return_inverse=True)[1]
        self._frame, self._pixels = self._frame[which][often], self._pixels[which][often]
        self._first = np.flatnonzero(np.diff(self._landmark, prepend=-1))

    def _start(self, correction: FloatArray) -> _State | None:
        """Points from their first sighting; landmarks that fit none of it are left out."""
        self._keep(self._measured(correction)[:, 2] > _LEAST_DISPARITY_PX)
        if not self._first.size:
            return None
        local = triangulate(self._rig, self._measured(correction)[self._first])
        turn, place = self._poses[:, :3, :3], self._poses[:, :3, 3]
        at = self._frame[self._first]
        points = np.einsum("lij,lj->li", turn[at], local) + place[at]
        found = self._predicted(_State(self._poses, points, correction))
        wild = (np.abs(found.residual).max(axis=1) > _GROSS) | (found.local[:, 2] < _NEAREST_M)
        usable = ~np.logical_or.reduceat(wild, self._first)
        self._keep(usable[self._landmark])
        if usable.sum() < len(correction):
            return None
        return _State(self._poses, points[usable], correction)

    def _measured(self, correction: FloatArray) -> FloatArray:
        """(column, row, disparity) (m, 3), corrected."""
        moved = displacements(self._rig, self._pixels) @ correction
        return np.asarray((self._raw() - moved) @ self._fuse.T)

    def _raw(self) -> FloatArray:
        return self._pixels.reshape(-1, 2 * self._rig.cameras)

    def _local(self, state: _State) -> FloatArray:
        """Points (m, 3) in the cameras that see them."""
        turn, place = state.poses[:, :3, :3], state.poses[:, :3, 3]
        off = state.points[self._landmark] - place[self._frame]
        return np.asarray((off[:, None] @ turn[self._frame])[:, 0])

    def _predicted(self, state: _State) -> _Prediction:
        """What is measured at a state; of the last one it is known.

        Displacements are taken at the prediction: a measured pixel's noise would correlate with
        them, and windows without end would agree on a wrong lens.
        """
        if self._last is not None and self._last.state is state:
            return self._last
        local = self._local(state)
        safe = np.where(local[:, 2:] > _NEAREST_M, local, [0.0, 0.0, 1.0])
        exact = project(self._rig, safe) @ self._model.T
        pixels = exact.reshape(-1, self._rig.cameras, 2)
        unit = displacements(self._rig, pixels)
        unit *= self._free
        off = exact + unit @ state.correction - self._raw()
        residual = off @ self._white.T / self._sigma
        self._last = _Prediction(state, local, residual, unit, pixels)
        return self._last

    def _cost(self, state: _State, around: FloatArray, prior: FloatArray) -> float:
        found = self._predicted(state)
        if (found.local[:, 2] < _NEAREST_M).any():
            return np.inf
        off = state.correction - around
        squared = (found.residual**2).sum(axis=1) / _KERNEL_WIDTH**2
        return float(_KERNEL_WIDTH**2 * np.log1p(squared).sum() + off @ prior @ off)

    def _minimise(self, state: _State, around: FloatArray, prior: FloatArray) -> _State | None:
        damping, best = 1e-6, self._cost(state, around, prior)
        for _ in range(_ITERATIONS):
            normal = self._normal(self._predicted(state))
            moved = self._step(state, normal, around, prior, damping)
            if moved is None:
                return None
            cost = self._cost(moved, around, prior)
            if cost > best:
                damping *= 100.0
                continue
            rested = best - cost <= _TOLERANCE * best
            state, best, damping = moved, cost, max(damping / 10.0, _LEAST_DAMPING)
            if rested:
                break
        return state

    def _with_field(self, state: _State) -> _Normal:
        """Normal equations with the modes of a field as further unknowns, at zero."""
        found = self._predicted(state)
        modes = field_displacements(self._rig, found.exact)
        unit = np.concatenate([found.unit, modes], axis=2)
        return self._normal(dataclasses.replace(found, unit=unit))

    def _normal(self, found: _Prediction) -> _Normal:
        state = found.state
        local, residual, unit = found.local, found.residual, self._white @ found.unit
        squared = (residual**2).sum(axis=1)
        root = 1.0 / (self._sigma * np.sqrt(1.0 + squared / _KERNEL_WIDTH**2))
        by_local = root[:, None, None] * (
            self._white @ self._model @ projection_jacobian(self._rig, local)
        )
        by_pose = by_local @ point_pose_jacobian(local)
        by_point = by_local @ np.swapaxes(state.poses[:, :3, :3], 1, 2)[self._frame]
        joint = np.concatenate([by_pose, root[:, None, None] * unit], axis=2)
        weighted = self._sigma * root[:, None] * residual
        hessian, gradient = self._of_frames(joint, weighted)
        point_left = np.swapaxes(by_point, 1, 2)
        curvature = np.add.reduceat(point_left @ by_point, self._first)
        curvature += 1e-9 * np.trace(curvature, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        pull = np.add.reduceat((point_left @ weighted[:, :, None])[..., 0], self._first)
        coupling = self._coupling(np.swapaxes(joint, 1, 2) @ by_point)
        inverse = np.linalg.inv(curvature)
        eliminated = coupling @ inverse
        flat = np.swapaxes(coupling, 1, 2).reshape(-1, len(gradient))
        hessian -= np.swapaxes(eliminated, 1, 2).reshape(-1, len(gradient)).T @ flat
        gradient = gradient - np.einsum("lnj,lj->n", eliminated, pull)
        return _Normal(hessian, gradient, inverse, coupling, pull)

    def _of_frames(self, joint: FloatArray, weighted: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Joint Hessian and gradient before points are eliminated; the first pose is held."""
        frames, p = len(self._poses), joint.shape[2] - 6
        size = 6 * (frames - 1)
        hessian, out = np.zeros((size + p, size + p)), np.zeros(size + p)
        for k in range(frames):
            own = self._frame == k
            jacobian = joint[own].reshape(-1, 6 + p)
            block, gradient = jacobian.T @ jacobian, jacobian.T @ weighted[own].ravel()
            hessian[size:, size:] += block[6:, 6:]
            out[size:] += gradient[6:]
            if k:
                at = slice(6 * k - 6, 6 * k)
                hessian[at, at], out[at] = block[:6, :6], gradient[:6]
                hessian[at, size:], hessian[size:, at] = block[:6, 6:], block[6:, :6]
        return hessian, out

    def _coupling(self, crossing: FloatArray) -> FloatArray:
        """Points against poses 1.. and correction (l, n, 3), from observations (m, 6 + p, 3)."""
        landmarks, later = len(self._first), len(self._poses) - 1
        poses = np.zeros((landmarks, later, 6, 3))
        moving = self._frame > 0
        poses[self._landmark[moving], self._frame[moving] - 1] = crossing[moving, :6]
        rig = np.add.reduceat(crossing[:, 6:], self._first)
        return np.concatenate([poses.reshape(landmarks, 6 * later, 3), rig], axis=1)

    def _step(
        self, state: _State, normal: _Normal, around: FloatArray, prior: FloatArray, damping: float
    ) -> _State | None:
        p = len(around)
        hessian, gradient = normal.hessian.copy(), normal.gradient.copy()
        hessian[-p:, -p:] += prior
        gradient[-p:] += prior @ (state.correction - around)
        hessian.flat[:: len(hessian) + 1] *= 1.0 + damping
        try:
            step = np.asarray(-np.linalg.solve(hessian, gradient), np.float64)
        except np.linalg.LinAlgError:
            return None
        pull = normal.point_gradient + np.einsum("lnj,n->lj", normal.coupling, step)
        points = state.points - np.einsum("lij,lj->li", normal.point_inverse, pull)
        moves = step[:-p].reshape(-1, 6)
        poses = np.stack(
            [state.poses[0]]
            + [moved_apart(T, xi) for T, xi in zip(state.poses[1:], moves, strict=True)]
        )
        return _State(poses, points, state.correction + step[-p:])
