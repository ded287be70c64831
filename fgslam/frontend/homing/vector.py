"""The homing vector from wide-baseline matches: RANSAC over pairs, refinement, refusal.

Section III-B of Goedemé et al. (2005). Samples of two matches give one or two hypotheses each; each
is supported by the matches that keep the epipolar constraint with positive distances; the best is
refined on its inliers. An answer is given only if its support cannot be
chance, no different solution comes near it, and the other matches show no second motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr
from scipy.stats import chi2

from fgslam.core.arrays import BoolArray, ByteArray, Float32, FloatArray, IntArray, Rows
from fgslam.core.bearings import (
    BearingMatches,
    OmniFeatures,
    Refusal,
    RefusalReason,
    TwoViewVector,
    UprightFeatures,
)
from fgslam.core.geometry import circular_median, unit, wrap
from fgslam.frontend.homing.two_view import (
    COMMON_CHANCE,
    EpipolarTest,
    HomingRefinement,
    Refined,
    TwoPointSamples,
    gain,
    log_likelihood_ratio,
    match_features,
    planar_distances,
    right_probability,
    sift_matches,
    solve_two_point,
    spread_over,
)
from fgslam.frontend.settings import HomingVectorSettings, OmniMatchingSettings

LEAST_PARALLAX = np.deg2rad(3.0)  # of two rays; below, the signs of the distances are noise

INLIER_SIGMAS = 3.0  # normalised epipolar residual; right matches exceed it in 0.3 %
_BATCH = 50  # samples between two tests of the confidence
_MAX_LOG_RATIO_SIGMA = 0.7  # of ln rho: matches near the horizon support, but are not sampled
_SHUFFLES = 10  # times the matches are paired wrongly to learn what chance supports
_REFINED = 8  # different hypotheses that are refined, the best supported first
_ALIKE = np.deg2rad(5.0)  # hypotheses closer than this lead to the same refined solution, mostly
_SAME = np.deg2rad(0.2)  # refined solutions closer than this are one
_TEMPER = 2.0  # residuals have common causes: so many of them count as one, see `covariance`
_CELLS_AROUND = 180  # of 2 degrees: matches within one cell in both views count as one inlier
_TURNED = 3.0  # times the median's limit: what is explained by the turn alone
_SIMILAR = 0.5
"""Score of a second motion over the best one's, each of matches of its own: what a mirror shows, or
a room like another one, moves consistently, too. Of 240 pairs of a home matched as for driving, 6
of 10 answers that are off by more than 10 degrees have more, and 2 of the 65 others."""
_SECTORS = 8  # of 45 degrees: what is seen in one has its errors in common, see `rival_probability`
_LEAST_SPREAD = 0.25  # of directions; half a turn has 0.31, all around 0.71
_LEVEL = float(chi2.ppf(0.95, 5))  # of the prior's strain: level cameras keep within
_DRIVEN, _CARRIED = (2, 2), (5, 10)
"""Matches that determine a motion, and its solutions at most: on the plane the two-point problem,
else the essential matrix (Nistér 2004). More freedom is more hypotheses that chance may support."""
_FREE = (np.deg2rad(5.0), 1.0)
"""Prior of a camera that is carried: tilts at which nearly all features are still matched
(docs/results/homing.md), and a height of a whole leg, up stairs or down to the ground."""


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
        self.match_cells = match_cells(matches)
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
        carried = self._carried(refined, candidates)
        answer = self._judged(carried, _CARRIED) if carried else self._judged(refined, _DRIVEN)
        if answer and not carried and self._refinement.strain(refined[0]) > _LEVEL:
            # Neither level nor clearly tilted: the sigma holds for neither. Of 285 answers in a
            # rendered house 14 are so; 9 of these are beyond three sigma, of the others 36.
            return replace(answer, wrong_probability=0.5)
        return answer

    def _judged(self, refined: list[Refined], sample: tuple[int, int]) -> TwoViewVector | Refusal:
        s, best = self._settings, refined[0]
        competitors = [r for r in refined[1:] if self.differ(r, best)]
        covariance, refusal = self.covariance(refined), self.refusal(best, competitors, sample)
        if refusal is None:
            covariance, refusal = self._with_second_motions(best, covariance)
        self.direction_sigma = float(np.sqrt(covariance[0, 0]))
        if refusal is not None:
            return refusal
        if self.direction_sigma > np.deg2rad(s.max_direction_sigma_deg):
            text = f"direction is uncertain by {np.rad2deg(self.direction_sigma):.1f} deg"
            return Refusal(RefusalReason.UNCERTAIN, text)
        theta, psi = (float(v) for v in best.parameters[:2])
        support = max((self.independent_inliers(r.inliers) for r in competitors), default=0)
        floor = np.deg2rad([s.direction_floor_deg, s.rotation_floor_deg])
        return TwoViewVector(
            theta, psi, covariance + np.diag(floor**2), best.inliers, support,
            self.rival_probability(best, competitors),
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
        inliers, residuals = self._test.inliers(
            direction, rotation, INLIER_SIGMAS, LEAST_PARALLAX, self._settings.inliers == "ratio"
        )
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
            open_ &= _angle_between(ordered[:2], ordered[:2, k : k + 1]) > _ALIKE
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
            if all(_direction_difference(solution, known) > _SAME for known in out):
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
        return _direction_difference(one, other) > float(np.deg2rad(self._settings.rival_angle_deg))

    def independent_inliers(self, which: BoolArray) -> int:
        """Number of inliers that are independent of each other."""
        return len(np.unique(self.match_cells[which]))

    def _with_second_motions(
        self, best: Refined, covariance: FloatArray
    ) -> tuple[FloatArray, Refusal | None]:
        """The covariance (2, 2), widened to the motions near it that the other matches support.

        Those matches alone are asked for hypotheses. One that differs is a reason to refuse.
        """
        rest = HomingSearch(self._matches.select(~best.inliers), self._settings, self._rng)
        theta, psi = self._found[:2]
        inliers, residuals = rest._test.inliers(theta, psi, INLIER_SIGMAS, LEAST_PARALLAX)
        rest._found = np.vstack([self._found[:3], rest._score(inliers, residuals)])
        least = _SIMILAR * self._score_of(best)
        for other in rest.refined(rest.different(_REFINED)):
            if rest._score_of(other) < least:
                break
            if self.differ(other, best):
                text = f"{np.count_nonzero(best.inliers)} inliers, of the others "
                text += f"{np.count_nonzero(other.inliers)} move alike in a different way"
                return covariance, Refusal(RefusalReason.AMBIGUOUS, text)
            offset = wrap(other.parameters[:2] - best.parameters[:2])
            covariance = covariance + np.outer(offset, offset)
        return covariance, None

    def turn_at_target(self, best: Refined) -> Refusal | None:
        """Both views from one place: there is a turn, but no direction.

        That must be as well supported as any answer, and from enough sides: a single thing seems
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

    def rival_probability(self, best: Refined, competitors: list[Refined]) -> float:
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
        self, best: Refined, competitors: list[Refined], sample: tuple[int, int] = _DRIVEN
    ) -> Refusal | None:
        """Why the best solution is no answer, or None; its uncertainty aside."""
        s = self._settings
        support = self.independent_inliers(best.inliers)
        alarms, *without_sector = self._log_false_alarms(best, sample)
        if support < s.min_inliers:
            reason = RefusalReason.TOO_FEW_INLIERS
            text = f"{support} inliers of {len(self._matches)}"
        elif alarms > np.log(s.max_false_alarms):
            reason = RefusalReason.TOO_FEW_INLIERS
            text = (
                f"{support} inliers of {len(self._matches)} matches may be chance "
                f"(1e{alarms / np.log(10.0):.1f} expected)"
            )
        elif max(without_sector) > 0.0:
            reason = RefusalReason.TOO_FEW_INLIERS
            text = f"of {support} inliers those outside an eighth of a view may be chance"
        elif undecided := [r for r in competitors if self._undecided(best, r)]:
            reason = RefusalReason.AMBIGUOUS
            other = self.independent_inliers(undecided[0].inliers)
            text = f"{support} inliers, {other} for a different solution"
        else:
            return None
        return Refusal(reason, text)

    def _log_false_alarms(self, best: Refined, sample: tuple[int, int]) -> list[float]:
        """Log of the number of equally supported hypotheses expected if all matches were wrong.

        By all inliers first, then by those outside each sector of either view: one thing seen in
        both views that is another one of its kind fits some motion exactly. How often a wrong match
        agrees with this hypothesis is read off wrong matches: the same features paired at random
        (an *a contrario* test, Moisan and Stival 2004).
        """
        n, sigmas = len(self._matches), INLIER_SIGMAS
        shuffled = np.concatenate([self._rng.permutation(n) for _ in range(_SHUFFLES)])
        first = np.tile(np.arange(n), _SHUFFLES)
        wrong = EpipolarTest.of(re_paired(self._matches, first, shuffled), self._tilt)
        good, _ = wrong.inliers(best.parameters[:1], best.parameters[1:2], sigmas, LEAST_PARALLAX)
        chance = (np.count_nonzero(good) + 1.0) / (len(good) + 2.0)
        gains = np.where(best.inliers, gain(best.residuals, sigmas, chance), 0.0)
        kept = _one_a_cell(gains, self.match_cells)
        middles = np.arange(2 * _SECTORS) * (np.pi / _SECTORS)
        every = [kept]
        for bearing in (self._matches.bearing_a[kept], self._matches.bearing_b[kept]):
            every += [kept[np.abs(wrap(bearing - c)) > np.pi / _SECTORS] for c in middles]
        tests = math.log(sample[1] * math.comb(max(n, sample[0]), sample[0]))
        return [tests - log_likelihood_ratio(gains[k], self._right[k]) for k in every]


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


