"""The whole homing solved again with every image, in plain arrays: exact, and the fastest.

Gauss-Newton with reweighting from the last solution; steps that raise the cost are damped. Every
few images the match that everything else contradicts most is put to the test.
Derivation: docs/derivations/homing_estimators.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import lapack

from fgslam.backend.homing.parts import (
    FIRST_SPEEDS,
    KERNEL,
    KERNEL_WIDTH,
    MOTION_DENSITIES,
    BearingSeen,
    NewPart,
    Pair,
)
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.geometry import Damping, wrap, wrapped_pose
from fgslam.factors.bearing import (
    STIFF,
    ChainMotion,
    bearings_from_views,
    direction_and_turn,
    elevation_pair,
    motion_informations,
    offsets,
)
from fgslam.factors.noise import kernel_losses, kernel_weights

STATE = 6  # numbers of an image: pose and velocity
_ROWS, _COLUMNS = np.indices((STATE, STATE))
_LOWER = np.tril_indices(STATE)
_LEAST_DAMPING = 1e-3  # an image later the start is another, and covariances want none
STILL = 0.3  # deviations, of all variables together: a shorter step ends the iteration
_EVERY = 4  # images: re-weighing costs half as much as an update
STEPS = 1
"""Gauss-Newton steps with an image, at most: what is left after one is gone with the next image."""

MATCH_LIMIT = 13.8
"""What the target saw of a landmark is dropped where everything else contradicts it by more than
this squared Mahalanobis distance: one in a thousand of right matches, by chi-square of two degrees
of freedom."""

_FIRST_STEPS = 20  # with start and target alone, whose first guess is the initialisation's


class Factored:
    """Normal equations factored once: the step to the minimum, and covariances.

    A is factored as a band, then the Schur complement C - B' A^-1 B. Everything is relinearised
    each time, and one covariance costs a few columns.

    Raises:
        numpy.linalg.LinAlgError: they do not determine every variable.
    """

    def __init__(self, equations: NormalEquations, damping: float = 0.0) -> None:
        """``damping`` adds so many times the diagonal to itself (Marquardt)."""
        e = equations
        count, m = len(e.diagonal), len(e.border)
        self._size = m
        band, info = lapack.dpbtrf(_band(e, damping), lower=1, overwrite_ab=1)
        if info != 0:
            raise LinAlgError("the chain of images is not determined")
        right = np.zeros((STATE * count, m + 4), order="F")
        right[:, :m] = e.cross.reshape(-1, m)
        right[:, m] = e.chain_gradient.ravel()
        last = np.arange(3)
        right[STATE * (count - 1) + last, m + 1 + last] = 1.0
        solved, _ = lapack.dtbtrs(band, right, uplo="L", overwrite_b=1)
        crossed, gradient, self._end = np.split(solved, [m, m + 1], axis=1)
        reduced = e.border - crossed.T @ crossed
        if damping > 0.0:
            reduced[np.diag_indices(m)] += damping * np.diagonal(e.border)
        self._reduced, info = lapack.dpotrf(reduced, lower=1, clean=0, overwrite_a=1)
        if info != 0:
            raise LinAlgError("target and landmarks are not determined")
        self.border = -self._solved(e.border_gradient - crossed.T @ gradient[:, 0])
        left = gradient[:, 0] + crossed @ self.border
        chain, _ = lapack.dtbtrs(band, left[:, None], uplo="L", trans="T")
        self.chain = -chain.reshape(count, STATE)
        fall = e.chain_gradient.ravel() @ chain[:, 0] - e.border_gradient @ self.border
        self.decrement = float(np.sqrt(max(fall, 0.0)))
        """Length of the step in its own deviations."""
        self._carried = self._end.T @ crossed

    def _solved(self, right: FloatArray) -> FloatArray:
        """The reduced border's solutions for (m,) or (m, k)."""
        return np.asarray(lapack.dpotrs(self._reduced, right, lower=1)[0])

    def border_covariance(self) -> FloatArray:
        """(m, m) of target and landmarks."""
        return self._solved(np.eye(self._size))

    def covariance(self, columns: IntArray) -> FloatArray:
        """Joint covariance (3 + k) of the last image's pose and numbers (k,) of the border."""
        k = len(columns)
        chosen = np.zeros((self._size, k + 3))
        chosen[columns, np.arange(k)] = 1.0
        chosen[:, k:] = self._carried.T
        solved = self._solved(chosen)
        out = np.empty((3 + k, 3 + k))
        out[:3, :3] = self._end.T @ self._end + self._carried @ solved[:, k:]
        out[3:, :3] = -solved[columns, k:]
        out[:3, 3:] = out[3:, :3].T
        out[3:, 3:] = solved[columns, :k]
        return np.asarray(0.5 * (out + out.T))


