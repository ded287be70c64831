"""A measurement is one residual: the interface of models, and what estimators make of one.

A user's model is ``predict`` over arrays, and perhaps ``start``. :func:`linearise` is what every
estimator calls; derivatives are numeric where a model gives none. Derived in
docs/derivations/measurements.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, TypeAlias

import gtsam
import numpy as np
import numpy.typing as npt

from fgslam.core.arrays import BoolArray, FloatArray, Rows
from fgslam.core.errors import MeasurementLogError
from fgslam.core.geometry import adjoint, inverse, se3_exp, skew, transform_to_camera, wrap
from fgslam.core.sensors import CameraRig, Measured
from fgslam.factors.graphs import nuisance_key

_STEP = 6e-6  # of a central difference: the third root of the rounding, where both errors are least


class MeasurementModel:
    """What a sensor measures: m numbers, of k moments at once.

    Attributes:
        kind: names it in logs, messages and tables.
        size: m.
        angles: which of the m are angles, whose differences are wrapped.
        bTs: (4, 4) the sensor on the robot's body.
    """

    kind: ClassVar[str]
    size: ClassVar[int]
    angles: ClassVar[tuple[int, ...]] = ()
    unpredicted: ClassVar[float] = 0.0  # residual of what cannot be predicted
    nuisance: FloatArray = np.empty((0, 0))

    def __init__(self, bTs: FloatArray | None = None) -> None:
        """``bTs`` left out: the sensor's frame is the body's."""
        self.bTs = np.eye(4) if bTs is None else np.asarray(bTs, np.float64)

    @property
    def has_factor(self) -> bool:
        """Whether :meth:`factor` gives one, which knows no nuisance parameters."""
        return type(self).factor is not MeasurementModel.factor and not self.nuisance.size

    def measured(
        self, values: npt.ArrayLike, covariance: npt.ArrayLike, ids: npt.ArrayLike = ()
    ) -> Measured:
        """What a frame measured.

        Args:
            values: (k, m), or the k m numbers in a row.
            covariance: (m, m) of each, or (k, m, m); a variance where m is 1.
            ids: (k,) identities of the landmarks; none for a model of poses.

        Raises:
            MeasurementLogError: the shapes do not fit, a number is not finite, or a covariance is
                not positive definite.
        """
        given, m = np.atleast_1d(np.asarray(values, np.float64)), self.size
        if given.ndim == 1 and given.size % m == 0:
            given = given.reshape(-1, m)
        k, noise = len(given), np.atleast_2d(np.asarray(covariance, np.float64))
        of_pose = isinstance(self, PoseModel)
        wanted, most = (0, 0) if of_pose else (k, 3)
        if len(self.nuisance) > most:
            raise MeasurementLogError(
                f"{self.kind}: {len(self.nuisance)} nuisance parameters; give at most {most}"
            )
        if given.shape != (k, m) or noise.shape not in ((m, m), (k, m, m)):
            raise MeasurementLogError(
                f"{self.kind}: values {given.shape} with covariance {noise.shape}; give (k, {m}) "
                f"and ({m}, {m}) or (k, {m}, {m})"
            )
        if len(np.unique(ids)) != wanted or np.size(ids) != wanted:
            raise MeasurementLogError(f"{self.kind}: give {wanted} different ids for {k} values")
        shape = np.shape(self.predict(np.eye(4)[None] if of_pose else np.ones((1, 3))))
        if shape != (1, m):
            raise MeasurementLogError(
                f"{self.kind}: predict() of k = 1 returned an array {shape}; return (k, {m})"
            )
        if not np.isfinite(given).all() or not (np.linalg.eigvalsh(noise) > 0.0).all():
            raise MeasurementLogError(
                f"{self.kind}: a value is not finite or a covariance not positive definite; leave "
                "out what was not measured"
            )
        which = np.asarray(ids, np.int64).reshape(-1)
        noise = np.broadcast_to(noise, (k, m, m)).copy()
        return Measured(self.kind, given, noise, which, self)

    def predict(self, x: FloatArray) -> FloatArray:
        """(k, m) expected; NaN in a row that cannot be predicted."""
        raise NotImplementedError

    def jacobian(self, x: FloatArray) -> FloatArray:
        """(k, m, d) derivatives of :meth:`predict`; by central differences, right to 1e-10."""
        raise NotImplementedError

    def start(
        self, z: FloatArray, covariance: FloatArray
    ) -> tuple[FloatArray, FloatArray | None] | None:
        """Where landmarks begin that are seen for the first time.

        Args:
            z: (k, m) measured.
            covariance: (k, m, m) of it.

        Returns:
            Points (k, 3) in the sensor's frame; and covariances (k, 3, 3) of what is known of them
            without this measurement, which then counts like any other, or None where it fixes
            them by itself (m is 3). None alone: they wait until several measurements fix a point.
        """
        return None

    def factor(self, keys: list[int], z: FloatArray, noise: Any, xTs: FloatArray) -> Any:
        """The same as a C++ factor of GTSAM; None where there is none.

        Args:
            keys: of the pose, and of the landmark where there is one.
            z: (m,) measured.
            noise: GTSAM's model of its noise.
            xTs: (4, 4) the sensor, in the frame of the pose variable.
        """
        return None


class LandmarkModel(MeasurementModel):
    """What is measured of landmarks: ``predict`` is given points (k, 3) in the sensor's frame.

    Attributes:
        nuisance: (q, q) covariance, about zero, of constants of the sensor that shift what it
            measures, at most 3: they are estimated along. (0, 0): none.
    """

    def shifts(self, z: FloatArray) -> FloatArray:
        """(k, m, q) by which a unit of each nuisance parameter shifts measurements (k, m)."""
        return np.zeros((*z.shape, len(self.nuisance)))

    def jacobian(self, x: FloatArray) -> FloatArray:
        """(k, m, 3) derivatives by the points; by central differences, right to 1e-10."""
        step = _STEP * np.maximum(1.0, np.abs(x).max(axis=1, initial=0.0))[:, None]
        ends = [(x + step * axis, x - step * axis) for axis in np.eye(3)]
        return np.stack([_change(self, *both) / (2.0 * step) for both in ends], axis=2)


class PoseModel(MeasurementModel):
    """What is measured of the robot alone: ``predict`` is given poses ``wTs`` (k, 4, 4)."""

    def jacobian(self, x: FloatArray) -> FloatArray:
        """(k, m, 6) derivatives by the poses' tangents; by central differences."""
        ends = [(x @ se3_exp(by), x @ se3_exp(-by)) for by in _STEP * np.eye(6)]
        return np.stack([_change(self, *both) / (2.0 * _STEP) for both in ends], axis=2)