def _direction_difference(one: Refined, other: Refined) -> float:
    """Larger of the differences in direction and rotation."""
    return float(_angle_between(one.parameters[:2, None], other.parameters[:2, None])[0])


def _angle_between(one: FloatArray, other: FloatArray) -> FloatArray:
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


def match_cells(matches: BearingMatches) -> IntArray:
    """(n,) number of the cell of both views that a match lies in: one cell counts once."""
    angles = [matches.bearing_a, matches.bearing_b, matches.elevation_a, matches.elevation_b]
    grid = np.round(np.column_stack(angles) * (_CELLS_AROUND / (2.0 * np.pi)))
    grid[:, :2] %= _CELLS_AROUND  # both sides of the seam are one cell
    _, cells = np.unique(grid, axis=0, return_inverse=True)
    return np.asarray(cells.ravel(), dtype=np.int64)


def re_paired(matches: BearingMatches, first: IntArray, second: IntArray) -> BearingMatches:
    """(m) features of the first view, of matches (m,), each with one of the second view."""
    a, b = matches.select(first), matches.select(second)
    return BearingMatches(
        a.kind, a.index_a, b.index_b, a.bearing_a, a.elevation_a, b.bearing_b, b.elevation_b,
        np.column_stack([a.sigma[:, :2], b.sigma[:, 2:]]), a.quality,
    )  # fmt: skip


