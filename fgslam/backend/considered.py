"""Consider covariance (Schmidt 1966): what is not estimated, in the covariances reported.

Errors that the newest pose and the landmarks have in common are columns, one column a cause: a term
of the rig's calibration, or one drawn sample of all noise. The columns of the newest pose (6, m)
are how far a unit of each cause moves its tangent vector, to first order; those of a landmark
(3, m) how far it moves its position. What a filter does to its estimates it does to each column;
covariances are products of columns, and so have the correlations that no filter of single
landmarks keeps. Estimates stay as they are.

Two estimators of errors keep such columns:

* :class:`ConsiderCovariance`, next to a filter that keeps all correlations and a smoother's
  tracker: the rig's terms alone, as derivatives; what they add to the covariances that are there.
* :class:`SampledErrors`, next to the filter of single landmarks: the rig's terms and samples of all
  noise, through the filter's own gains; they replace its covariances.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from fgslam.backend.loops import (
    CLOSURE_FACTOR,
    FREE,
    Chain,
    as_motions_of_the_world,
    starts_new_part,
)
from fgslam.backend.persistence import Persistence, learn_from
from fgslam.core.arrays import BoolArray, FloatArray, GrowingColumns, IntArray, Rows, StateArrays
from fgslam.core.correction import (
    EXPECTED_PX,
    FIELD_PX,
    SHARED,
    RigCorrection,
    displacements,
    field_displacements,
    field_modes,
    shared_displacements,
    shared_information,
)
from fgslam.core.geometry import (
    adjoint,
    congruence,
    in_front,
    inverse,
    point_pose_jacobian,
    se3_log,
    skew,
    transform_to_camera,
)
from fgslam.core.sensors import (
    CameraRig,
    Increment,
    LoopClosure,
    Observations,
    pixel_model,
    rig_map,
    vertical_to_horizontal,
)
from fgslam.core.store import Kept
from fgslam.core.types import LAGS, EgoMotion, EgoMotionStatus, Floor, LandmarkMap, Prediction
from fgslam.factors.measurement import LinearRows
from fgslam.frontend.tracking.ego_motion import EgoMotionSolver, PoseProblem


class ErrorColumns:
    """Columns (6, m) of the newest pose and (n, 3, m) of landmarks: what both estimators keep.

    Those of a landmark stay in one place while it is there: what comes and goes costs what it is,
    whatever the map.
    """

    _pose_columns: Kept[FloatArray]
    _order: Kept[GrowingColumns]
    _map: Kept[GrowingColumns]
    _free: Kept[IntArray]
    _recent: Kept[list[tuple[FloatArray, FloatArray]]]

    def __init__(self, count: int, kind: type = np.float64, **more: FloatArray) -> None:
        """All zero, the map empty.

        Args:
            count: of columns.
            kind: of number in which those of landmarks are kept.
            more: what else is kept by landmark, arrays (0, ...).
        """
        self._held = False
        self._pose_columns = np.zeros((6, count))
        self._recent = []  # poses and their columns, the newest last
        self._order = GrowingColumns(ids=np.empty(0, np.int64), row=np.empty(0, np.int64))
        """Identities, ascending, and the rows that are theirs in the map; free ones have none."""
        self._map = GrowingColumns(columns=np.empty((0, 3, count), kind), **more)
        self._free = np.empty(0, np.int64)

    def hold_map(self) -> None:
        """The map is a saved one that nothing changes: it is as well known as it was then."""
        self._held = True

    def forget(self, ids: IntArray) -> None:
        """Drops landmarks; those that are unknown are passed over."""
        places, known = self._places(ids)
        if known.any():
            gone = np.zeros(len(self._order), np.bool_)
            gone[places[known]] = True
            self._free = np.concatenate([self._free, self._order["row"][gone]])
            self._order.drop(gone)

    def columns_of_motions(self, wTc: FloatArray) -> dict[int, FloatArray]:
        """Columns (6, m) of the motions over LAGS frames to the newest pose.

        That is kept for those of later frames.
        """
        self._recent = [*self._recent, (wTc, self._pose_columns)][-max(LAGS) - 1 :]
        known = [lag for lag in LAGS if lag < len(self._recent)]
        return {lag: self._since(wTc, *self._recent[-lag - 1]) for lag in known}

    def _since(self, wTc: FloatArray, earlier: FloatArray, columns: FloatArray) -> FloatArray:
        return self._pose_columns - adjoint(inverse(wTc) @ earlier) @ columns

    # ----------------------------------------------------------------------------------------

    def append(self, values: StateArrays) -> None:
        """Landmarks (k,) that are not there yet; their identities ascend."""
        ids = values["ids"]
        if not len(ids):
            return
        again = min(len(ids), len(self._free))
        begun = len(self._map)
        rows = np.concatenate([self._free[:again], np.arange(begun, begun + len(ids) - again)])
        self._free = self._free[again:]
        of_map = {name: values[name] for name in self._map.packed()}
        self._map.append({name: array[again:] for name, array in of_map.items()})
        for name, array in of_map.items():
            self._map[name][rows[:again]] = array[:again]
        before = len(self._order)
        self._order.append({"ids": ids, "row": rows})
        self._order.keep_ascending("ids", before)

    def _places(self, ids: IntArray) -> tuple[IntArray, BoolArray]:
        """(k,) places of landmarks in the order, and which of them are there."""
        have = self._order["ids"]
        if not len(have):
            return np.zeros(len(ids), np.int64), np.zeros(len(ids), np.bool_)
        places = np.minimum(np.searchsorted(have, ids), len(have) - 1)
        return places, np.asarray(have[places] == ids)

    def rows(self, ids: IntArray) -> tuple[IntArray, BoolArray]:
        """(k,) rows of landmarks in the map, and which of them are there."""
        places, known = self._places(ids)
        return (self._order["row"][places] if known.any() else places), known

    def _of_map(self, ids: IntArray) -> FloatArray:
        """(k, 3, m) columns of landmarks, as far as they are reported."""
        if self._held:
            return np.zeros((len(ids), *self._map["columns"].shape[1:]))
        return self.kept("columns", ids)

    def kept(self, name: str, ids: IntArray) -> FloatArray:
        """(k, ...) what is kept of landmarks under a name; zero of unknown ones."""
        rows, known = self.rows(ids)
        kept = self._map[name]
        out = np.zeros((len(ids), *kept.shape[1:]))
        out[known] = kept[rows[known]]
        return out


# --------------------------------------------------------------------------------------------
# The rig's terms, next to a filter that keeps all correlations, and a smoother's tracker.
#
# The Schmidt-Kalman filter's cross terms (Schmidt 1966), as derivatives: how the newest pose and
# each landmark follow the terms that all cameras share, and the field that no term follows,
# neither of which is estimated. A frame costs what it sees. Final covariances of a whole graph
# have the same from the graph (:mod:`fgslam.backend.smoothers.final`).
# docs/derivations/measurements.md.


_LEAST_MATCHES = 6  # of a frame; with fewer, its pose follows the one before
_LEAST_DISPARITY_PX = 0.5  # farther points are known no better than their noise
_LEAST_INFORMATION = 1e-9  # of the mean, in directions that the matches leave open
_NONE = np.zeros((6, 6))
_INSTANT_S = 1e-6  # between frames, at least


class RigTerms:
    """The terms in SHARED of a rig that calibrates itself, then the modes of its field: unknown.

    Of a rig that is taken as stated TERMS are, too; of one that is exact none. The last one is the
    read-out of a rig whose rows are not of one moment.
    """

    deviations: Kept[FloatArray | None]
    _path: Kept[list[tuple[float, FloatArray]]]  # stamps and poses, the last two, to tell rates
    _applied: Kept[FloatArray]
    _field_px: Kept[float]

    def __init__(self, sensor: CameraRig) -> None:
        """Those of a rig that is not exact."""
        self.rig = None if sensor.exact else sensor
        self._late, self._path = sensor.readout_s > 0.0, []
        self.count = len(SHARED) + (0 if self.rig is None else field_modes(self.rig)) + self._late
        """How many there are, q."""
        self.deviations = None
        """(q, q) lower root of their covariance; None: they are known."""
        self._applied = np.empty(0)
        self._field_px = 0.0
        if sensor.stated and self.rig is not None:
            stated = RigCorrection.none(self.rig)
            self.count += len(stated.values)
            self._hear(stated.values, FIELD_PX)

    @property
    def covariance(self) -> FloatArray | None:
        """(q, q) of the terms; None: they are known."""
        return None if self.deviations is None else self.deviations @ self.deviations.T

    def update(self, increment: Increment, wTc: FloatArray) -> bool:
        """Takes in a frame's pose, the correction in its measurements, and the field's size.

        False where rows are not of one moment, and it is not known yet how the camera moves.
        """
        known = increment.settled_rig
        self._hear(increment.rig_correction, 0.0 if known is None else known.field_px)
        if not self._late:
            return True
        self._path = [*self._path[-1:], (increment.timestamp, wTc)]
        return len(self._path) > 1

    def shifts(self, measured: FloatArray, by_pose: FloatArray) -> FloatArray:
        """(k, 3, q) by which a unit of each displaces measurements (k, 3); zero where known.

        ``by_pose`` (k, 3, 6) is their derivative by the frame's pose.
        """
        if self.rig is None or self.deviations is None:
            return np.zeros((len(measured), 3, self.count))
        pixels = pixels_of(self.rig, measured)
        of_pixels = [shared_displacements(self.rig, pixels), field_displacements(self.rig, pixels)]
        if self.rig.stated:
            of_pixels.append(displacements(self.rig, pixels))
        of_terms = fused(self.rig, np.concatenate(of_pixels, axis=2))
        if not self._late:
            return of_terms
        rates = rates_of(*map(np.array, zip(*self._path, strict=True)))[-1:]
        return np.concatenate([of_terms, read_late(self.rig, measured, by_pose, rates)], axis=2)

    def _hear(self, correction: FloatArray | None, field_px: float) -> None:
        """Both change seldom."""
        if self.rig is None or correction is None:
            return
        if np.array_equal(correction, self._applied) and field_px == self._field_px:
            return
        self._applied, self._field_px = correction, field_px
        none = RigCorrection.none(self.rig)
        shared = shared_covariance(dataclasses.replace(none, values=correction))
        self.deviations = field_px * np.eye(self.count)
        self.deviations[: len(SHARED), : len(SHARED)] = np.linalg.cholesky(shared)
        if self.rig.stated:
            own = slice(-len(correction), None)
            self.deviations[own, own] = np.linalg.cholesky(none.covariance)
        if self._late:
            self.deviations[-1, -1] = self.rig.readout_s


class ConsiderCovariance(ErrorColumns):
    """Derivatives of the newest pose and of the landmarks by what is unknown of the rig.

    Of a rig that is exact nothing is added.
    """

    _terms: Kept[RigTerms]
    _wTc: Kept[FloatArray | None]
    _waiting: Kept[list[tuple[Increment, FloatArray]]]

    def __init__(self, sensor: CameraRig, floor: Floor) -> None:
        """The first pose is known, the map empty.

        Args:
            sensor: that measures.
            floor: a hard one leaves the pose these directions alone.
        """
        # By landmark: derivative in world axes, information given the poses.
        self._terms = RigTerms(sensor)
        super().__init__(self._terms.count, information=np.empty((0, 3, 3)))
        self._floor = floor
        self._wTc, self._waiting = None, []

    @property
    def present(self) -> bool:
        """Whether any term is unknown."""
        return self._terms.deviations is not None

    def observe(self, increment: Increment, wTc: FloatArray) -> None:
        """Takes in a frame: its accepted measurements and its pose as estimated."""
        self._waiting.append((increment, wTc))
        if self._terms.update(increment, wTc):
            while self._waiting:  # a first frame's rows tell of a motion that the next one shows
                self._take_in(*self._waiting.pop(0))

    def _take_in(self, increment: Increment, wTc: FloatArray) -> None:
        rig = self._terms.rig
        if rig is None or not self.present:
            return
        if self._wTc is not None:
            self._pose_columns = adjoint(inverse(inverse(self._wTc) @ wTc)) @ self._pose_columns
        kept = increment.observations.select(~increment.rejected)
        near = kept.measurement[:, 2] > _LEAST_DISPARITY_PX
        seen = _Linearised.of(rig, self._terms, kept.select(near), wTc)
        rows, known = self.rows(seen.ids)
        if self._wTc is not None and known.sum() >= _LEAST_MATCHES:
            basis = self._floor.basis(wTc) if self._floor.rigid_dof < 6 else np.eye(6)
            self._pose_columns = seen.select(known).pose_columns(*self._at(rows[known]), basis)
        self._update(seen.select(known), rows[known])
        self._add(seen.select(~known))
        self.forget(increment.pruned_ids)
        self._wTc = wTc

    def of_pose(self) -> FloatArray:
        """(6, 6) what the terms add to the newest pose's covariance; zero where they are known."""
        if self._terms.deviations is None:
            return _NONE  # one for all frames: a smoother keeps that of each
        root = self._pose_columns @ self._terms.deviations
        return np.asarray(root @ root.T)

    def motions(self, wTc: FloatArray) -> dict[int, FloatArray]:
        """(6, 6) what they add to the covariances of the motions over LAGS frames to it."""
        covariance = self._terms.covariance
        if covariance is None:
            return {}
        motions = self.columns_of_motions(wTc).items()
        return {lag: congruence(columns, covariance) for lag, columns in motions}

    def pose(self, newest: Prediction) -> Prediction:
        """The newest pose with what the terms add to its covariance."""
        if not self.present:
            return newest
        return Prediction(newest.wTc, newest.covariance + self.of_pose())

    def landmarks(self, known: LandmarkMap) -> LandmarkMap:
        """Landmarks with what the terms add to their covariances."""
        covariance = self._terms.covariance
        if covariance is None or self._held:
            return known
        columns = self.kept("columns", known.ids)
        more = columns @ covariance @ np.swapaxes(columns, 1, 2)
        return dataclasses.replace(known, covariances=known.covariances + more)

    # ----------------------------------------------------------------------------------------

    def _at(self, rows: IntArray) -> tuple[FloatArray, FloatArray]:
        return self._map["columns"][rows], self._map["information"][rows]

    def _update(self, seen: _Linearised, rows: IntArray) -> None:
        columns, information = self._at(rows)
        pull, added = seen.landmark_information()
        information = information + added
        off = seen.left(self._pose_columns) - seen.by_point @ columns
        self._map["columns"][rows] = columns + np.linalg.solve(information, pull @ off)
        self._map["information"][rows] = information

    def _add(self, seen: _Linearised) -> None:
        """Landmarks where their first measurement has them; identities ascend."""
        if len(seen.ids):
            columns = np.linalg.solve(seen.by_point, seen.left(self._pose_columns))
            information = seen.landmark_information()[1]
            self.append({"ids": seen.ids, "columns": columns, "information": information})


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class ObservedColumns(Rows):
    """Measurements (k) of landmarks in a frame, linearised at the landmarks: error columns."""

    by_pose: FloatArray
    by_point: FloatArray
    shift: FloatArray

    def off(self, points: FloatArray) -> FloatArray:
        """(k, 3, m) how far they are from where landmarks with errors (k, 3, m) have them."""
        return np.asarray(self.shift - self.by_point @ points)

    def placed(self, pose: FloatArray) -> FloatArray:
        """(k, 3, m) where a camera with errors (6, m) has the points."""
        off = self.shift - (self.by_pose.reshape(-1, 6) @ pose).reshape(self.shift.shape)
        return np.asarray(np.linalg.inv(self.by_point) @ off)

    def following(self, by_measurement: FloatArray, points: FloatArray) -> FloatArray:
        """(6, m) of a pose with this derivative (k, 6, 3) by the measurements."""
        off = self.off(points)
        gain = np.swapaxes(by_measurement, 0, 1).reshape(6, -1)
        return np.asarray(gain @ off.reshape(gain.shape[1], off.shape[2]))


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class _Linearised(ObservedColumns):
    """Measurements (k) of a frame, linearised where they have their points."""

    ids: IntArray
    covariance: FloatArray

    @staticmethod
    def of(rig: CameraRig, terms: RigTerms, seen: Observations, wTc: FloatArray) -> _Linearised:
        points = rig.triangulate(seen.measurement)
        projection = rig.jacobian(points)
        by_pose = np.concatenate([projection @ skew(points), -projection], axis=2)
        by_point = projection @ wTc[:3, :3].T
        shift = terms.shifts(seen.measurement, by_pose)
        return _Linearised(by_pose, by_point, shift, seen.ids, seen.covariance)

    def left(self, pose_columns: FloatArray) -> FloatArray:
        """(k, 3, q) what of the measurements' shifts the pose does not follow."""
        return np.asarray(self.shift - self.by_pose @ pose_columns)

    def landmark_information(self) -> tuple[FloatArray, FloatArray]:
        """What residuals pull landmarks by (k, 3, 3), and their information (k, 3, 3)."""
        pull = np.swapaxes(self.by_point, 1, 2) @ np.linalg.inv(self.covariance)
        return pull, pull @ self.by_point

    def pose_columns(
        self, columns: FloatArray, information: FloatArray, basis: FloatArray
    ) -> FloatArray:
        """(6, q) derivative of the pose that fits landmarks of these derivatives best.

        ``basis`` (6, d) spans the directions that the pose has.
        """
        turned = np.swapaxes(self.by_point, 1, 2)
        expected = self.covariance + self.by_point @ np.linalg.solve(information, turned)
        by_pose = self.by_pose @ basis
        pull = np.swapaxes(by_pose, 1, 2) @ np.linalg.inv(expected)
        normal, freedom = (pull @ by_pose).sum(axis=0), basis.shape[1]
        normal += _LEAST_INFORMATION * np.trace(normal) / freedom * np.eye(freedom)
        off = self.shift - self.by_point @ columns
        return np.asarray(basis @ np.linalg.solve(normal, (pull @ off).sum(axis=0)))