def _change(model: MeasurementModel, ahead: FloatArray, behind: FloatArray) -> FloatArray:
    return difference(model, model.predict(ahead), model.predict(behind))


AnyModel: TypeAlias = MeasurementModel | CameraRig


def difference(model: AnyModel, a: FloatArray, b: FloatArray) -> FloatArray:
    """``a - b`` (k, m) of two measurements, angles wrapped."""
    out = a - b
    for column in model.angles:
        out[:, column] = wrap(out[:, column])
    return out


@dataclass(frozen=True, slots=True, eq=False)
class LinearRows(Rows):
    """Linearised measurements: ``residual + by_pose dx + by_point dl``.

    Attributes:
        residual: (k, m) predicted minus measured.
        by_pose: (k, m, 6) by the tangent of the pose.
        by_point: (k, m, 3) by the world point; of a pose alone (k, m, 0).
        usable: (k,) which can be predicted; the others pull at nothing.
    """

    residual: FloatArray
    by_pose: FloatArray
    by_point: FloatArray
    usable: BoolArray


def residuals(
    model: AnyModel,
    poses: FloatArray,
    points: FloatArray,
    measured: FloatArray,
    roots: FloatArray,
) -> FloatArray:
    """Whitened residuals (k, m), predicted minus measured; arguments of :func:`linearise`."""
    return products(roots, _off(model, in_cameras(poses, points), measured)[0])


