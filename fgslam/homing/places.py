"""Where along a taught path an image was taken, and where its next path image lies.

Each image is matched with the path images that are believed to be near and with those that look
alike; a Bayes filter along the path (:mod:`.localisation`) joins what they say. So a robot that was
put down anywhere, or was carried off, finds its place, and a wall that resembles another one does
not mislead it. The homing vector to the next path image comes from the same matches: no tracking,
so images may be far apart, or the robot be driven by others.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, cast

import numpy as np
from scipy.sparse import csr_matrix, diags
from scipy.stats import norm, t as student

from fgslam.cameras.omni import Equirectangular, LensCamera, OmniCamera, RadialCamera
from fgslam.core.arrays import FloatArray, Image, IntArray
from fgslam.core.bearings import BearingMatches, OmniFeatures, Refusal, RefusalReason, TwoViewVector
from fgslam.core.geometry import wrap
from fgslam.frontend.features.omni import OmniFeatureExtractor
from fgslam.frontend.homing.vector import vector_between
from fgslam.homing.active import CONTRADICTION_DEG, parallax
from fgslam.homing.features import compacted
from fgslam.homing.front_end import compare_views
from fgslam.homing.links import Answer, VisualWords, between_misfit
from fgslam.homing.route import MetricPoses, PathMemory, is_near
from fgslam.homing.settings import FrontEndSettings, LocalisationSettings
from fgslam.homing.steering import SURE, MetricPlace, PathPlace

_ALL = 60  # so many path images at most are all tried while the place is not known
_OTHERS = 3  # path images elsewhere that tell how many matches a wrong place has
_STEP_PRIOR = 3.0 * np.array([0.1, 0.5, 0.4])
"""Chances to be at the path image before, at the same or at the one after by the next image, as if
seen in so many steps."""
_KEPT = 0.9  # of what earlier steps tell of the next one: of some ten
_LOOKED_AGAIN = 5  # path images at most that are looked at again by all candidate matches
_EVEN = 0.5  # chance that a vector is wrong which all candidate matches do not tell from others
_CANDIDATES_EACH = 2.5  # inliers of all candidates over those of matches, on a school floor
_ALIKE = 0.02
"""Chance that a place looks like another one of the path: a corridor built twice. As of a leap."""

_ON_ROUTE = 0.5  # that images are of the route at all, before the first and when carried off
_LEAVING = 0.02  # chance to have left the route, or to have come upon it, since the last image
_MISSED = 0.25  # chance that an image on the route has no homing vector to the nearest path image

_ELSEWHERE = 12.0
"""Evidence, in inliers, that the best of a route's images may get from another place: what the
homing vector itself demands, and the background of the filter. No number of matches without a
homing vector exceeds it: of many wrong images one always has the most."""

_POWER = 3.0
"""Of the evidence. From single images of eight rendered drives, a film and a school floor the place
is best known by its fourth to sixth power; neighbouring images agree in part. By half or
twice the power no known place was wrong in 40 drives along these routes."""

_NEAR = 0.25
"""Parallax to a path image over that to the one after it, at which the robot turns to the latter:
a third of a leg is left. Nearer, the direction to it is noise."""

_REACHED, _BESIDE = 0.07, 0.25
"""Parts of the last leg: along it, as `SWITCH_FRACTION` of the controller, and in all."""

_CONTRADICTION = np.deg2rad(CONTRADICTION_DEG)
_TRIANGLE = np.deg2rad(10.0)  # of a robot and two path images; as of links of a map
_AGREEING = 3  # images in a row that agree, until what contradicts those before is believed
_SIGMAS = 4.0  # between two homing vectors of which one must be wrong
_STREAM = 9  # of the seed's random numbers


@dataclass(slots=True, eq=False)
class _Aim:
    """The path image that is aimed at, and what was seen of it.

    Attributes:
        target: its number.
        across: direction of the robot's way in the target's axes, radians; NaN before it is known.
        heading: its heading minus the robot's, radians; NaN where its turns are not known. A vector
            that is wrong by half a turn has the right way across.
        doubted: one that contradicted it, and must be seen again.
        agreeing: images in a row that saw it.
        widest: largest parallax so far, radians.
        after: as ``across``, of the path image after the target, in the last image.
        fresh: it was not looked at yet.
        elsewhere: images in a row from where the robot would not come by on its way.
        left: of the last leg, along it, in the last image; NaN where it was not seen.
    """

    target: int
    across: float = float("nan")
    heading: float = float("nan")
    doubted: float = float("nan")
    agreeing: int = 0
    widest: float = 0.0
    after: float = float("nan")
    fresh: bool = True
    elsewhere: int = 0
    left: float = float("nan")


class PathPlaces:
    """Follows a robot along a path, image by image."""

    def __init__(self, path: PathMemory, settings: FrontEndSettings, seed: int = 0) -> None:
        """Knows nothing of the place at first.

        Args:
            path: taught.
            settings: of matching and homing vector.
            seed: of everything random.
        """
        self._path, self._settings = path, settings
        self._rng = np.random.default_rng((seed, _STREAM))
        self._parallax: dict[int, float] = {}
        self._matches: dict[int, BearingMatches] = {}
        self._shown: dict[int, IntArray] = {}
        self._twice, self._repeated = set[int](), set[int]()
        self._steps = _STEP_PRIOR
        self._spoke = set[int]()
        self._probability, self._on_route = 0.0, _ON_ROUTE
        localisation = LocalisationSettings()
        self._continuity = Continuity(localisation.leap)
        self._before: OmniFeatures | None = None
        self._localiser = Localiser(
            _along(len(path), _STEP_PRIOR),
            VisualWords(path.images, self._rng),
            self._link,
            localisation,
            self._weighed,
            _POWER,
        )
        self._aim: _Aim | None = None
        self._legs: dict[int, tuple[Answer, BearingMatches]] = {}

    @property
    def belief(self) -> FloatArray:
        """(n,) probability of each path image to be the nearest one."""
        return self._localiser.belief.copy()

    def look(self, features: OmniFeatures) -> PathPlace:
        """The place of one more image."""
        self._parallax, self._matches = {}, {}
        self._before_shown, self._shown = self._shown, {}
        off = self._localiser.leap = self._carried_off(features)
        if off > _OFF:
            self._probability, self._aim = 0.0, None
        lost = self._probability < SURE
        every = range(len(self._path))
        wanted = every if lost and len(every) <= _ALL else self._wanted()
        before, expected = self._localiser.belief, self._localiser.expected()
        belief = self._localiser.update(features, wanted)
        self._learn_steps(before)
        self._on_route = self._still_on_route(off, float(expected @ self._on_route_evidence()))
        nearest = int(np.argmax(belief))
        near = slice(max(nearest - 1, 0), nearest + 2)
        believed = self._on_route * float(belief[near].sum())
        probability = self._probability = believed * self._spoken_for(near)
        if probability < SURE:
            refusal = f"place not known: {100.0 * probability:.0f} % at {self._path.names[nearest]}"
            return PathPlace(nearest, probability, nearest, None, refusal, 1.0, False)
        aim = self._aimed(nearest)
        reached = self._reached(aim, nearest)
        vector, refusal = self._vector(aim, nearest, features)
        metric = metric_place(self._path.metric, aim.target, self._left(aim.target))
        remaining = self._remaining(aim)
        return PathPlace(
            nearest, probability, aim.target, vector, refusal, remaining, reached, metric
        )

    # ----------------------------------------------------------------------------------------

    def _link(self, image: OmniFeatures, nodes: Sequence[int]) -> dict[int, Answer]:
        """Homing vectors to path images; where none is clear, by all candidate matches."""
        found = dict[int, Answer]()
        for k in nodes:
            target = self._path.images[k]
            answer, self._matches[k] = compare_views(image, target, self._settings, self._rng)
            found[k] = self._seen(k, answer, self._matches[k])
        self._twice, self._repeated = set(), set()
        if not any(map(_is_clear, found.values())):
            best = sorted(nodes, key=lambda k: (inliers_of(found)[k], len(self._matches[k])))
            self._twice = {*best[-_LOOKED_AGAIN:], *self._wanted()} & found.keys()
        return found | {k: self._looked_again(image, k, found[k]) for k in sorted(self._twice)}

    def _looked_again(self, image: OmniFeatures, node: int, first: Answer) -> Answer:
        """By all candidate matches; what the first look alone sees may as well be another one."""
        s, target = self._settings, self._path.images[node]
        matching, rng = s.features.matching, self._rng
        answer, matches = vector_between(image, target, matching, s.homing_vector, rng, alone=False)
        if answer:
            return self._seen(node, answer, matches)
        if answer.reason is RefusalReason.AMBIGUOUS and not is_near(answer, self._matches[node]):
            self._repeated.add(node)
        return (
            replace(first, wrong_probability=_EVEN) if first else self._seen(node, answer, matches)
        )

    def _seen(self, node: int, answer: Answer, matches: BearingMatches) -> Answer:
        """The answer, whose parallax is kept."""
        if isinstance(answer, TwoViewVector):
            inliers = matches.select(answer.inliers)
            self._parallax[node] = parallax(inliers, answer.rotation)
            self._shown[node] = 2 * inliers.index_b + inliers.kind
        elif answer.reason is RefusalReason.AT_TARGET:
            self._parallax[node] = 0.0
        return answer

    def _learn_steps(self, before: FloatArray) -> None:
        """How the robot goes along the path, by what its last steps seem to have been."""
        here, leap = self._localiser.likelihood, self._localiser.leap
        here = (here / here.max()) ** _POWER
        each = np.array([before[1:] @ here[:-1], before @ here, before[:-1] @ here[1:]])
        each *= (1.0 - leap) * self._steps / self._steps.sum()
        found = each / (each.sum() + leap * here.mean())
        self._steps = _STEP_PRIOR + _KEPT * (self._steps - _STEP_PRIOR) + found
        self._localiser.transition = _along(len(before), self._steps)

    def _wanted(self) -> list[int]:
        """Path images that are matched in any case: the one aimed at and its neighbours."""
        if self._aim is None:
            return []
        near = range(self._aim.target - 1, self._aim.target + 2)
        return [k for k in near if 0 <= k < len(self._path)]

    def _carried_off(self, features: OmniFeatures) -> float:
        """Probability of it since the last image, by what both have in common."""
        before, self._before = self._before, compacted(features)
        if before is None:
            return self._continuity.chance
        answer, matches = compare_views(before, self._before, self._settings, self._rng)
        if self._aim is not None:
            self._aim.heading -= np.nan if answer.rotation is None else answer.rotation
        most = min(len(one.sift) + len(one.columns) for one in (before, self._before))
        return self._continuity.carried_off(in_common(answer, matches), most)

    def _spoken_for(self, near: slice) -> float:
        """1 where the image itself speaks for a place as much as for any other; else less.

        What is believed from the images before is not to be stated against the present one. It
        counts by the place's share of its own evidence and that of the better one: half at most.
        Half counts, too, what no homing vector speaks for, or one path image alone in this image
        and the last while the place was not known: a corridor may be built twice.
        """
        spoke, answers = self._spoke, self._localiser.answers.items()
        self._spoke = {k for k, a in answers if a or is_near(a, self._matches[k])}
        within = set(range(*near.indices(len(self._path))))
        least = 1 if self._probability >= SURE else 2
        if not self._spoke & within or len((self._spoke | spoke) & within) < least:
            return 0.5
        here = float(self._localiser.likelihood[near].max())
        best = float(self._localiser.likelihood.max())
        return 1.0 if here >= best else here / (here + best)

    def _alike(self, best: int) -> float:
        """Chance that an image shows the like of a path image, and not its place.

        It is that of the things seen: as far as the last image saw the same ones there, this one is
        no other witness of the place.
        """
        if best not in self._shown:
            return _ALIKE
        before = self._before_shown.get(best, np.zeros(0))
        return float(_ALIKE ** np.mean(~np.isin(self._shown[best], before)))

    def _still_on_route(self, off: float, likelihood: float) -> float:
        """Probability that the image was taken on the route at all.

        Args:
            off: that the robot was carried off since the last one.
            likelihood: of the image if it was, over that elsewhere.
        """
        on = self._on_route
        on = on * (1.0 - _LEAVING) + (1.0 - on) * _LEAVING
        on = on * (1.0 - off) + _ON_ROUTE * off
        return on * likelihood / (on * likelihood + 1.0 - on)

    def _on_route_evidence(self) -> FloatArray:
        """(n,) how much likelier the image is at each path image than elsewhere: by inliers."""
        evidence = self._localiser.likelihood.copy()
        for k, answer in self._localiser.answers.items():
            at_target = not answer and answer.reason is RefusalReason.AT_TARGET
            if (not answer or k in self._repeated) and not at_target:
                evidence[k] = min(evidence[k], _ELSEWHERE)
        return np.asarray(np.maximum((evidence / _ELSEWHERE) ** _POWER, _MISSED))

    def _weighed(self, answers: Mapping[int, Answer]) -> dict[int, float]:
        """Inliers of path images, and by how much their matches exceed those of wrong places.

        In dim light the right place often has too few inliers for a homing vector, but more
        matches than the wrong ones. Not so where several motions fit: lockers, one like the other.
        """
        inliers = inliers_of(answers)
        inliers |= {
            k: inliers[k] / _CANDIDATES_EACH for k in self._twice if not _is_even(answers[k])
        }
        inliers |= dict.fromkeys(self._repeated, 0.0)
        counts = {k: len(self._matches[k]) for k in answers}
        best = max(counts, key=lambda k: (inliers[k], counts[k]))
        others = [count for k, count in counts.items() if abs(k - best) > 1]
        usual = _most_by_chance(others) if len(others) >= _OTHERS else max(counts.values())
        found = {k: inliers[k] + max(counts[k] - usual, 0.0) for k in answers}
        found |= dict.fromkeys(self._repeated, 0.0)
        self._localiser.alike = self._alike(max(found, key=found.__getitem__))
        return found

    def _aimed(self, nearest: int) -> _Aim:
        """The path image to go to: the nearest one or, once that is passed, the one after it."""
        if self._aim is None or self._elsewhere(self._aim, nearest):
            self._aim = _Aim(nearest)
        last = len(self._path) - 1
        if self._aim.target == nearest < last and self._passed(self._aim):
            self._aim = _Aim(nearest + 1)
        return self._aim

    def _elsewhere(self, aim: _Aim, nearest: int) -> bool:
        """Whether the target lies behind, or far off: unclear, or as images in a row agree."""
        aim.elsewhere = aim.elsewhere + 1 if aim.target > nearest + 1 else 0
        seen = self._localiser.answers.get(aim.target)
        unclear = aim.elsewhere > 0 and not (seen and _is_clear(seen))
        return aim.target < nearest or unclear or aim.elsewhere >= _AGREEING

    def _passed(self, aim: _Aim) -> bool:
        """Whether the path image lies behind, as seen from the robot's way to the one after it.

        On the way that one must have been seen alike in two images: the robot will go by it.
        """
        k = aim.target
        here, ahead = self._parallax.get(k), self._parallax.get(k + 1)
        answer, before = self._localiser.answers.get(k + 1), aim.after
        aim.after = _across(answer) if isinstance(answer, TwoViewVector) else float("nan")
        if here == 0.0:
            return True
        agreed = aim.fresh or _away(aim.after, before) <= _CONTRADICTION
        aim.fresh = False
        if here is None or ahead is None or not agreed:
            return False
        return here < _NEAR * ahead or self._apart(k, k + 1) > np.pi / 2

    def _confirmed(self, aim: _Aim, vector: TwoViewVector) -> bool:
        """Whether enough images in a row agree on what contradicts those before."""
        across = _across(vector)
        aim.agreeing = aim.agreeing + 1 if _away(across, aim.doubted) <= _limit(vector) else 1
        aim.doubted = across
        return aim.agreeing >= _AGREEING

    def _apart(self, a: int, b: int) -> float:
        """Angle between the directions to two path images; 0 where one is not known."""
        first, second = self._localiser.answers.get(a), self._localiser.answers.get(b)
        if not isinstance(first, TwoViewVector) or not isinstance(second, TwoViewVector):
            return 0.0
        return abs(float(wrap(np.array(first.direction - second.direction))))

    def _remaining(self, aim: _Aim) -> float:
        seen = self._parallax.get(aim.target)
        if seen is None or aim.widest == 0.0:
            return 1.0 if seen is None else 0.0
        return min(1.0, seen / aim.widest)

    def _left(self, target: int) -> float:
        """Part of the leg to a path image that is left, by parallax to both its ends; NaN else."""
        before, after = (self._parallax.get(k, float("nan")) for k in (target - 1, target))
        return after / (before + after) if before + after > 0.0 else float("nan")

    def _reached(self, aim: _Aim, nearest: int) -> bool:
        """Whether the path's end is: two images in a row approach it, or are there.

        What is left is measured along the last leg as it was taught, as the robot may pass next to
        the end; and no nearer than to half its last step, as the next image would be farther off.
        """
        last = len(self._path) - 1
        before, aim.left = aim.left, float("nan")
        if aim.target != last or last not in self._parallax:
            return False
        far, aim.left = self._left_of_last_leg(aim)
        if nearest != last or not np.isfinite(before):
            return False
        return far <= _BESIDE and aim.left <= max(_REACHED, 0.5 * (before - aim.left))

    def _left_of_last_leg(self, aim: _Aim) -> tuple[float, float]:
        """Distance of the path's end, and the part of it along the last leg; in legs."""
        last = len(self._path) - 1
        seen, answer = self._parallax[last], self._localiser.answers[last]
        across, length = _leg_of(*self._leg(last - 1)) if last else (float("nan"), float("nan"))
        if not np.isfinite(length):
            length = max(self._parallax.get(last - 1, 0.0), aim.widest, 1e-9)
        far = seen / length
        if isinstance(answer, Refusal) or not np.isfinite(across):
            return far, far
        return far, far * float(np.cos(_across(answer) - across))

    def _vector(
        self, aim: _Aim, nearest: int, features: OmniFeatures
    ) -> tuple[TwoViewVector | None, str]:
        """The homing vector to the target, unless it contradicts those before it for once.

        At little parallax, or with a camera that is tilted, another direction may fit nearly as
        well. Where earlier images tell which is right that does no harm; else all candidate
        matches must tell, or it be seen alike in several images. The sigma takes in what it misses
        the taught triangle by and, where its own does not hold, what it differs from those before.
        """
        answer = self._localiser.answers.get(aim.target)
        if answer is None:
            return None, "not matched"
        vector = answer if isinstance(answer, TwoViewVector) else None
        why = self._open(aim, answer)
        if why:
            twice = aim.target in self._twice
            again = answer if twice else self._looked_again(features, aim.target, answer)
            if isinstance(again, TwoViewVector) and not _is_even(again):
                vector = again
            elif vector is not None and not self._confirmed(aim, vector):
                vector = None
        if vector is None:
            return None, why
        misfit = self._misfit_of_path(aim.target, vector)
        unclear = why or aim.target > nearest + 1 or aim.target in self._twice
        if aim.target != nearest and (misfit == np.inf or (unclear and np.isnan(misfit))):
            return None, "is not confirmed by the path images before and after"
        before = _away(_across(vector), aim.across) if _is_even(vector) else np.nan
        off = np.nan_to_num([before, misfit], posinf=0.0).max()
        vector = replace(vector, covariance=vector.covariance + off**2 * np.eye(2))
        aim.widest = max(aim.widest, self._parallax.get(aim.target, 0.0))
        aim.across, aim.heading, aim.agreeing = _across(vector), vector.rotation, 0
        return vector, ""

    def _misfit_of_path(self, target: int, vector: TwoViewVector) -> float:
        """Angle by which the target, seen from the robot, misses a triangle as taught, radians.

        With the path image before or after; the lesser one, as of the other the vector to that path
        image may be wrong. Inf: more than chance explains; NaN: there is no triangle.
        """
        misfits = list[float]()
        for begin in (target - 1, target):
            seen = self._localiser.answers.get(2 * begin + 1 - target)
            leg = self._leg(begin)[0] if seen and not _is_even(seen) else None
            if seen and leg:
                first, whole = (vector, seen) if begin == target else (seen, vector)
                turned = _away(whole.rotation, first.rotation + leg.rotation)
                onwards = leg.direction + first.rotation
                aside = between_misfit(first.direction, onwards, whole.direction)
                # Of a way back the third side may have any direction: it confirms nothing.
                if _away(onwards, first.direction) < np.pi - _TRIANGLE:
                    misfit, limit = max(turned, aside), _limit(vector, seen, leg, least=_TRIANGLE)
                    misfits.append(misfit if misfit <= limit else np.inf)
        return min(misfits, default=np.nan)

    def _leg(self, begin: int) -> tuple[Answer, BearingMatches]:
        """Of a path image to the one after it."""
        if begin not in self._legs:
            first, second = self._path.images[begin : begin + 2]
            self._legs[begin] = compare_views(first, second, self._settings, self._rng)
        return self._legs[begin]

    def _open(self, aim: _Aim, answer: Answer) -> str:
        """Why a homing vector to the target is not to be trusted by itself; empty if it is."""
        if isinstance(answer, Refusal):
            return answer.details
        if np.isfinite(aim.across):
            off = (_away(_across(answer), aim.across), _away(answer.rotation, aim.heading))
            contradicts = any(angle > _limit(answer) for angle in off)
            return "contradicts those before, needs other images that agree" if contradicts else ""
        if answer.wrong_probability > 1.0 - SURE:
            return "fits another direction nearly as well, needs other images that agree"
        return ""