# --------------------------------------------------------------------------------------------
# Candidate matches of two distant views, and how much they speak for a homing vector
#
# Matching keeps a feature's nearest descriptor if it is clearly nearer than the second nearest.
# From far apart few right ones are: they rank second or fifth. So every feature keeps its nearest
# few, and which of them is right, if any, the homing vector under test decides (guided matching).
# What counts as evidence is narrower than what matching takes:
#
# * features on an edge are left out: a feature on a line finds its like wherever along the line the
# epipolar plane cuts it, so that one door frame supports any homing vector; * so is the floor
# nearer than the camera is high: no descriptor survives the change of view of a leg of that length,
# and what does repeat there is the camera's own stand and shadow; * the ratio of sizes must be that
# of the distances, d / e, that the homing vector implies; * one place in either view counts little
# more than once: what is on one wall is wrong together.


_NEAREST = 5  # candidates of a feature, in either direction
_MAX_DISTANCE = 0.8  # see `_relative_distances`; beyond, one candidate in twenty is right
_LOWEST = np.deg2rad(-45.0)
_MAX_EDGE = 0.6  # see `edge_likeness`; the median feature of a home has 0.42

_RIGHT_BY_DISTANCE = (
    (0.05, 0.1, 0.2, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75),
    (3.0, 2.0, 0.5, -0.2, -1.0, -1.85, -2.45, -2.95, -3.5),
)
_RIGHT_BY_COLOUR = (0.0, 0.03, 0.08, 0.15, 0.3, 0.6), (0.5, 0.35, 0.0, -0.5, -1.2, -1.8)
"""Logit of the probability that a candidate is right: by its distance, and what its colour adds.

Counted on 45 pairs of ``omni_home`` among 980,000 candidates: how many more agree with the homing
vector than with twenty drawn by lot. 0.78 of those nearer than 0.2 are right, 0.16 at 0.45, 0.07
at 0.65, 0.05 at 0.75.
"""