def _band(e: NormalEquations, damping: float) -> FloatArray:
    """(12, 6 n) lower band of the chain, column by column, as LAPACK wants it."""
    count = len(e.diagonal)
    band = np.zeros((2 * STATE, count * STATE), order="F")
    blocks = band.T.reshape(count, STATE, 2 * STATE)
    i, j = _LOWER
    blocks[:, j, i - j] = e.diagonal[:, i, j]
    blocks[:-1, _COLUMNS, STATE + _ROWS - _COLUMNS] = e.below
    if damping > 0.0:
        band[0] *= 1.0 + damping
    return band


class SchurSolver:
    """On :class:`fgslam.backend.homing.parts.Solver`."""

    def __init__(self) -> None:
        """Empty."""
        self.model = SchurModel()
        self.state = State(np.empty((0, 6)), np.zeros(3), np.empty((0, 2)))
        self._factored: Factored | None = None

    def add(self, new: NewPart) -> None:
        """See :class:`Solver`."""
        self.state = self.model.take(new, self.state)
        look = self._go_on(_FIRST_STEPS if new.image == 0 else STEPS)
        if not np.isfinite(look.cost):
            raise EstimatorError(
                "the homing graph cannot be solved (its cost is no number); start the homing again"
            )
        if new.image % _EVERY == 0:
            self._weigh_down(look)

    def move(self, points: dict[int, FloatArray]) -> None:
        """See :class:`Solver`."""
        places = self.state.points.copy()
        for row, point in points.items():
            places[self.model.landmarks[row]] = point
        self.state = State(self.state.chain, self.state.target, places)
        self._factored = None

    def pose(self, image: int) -> FloatArray:
        """See :class:`Solver`."""
        return wrapped_pose(self.state.chain[image, :3])

    def velocity(self, image: int) -> FloatArray:
        """See :class:`Solver`."""
        return self.state.chain[image, 3:].copy()

    def target(self) -> FloatArray:
        """See :class:`Solver`."""
        return wrapped_pose(self.state.target)

    def points(self, rows: list[int]) -> FloatArray:
        """See :class:`Solver`."""
        return self.state.points[self._numbers(rows)]

    def covariance(self, rows: list[int]) -> FloatArray:
        """See :class:`Solver`."""
        first = 3 + 2 * self._numbers(rows)
        columns = np.concatenate([np.arange(3), (first[:, None] + np.arange(2)).ravel()])
        try:
            if self._factored is None:
                self._factored = Factored(self.model.normal(self.model.look(self.state)))
        except LinAlgError:
            return np.full((3 + len(columns), 3 + len(columns)), np.nan)
        return self._factored.covariance(columns)

    def _numbers(self, rows: list[int]) -> IntArray:
        return np.array([self.model.landmarks[row] for row in rows], np.int64)

    def _weigh_down(self, look: Look) -> None:
        """Goes on without the match that contradicts the solution most, if one does too much."""
        if self._factored is None or not self.model.landmarks:
            return
        far = self.model.contradictions(look, self._factored.border_covariance())
        worst = int(np.argmax(far))
        if far[worst] > MATCH_LIMIT:
            self.model.drop_match(worst)
            self._go_on(STEPS)

    def _go_on(self, steps: int) -> Look:
        """Up to so many steps; what is left of the way is gone with the next image."""
        look, damping = self.model.look(self.state), Damping(_LEAST_DAMPING)
        self._factored = None
        for _ in range(steps):
            attempt = partial(self._tried, look.state, self.model.normal(look))
            found = damping.step(look.cost, attempt)
            if found is None:
                break
            look, factored = found[1]
            self.state = look.state
            self._factored = factored if damping.last == 0.0 else None
            if damping.last == 0.0 and factored.decrement < STILL:
                break
        return look

    def _tried(
        self, state: State, equations: NormalEquations, damping: float
    ) -> tuple[float, tuple[Look, Factored]]:
        factored = Factored(equations, damping)
        ahead = self.model.look(state.moved(factored.chain, factored.border))
        return ahead.cost, (ahead, factored)


