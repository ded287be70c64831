"""What estimators share of measurements by other sensors than the camera, whatever their model.

A landmark begins at its first measurement where the model knows a start; else it waits until
several fix a point. What is known beforehand is a measurement, too, of the point relative to the
sensor (:class:`RelativePoint`): so filters and graphs hold the same information.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from fgslam.backend.loops import nearest_positive
from fgslam.core.arrays import FloatArray, IntArray, chi_square_quantile
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import (
    GaussNewton,
    adjoint,
    block_diagonal,
    congruence,
    inverse,
    transform_to_camera,
    transform_to_world,
)
from fgslam.core.sensors import CameraRig, Measured
from fgslam.core.store import Kept
from fgslam.core.types import Prediction
from fgslam.factors.measurement import (
    LandmarkModel,
    LinearRows,
    linearise,
    products,
    shifted,
)

_FIT = GaussNewton(iterations=20, converged=1e-6, longest=20.0, damping=1e-6)
_FROM_M = (2.0, 8.0, 32.0)  # distances from which a point is looked for
_FROM = 16  # directions
LOOKED_FOR = (4, 6, 9, 13, 19, 28, 42, 60)
"""Numbers of measurements of a landmark at which it is looked for; after the last, half stay."""
_KNOWN = 8.0  # range over deviation from which a point is normally distributed, as of cameras' ones
_SETTLED = 0.01  # squared deviations that a further step would go: a minimum, not where it ended
_RIVAL = float(chi_square_quantile(0.999, 3))


class RelativePoint(LandmarkModel):
    """Where a landmark is in the sensor's frame: what a weak prior states."""

    kind, size = "relative_point", 3

    def predict(self, x: FloatArray) -> FloatArray:
        """(k, 3)."""
        return x.copy()

    def start(self, z: FloatArray, covariance: FloatArray) -> tuple[FloatArray, None]:
        """Where it is measured."""
        return z, None


def sensor_in_pose(rig: CameraRig, model: Any) -> FloatArray:
    """(4, 4) a model's sensor in the frame of the estimated pose, which is the camera's."""
    return np.asarray(inverse(rig.bTc) @ model.bTs)


def linearised(
    rig: CameraRig,
    one: Measured,
    wTc: FloatArray,
    points: FloatArray | None = None,
    nuisance: FloatArray | None = None,
) -> LinearRows:
    """A frame's measurements at a pose ``wTc`` (4, 4), of points (k, 3) where they are of any.

    With nuisance parameters (3,) ``by_point`` is (k, m, 6), theirs behind the point.
    """
    poses = np.broadcast_to(wTc, (len(one), 4, 4))
    rows = linearise(one.model, poses, points, one.values, xTs=sensor_in_pose(rig, one.model))
    if nuisance is None:
        return rows
    by = shifted(one.model, one.values)
    both = np.concatenate([rows.by_point, by], axis=2)
    return replace(rows, residual=rows.residual + by @ nuisance, by_point=both)


def nuisance_words(kind: str, values: FloatArray, variances: FloatArray) -> str:
    """What nuisance parameters (3,) were found to be; those that there are not stay zero."""
    each = zip(values.tolist(), np.sqrt(variances).tolist(), strict=True)
    found = ", ".join(f"{value:.4g} (deviation {sigma:.2g})" for value, sigma in each if value)
    return f"nuisance parameters of {kind}: {found}"


def require_model(one: Measured, index: int) -> None:
    """Raises EstimatorError where the model of a frame's measurements is not known."""
    if one.model is None:
        raise EstimatorError(
            f"frame {index}: measurements of kind {one.kind!r} without their model; read the log "
            "with MeasurementLog.load(path, models=[...])"
        )


def prior_of(one: Measured) -> list[Measured]:
    """What is known beforehand of landmarks that are measured for the first time: none or one."""
    start = one.model.start(one.values, one.covariance) if len(one) else None
    if start is None or start[1] is None:
        return []
    return [RelativePoint(one.model.bTs).measured(start[0], start[1], one.ids)]