_SIZE_SIGMA = 0.35  # of ln of the ratio of sizes, of right candidates
_SIZE_RANGE = 1.6  # that of wrong ones is even over so much: the planar gates admit a factor 2
_NEAR_LEG = 0.05  # sine of the angle to the leg below which the distances' ratio measures nothing
_CELL_DEG = 2.0  # candidates within one cell in both views count as one
_BLOCK_DEG, BLOCK_FULL = 7.0, 6.0
"""Evidence s within a block of so many degrees of a view counts f ln(1 + s / f)."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidates(Rows):
    """Candidate matches of two views; a feature may be in several of them.

    Attributes:
        matches: (n).
        right: (n,) probability of being right, before any geometry.
        log_size: (n,) ln of the size in view a over that in view b.
    """

    matches: BearingMatches
    right: FloatArray
    log_size: FloatArray


def candidate_matches(a: UprightFeatures, b: UprightFeatures, squared: Float32) -> Candidates:
    """The nearest few in the other view of each feature that is fit as evidence.

    Args:
        a: features of one view.
        b: of the other.
        squared: (n, m) distances of their descriptors as of
            :func:`fgslam.frontend.homing.two_view.planar_distances`.
    """
    i, j, distance = _nearest_both_ways(squared)
    keep = (distance < _MAX_DISTANCE) & _fit(a)[i] & _fit(b)[j]
    i, j, distance = i[keep], j[keep], distance[keep]
    colour = np.linalg.norm(a.colour[i] - b.colour[j], axis=1)
    logit = np.interp(distance, *_RIGHT_BY_DISTANCE) + np.interp(colour, *_RIGHT_BY_COLOUR)
    return Candidates(
        sift_matches(a, b, i, j, 1.0 - distance),
        1.0 / (1.0 + np.exp(-logit)),
        np.log(a.scale[i] / b.scale[j]),
    )


def edge_likeness(descriptors: ByteArray) -> FloatArray:
    """(n,) how far the gradients of descriptors (n, 128) lie along one line: 1 on an edge.

    The length of the mean of the gradients' directions, doubled so that both sides of an edge are
    one, weighted by their size.
    """
    by_direction = descriptors.reshape(-1, 16, 8).sum(axis=1, dtype=np.float64)
    doubled = np.exp(0.5j * np.pi * np.arange(8))
    total = np.maximum(by_direction.sum(axis=1), 1.0)
    return np.asarray(np.abs(by_direction @ doubled) / total)


def _fit(features: UprightFeatures) -> BoolArray:
    """(n,) which features count as evidence."""
    corner = edge_likeness(features.descriptors) < _MAX_EDGE
    return np.asarray(corner & (features.elevation > _LOWEST))


def _nearest_both_ways(squared: Float32) -> tuple[IntArray, IntArray, FloatArray]:
    """Rows, columns and relative distance of the nearest few of each row and of each column."""
    if min(squared.shape) <= _NEAREST:
        none = np.zeros(0, np.int64)
        return none, none, np.zeros(0)
    ahead, least = _nearest(squared)
    back, least_back = _nearest(np.ascontiguousarray(squared.T))
    count = squared.shape[1]
    rows, columns = np.arange(len(squared)), np.arange(count)
    pairs = np.unique(
        np.concatenate(
            [(rows[:, None] * count + ahead).ravel(), (back * count + columns[:, None]).ravel()]
        )
    )
    i, j = pairs // count, pairs % count
    return i, j, _relative_distances(squared[i, j], least[i], least_back[j])


def _nearest(squared: Float32) -> tuple[IntArray, Float32]:
    """(n, k) columns of the nearest of each row, and (n,) the distance of the next one.

    One search after the other for what is nearest still: five times as fast as a partial sort.
    The distances are changed meanwhile, and put back.
    """
    every = np.arange(len(squared))
    order = np.empty((len(squared), _NEAREST), np.int64)
    kept = np.empty(order.shape, np.float32)
    for k in range(_NEAREST):
        order[:, k] = squared.argmin(axis=1)
        kept[:, k] = squared[every, order[:, k]]
        squared[every, order[:, k]] = np.inf
    next_one = squared.min(axis=1)
    for k in reversed(range(_NEAREST)):  # a row that ran out of candidates takes one twice
        squared[every, order[:, k]] = kept[:, k]
    return order, next_one


def _relative_distances(squared: Float32, *next_ones: Float32) -> FloatArray:
    """(n,) product of the distance over that of the first one not kept, in either direction."""
    with np.errstate(invalid="ignore", divide="ignore"):
        shares = [np.sqrt(np.maximum(squared, 0.0) / other) for other in next_ones]
    product = np.asarray(shares[0] * shares[1], np.float64)
    return np.where(np.isfinite(product) & np.isfinite(squared), product, np.inf)


# --------------------------------------------------------------------------------------------
# What they say of a homing vector


class GuidedScore:
    """The candidates, prepared for scoring any homing vector."""

    def __init__(self, candidates: Candidates) -> None:
        """Prepares cells and blocks."""
        m = candidates.matches
        self._matches, self._log_size = m, candidates.log_size
        self._odds = candidates.right / (1.0 - candidates.right)
        cells = [
            _blocks(m.bearing_a, m.elevation_a, _CELL_DEG),
            _blocks(m.bearing_b, m.elevation_b, _CELL_DEG),
        ]
        _, self.match_cells = np.unique(np.column_stack(cells), axis=0, return_inverse=True)
        self.match_cells = self.match_cells.ravel()
        self._block_a = _blocks(m.bearing_a, m.elevation_a, _BLOCK_DEG)
        self._block_b = _blocks(m.bearing_b, m.elevation_b, _BLOCK_DEG)

    def of(
        self, direction: float, rotation: float, residuals: FloatArray, sigmas: float
    ) -> tuple[float, IntArray]:
        """Log of how much better the homing vector explains the candidates than chance.

        Args:
            direction: theta, radians.
            rotation: psi.
            residuals: (n,) normalised, NaN of candidates that contradict it.
            sigmas: largest residual of an inlier.

        Returns:
            The score, and (k,) the candidates that it is made of: each feature once.
        """
        rows = np.flatnonzero(np.isfinite(residuals))
        gains = gain(residuals[rows], sigmas, COMMON_CHANCE)
        gains *= self._size_gain(rows, direction, rotation)
        evidence = np.log1p(self._odds[rows] * gains)
        kept = self._each_once(rows, evidence)
        rows, evidence = rows[kept], evidence[kept]
        score = min(_with_limit(evidence, block[rows]) for block in (self._block_a, self._block_b))
        return score, np.sort(rows)

    def _size_gain(self, rows: IntArray, direction: float, rotation: float) -> FloatArray:
        """(k,) how much denser right ratios of sizes are than wrong ones.

        Distances are d ~ sin(phi - theta) and e ~ sin(delta - theta), sizes their inverses.
        """
        m = self._matches
        far_b = np.abs(np.sin(m.bearing_a[rows] - direction)) + _NEAR_LEG
        far_a = np.abs(np.sin(m.bearing_b[rows] + rotation - direction)) + _NEAR_LEG
        off = (self._log_size[rows] - np.log(far_b / far_a)) / _SIZE_SIGMA
        peak = _SIZE_RANGE / (_SIZE_SIGMA * np.sqrt(2.0 * np.pi))
        return np.asarray(peak * np.exp(-0.5 * off**2))

    def _each_once(self, rows: IntArray, evidence: FloatArray) -> IntArray:
        """Places among ``rows`` of the best of each cell, then of each feature of either view."""
        order = np.argsort(-evidence, kind="stable")
        for key in (self.match_cells, self._matches.index_a, self._matches.index_b):
            _, first = np.unique(key[rows[order]], return_index=True)
            order = order[np.sort(first)]
        return order


def _with_limit(evidence: FloatArray, blocks: IntArray) -> float:
    _, inverse = np.unique(blocks, return_inverse=True)
    sums = np.bincount(inverse.ravel(), evidence)
    return float(np.sum(BLOCK_FULL * np.log1p(sums / BLOCK_FULL)))


def _blocks(bearing: FloatArray, elevation: FloatArray, degrees: float) -> IntArray:
    """(n,) number of the block of a view that each feature lies in."""
    size = np.deg2rad(degrees)
    around, up = np.floor(np.mod(bearing, 2.0 * np.pi) / size), np.floor(elevation / size)
    return np.asarray(around * 1000 + up, np.int64)


# --------------------------------------------------------------------------------------------
# The homing vector from the features of two images, near or far apart
#
# The matches decide where many of them agree. Where they do not, or barely, their best hypotheses
# are looked at again with all candidate matches: refined on them, scored by them, and answered if
# the score is beyond what views reach that share nothing, and that of no other motion is. A clear
# answer stands unless they speak for another one.


_CLEAR_SUPPORT = 50  # independent inliers of an answer that is only confirmed
_CLEAR_SIGMA = np.deg2rad(0.5)  # of its direction: beyond, the matches leave a valley
_HYPOTHESES = 80  # that are scored again
_PAIR_REFINED = 24  # of them are refined
_WIDENED = 2.0  # times as far a candidate may lie from a hypothesis that is not refined

_LEAST_SCORE = 40.0
_RIVAL = np.deg2rad(15.0)  # nearer, solutions are one: a wrong one has rivals at any angle beyond
_LEAST_LEAD, _LEAST_LEAD_PART = 7.0, 0.09
"""Of the score over any different solution's, and as part of it. Scores grow with how alike places
are to each other, and so do their differences. Among the 240 ordered pairs of ``omni_home`` as
for driving the largest lead of a wrong one is 7.1, at a score of 37; in rooms of one furniture
seven of ten wrong ones have less than 0.08 of scores up to 194."""


def vector_between(
    present: OmniFeatures,
    target: OmniFeatures,
    matching: OmniMatchingSettings,
    settings: HomingVectorSettings,
    rng: np.random.Generator,
    alone: bool = True,
) -> tuple[TwoViewVector | Refusal, BearingMatches]:
    """The homing vector from one image's place to another's, and the tentative matches.

    Args:
        present: features of the image where the robot is.
        target: of the one where it is to go.
        matching: of features.
        settings: of the search, and when it refuses.
        rng: chooses RANSAC's samples.
        alone: nothing else is known of these images; else those before show which motion is right.
    """
    distances = planar_distances(present.sift, target.sift, matching)
    matches = match_features(present, target, matching, distances)
    search = HomingSearch(matches, settings, rng)
    answer = search.answer()
    final = _is_final(answer, search)
    if not settings.second_look or (final and not (answer and alone)):
        return answer, matches
    candidates = candidate_matches(present.sift, target.sift, distances)
    hypotheses = search.different(_HYPOTHESES)
    if len(candidates) < settings.min_inliers or not len(hypotheses):
        return answer, matches
    look = SecondLook(candidates, settings)
    if final and isinstance(answer, TwoViewVector):
        return look.confirmed(answer, hypotheses), matches
    return look.answer(hypotheses, alone), candidates.matches


def pair_generator(seed: int, a: int, b: int) -> np.random.Generator:
    """What RANSAC draws from for the pair of images (a, b), whichever process and order."""
    return np.random.default_rng((seed, a, b))


def _is_final(answer: TwoViewVector | Refusal, search: HomingSearch) -> bool:
    if isinstance(answer, Refusal):
        return answer.reason in (RefusalReason.AT_TARGET, RefusalReason.TOO_FEW_MATCHES)
    clear = search.independent_inliers(answer.inliers) >= _CLEAR_SUPPORT
    return clear and search.direction_sigma < _CLEAR_SIGMA


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """A refined hypothesis, its score, and the candidates (k,) that it is made of."""

    refined: Refined
    score: float
    rows: IntArray


class SecondLook:
    """All candidate matches of two views, against hypotheses of their homing vector."""

    def __init__(self, candidates: Candidates, settings: HomingVectorSettings) -> None:
        """Prepares test, refinement and score."""
        self._settings = settings
        self._candidates = candidates
        tilt = np.deg2rad(settings.tilt_sigma_deg)
        self._test = EpipolarTest.of(candidates.matches, tilt)
        self._score = GuidedScore(candidates)
        self._refinement = HomingRefinement(
            candidates.matches,
            (tilt, settings.height_sigma),
            INLIER_SIGMAS,
            LEAST_PARALLAX,
            candidates.right,
        )

    def answer(self, hypotheses: FloatArray, alone: bool = True) -> TwoViewVector | Refusal:
        """The best of hypotheses (c, 2), direction and rotation, or why none is the answer.

        ``alone``: nothing else is known of these two images, see :meth:`_alone`.
        """
        best, *others = self._solutions(hypotheses)
        rivals = [other for other in others if self._differ(best, other)]
        covariance = self._covariance(best, others)
        refusal = self._refusal(best, rivals[0].score if rivals else 0.0, covariance)
        if refusal is None and alone:
            refusal = self._alone(best, hypotheses)
        if refusal is not None:
            return refusal
        theta, psi = (float(v) for v in best.refined.parameters[:2])
        floor = np.deg2rad([self._settings.direction_floor_deg, self._settings.rotation_floor_deg])
        inliers = np.zeros(len(self._candidates), np.bool_)
        inliers[best.rows] = True
        support = len(rivals[0].rows) if rivals else 0
        # As of a first look: neither level nor clearly tilted.
        wrong = 0.5 if self._refinement.strain(best.refined) > _LEVEL else 0.0
        return TwoViewVector(theta, psi, covariance + np.diag(floor**2), inliers, support, wrong)

    def confirmed(self, first: TwoViewVector, hypotheses: FloatArray) -> TwoViewVector | Refusal:
        """The answer of a first look, unless the candidates speak more for a different one."""
        here = self._solutions(np.array([[first.direction, first.rotation]]))[0]
        best = self._solutions(hypotheses)[0]
        if best.score <= here.score or not self._differ(best, here):
            return first
        text = f"evidence of {here.score:.0f}, {best.score:.0f} for a different solution"
        return Refusal(RefusalReason.AMBIGUOUS, text)

    def _solutions(self, hypotheses: FloatArray) -> list[_Solution]:
        """The most promising ones, refined, the best first."""
        promise = np.array(self._promise(hypotheses))
        chosen = hypotheses[np.argsort(-promise, kind="stable")[:_PAIR_REFINED]]
        found = [
            _Solution(refined, *self._scored(refined))
            for refined in self._refinement.refine(chosen[:, 0], chosen[:, 1])
        ]
        return sorted(found, key=lambda s: -s.score)

    def _promise(self, hypotheses: FloatArray) -> list[float]:
        """(c,) scores of hypotheses that are a few degrees off."""
        theta, psi = hypotheses.T
        good, residuals = self._test.inliers(theta, psi, _WIDENED * INLIER_SIGMAS, LEAST_PARALLAX)
        residuals = np.where(good, residuals / _WIDENED, np.nan)
        return [
            self._score.of(theta[k], psi[k], residuals[:, k], INLIER_SIGMAS)[0]
            for k in range(len(hypotheses))
        ]

    def _scored(self, refined: Refined) -> tuple[float, IntArray]:
        residuals = np.where(refined.inliers, refined.residuals, np.nan)
        theta, psi = refined.parameters[:2]
        return self._score.of(theta, psi, residuals, INLIER_SIGMAS)

    def _alone(self, best: _Solution, hypotheses: FloatArray) -> Refusal | None:
        """Why the best solution is no answer to two images of which nothing else is known.

        Its tilts and height cost evidence as of their prior. And what it leaves must not be enough
        for an answer of its own: a mirror, and rooms alike, show several motions in earnest.
        """
        evidence = best.score - 0.5 * self._refinement.strain(best.refined)
        if evidence < _LEAST_SCORE:
            text = f"evidence of {evidence:.0f} after its tilts, of {_LEAST_SCORE:.0f} needed"
            return Refusal(RefusalReason.TOO_FEW_INLIERS, text)
        m = self._candidates.matches
        left = ~np.isin(m.index_a, m.index_a[best.rows]) & ~np.isin(m.index_b, m.index_b[best.rows])
        if np.count_nonzero(left) < self._settings.min_inliers:
            return None
        rest = SecondLook(self._candidates.select(left), self._settings)._solutions(hypotheses)
        second = max((other.score for other in rest if self._differ(best, other)), default=0.0)
        if second < _LEAST_SCORE:
            return None
        text = f"evidence of {best.score:.0f}, of the rest {second:.0f} for a different motion"
        return Refusal(RefusalReason.AMBIGUOUS, text)

    def _differ(self, one: _Solution, other: _Solution) -> bool:
        apart = np.abs(wrap(one.refined.parameters[:2] - other.refined.parameters[:2]))
        return bool(np.max(apart) > min(_RIVAL, np.deg2rad(self._settings.rival_angle_deg)))

    def _covariance(self, best: _Solution, others: list[_Solution]) -> FloatArray:
        """(2, 2) of the best solution, widened by those near it with nearly as much evidence.

        What less than a block's evidence separates is undecided: its full evidence is the unit.
        """
        near = [best, *(other for other in others if not self._differ(best, other))]
        scores = np.array([solution.score for solution in near])
        return spread_over([solution.refined for solution in near], scores, BLOCK_FULL)

    def _refusal(self, best: _Solution, rival: float, covariance: FloatArray) -> Refusal | None:
        sigma = float(np.rad2deg(np.sqrt(covariance[0, 0])))
        support = len(best.rows)
        if support < self._settings.min_inliers or best.score < _LEAST_SCORE:
            reason = RefusalReason.TOO_FEW_INLIERS
            text = f"{support} inliers, evidence of {best.score:.0f}, of {_LEAST_SCORE:.0f} needed"
        elif best.score - rival < max(_LEAST_LEAD, _LEAST_LEAD_PART * best.score):
            reason = RefusalReason.AMBIGUOUS
            text = f"evidence of {best.score:.0f}, {rival:.0f} for a different solution"
        elif sigma > self._settings.max_direction_sigma_deg:
            reason = RefusalReason.UNCERTAIN
            text = f"direction is uncertain by {sigma:.1f} deg"
        else:
            return None
        return Refusal(reason, text)
