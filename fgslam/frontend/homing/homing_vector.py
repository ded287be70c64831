"""The homing vector from wide-baseline matches: RANSAC over pairs, refinement, refusal.

Section III-B of Goedemé et al. (2005). Samples of two matches give one or two hypotheses each; each
is supported by the matches that keep the epipolar constraint with positive distances; the best is
refined on its inliers. An answer is given only if its support cannot be
chance and no different solution comes near it.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr
from scipy.stats import chi2

from fgslam.core.arrays import BoolArray, FloatArray, IntArray
from fgslam.core.homing import BearingMatches, Refusal, RefusalReason, TwoViewVector
from fgslam.core.planar import circular_median, unit, wrap
from fgslam.frontend.homing.matching import (
    COMMON_CHANCE,
    gain,
    log_likelihood_ratio,
    right_probability,
)
from fgslam.frontend.homing.refinement import HomingRefinement, Refined, spread_over
from fgslam.frontend.homing.settings import HomingVectorSettings
from fgslam.frontend.homing.two_view_geometry import EpipolarTest, TwoPointSamples, solve_two_point

LEAST_PARALLAX = np.deg2rad(3.0)  # of two rays; below, the signs of the distances are noise

INLIER_SIGMAS = 3.0  # normalised epipolar residual; right matches exceed it in 0.3 %
_BATCH = 50  # samples between two looks at the confidence
_MAX_LOG_RATIO_SIGMA = 0.7  # of ln rho: matches near the horizon support, but are not sampled
_SHUFFLES = 10  # times the matches are paired wrongly to learn what chance supports
_REFINED = 8  # different hypotheses that are refined, the best supported first
_ALIKE = np.deg2rad(5.0)  # hypotheses closer than this lead to the same refined solution, mostly
_SAME = np.deg2rad(0.2)  # refined solutions closer than this are one
_TEMPER = 2.0  # residuals have common causes: so many of them count as one, see `covariance`
_CELLS_AROUND = 180  # of 2 degrees: matches within one cell in both views count as one inlier
_TURNED = 3.0  # times the median's limit: what is explained by the turn alone
_SECTORS = 8  # of 45 degrees: what is seen in one has its errors in common, see `doubt`
_LEAST_SPREAD = 0.25  # of directions; half a turn has 0.31, all around 0.71
_LEVEL = float(chi2.ppf(0.95, 5))  # of the prior's strain: level cameras keep within
_FREE = (np.deg2rad(5.0), 1.0)
"""Prior of a camera that is carried: tilts at which nearly all features are still matched
(docs/results/homing_vectors.md), and a height of a whole leg, up stairs or down to the ground."""


def estimate_homing_vector(
    matches: BearingMatches, settings: HomingVectorSettings, rng: np.random.Generator
) -> TwoViewVector | Refusal:
    """The homing vector that the matches support best, or why there is none.

    Args:
        matches: tentative ones, wrong ones among them.
        settings: number of samples, thresholds.
        rng: chooses the samples; the same generator state gives the same answer.
    """
    return HomingSearch(matches, settings, rng).answer()


class HomingSearch:
    """One search: matches prepared for sampling, testing and refining.

    Attributes:
        direction_sigma: of the best solution, radians, without the settings' floor; set by
            :meth:`answer`.
    """

    def __init__(
        self, matches: BearingMatches, settings: HomingVectorSettings, rng: np.random.Generator
    ) -> None:
        self._matches = matches
        self._settings = settings
        self._rng = rng
        tilt = np.deg2rad(settings.tilt_sigma_deg)
        self._test = EpipolarTest.of(matches, tilt)
        self._refinement = HomingRefinement(
            matches, (tilt, settings.height_sigma), INLIER_SIGMAS, LEAST_PARALLAX
        )
        self._cells = _cells(matches)
        self._tilt = tilt
        self._right = right_probability(matches)
        self._found = np.empty((4, 0))
        self.direction_sigma = np.inf

    def answer(self) -> TwoViewVector | Refusal:
        """The homing vector that the matches support best, or why there is none."""
        s, count = self._settings, len(self._matches)
        if count < s.min_inliers:
            text = f"{count} matches, of {s.min_inliers} needed"
            return Refusal(RefusalReason.TOO_FEW_MATCHES, text)
        self._found = self._sampled()
        candidates = self.different(_REFINED)
        if not len(candidates):
            text = "no pair of matches agrees on any homing vector"
            alone = self._turned_alone()
            return Refusal(RefusalReason.TOO_FEW_INLIERS, text) if alone is None else alone
        refined = self.refined(candidates)
        at_target = self.turn_at_target(refined[0])
        if at_target is not None:
            return at_target
        return self._judged(self._carried(refined, candidates) or refined)

    def _judged(self, refined: list[Refined]) -> TwoViewVector | Refusal:
        s, best = self._settings, refined[0]
        competitors = [r for r in refined[1:] if self.differ(r, best)]
        covariance = self.covariance(refined)
        self.direction_sigma = float(np.sqrt(covariance[0, 0]))
        refusal = self.refusal(best, competitors, self.direction_sigma)
        if refusal is not None:
            return refusal
        theta, psi = (float(v) for v in best.parameters[:2])
        support = max((self.independent_inliers(r.inliers) for r in competitors), default=0)
        floor = np.deg2rad([s.direction_floor_deg, s.rotation_floor_deg])
        return TwoViewVector(
            theta, psi, covariance + np.diag(floor**2), best.inliers, support,
            self.doubt(best, competitors),
        )  # fmt: skip

    # ----------------------------------------------------------------------------------------
    # Sampling

    def _sampled(self) -> FloatArray:
        """(4, c) hypotheses as of :meth:`_hypotheses`, until a better one is unlikely."""
        log_ratio, sigma_log, eligible = _log_ratios(self._matches, self._tilt)
        if len(eligible) < 2:
            return self._found
        found: list[FloatArray] = []
        drawn, best = 0, 0.0
        while drawn < self._settings.samples and drawn < self._needed(best):
            count = min(_BATCH, self._settings.samples - drawn)
            pairs = eligible[_distinct_pairs(self._right[eligible], count, self._rng)]
            solutions = self._hypotheses(pairs, log_ratio, sigma_log)
            drawn += count
            if solutions.shape[1]:
                found.append(solutions)
                best = max(best, float(np.max(solutions[2])))
        return np.hstack(found) if found else self._found

    def _needed(self, share: float) -> float:
        """Samples until one of two inliers was drawn with the wanted confidence.

        ``share`` is that of the inliers, each counted as often as it is drawn.
        """
        if share <= 0.0:
            return np.inf
        if share >= 1.0:
            return 1.0
        return float(np.log(1.0 - self._settings.confidence) / np.log1p(-(share**2)))

    def _hypotheses(
        self, pairs: IntArray, log_ratio: FloatArray, sigma_log: FloatArray
    ) -> FloatArray:
        """(4, c) direction, rotation, share of the inliers, and score, see :meth:`_score`."""
        m = self._matches
        bearing_sigma = np.sqrt(0.5 * (m.sigma[:, 0] ** 2 + m.sigma[:, 2] ** 2))
        solved = solve_two_point(
            TwoPointSamples(
                m.bearing_a[pairs],
                m.bearing_b[pairs],
                log_ratio[pairs],
                bearing_sigma[pairs],
                sigma_log[pairs],
            )
        )
        direction, rotation = solved.direction[solved.valid], solved.rotation[solved.valid]
        inliers, residuals = self._test.inliers(direction, rotation, INLIER_SIGMAS, LEAST_PARALLAX)
        share = self._right @ inliers / np.sum(self._right)
        return np.stack([direction, rotation, share, self._score(inliers, residuals)])

    def _score(self, inliers: BoolArray, residuals: FloatArray) -> FloatArray:
        """(c,) log-likelihoods of hypotheses, up to a constant, of (n, c) residuals."""
        return np.asarray(np.sum(self._scores(inliers, residuals), axis=0))

    def _scores(self, inliers: BoolArray, residuals: FloatArray) -> FloatArray:
        """(n, c) what each match adds to the score of each hypothesis."""
        gains = gain(residuals, INLIER_SIGMAS, COMMON_CHANCE)
        odds = (self._right / (1.0 - self._right))[:, None]
        return np.where(inliers, np.log1p(odds * gains), 0.0)

    def different(self, most: int) -> FloatArray:
        """(c, 2) direction and rotation of the best supported, different hypotheses, best first."""
        ordered = self._found[:, np.argsort(-self._found[3], kind="stable")]
        chosen: list[int] = []
        open_ = np.ones(ordered.shape[1], dtype=np.bool_)
        while len(chosen) < most and np.any(open_):
            k = int(np.argmax(open_))
            chosen.append(k)
            open_ &= _angle_apart(ordered[:2], ordered[:2, k : k + 1]) > _ALIKE
        return ordered[:2, chosen].T

    # ----------------------------------------------------------------------------------------
    # Refining and judging

    def refined(
        self, candidates: FloatArray, refinement: HomingRefinement | None = None
    ) -> list[Refined]:
        """The candidates (c, 2) after least squares, the best score first, each solution once."""
        found = (refinement or self._refinement).refine(candidates[:, 0], candidates[:, 1])
        found.sort(key=lambda r: -self._score_of(r))
        out: list[Refined] = []
        for solution in found:
            if all(_apart(solution, known) > _SAME for known in out):
                out.append(solution)
        return out

    def _carried(self, level: list[Refined], candidates: FloatArray) -> list[Refined]:
        """Solutions without the plane, where the matches contradict it; none where they do not.

        Tried only where the best solution strains the prior; it must lead as over any rival, as
        freedom explains wrong matches, too.
        """
        if self._refinement.strain(level[0]) <= _LEVEL:
            return []
        free = self._refinement.held_by(_FREE)
        found = self.refined(np.vstack([candidates, level[0].parameters[:2]]), free)
        return [] if self._undecided(found[0], level[0]) else found

    def _score_of(self, solution: Refined) -> float:
        return float(self._score(solution.inliers[:, None], solution.residuals[:, None])[0])

    def covariance(self, refined: list[Refined]) -> FloatArray:
        """(2, 2) of the best solution, widened by those near it that fit nearly as well.

        Features all on one side leave a valley with several minima. Each solution within the
        competitors' angle weighs by its likelihood, tempered since residuals have common causes.
        """
        near = [r for r in refined if not self.differ(r, refined[0])]
        return spread_over(near, np.array([self._score_of(r) for r in near]), _TEMPER)

    def differ(self, one: Refined, other: Refined) -> bool:
        """Whether two solutions are not one and the same."""
        return _apart(one, other) > float(np.deg2rad(self._settings.rival_angle_deg))

    def independent_inliers(self, which: BoolArray) -> int:
        """Number of inliers that are independent of each other."""
        return len(np.unique(self._cells[which]))

    def turn_at_target(self, best: Refined) -> Refusal | None:
        """Both views from one place: there is a turn, but no direction.

        That must be as well supported as any answer, and from enough sides: a single thing looks
        alike from anywhere, and like turned when it is another one of its kind.
        """
        return self._turn_of(best.inliers) if np.any(best.inliers) else None

    def _turned_alone(self) -> Refusal | None:
        """The same where no two matches have parallax enough for a hypothesis: one image twice.

        Most matches must be explained by the turn.
        """
        turns = wrap(self._matches.bearing_a - self._matches.bearing_b)
        psi = circular_median(turns)
        still = np.abs(wrap(turns - psi)) < np.deg2rad(self._settings.at_target_parallax_deg)
        return self._turn_of(still) if 2 * np.count_nonzero(still) > len(still) else None

    def _turn_of(self, inliers: BoolArray) -> Refusal | None:
        m, limit = self._matches, np.deg2rad(self._settings.at_target_parallax_deg)
        turns = wrap(m.bearing_a - m.bearing_b)
        psi = float(np.angle(np.mean(np.exp(1j * turns[inliers]))))
        parallaxes = np.abs(wrap(turns - psi))
        parallax = float(np.median(parallaxes[inliers]))
        if parallax >= limit:
            return None
        turned = inliers & (parallaxes < _TURNED * limit)
        if (
            self.independent_inliers(turned) < self._settings.min_inliers
            or _spread(m.bearing_a[turned]) < _LEAST_SPREAD
        ):
            return None
        return Refusal(
            RefusalReason.AT_TARGET,
            f"median parallax {np.rad2deg(parallax):.2f} deg: both views are from one place",
            psi,
        )

    def doubt(self, best: Refined, competitors: list[Refined]) -> float:
        """Largest probability that a different solution is the better one, at most 0.5.

        Vuong's test (1989) of two models that both are wrong a little: what the matches add to the
        lead of one solution over the other is summed by sectors of the present view, and the lead
        is held against the scatter of these sums. Errors that are common to a sector, of a tilt or
        a calibration, so count once, not once a match.
        """
        if not competitors:
            return 0.0
        every = [best, *competitors]
        inliers = np.column_stack([r.inliers for r in every])
        scores = self._scores(inliers, np.column_stack([r.residuals for r in every]))
        part = np.mod(self._matches.bearing_a, 2.0 * np.pi) * (_SECTORS / (2.0 * np.pi))
        within = np.minimum(part.astype(np.int64), _SECTORS - 1) == np.arange(_SECTORS)[:, None]
        leads = within @ (scores[:, :1] - scores[:, 1:])
        spread = np.sqrt(np.sum(leads**2, axis=0))
        with np.errstate(invalid="ignore", divide="ignore"):
            sigmas = np.where(spread > 0.0, np.sum(leads, axis=0) / spread, 0.0)
        return float(np.max(ndtr(-np.maximum(sigmas, 0.0))))

    def _undecided(self, best: Refined, competitor: Refined) -> bool:
        return self._score_of(best) - self._score_of(competitor) < self._settings.rival_log_odds

    def refusal(
        self, best: Refined, competitors: list[Refined], direction_sigma: float
    ) -> Refusal | None:
        """Why the best solution is no answer, or None."""
        s = self._settings
        support = self.independent_inliers(best.inliers)
        alarms = self._log_false_alarms(best)
        if support < s.min_inliers:
            reason, text = (
                RefusalReason.TOO_FEW_INLIERS,
                f"{support} inliers of {len(self._matches)}",
            )
        elif alarms > np.log(s.max_false_alarms):
            reason = RefusalReason.TOO_FEW_INLIERS
            text = (
                f"{support} inliers of {len(self._matches)} matches may be chance "
                f"(1e{alarms / np.log(10.0):.1f} expected)"
            )
        elif undecided := [r for r in competitors if self._undecided(best, r)]:
            reason = RefusalReason.AMBIGUOUS
            other = self.independent_inliers(undecided[0].inliers)
            text = f"{support} inliers, {other} for a different solution"
        elif direction_sigma > np.deg2rad(s.max_direction_sigma_deg):
            reason = RefusalReason.UNCERTAIN
            text = f"direction is uncertain by {np.rad2deg(direction_sigma):.1f} deg"
        else:
            return None
        return Refusal(reason, text)

    def _log_false_alarms(self, best: Refined) -> float:
        """Log of the number of equally supported hypotheses expected if all matches were wrong.

        How often a wrong match agrees with this hypothesis is read off wrong matches: the same
        features paired at random (an *a contrario* test, Moisan and Stival 2004).
        """
        n, sigmas = len(self._matches), INLIER_SIGMAS
        shuffled = np.concatenate([self._rng.permutation(n) for _ in range(_SHUFFLES)])
        every = np.tile(np.arange(n), _SHUFFLES)
        wrong = EpipolarTest.of(paired_anew(self._matches, every, shuffled), self._tilt)
        good, _ = wrong.inliers(best.parameters[:1], best.parameters[1:2], sigmas, LEAST_PARALLAX)
        chance = (np.count_nonzero(good) + 1.0) / (len(good) + 2.0)
        gains = np.where(best.inliers, gain(best.residuals, sigmas, chance), 0.0)
        kept = _one_a_cell(gains, self._cells)
        tests = float(np.log(n * (n - 1.0)))  # two solutions for each pair
        return tests - log_likelihood_ratio(gains[kept], self._right[kept])


def _spread(bearing: FloatArray) -> float:
    """How well bearings (n,) would show a short leg, whichever way it goes.

    A leg of length r shifts what is at distance d by r / d times the sine of its bearing from the
    leg; what is the same for all is taken for a turn. So the measure is the standard deviation of
    unit vectors along the direction where it is least.
    """
    return float(np.sqrt(max(np.linalg.eigvalsh(np.cov(unit(bearing).T, bias=True))[0], 0.0)))


def _one_a_cell(gains: FloatArray, cells: IntArray) -> IntArray:
    """(m,) of each cell the match that agrees best: the others say the same again."""
    order = np.lexsort((-gains, cells))
    first = np.ones(len(order), dtype=np.bool_)
    first[1:] = cells[order][1:] != cells[order][:-1]
    return np.asarray(order[first], dtype=np.int64)


def _distinct_pairs(weights: FloatArray, count: int, rng: np.random.Generator) -> IntArray:
    """(count, 2) of two different indices, drawn in proportion to weights (n,), n at least 2."""
    n, ends = len(weights), np.cumsum(weights)
    first = np.searchsorted(ends, rng.uniform(0.0, ends[-1], count), side="right")
    # The second is drawn from what is left when the first one's interval is cut out.
    rest = rng.uniform(0.0, 1.0, count) * (ends[-1] - weights[first])
    rest = np.where(rest < ends[first] - weights[first], rest, rest + weights[first])
    second = np.searchsorted(ends, rest, side="right")
    return np.asarray(np.minimum(np.column_stack([first, second]), n - 1), dtype=np.int64)


def _apart(one: Refined, other: Refined) -> float:
    """Larger of the differences in direction and rotation."""
    return float(_angle_apart(one.parameters[:2, None], other.parameters[:2, None])[0])


def _angle_apart(one: FloatArray, other: FloatArray) -> FloatArray:
    """(c,) larger of the differences in direction and rotation, of (2, c) hypotheses."""
    return np.asarray(np.max(np.abs(wrap(one - other)), axis=0))


def _log_ratios(
    matches: BearingMatches, tilt_sigma: float
) -> tuple[FloatArray, FloatArray, IntArray]:
    """(n,) ln rho and its standard deviation, and which matches may be sampled.

    sigma(ln tan alpha) = 2 sigma / sin(2 alpha): it explodes towards the horizon and the zenith.
    Where both elevations have different signs there is no ratio.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.tan(matches.elevation_a) / np.tan(matches.elevation_b)
        log_ratio = np.log(np.where(ratio > 0.0, ratio, np.nan))
        sigma_a = (
            2.0 * np.hypot(matches.sigma[:, 1], tilt_sigma) / np.sin(2.0 * matches.elevation_a)
        )
        sigma_b = (
            2.0 * np.hypot(matches.sigma[:, 3], tilt_sigma) / np.sin(2.0 * matches.elevation_b)
        )
    sigma = np.hypot(sigma_a, sigma_b)
    eligible = np.flatnonzero(np.isfinite(log_ratio) & (sigma < _MAX_LOG_RATIO_SIGMA))
    return log_ratio, sigma, eligible


def _cells(matches: BearingMatches) -> IntArray:
    """(n,) number of the cell of both views that a match lies in: one cell counts once."""
    angles = [matches.bearing_a, matches.bearing_b, matches.elevation_a, matches.elevation_b]
    grid = np.round(np.column_stack(angles) * (_CELLS_AROUND / (2.0 * np.pi)))
    grid[:, :2] %= _CELLS_AROUND  # both sides of the seam are one cell
    _, cells = np.unique(grid, axis=0, return_inverse=True)
    return np.asarray(cells.ravel(), dtype=np.int64)


def paired_anew(matches: BearingMatches, first: IntArray, second: IntArray) -> BearingMatches:
    """(m) features of the first view, of matches (m,), each with one of the second view."""
    a, b = matches.select(first), matches.select(second)
    return BearingMatches(
        a.kind, a.index_a, b.index_b, a.bearing_a, a.elevation_a, b.bearing_b, b.elevation_b,
        np.column_stack([a.sigma[:, :2], b.sigma[:, 2:]]), a.quality,
    )  # fmt: skip