class Begun(NamedTuple):
    """Landmarks that begin in a frame.

    Attributes:
        ids: (k,).
        points: (k, 3) in the frame of the pose.
        covariances: (k, 3, 3) of what is known of them.
        later: their measurements, which that does not contain yet.
    """

    ids: IntArray
    points: FloatArray
    covariances: FloatArray
    later: Measured


@dataclass(frozen=True, slots=True, eq=False)
class Single:
    """One measurement of a landmark without a place, by a sensor at ``wTs``.

    ``drift`` (6, 6) is the covariance of that pose, as a motion of the world.
    """

    kind: str
    wTs: FloatArray
    drift: FloatArray
    value: FloatArray
    noise: FloatArray


class Waiting:
    """Measurements of landmarks that have no place yet."""

    _singles: Kept[dict[int, list[Single]]]

    def __init__(self) -> None:
        """None yet."""
        self._singles = {}
        """By the landmarks' identities."""
        self._models: dict[str, Known] = {}

    def begin(
        self,
        rig: CameraRig,
        one: Measured,
        pose: Prediction,
        held: IntArray,
        nuisance: tuple[FloatArray, FloatArray] | None = None,
    ) -> Begun:
        """Landmarks of a frame's measurements, of none that is ``held``, that now have a place.

        ``nuisance``: parameters (3,) of the sensor and their covariance (3, 3), if it has any.
        """
        new, xTs = one.select(~np.isin(one.ids, held)), sensor_in_pose(rig, one.model)
        new = new.select(np.argsort(new.ids))
        parameters, spread = nuisance or (np.empty(0), np.empty((0, 0)))
        self._models[one.kind] = one.model, parameters, spread
        by = shifted(one.model, new.values)
        noise = new.covariance + congruence(by, spread)
        start = one.model.start(new.values - by @ parameters, noise)
        if start is None:
            return self._fixed(new, pose, xTs)
        points, known = start
        for identity in new.ids.tolist():
            self._singles.pop(identity, None)
        later = new.select(np.full(len(new), known is not None))
        if known is None:
            known = congruence(np.linalg.inv(one.model.jacobian(points)), noise)
        turned = congruence(xTs[:3, :3], known)
        return Begun(new.ids, transform_to_world(xTs, points), turned, later)

    def _fixed(self, new: Measured, pose: Prediction, xTs: FloatArray) -> Begun:
        """Those that all their measurements so far fix."""
        wTs, drift = pose.wTc @ xTs, congruence(adjoint(pose.wTc), pose.covariance)
        each = zip(new.ids.tolist(), new.values, new.covariance, strict=True)
        found = {
            identity: self._found(identity, Single(new.kind, wTs, drift, *measured))
            for identity, *measured in each
        }
        places = {identity: place for identity, place in found.items() if place is not None}
        for identity in places:
            del self._singles[identity]
        points = np.array([point for point, _ in places.values()]).reshape(-1, 3)
        known = np.array([covariance for _, covariance in places.values()]).reshape(-1, 3, 3)
        turned = congruence(pose.wTc[:3, :3].T, known)
        ids = np.array(list(places), np.int64)
        return Begun(ids, transform_to_camera(pose.wTc, points), turned, new.select(ids[:0]))

    def _found(self, identity: int, new: Single) -> tuple[FloatArray, FloatArray] | None:
        """The world point that a landmark's measurements fix, with one more; its covariance."""
        own = [*self._singles.get(identity, []), new]
        self._singles[identity] = own if len(own) < LOOKED_FOR[-1] else own[::2]
        known = all(single.kind in self._models for single in own)
        return fixed_point(own, self._models) if len(own) in LOOKED_FOR and known else None


_COLUMNS = ("wTs", "value", "noise")
Known: TypeAlias = tuple[Any, FloatArray, FloatArray]
"""A model, its nuisance parameters (3,) or (0,), and their covariance."""