def _limit(*vectors: TwoViewVector, least: float = _CONTRADICTION) -> float:
    """Angle up to which homing vectors may differ from each other and be right, radians."""
    variance = sum(float(np.trace(vector.covariance)) for vector in vectors)
    return max(least, _SIGMAS * float(np.sqrt(variance)))


def _along(count: int, steps: FloatArray) -> FloatArray:
    """(n, n) chances to be at each path image by the next image; ``steps`` are in proportion."""
    back, _, on = steps / steps.sum()
    moves = np.eye(count, k=1) * on + np.eye(count, k=-1) * back
    return np.asarray(moves + np.diag(1.0 - moves.sum(axis=1)))


def _is_clear(answer: Answer) -> bool:
    """Whether a vector is so much likelier than any other that a second look shows no more."""
    return isinstance(answer, TwoViewVector) and answer.wrong_probability <= 1.0 - SURE


def _is_even(answer: Answer) -> bool:
    return isinstance(answer, TwoViewVector) and answer.wrong_probability >= _EVEN


def _most_by_chance(counts: Sequence[int]) -> float:
    """Matches of the one of so many wrong places that has the most, as far as their spread shows.

    A normal distribution's quantile; counts of independent matches spread by their root at least.
    """
    middle = float(np.median(counts))
    spread = max(1.4826 * float(np.median(np.abs(np.array(counts) - middle))), np.sqrt(middle))
    return float(middle + spread * norm.ppf(1.0 - 1.0 / (len(counts) + 1.0)))