# --------------------------------------------------------------------------------------------
# The homing graph in plain arrays: variables, measurements, costs and normal equations
#
# The same cost as that of :mod:`fgslam.backend.homing.parts` in GTSAM's factors.


_ROUNDING = 1e-9
_SPARE = 16  # views and landmarks that tables have room for beyond those that are there


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """Values of all variables.

    Attributes:
        chain: (n, 6) pose (x, y, psi) and velocity of start and images.
        target: (3,).
        points: (m, 2) landmarks.
    """

    chain: FloatArray
    target: FloatArray
    points: FloatArray

    def moved(self, chain: FloatArray, border: FloatArray) -> State:
        """After a step (n, 6) and (3 + 2 m,)."""
        points = self.points + border[3:].reshape(self.points.shape)
        return State(self.chain + chain, self.target + border[:3], points)

    def views(self) -> FloatArray:
        """(1 + n, 3) poses, the target first."""
        return np.vstack([self.target, self.chain[:, :3]])


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """Everything measured, seen from one state.

    Attributes:
        state: where.
        cost: half the robust sum of squares.
        bearings: residuals (v, m) and weighed informations.
        pairs: residuals (k,), weighed informations, derivatives by target (k, 3), points (k, 2).
        motion: of the chain, with its residuals.
        initial: residual (2,) of the initialisation, and its derivative (2, 3) by the target.
    """

    state: State
    cost: float
    bearings: tuple[FloatArray, FloatArray]
    pairs: tuple[FloatArray, FloatArray, FloatArray, FloatArray]
    motion: ChainMotion
    initial: tuple[FloatArray, FloatArray]


@dataclass(frozen=True, slots=True, eq=False)
class NormalEquations:
    """Half the Hessian of the cost, and its gradient.

    The chain of images (pose and velocity, six numbers each) is a block-tridiagonal matrix A,
    target and landmarks are its border C, with what each image sees of them, B, between::

        [A  B] [chain ]     [a]
        [B' C] [border] = - [b]

    Attributes:
        diagonal: (n, 6, 6) of the chain.
        below: (n - 1, 6, 6) rows of the later image, columns of the earlier.
        cross: (n, 6, m) chain and border.
        border: (m, m) target and landmarks.
        chain_gradient, border_gradient: (n, 6) and (m,).
    """

    diagonal: FloatArray
    below: FloatArray
    cross: FloatArray
    border: FloatArray
    chain_gradient: FloatArray
    border_gradient: FloatArray


class Sights:
    """Bearings, a table of views by landmarks; information 0 where there is none."""

    def __init__(self) -> None:
        """Empty."""
        self._table = np.zeros((2, 0, 0))

    def put(self, seen: list[BearingSeen], landmarks: dict[int, int]) -> None:
        """Notes some, of landmarks whose numbers are those of their rows.

        Of the views the target is 0 here, the start 1.
        """
        if not seen:
            return
        views, rows, measured, sigmas = zip(*seen, strict=True)
        at = np.array(views) + 1, np.array([landmarks[row] for row in rows])
        self._reach(int(at[0].max()) + 1, int(at[1].max()) + 1)
        self._table[0][at], self._table[1][at] = measured, np.array(sigmas) ** -2.0

    def drop(self, view: int, landmark: int) -> None:
        """Forgets one, if there is one."""
        self._reach(view + 1, landmark + 1)
        self._table[1, view, landmark] = 0.0

    def first(self, views: int, landmarks: int) -> FloatArray:
        """(2, views, landmarks) measured values and informations, of the first ones."""
        self._reach(views, landmarks)
        return self._table[:, :views, :landmarks]

    def _reach(self, views: int, landmarks: int) -> None:
        _, had, known = self._table.shape
        if views > had or landmarks > known:
            table = np.zeros((2, max(had, views + _SPARE), max(known, landmarks + _SPARE)))
            table[:, :had, :known] = self._table
            self._table = table


