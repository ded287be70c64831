"""Homing as one bearing-only factor graph, solved with every image.

Start, target and every image on the way are planar poses, landmarks points. The start's and the
target's bearings enter once, with the landmark; scale is the leg from start to target. Here is what
each image adds, with first guesses; :mod:`fgslam.backend.homing.schur` and
:mod:`fgslam.backend.homing.gtsam` solve it. Derivation: docs/derivations/homing_estimators.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import repeat
from typing import Any, ClassVar

import numpy as np

from fgslam.backend.homing.gtsam import BatchSolver, Isam2Solver
from fgslam.backend.homing.parts import (
    FORWARD,
    SIDEWAYS,
    TARGET,
    TURNING,
    BearingSeen,
    NewPart,
    Pair,
    Solver,
    TrackedFeatures,
)
from fgslam.backend.homing.schur import SchurSolver
from fgslam.backend.settings import HomingGraphSettings
from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.bearings import HomingEstimate, HomingStart, TrackedBearings, among
from fgslam.core.geometry import GaussNewton, Linearised, compose, unit, wrap
from fgslam.factors.bearing import bearing, bearing_jacobians, polar_points, triangulated

_PRIOR_DISTANCES = 2.0  # deviation of the weak prior on a landmark's place, in initial distances
_MOST_RELATIVE_SIGMA = 0.3  # of its distance: a feature enters once it is known better than this
_GATE_SIGMAS = 4.0  # on the misfit of a bearing
_COLLAPSED = 0.1  # of the first distance from the start: gates let no error of ninety percent in
_CONFIRMED, _SAME_SIGMAS = 3, 1.0  # agreements in a row before a waiting feature enters
_JUMPED = 4  # misses in a row after which a track follows something else
_WIDER = 10.0  # deviations of the initialisation's answer where its elevations enter themselves
_SEEN_SIGMAS = 3.0  # of the target's bearing against the place where a feature is to enter
_LEAST_SIGMA = 1e-3  # radians: of the initialisation's direction and rotation, stated smaller
_WIDTH = 2.0  # of Cauchy's kernel, in deviations
_SEARCH = GaussNewton(iterations=8, converged=1e-6)  # legs and radians


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """The robot as last estimated: number and time of the image, pose (3,), velocity (3,).

    ``variances`` answers those of the pose, (3,); it is asked only where a feature waits to enter.
    """

    image: int
    time: float
    pose: FloatArray
    velocity: FloatArray
    variances: Callable[[], FloatArray]


class HomingProblem:
    """Turns a homing start and images into parts of the graph."""

    def __init__(self, start: HomingStart) -> None:
        """Nothing is in the graph yet; see :meth:`first`."""
        self._start = start
        self._ids = start.local_map.ids
        self._entered = np.zeros(len(self._ids), np.bool_)
        self._guesses = np.full((len(self._ids), 2), np.nan)
        self._sighted = np.full((len(self._ids), 2), np.nan)  # distance and deviation, when waiting
        self._agreed = np.zeros(len(self._ids), np.int64)
        self._missed = np.zeros(len(self._ids), np.int64)

    @property
    def entered(self) -> IntArray:
        """Identities of the features that are variables, ascending."""
        return self._ids[self._entered]

    def variables(self, ids: IntArray) -> IntArray:
        """Numbers of the landmark variables of identities (k,)."""
        return np.asarray(np.searchsorted(self._ids, ids))

    def collapsed(self, points: FloatArray) -> dict[int, FloatArray]:
        """Landmarks that fell upon the start, with their first guesses (2,) by row.

        A long step may carry a landmark with few good bearings across the start, where any
        bearing is as good as another; from there it does not come back, and its derivatives grow
        beyond all bounds.

        Args:
            points: (n, 2) the present landmarks of :attr:`entered`.
        """
        rows = np.flatnonzero(self._entered)
        guesses = self._guesses[rows]
        nearer = np.hypot(*points.T) / np.hypot(*guesses.T)
        fell = np.flatnonzero(~(nearer > _COLLAPSED))
        return {int(rows[k]): guesses[k] for k in fell}

    def first(self) -> NewPart:
        """Start, target and the features that both views triangulate well."""
        start, vector = self._start, self._start.vector
        covariance = 0.5 * _WIDER**2 * (vector.covariance + vector.covariance.T)
        covariance = covariance + _LEAST_SIGMA**2 * np.eye(2)
        target = np.append(unit(np.array(vector.direction)), vector.rotation)
        beginning = target, vector, covariance
        new = NewPart(0, np.zeros(3), np.zeros(3), (start.time, start.time), beginning)
        chart = start.local_map
        spread = np.sqrt(chart.covariance[:, 0, 0])
        good = _is_good(chart.distance, spread)
        for row in np.flatnonzero(good).tolist():
            self._enter(new, row, chart.points()[row], float(chart.distance[row]))
        return new

    def image(
        self, tracked: TrackedBearings, taken: BoolArray, before: Motion, points: FloatArray
    ) -> NewPart:
        """The robot's next pose with what it sees.

        Args:
            tracked: the image.
            taken: (m,) its rows that count.
            before: the robot at the last image.
            points: (n, 2) the present landmarks of :attr:`entered`.
        """
        image = before.image + 1
        rows = np.searchsorted(self._ids, tracked.ids)
        pose, fits = self._resected(tracked, taken & self._entered[rows], before, points)
        new = NewPart(image, pose, before.velocity, (before.time, tracked.time))
        entering = self._enter_seen(new, rows, tracked, taken & ~self._entered[rows], before)
        which = fits | entering
        seen = (rows, tracked.bearing, tracked.sigma_bearing)
        new.bearings += map(
            BearingSeen, repeat(image), *(values[which].tolist() for values in seen)
        )
        return new

    def _resected(
        self, tracked: TrackedBearings, seen: BoolArray, before: Motion, points: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """First guess (3,) of the pose, and which bearings (m,) of those ``seen`` fit to it."""
        step = tracked.time - before.time
        predicted = compose(before.pose, _travelled(before.velocity, step))
        rows = np.searchsorted(self.entered, tracked.ids[seen])
        bearings, sigma = tracked.bearing[seen], tracked.sigma_bearing[seen]
        spread = _drift(step)
        pose = resected(predicted, spread**-2.0, points[rows], bearings, sigma)
        misses = np.abs(bearing(pose, points[rows], bearings)) > _GATE_SIGMAS * sigma
        if np.count_nonzero(misses) > 0.5 * len(misses):
            return pose, seen
        numbers = np.searchsorted(self._ids, tracked.ids[seen])
        self._missed[numbers] = np.where(
            misses | (self._missed[numbers] >= _JUMPED), self._missed[numbers] + 1, 0
        )
        fits = seen.copy()
        fits[seen] = ~misses & (self._missed[numbers] == 0)
        return pose, fits

    # ----------------------------------------------------------------------------------------
    # Landmarks

    def _enter(self, new: NewPart, row: int, point: FloatArray, distance: float) -> None:
        """A landmark with its bearings, and its elevations if any, from start and target."""
        matches, vector = self._start.matches, self._start.vector
        new.points[row] = (point, _PRIOR_DISTANCES * distance)
        from_start, _, from_target, _ = matches.sigma[row].tolist()
        new.bearings += [
            BearingSeen(0, row, float(matches.bearing_a[row]), from_start),
            BearingSeen(TARGET, row, float(matches.bearing_b[row]), from_target),
        ]
        elevations = np.array([matches.elevation_a[row], matches.elevation_b[row]])
        if np.isfinite(elevations).all():
            first = np.array([*unit(np.array(vector.direction)), vector.rotation, *point])
            new.pairs.append(Pair(row, elevations, matches.sigma[row, [1, 3]], first))
        self._entered[row], self._guesses[row] = True, point

    def _enter_seen(
        self,
        new: NewPart,
        rows: IntArray,
        tracked: TrackedBearings,
        candidates: BoolArray,
        before: Motion,
    ) -> BoolArray:
        """Features that were too uncertain until now and have parallax to the last pose.

        Judged with the bearing of this image from where the robot is expected. Answers which
        (m,) of the candidates entered.
        """
        waiting = np.flatnonzero(candidates)
        entering = np.zeros(len(candidates), np.bool_)
        reach = math.hypot(*before.pose[:2])
        if len(waiting) == 0 or reach == 0.0:
            return entering
        pose = compose(before.pose, _travelled(before.velocity, tracked.time - before.time))
        matches = self._start.matches
        rows, seen = rows[waiting], tracked.bearing[waiting]
        start = matches.bearing_a[rows]
        legs, by = triangulated((math.atan2(pose[1], pose[0]), float(pose[2])), start, seen)
        length = math.hypot(*pose[:2])
        x, y, turn = before.variances().tolist()
        variance = np.empty_like(by)
        variance[:, 0], variance[:, 1] = (x + y) / reach**2, turn
        variance[:, 2] = matches.sigma[rows, 0] ** 2
        variance[:, 3] = tracked.sigma_bearing[waiting] ** 2
        spread = np.sqrt((by**2 * variance).sum(axis=1))
        self._compare(rows, length * legs, length * spread)
        confirmed = _is_good(legs, spread) & (self._agreed[rows] >= _CONFIRMED)
        confirmed &= self._seen_by_target(rows, length * legs, length * spread)
        for k in np.flatnonzero(confirmed).tolist():
            distance = float(length * legs[k])
            self._enter(new, int(rows[k]), distance * unit(start[k]), distance)
            entering[waiting[k]] = True
        return entering

    def _seen_by_target(
        self, rows: IntArray, distance: FloatArray, spread: FloatArray
    ) -> BoolArray:
        """Whether the target saw them where they would be, as far as both are known.

        A track that jumped while its feature waited triangulates something else.
        """
        vector, matches = self._start.vector, self._start.matches
        target = np.append(unit(np.array(vector.direction)), vector.rotation)
        polar = np.column_stack([distance, matches.bearing_a[rows]])
        points = polar_points(polar)
        miss = bearing(target, points, matches.bearing_b[rows])
        by_pose, by_point = bearing_jacobians(target, points)
        along = np.einsum("ij,ij->i", by_point, unit(polar[:, 1])) * spread
        turned = np.column_stack([by_pose[:, :2] @ [-target[1], target[0]], by_pose[:, 2]])
        variance = np.einsum("ni,ij,nj->n", turned, vector.covariance, turned)
        variance = variance + along**2 + matches.sigma[rows, 2] ** 2 + matches.sigma[rows, 0] ** 2
        return np.asarray(miss**2 <= _SEEN_SIGMAS**2 * variance)

    def _compare(self, rows: IntArray, distance: FloatArray, spread: FloatArray) -> None:
        """Counts how often in a row a waiting feature was seen at one distance, within its noise.

        A single wrong bearing makes a large parallax, and would pass for a good triangulation.
        """
        last = self._sighted[rows]
        with np.errstate(invalid="ignore"):
            same = np.abs(distance - last[:, 0]) <= _SAME_SIGMAS * np.hypot(spread, last[:, 1])
        self._agreed[rows] = np.where(same, self._agreed[rows] + 1, 0)
        self._sighted[rows] = np.column_stack([distance, spread])


def _is_good(distance: FloatArray, spread: FloatArray) -> BoolArray:
    """Which distances (n,) are known well enough for a landmark to enter."""
    with np.errstate(invalid="ignore"):
        known = (distance > 0.0) & (spread <= _MOST_RELATIVE_SIGMA * distance)
    return np.asarray(known & np.isfinite(distance) & np.isfinite(spread))


def _drift(step: float) -> FloatArray:
    """(3,) how far the robot may be from where it is expected: place in legs, heading."""
    place = max(FORWARD, SIDEWAYS) * step**0.5
    return np.array([place, place, TURNING * step**0.5])


def _travelled(velocity: FloatArray, step: float) -> FloatArray:
    """Motion (3,) of a constant velocity (3,) in the robot's axes over ``step`` seconds."""
    forward, left, turn = (velocity * step).tolist()
    half = 0.5 * turn
    chord = math.sin(half) / half if half else 1.0
    c, s = math.cos(half) * chord, math.sin(half) * chord
    return np.array([c * forward - s * left, s * forward + c * left, float(wrap(np.array(turn)))])