def linearise(
    model: AnyModel,
    poses: FloatArray,
    points: FloatArray | None,
    measured: FloatArray,
    roots: FloatArray | None = None,
    xTs: FloatArray | None = None,
) -> LinearRows:
    """Measurements, predicted minus measured, with derivatives.

    Args:
        model: of the sensor.
        poses: (k, 4, 4) of each measurement; of landmarks also one (4, 4) for all.
        points: (k, 3) of its landmark, world; None for a model of poses.
        measured: (k, m).
        roots: (k, m, m) of :func:`whitening`; None leaves them as they are.
        xTs: (4, 4) the sensor in the frame of the poses; None where they are its own.
    """
    at = poses if xTs is None else poses @ xTs
    local = at if points is None else in_cameras(at, points)
    off, usable = _off(model, local, measured)
    safe = np.where(usable.reshape(-1, *[1] * (local.ndim - 1)), local, 1.0)
    jacobian = model.jacobian(safe)
    if roots is not None:
        jacobian, off = roots @ jacobian, products(roots, off)
    jacobian[~usable] = 0.0
    if points is None:
        by_pose, by_point = jacobian, np.empty((*off.shape, 0))
    else:
        by_pose = np.empty((*off.shape, 6))
        by_pose[:, :, :3], by_pose[:, :, 3:] = jacobian @ skew(local), -jacobian
        by_point = jacobian @ np.swapaxes(at[..., :3, :3], -1, -2)
    if xTs is not None:
        by_pose = by_pose @ adjoint(inverse(xTs))
    return LinearRows(off, by_pose, by_point, usable)


def _off(model: AnyModel, local: FloatArray, measured: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Residuals (k, m) at points or poses of the sensor, and which can be predicted (k,)."""
    with np.errstate(all="ignore"):
        off = difference(model, model.predict(local), measured)
    usable = np.asarray(np.isfinite(off).all(axis=1))
    off[~usable] = model.unpredicted
    return off, usable


def in_cameras(poses: FloatArray, points: FloatArray) -> FloatArray:
    """World points (k, 3) in the frames of poses ``wTc`` (k, 4, 4), one each, or of one (4, 4)."""
    if poses.ndim == 2:
        return transform_to_camera(poses, points)
    offset = points - poses[:, :3, 3]
    return np.asarray(np.einsum("kji,kj->ki", poses[:, :3, :3], offset))


def shifted(model: Any, z: FloatArray) -> FloatArray:
    """(k, m, 3) shifts by up to 3 nuisance parameters; (k, m, 0) of a model without any."""
    if not len(model.nuisance):
        return np.zeros((*z.shape, 0))
    more = 3 - len(model.nuisance)
    return np.asarray(np.pad(model.shifts(z), ((0, 0), (0, 0), (0, more))))


def nuisance_covariance(model: Any) -> FloatArray:
    """(3, 3) of the same parameters beforehand; else (0, 0)."""
    q = len(model.nuisance)
    out = np.eye(3 if q else 0)
    out[:q, :q] = model.nuisance
    return out


def whitening(covariances: FloatArray) -> FloatArray:
    """(k, m, m) that turn residuals of covariances (k, m, m) into ones of unit covariance."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariances)))


def products(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """(k, i) products of matrices (k, i, j) and vectors (k, j)."""
    return np.asarray(np.einsum("kij,kj->ki", matrices, vectors))


def nuisance_prior(model: MeasurementModel) -> Any:
    """GTSAM's factor of what is known beforehand of the nuisance parameters of a kind."""
    noise = gtsam.noiseModel.Gaussian.Covariance(nuisance_covariance(model))
    return gtsam.PriorFactorVector(nuisance_key(model.kind), np.zeros(3), noise)


def gtsam_factor(
    model: MeasurementModel, keys: list[int], z: FloatArray, noise: Any, xTs: FloatArray
) -> Any:
    """The model's C++ factor; where it has none, one that calls back, 30 to 400 us each.

    Arguments are those of :meth:`MeasurementModel.factor`; a third key is of nuisance parameters.
    """
    given = None if model.nuisance.size else model.factor(keys, z, noise, xTs)
    if given is not None:
        return given

    def error(_: Any, values: Any, jacobians: list[FloatArray] | None) -> FloatArray:
        poses = values.atPose3(keys[0]).matrix()[None]
        points = values.atPoint3(keys[1])[None] if keys[1:] else None
        rows = linearise(model, poses, points, z[None], xTs=xTs)
        derivatives, off = [rows.by_pose[0], rows.by_point[0]], rows.residual[0]
        for key in keys[2:]:
            derivatives.append(shifted(model, z[None])[0])
            off = off + derivatives[-1] @ values.atVector(key)
        if jacobians is not None:
            for place in range(len(keys)):
                jacobians[place] = derivatives[place]
        return np.asarray(off)

    return gtsam.CustomFactor(noise, keys, error)