class Pairs:
    """Elevations of landmarks from start and target, as :class:`Pair` has them."""

    def __init__(self) -> None:
        """Empty."""
        self.landmarks = np.empty(0, np.int64)
        self._numbers = np.empty((0, 3))  # tangent from the start, elevation, information

    def put(self, landmark: int, pair: Pair) -> None:
        """Notes one."""
        by = elevation_pair(pair.first[:3], pair.first[3:], pair.measured)[3]
        information = float(np.sum((by * pair.sigmas) ** 2)) ** -1.0
        numbers = [np.tan(pair.measured[0]), pair.measured[1], information]
        self._numbers = np.vstack([self._numbers, numbers])
        self.landmarks = np.append(self.landmarks, landmark)

    @property
    def informations(self) -> FloatArray:
        """(k,) without any kernel."""
        return self._numbers[:, 2]

    def drop(self, landmark: int) -> None:
        """Forgets those of a landmark."""
        self._numbers[self.landmarks == landmark, 2] = 0.0

    def residuals(self, state: State) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """(k,) residuals and informations, derivatives by target (k, 3) and points (k, 2)."""
        tangent, up, information = self._numbers.T
        points = state.points[self.landmarks]
        offset = points - state.target[:2]
        near, far = np.hypot(*offset.T), np.hypot(*points.T)
        height = tangent * far
        squared = near**2 + height**2
        by_target = np.zeros((len(points), 3))
        by_target[:, :2] = (height / (squared * near))[:, None] * offset
        by_point = (near / squared * tangent / far)[:, None] * points - by_target[:, :2]
        return np.arctan2(height, near) - up, information, by_target, by_point