def resected(
    predicted: FloatArray,
    information: FloatArray,
    points: FloatArray,
    measured: FloatArray,
    sigma: FloatArray,
) -> FloatArray:
    """Pose (3,) that fits the bearings best, and the prediction as far as that is known.

    Iteratively reweighted Gauss-Newton with Cauchy's kernel.

    Args:
        predicted: (3,) expected pose.
        information: (3,) inverse variances of it, positive.
        points: (n, 2) landmarks.
        measured: (n,) bearings.
        sigma: (n,) their deviations.
    """

    def linearised(poses: FloatArray, iteration: int) -> Linearised:
        pose = poses[0]
        dx, dy = x - pose[0], y - pose[1]
        squared = sigma * (dx * dx + dy * dy)
        residual = wrap(np.arctan2(dy, dx) - (measured + pose[2])) / sigma
        by_pose[0], by_pose[1] = dy / squared, -dx / squared
        weighted = by_pose / (1.0 + (residual / _WIDTH) ** 2)
        normal = weighted @ by_pose.T + known
        gradient = weighted @ residual + information * (pose - predicted)
        return normal[None], gradient[None]

    (x, y), known = points.T, np.diag(information)
    by_pose = np.empty((3, len(points)))
    by_pose[2] = -1.0 / sigma

    return np.asarray(_SEARCH.minimise(predicted[None], linearised)[0])