def pixels_of(rig: CameraRig, measured: FloatArray) -> FloatArray:
    """(k, cameras, 2) where a point of these measurements (k, 3) is seen."""
    model = pixel_model(rig.cameras, vertical_to_horizontal(rig))
    return np.asarray((measured @ model.T).reshape(-1, rig.cameras, 2))


def fused(rig: CameraRig, of_pixels: FloatArray) -> FloatArray:
    """(k, 3, n) of measurements, by displacements of their pixels (k, 2 * cameras, n)."""
    return np.asarray(rig_map(rig) @ of_pixels)


def rates_of(stamps: FloatArray, poses: FloatArray) -> FloatArray:
    """(n, 6) tangent vectors a second at poses, from the one before to the one after; 0 of one."""
    at = np.arange(len(poses))
    first, then = np.maximum(at - 1, 0), np.minimum(at + 1, len(at) - 1)
    seconds = np.maximum(stamps[then] - stamps[first], _INSTANT_S)
    return np.array(list(map(se3_log, inverse(poses[first]) @ poses[then]))) / seconds[:, None]


def read_late(
    rig: CameraRig, measured: FloatArray, by_pose: FloatArray, rates: FloatArray
) -> FloatArray:
    """(k, 3, 1) by which a second from the first row to the last displaces measurements (k, 3).

    By their derivatives (k, 3, 6), and the poses' rates (k, 6) or (1, 6). The middle row is of the
    pose's moment.
    """
    late = measured[:, 1, None, None] / rig.height - 0.5
    return np.asarray(late * (by_pose @ rates[:, :, None]))