def _leg_of(answer: Answer, matches: BearingMatches) -> tuple[float, float]:
    """Direction of a leg in the axes of its end, and its parallax, radians; NaN if refused."""
    if isinstance(answer, Refusal):
        return float("nan"), float("nan")
    return _across(answer), parallax(matches.select(answer.inliers), answer.rotation)


def _across(vector: TwoViewVector) -> float:
    """Direction of the way to a target in the target's axes: it does not change as robots turn."""
    return float(wrap(np.array(vector.direction - vector.rotation)))


def _away(one: float, other: float) -> float:
    """Absolute difference of two angles; NaN where one is not known."""
    return abs(float(wrap(np.array(one - other)))) if np.isfinite(one + other) else float("nan")


# --------------------------------------------------------------------------------------------
# Localisation in a topological map: a Bayes filter over its nodes (I)
#
# Images are compared as nodes are: by how many of their features agree on one homing. The belief is
# a distribution over nodes; between two images it stays, moves along an edge, or, rarely, leaps
# anywhere, so that a robot that was carried off finds itself again.


Linker: TypeAlias = Callable[[OmniFeatures, Sequence[int]], Mapping[int, Answer]]
"""The homing vectors from an image's place to those of nodes, by their numbers."""

_BACKGROUND = 4.0  # inliers that a wrong place may get, on average