_SOLVERS: dict[str, Callable[[], Solver]] = {
    "schur": SchurSolver,
    "isam2": Isam2Solver,
    "batch": BatchSolver,
}


class HomingGraph:
    """Estimator of kind ``homing_graph``.

    On :class:`fgslam.backend.homing.parts.HomingEstimator`. Lost features simply get no more
    factors; what they taught stays.
    """

    kind: ClassVar[str] = "homing_graph"

    def __init__(self, start: HomingStart, settings: HomingGraphSettings) -> None:
        """Solves start and target alone.

        Raises:
            EstimatorError: they cannot be solved.
        """
        self._features = TrackedFeatures(start)
        self._problem = HomingProblem(start)
        self.solver: Solver = _SOLVERS[settings.solver]()
        self._image = 0
        self._covariance: FloatArray | None = None
        self.solver.add(self._problem.first())

    def update(self, tracked: TrackedBearings) -> None:
        """Takes in one image; see the protocol."""
        before = self._motion()
        _, taken = self._features.take(tracked)
        points = self.solver.points(self._entered())
        new = self._problem.image(tracked, taken, before, points)
        self._covariance = None
        self._image += 1
        self.solver.add(new)
        collapsed = self._problem.collapsed(self.solver.points(self._entered()))
        if collapsed:
            self.solver.move(collapsed)

    def estimate(self, landmarks: bool = True) -> HomingEstimate:
        """The present state; see the protocol."""
        ids, rows = self._alive()
        covariance = self._joint(rows if landmarks else [])
        return HomingEstimate(
            time=self._features.time,
            robot=self.solver.pose(self._image),
            target=self.solver.target(),
            covariance=covariance[:6, :6],
            ids=ids,
            landmarks=self.solver.points(rows),
            landmark_covariances=_blocks(covariance[6:, 6:], len(ids)),
        )

    def _alive(self) -> tuple[Any, list[int]]:
        """Identities of landmarks that are tracked still, and their variables' numbers."""
        ids = self._features.alive
        ids = ids[among(ids, self._problem.entered)]
        return ids, self._problem.variables(ids).tolist()

    def _entered(self) -> list[int]:
        numbers: list[int] = self._problem.variables(self._problem.entered).tolist()
        return numbers

    def _joint(self, rows: list[int]) -> FloatArray:
        """Covariance of robot, target and landmarks."""
        size = 6 + 2 * len(rows)
        if self._covariance is None or len(self._covariance) < size:
            self._covariance = self.solver.covariance(rows)
        return self._covariance[:size, :size]

    def _motion(self) -> Motion:
        pose, velocity = self.solver.pose(self._image), self.solver.velocity(self._image)
        return Motion(self._image, self._features.time, pose, velocity, self._variances)

    def _variances(self) -> FloatArray:
        """Of the robot's (x, y, psi) at the last image that the solver knows."""
        return np.asarray(np.diagonal(self._joint([]))[:3])


def _blocks(covariance: FloatArray, count: int) -> FloatArray:
    """(count, 2, 2) diagonal blocks; NaN where there is no covariance."""
    if len(covariance) < 2 * count:
        return np.full((count, 2, 2), np.nan)
    every = np.arange(count)
    return np.asarray(covariance.reshape(count, 2, count, 2)[every, :, every, :])