def shared_covariance(correction: RigCorrection) -> FloatArray:
    """(q, q) covariance of what nothing estimates; (0, 0) of an exact rig."""
    if correction.rig.exact:
        return np.empty((0, 0))
    # EXPECTED_PX is of one coordinate between two images: as much of a pixel in each of them.
    off_px = max(EXPECTED_PX, correction.rms_px() / np.sqrt(2.0))
    return np.asarray(np.linalg.inv(shared_information(correction.rig, off_px)))


# --------------------------------------------------------------------------------------------
# All noise, next to a filter of single landmarks: samples of it through the filter's own gains.
#
# The filter drops the correlations of landmarks and pose, so what it calculates is not the
# covariance of its errors. That follows the same gains with the true noise (sensitivity of
# suboptimal filters, Gelb 1974, 7.2): exactly, it takes a joint matrix whose size and cost grow
# with the square of the map. Here a fixed number of drawn samples stands for it, as in the
# ensemble of Evensen (1994): a landmark costs as much whatever the map. The terms of the rig's
# calibration go the same way, one column each. The noise is drawn as large as the drive's
# residuals so far have it, as a smoother weighs it. docs/derivations/filters.md.


SAMPLES = 48
"""A variance from them is known to the root of 2 / SAMPLES, a deviation to 10 %."""
_STREAM = 17  # of random numbers, next to those of the recording
_FARTHEST_M = 1e9  # beyond, a point has no derivative; and nothing to tell
_FLAT, _PADDING = 1e-20, 1e-9  # of the variances' sum: far below any landmark's, above rounding
_LEAST_PLACING = 6  # that place a frame by an old part of the drive
_PLACE = 24  # landmarks of it that do so where fewer match: of some frames


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """What a closure has done to landmarks (n).

    Attributes:
        rotations: (n, 3, 3) by which it turned them.
        homes: (n,) frame with which each moves; -1 for one that stays.
        shares: (frames, 6, 6) of the whole correction, as a motion of the world, by frame.
    """

    rotations: FloatArray
    homes: IntArray
    shares: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class TrackedStep:
    """How a frame's pose was found.

    Attributes:
        frame: its number.
        increment: its measurements.
        tracking: its pose.
        before: the last frame's pose; of the first one the prior pose, exactly.
        prediction: from there; worth nothing where the least squares searched everywhere.
    """

    frame: int
    increment: Increment
    tracking: EgoMotion
    before: Prediction
    prediction: Prediction

    @property
    def measured(self) -> bool:
        """Whether the pose is that of the least squares."""
        status = self.tracking.status
        return status.measured and status is not EgoMotionStatus.CAPPED

    def added(self) -> tuple[FloatArray, FloatArray]:
        """What takes an error of the last pose (6, 6) to this one or its prediction, and the noise.

        The latter is the covariance (6, 6) that the step adds.
        """
        carried = adjoint(inverse(inverse(self.before.wTc) @ self.tracking.wTc))
        known = not (self.measured or starts_new_part(self.increment, self.tracking))
        pose = self.tracking if known else self.prediction
        return carried, pose.covariance - congruence(carried, self.before.covariance)