_AT_NODE = 100.0  # inliers, at least, of an image that was taken at the node itself

_STAY = 0.5  # chance to be still at the node of the last image

Weigher: TypeAlias = Callable[[Mapping[int, Answer]], Mapping[int, float]]
"""What speaks for each node, in inliers, of the answers of those that were matched."""


class Localiser:
    """Probability of each node to be where the robot is, or nearest to it.

    Attributes:
        belief: (n,) probabilities; uniform before the first image.
        likelihood: (n,) of the last image at each node, up to a factor.
        answers: homing vectors of the last image to those nodes that it was matched with.
        leap: chance to be anywhere at all by the next image; the settings' unless it is set.
        alike: chance that the last image shows the like of a node elsewhere: no evidence.
        transition: (n, n) chances to go from row to column between two images, without leaps.
    """

    def __init__(
        self,
        transition: FloatArray,
        words: VisualWords,
        linker: Linker,
        settings: LocalisationSettings,
        weigh: Weigher | None = None,
        power: float = 1.0,
    ) -> None:
        """Begins with a uniform belief.

        Args:
            transition: (n, n) chances to go from row to column between two images, without leaps;
                along links: :func:`transition_along`.
            words: of the map's images, in their order.
            linker: homing vectors from the robot's image to nodes'.
            settings: chances and the number of nodes to match with.
            weigh: evidence of answers; None: their inliers.
            power: of the likelihood of an image: how much it counts.
        """
        self._words = words
        self._linker = linker
        self._settings = settings
        self._weigh = weigh or inliers_of
        self.transition = transition
        self._power = power
        self.leap, self.alike = settings.leap, 0.0
        self.belief: FloatArray = np.full(len(transition), 1.0 / max(len(transition), 1))
        self.answers: dict[int, Answer] = {}
        self.likelihood: FloatArray = np.ones(len(transition))
        self._fresh = True

    def update(self, image: OmniFeatures, also: Collection[int] = ()) -> FloatArray:
        """The belief after one more image.

        Args:
            image: its features.
            also: nodes that it is matched with in any case.

        Returns:
            (n,) the belief, a copy.
        """
        expected = self.expected()
        self._fresh = False
        self.likelihood = likelihoods(self._supports(image, expected, also), _BACKGROUND)
        shown = (self.likelihood / self.likelihood.max()) ** self._power
        posterior = expected * (self.alike + (1.0 - self.alike) * shown)
        self.belief = posterior / posterior.sum()
        return self.belief.copy()

    def expected(self) -> FloatArray:
        """(n,) the belief before the next image is seen."""
        return self.belief if self._fresh else self._moved()

    def best(self) -> tuple[int, float]:
        """The most probable node and its probability."""
        node = int(np.argmax(self.belief))
        return node, float(self.belief[node])

    def _moved(self) -> FloatArray:
        moved = self.belief @ self.transition
        return (1.0 - self.leap) * moved + self.leap / len(self.belief)

    def _supports(
        self, image: OmniFeatures, expected: FloatArray, also: Collection[int]
    ) -> FloatArray:
        """(n,) evidence of the nodes that are worth a match; 0 for the others."""
        nodes = np.union1d(self._candidates(image, expected), np.array([*also], dtype=np.int64))
        self.answers = dict(self._linker(image, nodes.tolist()))
        out = np.zeros(len(self.belief))
        for node, evidence in self._weigh(self.answers).items():
            out[node] = evidence
        return out

    def _candidates(self, image: OmniFeatures, expected: FloatArray) -> IntArray:
        """Nodes that look alike, and those that the belief expects, half and half."""
        most = self._settings.candidates
        if most == 0 or most >= len(self.belief):
            return np.arange(len(self.belief))
        alike = np.argsort(-self._words.likeness(image), kind="stable")
        likely = np.argsort(-expected, kind="stable")[: most // 2]
        rest = alike[~np.isin(alike, likely)][: most - len(likely)]
        return np.sort(np.concatenate([likely, rest]))


def inliers_of(answers: Mapping[int, Answer]) -> dict[int, float]:
    """Inliers of each node; where an image was taken at a node itself, as many as any other has."""
    out = {node: float(answer.support if answer else 0) for node, answer in answers.items()}
    best = max([*out.values(), _AT_NODE])
    at = (n for n, a in answers.items() if not a and a.reason is RefusalReason.AT_TARGET)
    return out | dict.fromkeys(at, best)


def likelihoods(supports: FloatArray, background: float) -> FloatArray:
    """(n,) of an image at each node, up to a factor: its inliers and those of a wrong place.

    Linear, not exponential as independent inliers would have it: features of one image stand and
    fall together (a poster that hangs in two rooms brings all of its own), and a single image must
    not decide.
    """
    return np.asarray(supports, dtype=np.float64) + background


def transition_along(links: csr_matrix) -> FloatArray:
    """(n, n) chances to go from row to column between two images, without leaps.

    ``links`` (n, n) are costs; of a place's links those that cost less are taken sooner.
    """
    graph = links.copy()
    graph.data = 1.0 / graph.data
    out = np.asarray(graph.sum(axis=1)).ravel()
    alone = out == 0.0
    moves = diags(np.where(alone, 0.0, (1.0 - _STAY) / np.where(alone, 1.0, out))) @ graph
    stay = np.where(alone, 1.0, _STAY)
    return np.asarray(moves.toarray() + np.diag(stay))


# --------------------------------------------------------------------------------------------
# Whether a robot went on from its last image or was carried off: what two images have in common
#
# Neighbouring images of one drive share most of their features, about as many each time; from one
# place to another they share few. How many are usual, and how widely that varies, is learned from
# the drive itself, so that images far apart or in dim light are no alarm where they are the rule,
# nor for long where they become the rule.


_STEPS = 20
"""Last steps that tell what is usual. With the one of the prior they vary by a fifth at least: a
robot that stood and drives on (0.6 of the features left) is none that was carried off."""

_OFF = 0.5  # from this probability on a step does not count as usual
_AGAIN = 5
"""Steps within which none is carried off twice: what seems so is a drive that has changed, as it
went faster, in dimmer light, or on after a long stand."""

_SPREAD = 1.0  # prior, in one step's weight: of the logarithm, a factor e
_HERE = (RefusalReason.AT_TARGET, RefusalReason.AMBIGUOUS, RefusalReason.UNCERTAIN)


class Continuity:
    """What two neighbouring images of a drive had in common so far.

    Attributes:
        chance: to be carried off from one image to the next, before they are seen.
    """

    def __init__(self, chance: float) -> None:
        """Begins before the first step.

        Args:
            chance: to be carried off from one image to the next, before they are seen.
        """
        self.chance = chance
        self._logs: deque[float] = deque(maxlen=_STEPS)
        self._since: list[float] = []

    def carried_off(self, common: int, most: int) -> float:
        """Probability that the robot was carried off between two images.

        Where it went on, the logarithm of the common features is as in the steps before
        (Student's t, the prediction for unknown mean and variance); where it was carried off,
        anything from none to ``most`` is as likely. A second such step soon after the first is
        reported too, but what is usual is learned again from the first one on.

        Args:
            common: features of both images that agree on one motion.
            most: that could have been.
        """
        log = float(np.log1p(common))
        off = self.chance / max(float(np.log1p(most)), log, 1.0)
        if not self._logs:
            self._logs.append(log)
            return self.chance
        usual = np.array(self._logs)
        n, mean = len(usual), float(usual.mean())
        scatter = (_SPREAD**2 + float(np.sum((usual - mean) ** 2))) / (n + 1.0)
        on = student.pdf(min(log - mean, 0.0), n, scale=np.sqrt(scatter * (1.0 + 1.0 / n)))
        probability = float(off / (off + (1.0 - self.chance) * on))
        self._learn(log, probability >= _OFF)
        return probability

    def _learn(self, log: float, off: bool) -> None:
        """Takes a step as usual; one that is not, from the second on."""
        if off and self._since:
            self._logs.clear()
            self._logs.extend([*self._since, log])
            self._since = []
            return
        if not off:
            self._logs.append(log)
        if off or self._since:
            self._since.append(log)
        if len(self._since) >= _AGAIN:
            self._since = []


def in_common(answer: Answer, matches: BearingMatches) -> int:
    """Features of two images that agree on one motion; all matches where there was next to none."""
    if answer:
        return answer.support
    return len(matches) if answer.reason in _HERE else 0


# --------------------------------------------------------------------------------------------
# Metres on a path whose images carry poses of SLAM on the same drive


LEFT_SIGMA = 0.12
"""Of the part of a leg that is left, by parallax, legs: at 45 places on legs of 2 m in the
rendered house it was off by 0.11 (root mean square; 0.34 at most)."""


def metric_place(metric: MetricPoses | None, target: int, left: float) -> MetricPlace | None:
    """The place on the straight line from the path image before a target to the target.

    Args:
        metric: of the path; None where it has none.
        target: number of the path image that is next.
        left: part of the leg that is left; NaN where it is not known.

    Returns:
        None where anything of it is not known.
    """
    if metric is None or target < 1 or not np.isfinite(left):
        return None
    before, after = metric.poses[target - 1 : target + 1, :3, 3]
    leg = float(np.linalg.norm(after - before))
    if not np.isfinite(leg):
        return None
    variance = metric.covariances[target - 1 : target + 1, 3:, 3:].trace(axis1=1, axis2=2)
    parts = np.array([left, 1.0 - left])
    sigma = float(np.sqrt((LEFT_SIGMA * leg) ** 2 + parts @ np.nan_to_num(variance)))
    return MetricPlace(left * before + (1.0 - left) * after, sigma, left * leg)


# --------------------------------------------------------------------------------------------
# Whether pictures fit a route only when they are mirrored or turned over
#
# Descriptors of a mirrored picture fit nothing, or what is alike by chance, and homing vectors
# then point anywhere. So the first pictures are compared with the route both as they are and as
# they would be if a side was mistaken: what they have in common with a path image shows which is
# right.


Turn: TypeAlias = Callable[[Image], Image]

_SIDE_CANDIDATES = 6  # path images that a picture is compared with: those that look most alike
_CLEARLY = 2.0  # times the features in common; what is alike by chance varies by its root
_SIDES_AGREEING = 3  # pictures that tell the same
_SIDE_STREAM = 10  # of the seed's random numbers


@dataclass(frozen=True, slots=True, eq=False)
class Mistaken:
    """A way in which pictures may be other than stated.

    Attributes:
        fault: what is wrong, and the mend.
        camera: with which they would be right.
        turn: that makes them right.
    """

    fault: str
    camera: OmniCamera
    turn: Turn


class PictureSides:
    """Compares pictures with a route until it is clear which way they fit.

    Attributes:
        settled: whether a picture fits as it is, so that there is nothing more to ask.
    """

    def __init__(
        self, camera: OmniCamera, path: PathMemory, settings: FrontEndSettings, seed: int = 0
    ) -> None:
        """``camera`` is that of the pictures, as stated."""
        self._path, self._settings = path, settings
        self._rng = np.random.default_rng((seed, _SIDE_STREAM))
        self._words = VisualWords(path.images, self._rng)
        stated = Mistaken("", camera, lambda image: image)
        self._ways = [stated, *_mistakes(camera)]
        self._extractors = [OmniFeatureExtractor(w.camera, settings.features) for w in self._ways]
        self._votes = np.zeros(len(self._ways), np.int64)
        self.settled = False

    def look(self, image: Image) -> str | None:
        """What is wrong with the pictures, once enough of them agree; None until then."""
        common = np.array([self._common(k, image) for k in range(len(self._ways))])
        best = int(np.argmax(common))
        if best == 0:
            self.settled = bool(common[0] > 0)
        elif common[best] > _CLEARLY * common[0]:
            self._votes[best] += 1
        return self._ways[best].fault if self._votes[best] >= _SIDES_AGREEING else None

    def _common(self, way: int, image: Image) -> int:
        """Features in common with the path image that has most of them, on one homing vector."""
        turned = np.ascontiguousarray(self._ways[way].turn(image))
        features = self._extractors[way].extract(turned)
        alike = np.argsort(-self._words.likeness(features), kind="stable")[:_SIDE_CANDIDATES]
        return max(self._inliers(features, self._path.images[k]) for k in alike)

    def _inliers(self, features: OmniFeatures, target: OmniFeatures) -> int:
        answer, matches = compare_views(features, target, self._settings, self._rng)
        return in_common(answer, matches)


def _mistakes(camera: OmniCamera) -> list[Mistaken]:
    """What may be wrong with pictures of this camera."""
    mirrored = "mirrored left to right: mirror them back"
    out = [Mistaken(mirrored, camera, lambda image: image[:, ::-1])]
    if isinstance(camera, Equirectangular):
        over = "upside down: turn them by 180 degrees"
        out.append(Mistaken(over, camera, lambda image: image[::-1, ::-1]))
        flipped = "turned over top to bottom: turn them over again"
        out.append(Mistaken(flipped, camera, lambda image: image[::-1]))
    if isinstance(camera, LensCamera):
        other: OmniCamera = replace(camera, up=not camera.up)
        over = "of a camera that looks the other way: change its key middle"
        out.append(Mistaken(over, other, lambda image: image))
    if isinstance(camera, LensCamera | RadialCamera):
        otherwise = f"{mirrored}, or change the camera's key clockwise"
        out.append(Mistaken(otherwise, _turning_otherwise(camera), lambda image: image))
    return out


def _turning_otherwise(camera: LensCamera | RadialCamera) -> OmniCamera:
    if isinstance(camera, LensCamera):
        return replace(camera, clockwise=not camera.clockwise)
    frame = replace(camera.frame, clockwise=not camera.frame.clockwise)
    return cast(OmniCamera, replace(cast(Any, camera), frame=frame))