def fixed_point(
    singles: list[Single], models: dict[str, Known]
) -> tuple[FloatArray, FloatArray] | None:
    """The world point (3,) that fits, given the last pose, and its covariance (3, 3).

    None where it is open, no minimum was reached, or another one fits as well. Damped Gauss-Newton
    from starts in all directions, on the models' own residuals, together with how far nuisance
    parameters are off; noise contains the drift since each.
    """
    groups, known = [], np.zeros((3, 3))
    for kind in {single.kind: None for single in singles}:
        own = [single for single in singles if single.kind == kind]
        drifts = np.array([nearest_positive(singles[-1].drift - one.drift) for one in own])
        wTs, values, noise = (np.array([getattr(one, name) for one in own]) for name in _COLUMNS)
        model, parameters, spread = models[kind]
        at, by = slice(len(known), len(known) + len(spread)), shifted(model, values)
        drifts = congruence(adjoint(inverse(wTs)), drifts)
        groups.append((model, parameters, at, len(own), wTs, values, noise, drifts, by))
        known = block_diagonal(known, np.asarray(np.linalg.inv(spread))[None])

    def linear(unknown: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        n, d = unknown.shape
        hessian, gradient = np.tile(known, (n, 1, 1)), unknown @ known
        cost = np.einsum("ni,ni->n", gradient, unknown)
        for model, parameters, own, k, *columns in groups:
            wTs, values, noise, drift, shifts = (np.concatenate([c] * n) for c in columns)
            at = np.repeat(unknown, k, axis=0)
            rows = linearise(model, wTs, at[:, :3], values)
            by = np.zeros((*values.shape, d))
            by[:, :, :3], by[:, :, own] = rows.by_point, shifts
            weight = np.linalg.inv(noise + congruence(rows.by_pose, drift))
            off = rows.residual + products(shifts, at[:, own] + parameters)
            turned = np.swapaxes((weight @ by).reshape(n, -1, d), 1, 2)
            hessian += turned @ by.reshape(n, -1, d)
            gradient += products(turned, off.reshape(n, -1))
            squared = np.einsum("ki,kij,kj->k", off, weight, off)
            cost += np.where(rows.usable, squared, np.inf).reshape(n, k).sum(axis=1)
        return hessian, gradient, cost

    here = singles[-1].wTs[:3, 3]
    starts = np.zeros((len(_FROM_M) * _FROM, len(known)))
    starts[:, :3] = (np.array(_FROM_M)[:, None, None] * _directions()).reshape(-1, 3) + here
    with np.errstate(all="ignore"):
        found = _FIT.minimise(starts, lambda at, _: linear(at)[:2])
        hessian, gradient, cost = linear(found)
    cost[~np.isfinite(cost)] = np.inf
    best, points = int(np.argmin(cost)), found[:, :3]
    if not np.isfinite(cost[best]):
        return None
    whole, slope = hessian[best], gradient[best]
    own = whole[:3, :3] - whole[:3, 3:] @ np.linalg.solve(whole[3:, 3:], whole[3:, :3])
    information = np.linalg.eigvalsh(own)[0]
    distance = float(np.linalg.norm(points[best] - here))
    if information * distance**2 < _KNOWN**2:  # singular, too: of a robot that stands
        return None
    if not slope @ np.linalg.solve(whole, slope) < _SETTLED:
        return None
    apart = np.linalg.norm(points - points[best], axis=1) ** 2
    rivals = (cost < cost[best] + _RIVAL) & (apart * information > _RIVAL)
    return None if rivals.any() else (points[best], np.linalg.inv(own))


def _directions() -> FloatArray:
    """(n, 3) unit vectors, evenly spread (Fibonacci's spiral)."""
    k = np.arange(_FROM) + 0.5
    up, turn = 1.0 - 2.0 * k / _FROM, np.pi * (1.0 + np.sqrt(5.0)) * k
    across = np.sqrt(1.0 - up**2)
    return np.column_stack([across * np.cos(turn), across * np.sin(turn), up])