class SampledErrors(ErrorColumns):
    """Columns by what is unknown of the rig, then by SAMPLES draws of all noise."""

    _terms: Kept[RigTerms]
    _noise: Kept[Persistence]
    _marked: Kept[tuple[FloatArray, FloatArray] | None]

    def __init__(self, solver: EgoMotionSolver, off: bool = False) -> None:
        """The first pose is known, the map empty.

        Args:
            solver: that finds each frame's pose.
            off: nothing is sampled, and what is reported is what the filter has.
        """
        # Single precision: a sample stands for a deviation that is known to a tenth.
        self._terms = RigTerms(solver.sensor)
        self._count = self._terms.count  # of columns before the draws
        super().__init__(0 if off else self._count + SAMPLES, np.float32)
        self._off = off
        self._solver = solver
        self._sensor = solver.sensor
        self._noise = Persistence(solver.sensor)
        self._random = np.random.default_rng(_STREAM)
        self._marked = None  # pose and columns, since which errors are asked for
        self._taken = 1.0  # variance over the stated one that the newest pose took
        self._seen: tuple[IntArray, ObservedColumns, FloatArray] | None = None
        """Matches of the newest frame: rows of their landmarks, and the columns of these before."""

    # -- what the filter does, done to the columns ---------------------------------------------

    def track(self, step: TrackedStep, used: Observations, landmarks: LandmarkMap) -> None:
        """From the last pose to a frame's, by the matches (k) that it is of, before these move."""
        if self._off:
            return
        self._random = np.random.default_rng((_STREAM, step.frame))
        self._terms.update(step.increment, step.tracking.wTc)
        learn_from(self._noise, step.frame, step.increment, step.tracking, step.before.wTc)
        self._taken = step.tracking.noise
        wTc, problem = step.tracking.wTc, PoseProblem.of(landmarks, used)
        carried, noise = step.added()
        moved = carried @ self._pose_columns
        moved[:, self._count :] += symmetric_root(noise) @ self._signs(1, 6)[0]
        columns = self.linearised(wTc, problem)
        self._enter(used.ids, columns, problem.point_covariances, moved)
        rows, _ = self.rows(used.ids)
        self._seen = rows, columns, self._map["columns"][rows].astype(np.float64)
        self._pose_columns = self._on_floor(wTc, moved)
        if step.measured:
            by_prediction, by_measurement = self._solver.gain(
                wTc, step.prediction, problem, self._taken
            )
            self._pose_columns = by_prediction @ moved + columns.following(
                by_measurement, self._seen[2]
            )

    def filter(self, share: FloatArray) -> None:
        """Matched landmarks move to where the frame has them by the share (k, 3, 3) of the way."""
        if self._seen is not None:
            rows, columns, before = self._seen
            self._map["columns"][rows] = before + share @ (
                columns.placed(self._pose_columns) - before
            )

    def correct(
        self, gain: FloatArray, rows: LinearRows, ids: IntArray, noise: FloatArray
    ) -> FloatArray:
        """The pose corrected by another sensor's measurements (k, m), of known landmarks or none.

        Args:
            gain: (6, km).
            rows: the measurements, linearised.
            ids: (k,) the landmarks; none of a pose.
            noise: (k, m, m) of the measurements.

        Returns:
            (k, m, c) samples of their errors.
        """
        drawn = np.zeros((*rows.residual.shape, self._pose_columns.shape[1]))
        if not self._off:
            drawn[..., self._count :] = self._drawn(noise)
            off = rows.by_pose @ self._pose_columns - drawn
            off += rows.by_point @ self._beside(ids, rows) if len(ids) else 0.0
            self._pose_columns = self._pose_columns - gain @ off.reshape(gain.shape[1], -1)
        return drawn

    def pull(self, gain: FloatArray, rows: LinearRows, ids: IntArray, drawn: FloatArray) -> None:
        """The landmarks of the same measurements follow them, by gains (k, 3, m)."""
        if not self._off:
            columns = self._beside(ids, rows)
            off = rows.by_pose @ self._pose_columns + rows.by_point @ columns - drawn
            at, known = self.rows(ids)
            moved = (columns - gain @ off).reshape(len(ids), 3, -1)
            self._map["columns"][at[known]] = moved[known]

    def _beside(self, ids: IntArray, rows: LinearRows) -> FloatArray:
        """(k, d, c) columns of the d numbers that each measurement is of."""
        columns = self._of_map(ids)
        return columns.reshape(-1, rows.by_point.shape[2], columns.shape[2])

    def begin(self, ids: IntArray, by_pose: FloatArray, covariances: FloatArray) -> None:
        """New landmarks (k,): world points by the pose (k, 3, 6), and their own errors."""
        if not self._off:
            columns = by_pose @ self._pose_columns
            columns[..., self._count :] += self._drawn(covariances)
            self.append({"ids": ids, "columns": columns})

    def add(self, ids: IntArray, placed: PoseProblem, wTc: FloatArray) -> None:
        """New landmarks, where the frame at ``wTc`` has them."""
        if not self._off:
            points = transform_to_camera(wTc, placed.points)
            near = in_front(points) & (np.abs(points).max(axis=1) < _FARTHEST_M)
            columns = np.zeros((len(ids), 3, self._count + SAMPLES))
            columns[near] = self.linearised(wTc, placed.select(near)).placed(self._pose_columns)
            self.append({"ids": ids, "columns": columns})

    def close(
        self, loop: LoopClosure, landmarks: LandmarkMap, wTc: FloatArray, moved: Moved
    ) -> None:
        """A closure has moved the drive; what it made of motions to frames before is not known.

        Args:
            loop: the closure.
            landmarks: the map, moved.
            wTc: the newest pose, moved.
            moved: the landmarks' share in it.
        """
        if self._off:
            return
        self._recent = []
        rows, known = self.rows(landmarks.ids)
        self._map["columns"][rows[known]] = (
            moved.rotations[known] @ self._map["columns"][rows[known]]
        )
        apart = adjoint(wTc) @ (
            self._pose_columns - self._returned(loop, landmarks, wTc, moved.homes)
        )
        self._pose_columns = self._on_floor(
            wTc, self._pose_columns - adjoint(inverse(wTc)) @ moved.shares[-1] @ apart
        )
        homes = np.where(known, moved.homes, -1)
        order = np.argsort(homes, kind="stable")[np.count_nonzero(homes < 0) :]
        ends = np.flatnonzero(np.diff(homes[order], append=-1)) + 1
        for of_home in np.split(order, ends[:-1]) if len(order) else ():
            motion = moved.shares[homes[of_home[0]]] @ apart
            points = skew(landmarks.positions[of_home])
            self._map["columns"][rows[of_home]] -= motion[3:] - points @ motion[:3]

    # -- what is reported ----------------------------------------------------------------------

    def pose(self, newest: Prediction) -> Prediction:
        """The newest pose with the covariance of its errors."""
        if self._off:
            return newest
        return Prediction(
            newest.wTc, self._covariances(self._pose_columns, self._solver.floor.rigid_dof)
        )

    def motions(self, wTc: FloatArray) -> FloatArray:
        """(l, 6, 6) covariances of the motions over LAGS frames to the newest pose; or NaN."""
        known = {} if self._off else self.columns_of_motions(wTc)
        none, freedom = np.full((6, 6), np.nan), self._solver.floor.rigid_dof
        return np.array(
            [self._covariances(known[lag], freedom) if lag in known else none for lag in LAGS]
        )

    def mark(self, wTc: FloatArray) -> None:
        """The newest pose is given from elsewhere: :meth:`since_marked` is of what comes after."""
        self._marked, self._recent = (wTc, self._pose_columns), []

    def since_marked(self, wTc: FloatArray) -> FloatArray | None:
        """(6, 6) of the motion since the marked pose, or the first one; None if it is not known."""
        if self._off:
            return None
        off = self._since(wTc, *self._marked) if self._marked else self._pose_columns
        return self._covariances(off, self._solver.floor.rigid_dof)

    def landmarks(self, known: LandmarkMap) -> LandmarkMap:
        """Landmarks with the covariances of their errors; those without keep what they have."""
        columns = self._of_map(known.ids)
        have = np.any(columns, axis=(1, 2))
        if self._held or not have.any():
            return known
        covariances = known.covariances.copy()
        covariances[have] = self._covariances(columns[have], 3)
        return dataclasses.replace(known, covariances=covariances)

    # ----------------------------------------------------------------------------------------

    def linearised(self, wTc: FloatArray, seen: PoseProblem) -> ObservedColumns:
        """Matches of a frame at ``wTc``, with the columns of the measurements' errors."""
        points = transform_to_camera(wTc, seen.points)
        projection = self._sensor.jacobian(points)
        shift = np.zeros((len(seen), 3, self._count + SAMPLES))
        by_pose = projection @ point_pose_jacobian(points)
        shift[:, :, : self._count] = self._terms.shifts(seen.measurement, by_pose)
        shift[:, :, self._count :] = self._drawn(self._noise.power * seen.measurement_covariance)
        return ObservedColumns(by_pose, projection @ wTc[:3, :3].T, shift)

    def _signs(self, k: int, d: int) -> FloatArray:
        """(k, d, SAMPLES) random signs.

        Of all that has variance one, they leave least error in a covariance (Hutchinson 1990).
        """
        bits = np.frombuffer(self._random.bytes(k * d * SAMPLES // 8), np.uint8)
        return np.asarray(2.0 * np.unpackbits(bits).reshape(k, d, SAMPLES) - 1.0)

    def _drawn(self, covariances: FloatArray) -> FloatArray:
        """Samples (k, m, SAMPLES) of these covariances (k, m, m)."""
        k, m = covariances.shape[:2]
        definite = covariances + lacking(covariances) if m == 3 else covariances
        return np.asarray(np.linalg.cholesky(definite) @ self._signs(k, m))

    def _enter(
        self, ids: IntArray, columns: ObservedColumns, covariances: FloatArray, pose: FloatArray
    ) -> None:
        """Landmarks of a saved map seen for the first time: independent, as the filter has them.

        Their map was made with the same rig: its terms have them where the pose does.
        """
        new = ~self.rows(ids)[1]
        if new.any():
            placed = columns.select(new).placed(pose)
            placed[:, :, self._count :] = self._drawn(covariances[new])
            self.append({"ids": ids[new], "columns": placed})

    def _returned(
        self, loop: LoopClosure, landmarks: LandmarkMap, wTc: FloatArray, homes: IntArray
    ) -> FloatArray:
        """Errors (6, m) of the newest pose, at ``wTc``, by the landmarks of an old place."""
        seen = loop.observations
        seen = seen.select(self.rows(seen.ids)[1] & np.isin(seen.ids, landmarks.ids))
        problem = PoseProblem.of(landmarks, seen)
        ahead = in_front(transform_to_camera(wTc, problem.points))
        if ahead.sum() < _LEAST_PLACING:
            errors = adjoint(inverse(wTc)) @ self._of_place(loop.frame, landmarks, homes)
            errors[:, self._count :] += symmetric_root(loop.covariance) @ self._signs(1, 6)[0]
            return errors
        problem = problem.select(ahead)
        columns = self.linearised(wTc, problem)
        by_measurement = self._solver.gain(wTc, Prediction(wTc, FREE), problem, self._taken)[1]
        return columns.following(by_measurement, self.kept("columns", seen.ids[ahead]))

    def _of_place(self, frame: int, landmarks: LandmarkMap, homes: IntArray) -> FloatArray:
        """Errors (6, m) of a frame's place as a motion of the world, by landmarks first seen there.

        Weighted least squares over those whose first frames are nearest; zero where there are none.
        """
        have = np.flatnonzero(self.rows(landmarks.ids)[1] & (homes >= 0))
        nearest = have[np.argsort(np.abs(homes[have] - frame), kind="stable")][:_PLACE]
        near = landmarks.select(np.sort(nearest))
        by_motion = np.concatenate(
            [-skew(near.positions), np.tile(np.eye(3), (len(near), 1, 1))], axis=2
        )
        weights = np.asarray(np.linalg.inv(near.covariances + lacking(near.covariances)))
        turned = np.swapaxes(by_motion, 1, 2) @ weights
        information = (turned @ by_motion).sum(axis=0)
        pull = (turned @ self.kept("columns", near.ids)).sum(axis=0)
        return np.asarray(np.linalg.pinv(information, hermitian=True) @ pull)

    def _on_floor(self, wTc: FloatArray, columns: FloatArray) -> FloatArray:
        basis = self._solver.floor.basis(wTc)
        return np.asarray(basis @ (basis.T @ columns))

    def _covariances(self, columns: FloatArray, freedom: int) -> FloatArray:
        """Covariances (..., d, d) of errors (..., d, m) with so many degrees of freedom."""
        weighed = self._weighed(columns, freedom)
        return np.asarray(weighed @ np.swapaxes(weighed, -1, -2))

    def _weighed(self, columns: FloatArray, freedom: int) -> FloatArray:
        """Roots (..., d, m) of those covariances.

        The inverse of a covariance of N samples is N / (N - d - 1) times too large in the mean
        (inverse Wishart): by so much the covariance is stated larger.
        """
        terms, drawn = columns[..., : self._count], columns[..., self._count :]
        drawn = np.asarray(drawn / np.sqrt(SAMPLES - freedom - 1.0))
        if self._terms.deviations is None:
            return drawn
        return np.concatenate([terms @ self._terms.deviations, drawn], axis=-1)


def lacking(covariances: FloatArray) -> FloatArray:
    """(k, 3, 3) what makes covariances definite: zero but where a direction has no variance.

    Saved maps may have such landmarks.
    """
    trace = np.trace(covariances, axis1=1, axis2=2)
    flat = np.linalg.det(covariances) <= _FLAT * trace**3
    return np.asarray(np.where(flat, _PADDING * trace, 0.0)[:, None, None] * np.eye(3))


def symmetric_root(covariance: FloatArray) -> FloatArray:
    """(6, 6) symmetric root of a covariance of any rank: it follows rounding as little."""
    variances, directions = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray((directions * np.sqrt(np.maximum(variances, 0.0))) @ directions.T)


def shares(chain: Chain, closed: LoopClosure) -> FloatArray:
    """(n, 6, 6) of a closure to the last frame that each pose takes, as motions of the world.

    Its earlier end and what is before stay; steps in between share as they are uncertain.
    """
    poses = np.array(chain.poses)
    since = np.cumsum(as_motions_of_the_world(poses, np.array(chain.steps)), axis=0)
    since = since - since[closed.frame]
    since[: closed.frame] = 0.0
    closure = congruence(adjoint(poses[-1]), CLOSURE_FACTOR**2 * closed.covariance)
    return np.asarray(since @ np.linalg.inv(since[-1] + closure))