class SchurModel:
    """All measurements so far, and what they say at a state."""

    def __init__(self) -> None:
        """Nothing is measured yet."""
        self._speeds = FIRST_SPEEDS**-2.0
        self.landmarks: dict[int, int] = {}  # numbers of the variables, by row
        self._steps = np.empty(0)
        self._motions = np.empty((0, STATE, STATE))  # informations
        self._bearings, self._pairs = Sights(), Pairs()
        self._vector = (0.0, 0.0)
        self._initial: FloatArray = np.eye(2)  # information
        self._places = np.empty((0, 2))  # the weak priors
        self._place_informations = np.empty((0, 2))

    def take(self, new: NewPart, state: State) -> State:
        """Notes what is new; answers the state with first guesses of the new variables."""
        if new.beginning is not None:
            target, vector, covariance = new.beginning
            self._vector = (vector.direction, vector.rotation)
            self._initial = np.linalg.inv(covariance).astype(np.float64)
            state = State(state.chain, target, state.points)
        else:
            step = np.array([new.times[1] - new.times[0]])
            self._steps = np.append(self._steps, step)
            information = motion_informations(step, MOTION_DENSITIES)
            self._motions = np.concatenate([self._motions, information])
        for row, (point, spread) in new.points.items():
            self.landmarks[row] = len(self._places)
            self._places = np.vstack([self._places, point])
            information = np.array([spread, spread]) ** -2.0
            self._place_informations = np.vstack([self._place_informations, information])
        self._bearings.put(new.bearings, self.landmarks)
        for pair in new.pairs:
            self._pairs.put(self.landmarks[pair.row], pair)
        chain = np.vstack([state.chain, np.append(new.pose, new.velocity)])
        points = np.vstack([state.points, self._places[len(state.points) :]])
        return State(chain, state.target, points)

    # ----------------------------------------------------------------------------------------
    # Residuals and cost

    def look(self, state: State) -> Look:
        """Residuals, robust weights and cost at a state."""
        total = self._fixed_cost(state)
        initial = direction_and_turn(state.target, *self._vector)
        total += 0.5 * float(initial[0] @ self._initial @ initial[0])
        motion = ChainMotion(state.chain[:, :3], state.chain[:, 3:], self._steps)
        carried = self._motions @ motion.residual[..., None]
        total += 0.5 * float(np.vdot(motion.residual, carried))
        views = state.views()
        dx, dy = offsets(views, state.points)
        measured, information = self._bearings.first(len(views), len(state.points))
        residual = wrap(np.arctan2(dy, dx) - views[:, 2:] - measured)
        weighed, loss = _robust(residual, information)
        bearings, total = (residual, weighed), total + loss
        residual, information, *by = self._pairs.residuals(state)
        weighed, loss = _robust(residual, information)
        pairs = (residual, weighed, by[0], by[1])
        return Look(state, total + loss, bearings, pairs, motion, initial)

    def _fixed_cost(self, state: State) -> float:
        """Of start, leg, first velocity and weak priors."""
        start, speed = state.chain[0, :3], state.chain[0, 3:]
        leg = math.dist(state.target[:2], start[:2]) - 1.0
        total = (start @ start + leg**2) / STIFF**2 + speed @ (self._speeds * speed)
        off = state.points - self._places
        total += np.vdot(self._place_informations * off, off)
        return float(0.5 * total)

    # ----------------------------------------------------------------------------------------
    # Normal equations

    def normal(self, look: Look) -> NormalEquations:
        """Linearised at a state, robust weights as they are there."""
        state = look.state
        count, landmarks = len(state.chain), len(state.points)
        size = 3 + 2 * landmarks
        e = NormalEquations(
            np.zeros((count, STATE, STATE)),
            np.zeros((count - 1, STATE, STATE)),
            np.zeros((count, STATE, size)),
            np.zeros((size, size)),
            np.zeros((count, STATE)),
            np.zeros(size),
        )
        blocks = np.zeros((landmarks, 2, 2))
        every = np.arange(2)
        blocks[:, every, every] = self._place_informations
        e.border_gradient[3:] = (self._place_informations * (state.points - self._places)).ravel()
        self._add_fixed(e, look)
        self._add_motion(e, look)
        self._add_bearings(e, blocks, look)
        self._add_pairs(e, blocks, look)
        inner = e.border[3:, 3:].reshape(landmarks, 2, landmarks, 2)
        number = np.arange(landmarks)
        inner[number, :, number, :] = blocks
        e.border[3:, :3] = e.border[:3, 3:].T
        return e

    def _add_fixed(self, e: NormalEquations, look: Look) -> None:
        """Start, unit leg, first velocity, initialisation."""
        state, (residual, by) = look.state, look.initial
        every, stiff = np.arange(3), STIFF**-2.0
        start, speed = state.chain[0, :3], state.chain[0, 3:]
        offset = state.target[:2] - start[:2]
        leg = np.hypot(*offset)
        along = np.append(offset / leg, 0.0)
        outer = stiff * np.outer(along, along)
        pull = stiff * (leg - 1.0) * along
        e.diagonal[0, every, every] += stiff
        e.diagonal[0, 3 + every, 3 + every] += self._speeds
        e.diagonal[0, :3, :3] += outer
        e.cross[0, :3, :3] -= outer
        e.chain_gradient[0, :3] += stiff * start - pull
        e.chain_gradient[0, 3:] += self._speeds * speed
        known = by.T @ self._initial
        e.border[:3, :3] += outer + known @ by
        e.border_gradient[:3] += pull + known @ residual

    def _add_motion(self, e: NormalEquations, look: Look) -> None:
        residual, (before, after) = look.motion.residual, look.motion.derivatives()
        known_before = before.transpose(0, 2, 1) @ self._motions
        known_after = after.transpose(0, 2, 1) @ self._motions
        e.diagonal[:-1] += known_before @ before
        e.diagonal[1:] += known_after @ after
        e.below[:] = known_after @ before
        e.chain_gradient[:-1] += (known_before @ residual[..., None])[..., 0]
        e.chain_gradient[1:] += (known_after @ residual[..., None])[..., 0]

    def _add_bearings(self, e: NormalEquations, blocks: FloatArray, look: Look) -> None:
        residual, weighed = look.bearings
        views = look.state.views()
        dx, dy = offsets(views, look.state.points)
        by_pose, by_point = bearings_from_views(dx, dy)
        known = weighed[..., None] * by_pose
        of_pose = known.transpose(0, 2, 1) @ by_pose
        pull = np.einsum("vli,vl->vi", known, residual)
        cross = known.transpose(0, 2, 1)[..., None] * by_point[:, None]
        cross = cross.reshape(len(views), 3, -1)
        e.diagonal[:, :3, :3] += of_pose[1:]
        e.cross[:, :3, 3:] += cross[1:]
        e.chain_gradient[:, :3] += pull[1:]
        e.border[:3, :3] += of_pose[0]
        e.border[:3, 3:] += cross[0]
        e.border_gradient[:3] += pull[0]
        known = weighed[..., None] * by_point
        blocks += known.transpose(1, 2, 0) @ by_point.transpose(1, 0, 2)
        e.border_gradient[3:] += np.einsum("vli,vl->li", known, residual).ravel()

    def _add_pairs(self, e: NormalEquations, blocks: FloatArray, look: Look) -> None:
        residual, weighed, by_target, by_point = look.pairs
        rows = self._pairs.landmarks
        known = weighed[:, None] * by_point
        blocks[rows] += known[:, :, None] * by_point[:, None]
        columns = 3 + 2 * rows[:, None] + np.arange(2)
        e.border_gradient[columns] += known * residual[:, None]
        e.border[:3, columns] += np.einsum("ki,kj->ikj", by_target, known)
        e.border[:3, :3] += (weighed[:, None] * by_target).T @ by_target
        e.border_gradient[:3] += by_target.T @ (weighed * residual)

    # ----------------------------------------------------------------------------------------
    # Weights of what may be wrong

    def contradictions(self, look: Look, covariance: FloatArray) -> FloatArray:
        """How much each landmark's match contradicts everything else.

        Squared Mahalanobis distances (m,), chi-square of two degrees of freedom where the match
        is right, of the target's bearing and the elevation pair from what they would be without
        them: data snooping (Baarda 1968) of both together. A robust kernel sees the residual
        *after* the fit alone, and a wrong match of a near point pulls the fit to itself.

        Args:
            look: the solution.
            covariance: of target and landmarks there, all of the border.
        """
        rows, residual, known = self._match_rows(look)
        places = np.zeros((len(rows), 5), np.int64)
        places[:, :3] = np.arange(3)
        places[:, 3:] = 3 + 2 * np.arange(len(rows))[:, None] + np.arange(2)
        joint = covariance[places[:, :, None], places[:, None, :]]
        root = np.sqrt(known)
        rows = rows * root[..., None]
        # In weighed deviations the residual is (1 - H) times the error of a fit without the match,
        # whose covariance is (1 - H)^-1 - 1 and the noise, which no kernel weighs.
        one = np.eye(2)
        without = np.linalg.inv((1.0 + _ROUNDING) * one - rows @ joint @ rows.transpose(0, 2, 1))
        error = without @ (root * residual)[..., None]
        noise = np.where(known > 0.0, known / self._unweighed(len(rows)), 1.0)
        spread = without - one + noise[..., None] * one
        return np.asarray((error * np.linalg.solve(spread, error)).sum(axis=(1, 2)))

    def _match_rows(self, look: Look) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Target bearing and elevation pair of each landmark, zero where there is none.

        Derivatives (m, 2, 5) by target and point, residuals (m, 2) and weighed informations.
        """
        count = len(look.state.points)
        rows, residual, known = np.zeros((count, 2, 5)), np.zeros((count, 2)), np.zeros((count, 2))
        dx, dy = offsets(look.state.target[None], look.state.points)
        by_target, by_point = bearings_from_views(dx, dy)
        rows[:, 0, :3], rows[:, 0, 3:] = by_target[0], by_point[0]
        residual[:, 0], known[:, 0] = look.bearings[0][0], look.bearings[1][0]
        of = self._pairs.landmarks
        residual[of, 1], known[of, 1], rows[of, 1, :3], rows[of, 1, 3:] = look.pairs
        return rows, residual, known

    def _unweighed(self, count: int) -> FloatArray:
        """(m, 2) informations of target bearings and pairs, without kernel; 1 for none."""
        out = np.ones((count, 2))
        out[:, 0] = self._bearings.first(1, count)[1, 0]
        out[self._pairs.landmarks, 1] = self._pairs.informations
        return np.where(out > 0.0, out, 1.0)

    def drop_match(self, landmark: int) -> None:
        """What the target saw is not this landmark."""
        self._bearings.drop(0, landmark)
        self._pairs.drop(landmark)


def _robust(residual: FloatArray, information: FloatArray) -> tuple[FloatArray, float]:
    """Weighed informations, and the loss of all."""
    squared = information * residual**2
    weighed = information * kernel_weights(KERNEL, KERNEL_WIDTH, squared)
    return weighed, float(kernel_losses(KERNEL, KERNEL_WIDTH, squared).sum())
