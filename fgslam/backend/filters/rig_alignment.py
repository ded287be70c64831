"""What a few frames say about a rig's correction: their poses and points are eliminated.

Bundle adjustment of one short window with errors in all images at both ends of every track. The
residuals are linear in the correction; poses and points are minimised over, then eliminated by
Schur complements (Triggs et al. 2000, Bundle adjustment, 6.1). Arrays are (frames, landmarks, ..)
with weight zero where a landmark is not seen. Derived in docs/derivations/self_calibration.md.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fgslam.core.arrays import BoolArray, FloatArray
from fgslam.core.geometry import (
    moved_apart,
    point_pose_jacobian,
    project,
    projection_jacobian,
    transform_to_camera,
    transform_to_world,
    triangulate,
)
from fgslam.core.measurements import Observations
from fgslam.core.rig_correction import displacements
from fgslam.core.sensors import (
    CameraRig,
    measurement_map,
    pixel_model,
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
    """

    information: FloatArray
    score: FloatArray
    at: FloatArray
    landmarks: int


@dataclass(slots=True, eq=False)
class _State:
    poses: FloatArray
    points: FloatArray
    correction: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations with the points eliminated; poses 1.. first, then the correction."""

    hessian: FloatArray
    gradient: FloatArray
    point_inverse: FloatArray
    coupling: FloatArray
    point_gradient: FloatArray


class RigAlignment:
    """One window of frames."""

    def __init__(
        self,
        rig: CameraRig,
        frames: Sequence[tuple[FloatArray, Observations]],
        pixel_sigma: float,
    ) -> None:
        """Frames are (wTc, what the ego-motion accepted), in order of time."""
        self._rig, self._sigma = rig, pixel_sigma
        self._poses = np.array([wTc for wTc, _ in frames])
        ids = np.concatenate([seen.ids for _, seen in frames])
        known, count = np.unique(ids, return_counts=True)
        self._ids = known[count >= 2]
        shape = (len(frames), len(self._ids))
        self._seen: BoolArray = np.zeros(shape, np.bool_)
        self._pixels = np.zeros((*shape, rig.cameras, 2))
        for k, (_, seen) in enumerate(frames):
            row = np.flatnonzero(np.isin(seen.ids, self._ids))
            at = np.searchsorted(self._ids, seen.ids[row])
            self._seen[k, at] = True
            self._pixels[k, at] = seen.pixels[row, : rig.cameras]
        ratio = vertical_to_horizontal(rig)
        self._model = pixel_model(rig.cameras, ratio)
        self._fuse = measurement_map("fused", rig.cameras, ratio)

    def evidence(self, correction: FloatArray, prior: FloatArray) -> RigEvidence | None:
        """What the window says of the correction; None where it shows too little.

        Args:
            correction: (p,) as known so far; the minimisation starts and is held there.
            prior: (p, p) its information.
        """
        state = self._start(correction)
        if state is None:
            return None
        found = self._minimise(state, correction, prior)
        if found is None:
            return None
        state, normal = found
        p = len(correction)
        poses, mixed = normal.hessian[:-p, :-p], normal.hessian[:-p, -p:]
        try:
            gain = np.linalg.solve(poses, np.column_stack([mixed, normal.gradient[:-p]]))
        except np.linalg.LinAlgError:
            return None
        information = normal.hessian[-p:, -p:] - mixed.T @ gain[:, :-1]
        score = -(normal.gradient[-p:] - mixed.T @ gain[:, -1])
        information = (information + information.T) / 2.0
        return RigEvidence(information, score, state.correction, len(self._ids))

    # ----------------------------------------------------------------------------------------

    def _start(self, correction: FloatArray) -> _State | None:
        """Points from their first sighting; landmarks that fit none of it are left out."""
        if not self._ids.size or len(self._poses) < 2:
            return None
        corrected = self._corrected(correction) @ self._fuse.T
        near = corrected[..., 2] > _LEAST_DISPARITY_PX
        self._seen &= near
        first = self._seen.argmax(axis=0)
        columns = np.arange(len(self._ids))
        usable = self._seen.sum(axis=0) >= 2
        at_first = corrected[first, columns]
        at_first[~usable] = [self._rig.cx, self._rig.cy, self._rig.fx]
        local = triangulate(self._rig, at_first)
        points = np.empty_like(local)
        for k, wTc in enumerate(self._poses):
            points[first == k] = transform_to_world(wTc, local[first == k])
        state = _State(self._poses, points, correction)
        residual, depth, _ = self._residuals(state)
        wild = (np.abs(residual).max(axis=2) > _GROSS) & self._seen
        usable &= ~((depth < _NEAREST_M) & self._seen).any(axis=0) & ~wild.any(axis=0)
        if usable.sum() < len(correction):
            return None
        self._keep(usable)
        return _State(self._poses, points[usable], correction)

    def _keep(self, which: BoolArray) -> None:
        self._ids, self._seen = self._ids[which], self._seen[:, which]
        self._pixels = self._pixels[:, which]

    def _raw(self) -> FloatArray:
        return self._pixels.reshape(*self._seen.shape, 2 * self._rig.cameras)

    def _corrected(self, correction: FloatArray) -> FloatArray:
        """Corrected pixels (f, l, 2 * cameras)."""
        flat = self._pixels.reshape(-1, self._rig.cameras, 2)
        moved = displacements(self._rig, flat) @ correction
        return np.asarray(self._raw() - moved.reshape(self._raw().shape))

    def _local(self, state: _State) -> FloatArray:
        """Points (f, l, 3) in the frames' cameras; out of view ones somewhere ahead."""
        local = np.stack([transform_to_camera(wTc, state.points) for wTc in state.poses])
        return np.where(self._seen[..., None], local, [0.0, 0.0, 1.0])

    def _residuals(self, state: _State) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Predicted less raw pixels (f, l, 2 * cameras) in sigmas, depths, and displacements.

        These are taken at the prediction: a measured pixel's noise would correlate with them, and
        windows without end would agree on a wrong lens.
        """
        local = self._local(state)
        safe = np.where(local[..., 2:] > _NEAREST_M, local, [0.0, 0.0, 1.0])
        exact = project(self._rig, safe.reshape(-1, 3)) @ self._model.T
        unit = displacements(self._rig, exact.reshape(-1, self._rig.cameras, 2))
        unit = unit.reshape(*self._seen.shape, *unit.shape[1:])
        predicted = exact.reshape(self._raw().shape) + unit @ state.correction
        residual = (predicted - self._raw()) / self._sigma
        return residual * self._seen[..., None], local[..., 2], unit

    def _cost(self, state: _State, around: FloatArray, prior: FloatArray) -> float:
        residual, depth, _ = self._residuals(state)
        if (depth[self._seen] < _NEAREST_M).any():
            return np.inf
        off = state.correction - around
        squared = (residual**2).sum(axis=2) / _KERNEL_WIDTH**2
        return float(_KERNEL_WIDTH**2 * np.log1p(squared).sum() + off @ prior @ off)

    def _minimise(
        self, state: _State, around: FloatArray, prior: FloatArray
    ) -> tuple[_State, _Normal] | None:
        damping, best = 1e-6, self._cost(state, around, prior)
        for _ in range(_ITERATIONS):
            normal = self._linearise(state)
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
        return state, self._linearise(state)

    def _linearise(self, state: _State) -> _Normal:
        residual, _, unit = self._residuals(state)
        frames, landmarks = self._seen.shape
        squared = (residual**2).sum(axis=2)
        weight = self._seen / (1.0 + squared / _KERNEL_WIDTH**2)
        local = self._local(state).reshape(-1, 3)
        by_local = self._model @ projection_jacobian(self._rig, local) / self._sigma
        by_pose = (by_local @ point_pose_jacobian(local)).reshape(frames, landmarks, -1, 6)
        by_local = by_local.reshape(frames, landmarks, -1, 3)
        by_point = by_local @ np.swapaxes(state.poses[:, None, :3, :3], 2, 3)
        by_rig = unit / self._sigma
        weighted = weight[..., None] * residual
        joint = np.concatenate([by_pose, by_rig], axis=3)
        left = np.swapaxes(weight[..., None, None] * joint, 2, 3)
        blocks, crossing = left @ joint, left @ by_point
        gradient = np.einsum("flai,fla->fi", joint, weighted)
        point_left = np.swapaxes(weight[..., None, None] * by_point, 2, 3)
        curvature = (point_left @ by_point).sum(axis=0)
        curvature += 1e-9 * np.trace(curvature, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        point_gradient = np.einsum("flai,fla->li", by_point, weighted)
        hessian, gradient = _assembled(blocks.sum(axis=1), gradient)
        coupling = _coupling(crossing)
        inverse = np.linalg.inv(curvature)
        eliminated = np.einsum("nlj,ljk->nlk", coupling, inverse).reshape(len(gradient), -1)
        hessian -= eliminated @ coupling.reshape(len(gradient), -1).T
        gradient = gradient - eliminated @ point_gradient.ravel()
        return _Normal(hessian, gradient, inverse, coupling, point_gradient)

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
        pull = normal.point_gradient + np.einsum("nlj,n->lj", normal.coupling, step)
        points = state.points - np.einsum("lij,lj->li", normal.point_inverse, pull)
        moves = step[:-p].reshape(-1, 6)
        poses = np.stack(
            [state.poses[0]]
            + [moved_apart(T, xi) for T, xi in zip(state.poses[1:], moves, strict=True)]
        )
        return _State(poses, points, state.correction + step[-p:])


def _assembled(blocks: FloatArray, gradient: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Joint Hessian and gradient from those of the frames (f, 6 + p, 6 + p); the first is held."""
    frames, p = len(blocks), blocks.shape[1] - 6
    size = 6 * (frames - 1)
    hessian, out = np.zeros((size + p, size + p)), np.zeros(size + p)
    for k in range(1, frames):
        at = slice(6 * k - 6, 6 * k)
        hessian[at, at] = blocks[k, :6, :6]
        hessian[at, size:] = blocks[k, :6, 6:]
        hessian[size:, at] = blocks[k, 6:, :6]
        out[at] = gradient[k, :6]
    hessian[size:, size:] = blocks[:, 6:, 6:].sum(axis=0)
    out[size:] = gradient[:, 6:].sum(axis=0)
    return hessian, out


def _coupling(crossing: FloatArray) -> FloatArray:
    """Poses 1.. and correction against points (n, l, 3) from (f, l, 6 + p, 3)."""
    poses = np.moveaxis(crossing[1:, :, :6], 2, 1).reshape(-1, crossing.shape[1], 3)
    rig = np.moveaxis(crossing[:, :, 6:].sum(axis=0), 1, 0)
    return np.concatenate([poses, rig])
