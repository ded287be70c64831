"""The whole homing solved anew with every image, in plain arrays: exact, and the fastest.

Gauss-Newton with reweighting from the last solution; steps that raise the cost are damped. Every
few images the match that everything else contradicts most is put to the test.
Derivation: docs/derivations/homing_graph.md.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.linalg import LinAlgError
from scipy.linalg import lapack

from fgslam.backend.homing.graph_parts import NewPart
from fgslam.backend.homing.schur_model import STATE, Look, NormalEquations, SchurModel, State
from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.errors import EstimatorError
from fgslam.core.levenberg import Damping
from fgslam.core.planar import wrapped_pose

_ROWS, _COLUMNS = np.indices((STATE, STATE))
_LOWER = np.tril_indices(STATE)
_LEAST_DAMPING = 1e-3  # an image later the start is another, and covariances want none
STILL = 0.3  # deviations, of all variables together: a shorter step ends the iteration
_EVERY = 4  # images: a doubt costs half as much as an update
STEPS = 1
"""Gauss-Newton steps with an image, at most: what is left after one is gone with the next image."""

MATCH_LIMIT = 13.8
"""What the target saw of a landmark is dropped where everything else contradicts it by more than
this squared Mahalanobis distance: one in a thousand of right matches, by chi-square of two degrees
of freedom."""

_FIRST_STEPS = 20  # with start and target alone, whose first guess is the initialisation's


class Factored:
    """Normal equations factored once: the step to the minimum, and covariances.

    A is factored as a band, then the Schur complement C - B' A^-1 B. Everything is linearised anew
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
    """On :class:`fgslam.backend.homing.graph_parts.Solver`."""

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
                "the homing graph cannot be solved (its cost is no number); start the homing anew"
            )
        if new.image % _EVERY == 0:
            self._doubt(look)

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

    def _doubt(self, look: Look) -> None:
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
