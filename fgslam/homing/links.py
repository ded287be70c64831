"""Links between images: homings there and back that agree."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from scipy.cluster.vq import kmeans2

from fgslam.core.arrays import FloatArray, IntArray
from fgslam.core.bearings import (
    BearingMatches,
    FeatureKind,
    OmniFeatures,
    Refusal,
    RefusalReason,
    TwoViewVector,
)
from fgslam.core.geometry import wrap

MUTUAL_DEG = 5.0  # largest difference between the answers there and back, beyond three deviations
MIN_SUPPORT = 12  # inliers of an edge, in either answer
ONE_WAY_SUPPORT = 25
"""Inliers of an edge that is answered in one direction and ambiguous in the other."""

Answer: TypeAlias = TwoViewVector | Refusal
Pair: TypeAlias = tuple[int, int]

_SIGMAS = 3.0
_UNDECIDED = (RefusalReason.AMBIGUOUS, RefusalReason.UNCERTAIN)


@dataclass(frozen=True, slots=True, eq=False)
class Link:
    """A homing from one image to another that was answered in both directions alike.

    Attributes:
        a, b: numbers of the images.
        direction: of b as seen from a, radians; NaN where both were taken at one place.
        rotation: heading of b minus that of a.
        back: direction of a as seen from b.
        covariance: (2, 2) of (direction, rotation).
        back_covariance: the same of the way back.
        support: inliers, of the answer that has fewer.
    """

    a: int
    b: int
    direction: float
    rotation: float
    back: float
    covariance: FloatArray
    back_covariance: FloatArray
    support: int

    def reversed(self) -> Link:
        """The way back."""
        return Link(
            self.b, self.a, self.back, -self.rotation, self.direction, self.back_covariance,
            self.covariance, self.support,
        )  # fmt: skip


def link_pair(pair: Pair, there: Answer, back: Answer) -> Link | str:
    """The link of two answers, or why there is none.

    Both directions must be answered with enough inliers, and one motion must explain both:
    the rotations are opposite, and back points where there came from:
    theta_ba = theta_ab + pi - psi_ab. Where one direction cannot decide between two solutions, the
    other may, with more inliers.
    """
    if isinstance(there, Refusal):
        if isinstance(back, Refusal):
            return _same_place(pair, there, back)
        return _one_way(pair, back, there, way_back=True)
    if isinstance(back, Refusal):
        return _one_way(pair, there, back, way_back=False)
    support = min(there.support, back.support)
    if support < MIN_SUPPORT:
        return f"{support} inliers, of {MIN_SUPPORT} needed"
    gap = np.array(
        [
            there.rotation + back.rotation,
            there.direction + np.pi - there.rotation - back.direction,
        ]
    )
    apart = float(np.max(np.abs(wrap(gap))))
    variance = float(np.max(np.diag(there.covariance) + np.diag(back.covariance)))
    if apart > max(np.deg2rad(MUTUAL_DEG), _SIGMAS * np.sqrt(variance)):
        return f"there and back disagree by {np.rad2deg(apart):.1f} deg"
    return Link(
        *pair, there.direction, there.rotation, back.direction, there.covariance,
        back.covariance, support,
    )  # fmt: skip


def _one_way(pair: Pair, answer: TwoViewVector, other: Refusal, way_back: bool) -> Link | str:
    """Link of a pair that is answered in one direction and undecided in the other.

    Which of the two solutions the few decisive features support, or which minimum of a
    valley, may depend on the draw; that is no contradiction. Any other refusal is, as both answers
    come from the same views.
    """
    if other.reason not in _UNDECIDED:
        return f"refused in one direction: {other.details}"
    if answer.support < ONE_WAY_SUPPORT:
        return (
            f"{answer.support} inliers one way, of {ONE_WAY_SUPPORT} needed; back: {other.details}"
        )
    opposite = _opposite(answer)
    ahead, behind = (opposite, answer) if way_back else (answer, opposite)
    return Link(
        *pair, ahead.direction, ahead.rotation, behind.direction, ahead.covariance,
        behind.covariance, answer.support,
    )  # fmt: skip


def _opposite(vector: TwoViewVector) -> TwoViewVector:
    """The way back, of the same motion."""
    back = float(wrap(np.array(vector.direction + np.pi - vector.rotation)))
    # (theta + pi - psi, -psi) of (theta, psi)
    jacobian = np.array([[1.0, -1.0], [0.0, -1.0]])
    covariance = jacobian @ vector.covariance @ jacobian.T
    return TwoViewVector(
        back, -vector.rotation, covariance, vector.inliers, vector.competing_support
    )


def _same_place(pair: Pair, there: Refusal, back: Refusal) -> Link | str:
    """Link of two images from one place: a turn without a direction."""
    if RefusalReason.AT_TARGET not in (there.reason, back.reason):
        return there.details
    if there.rotation is None or back.rotation is None:
        return "taken at one place as seen from one of them only"
    apart = abs(float(wrap(np.array(there.rotation + back.rotation))))
    if apart > np.deg2rad(MUTUAL_DEG):
        return f"there and back disagree by {np.rad2deg(apart):.1f} deg"
    nowhere = np.full((2, 2), np.nan)
    nowhere[1, 1] = np.deg2rad(MUTUAL_DEG / _SIGMAS) ** 2
    return Link(
        *pair, float("nan"), there.rotation, float("nan"), nowhere, nowhere, MIN_SUPPORT,
    )  # fmt: skip


def link_pairs(answers: Mapping[Pair, Answer]) -> tuple[list[Link], dict[Pair, str]]:
    """Links of all pairs a < b that were answered in both directions, and why others are none."""
    links: list[Link] = []
    refused: dict[Pair, str] = {}
    for a, b in sorted(answers):
        if a >= b or (b, a) not in answers:
            continue
        made = link_pair((a, b), answers[a, b], answers[b, a])
        if isinstance(made, str):
            refused[a, b] = made
        else:
            links.append(made)
    return links, refused


# --------------------------------------------------------------------------------------------
# Selection of consistent links: a false one, by perceptual aliasing, contradicts its neighbours
#
# Around a triangle of images the rotations add up to zero, and the direction from the first to the
# third lies between the directions of the two steps. Links that break more triangles than they keep
# go first, the worst one first, as one false link spoils every triangle it is in. Then each link's
# rotation is held against all others' together (rotation averaging).


_HEADING_DEG = 15.0  # largest misfit of an edge's rotation with all others' together
_LOOP_DEG = 6.0
"""Largest sum of the rotations around a triangle, and largest misfit of its directions, beyond
three deviations."""

LONE_SUPPORT = 50
"""Inliers of an edge that no third image confirms, unless its images follow each other on a walk
(false ones had up to 39 on `omni_home`)."""

_ROUNDS = 10  # of the rotation averaging's reweighting
_HUBER = np.deg2rad(5.0)  # residual from which on a link's rotation counts less


@dataclass(frozen=True, slots=True)
class Walks:
    """Which images follow each other: each walk's, numbered one walk after the other.

    Attributes:
        lengths: images of each; none at all where images are in no order.
    """

    lengths: tuple[int, ...] = ()

    def steps(self) -> set[Pair]:
        """Pairs (k, k + 1) of images that follow each other."""
        ends = np.cumsum((0, *self.lengths)).tolist()
        return {(k, k + 1) for a, b in itertools.pairwise(ends) for k in range(a, b - 1)}

    def near(self, image: int, reach: int) -> range:
        """Images of the same walk, at most so many steps away."""
        ends = np.cumsum((0, *self.lengths))
        walk = int(np.searchsorted(ends, image, side="right")) - 1
        return range(
            max(int(ends[walk]), image - reach), min(int(ends[walk + 1]), image + reach + 1)
        )


UNORDERED = Walks()


class LinkConsistency:
    """Links of a map, those that contradict others taken out."""

    def __init__(self, count: int, links: Iterable[Link], walks: Walks = UNORDERED) -> None:
        """Takes links between ``count`` images, one a pair.

        Images that follow each other on a walk need no third view. It is no proof: their link must
        still not contradict others.
        """
        self._count = count
        self._steps = walks.steps()
        self._links = {(link.a, link.b): link for link in links}
        self._holding = self._test_triangles()

    def accepted(self, confirmed: Collection[Pair] = ()) -> tuple[list[Link], dict[Pair, str]]:
        """Links that pass every check, by pair, and why the others do not.

        Args:
            confirmed: links that third images confirm in other ways: as those of a walk.
        """
        rejected: dict[Pair, str] = {}
        self._drop_contradicted(rejected)
        self._drop_lone(rejected, confirmed)
        self._drop_turned(rejected)
        return [self._links[pair] for pair in sorted(self._links)], rejected

    # ----------------------------------------------------------------------------------------
    # Triangles

    def _test_triangles(self) -> dict[tuple[int, int, int], bool]:
        neighbours: list[set[int]] = [set() for _ in range(self._count)]
        for a, b in self._links:
            neighbours[a].add(b)
            neighbours[b].add(a)
        return {
            (a, b, c): self._holds(a, b, c)
            for a, b in self._links
            for c in sorted(neighbours[a] & neighbours[b])
            if c > b
        }

    def _holds(self, a: int, b: int, c: int) -> bool:
        ab, bc, ac = self._links[a, b], self._links[b, c], self._links[a, c]
        limit = np.deg2rad(_LOOP_DEG)
        turn = abs(float(wrap(np.array(ab.rotation + bc.rotation - ac.rotation))))
        if turn > max(limit, _SIGMAS * np.sqrt(_variance(1, ab, bc, ac))):
            return False
        allowed = max(limit, _SIGMAS * np.sqrt(_variance(0, ab, bc, ac)))
        misfit = between_misfit(ab.direction, ab.rotation + bc.direction, ac.direction, allowed)
        # Without a direction (one place) there is nothing to contradict.
        return not misfit > allowed

    def votes(self) -> dict[Pair, tuple[int, int]]:
        """Triangles that each link keeps, and that it breaks."""
        out = dict.fromkeys(self._links, (0, 0))
        for triangle, holds in self._holding.items():
            for pair in itertools.combinations(triangle, 2):
                good, bad = out[pair]
                out[pair] = (good + holds, bad + (not holds))
        return out

    def _drop_contradicted(self, rejected: dict[Pair, str]) -> None:
        """Drops links, the worst first; following each other counts as one triangle kept."""
        while True:
            votes = self.votes()
            excess = {p: bad - good - (p in self._steps) for p, (good, bad) in votes.items() if bad}
            suspects = [p for p in excess if excess[p] >= 0]
            if not suspects:
                return
            worst = max(
                suspects,
                key=lambda p: (excess[p], p not in self._steps, -self._links[p].support, p),
            )
            good, bad = votes[worst]
            self._drop(worst, f"breaks {bad} of {good + bad} triangles", rejected)

    def _drop_lone(self, rejected: dict[Pair, str], confirmed: Collection[Pair]) -> None:
        for pair, (good, _) in self.votes().items():
            support = self._links[pair].support
            follows = pair in self._steps or pair in confirmed
            if good == 0 and not follows and support < LONE_SUPPORT:
                text = f"no third image confirms it, and {support} inliers are too few alone"
                self._drop(pair, text, rejected)

    def _drop(self, pair: Pair, why: str, rejected: dict[Pair, str]) -> None:
        del self._links[pair]
        rejected[pair] = why
        self._holding = {
            triangle: holds
            for triangle, holds in self._holding.items()
            if not set(pair) <= set(triangle)
        }

    # ----------------------------------------------------------------------------------------
    # Headings

    def _drop_turned(self, rejected: dict[Pair, str]) -> None:
        """Drops links whose rotation contradicts all others; neighbours on a walk weigh most."""
        limit = np.deg2rad(_HEADING_DEG)
        while self._links:
            pairs = list(self._links)
            rotations = np.array([self._links[p].rotation for p in pairs])
            supports = np.array([self._links[p].support for p in pairs], dtype=np.float64)
            follows = np.array([pair in self._steps for pair in pairs])
            supports = supports + follows * supports.max()
            residual = np.abs(heading_residuals(self._count, pairs, rotations, supports))
            worst = int(np.argmax(residual))
            if residual[worst] <= limit:
                return
            degrees = np.rad2deg(residual[worst])
            self._drop(pairs[worst], f"{degrees:.0f} deg off all other rotations", rejected)


def between_misfit(first: float, second: float, whole: float, slack: float = 0.0) -> float:
    """Angle by which a triangle's long side leaves the cone of its two steps, radians.

    Args:
        first: direction of the first step.
        second: of the second step, in the same axes.
        whole: of both together.
        slack: steps that lead back to within so much leave any direction open, as noise chooses
            the side on which the third image lies: corridors are full of them.
    """
    turn, reached = wrap(np.array([second - first, whole - first]))
    if not np.isfinite(turn + reached) or abs(turn) >= np.pi - slack:
        return 0.0
    if turn < 0.0:
        turn, reached = -turn, -reached
    return float(max(0.0, -reached, reached - turn))


def _variance(row: int, *links: Link) -> float:
    return float(np.nansum([link.covariance[row, row] for link in links]))


def heading_residuals(
    count: int, pairs: list[Pair], rotations: FloatArray, weights: FloatArray
) -> FloatArray:
    """(m,) rotations minus what the best headings of all images together say, radians.

    Headings start from a spanning tree of the strongest links, then iteratively reweighted least
    squares (Huber) on wrapped residuals.

    Args:
        count: of images.
        pairs: m links (a, b).
        rotations: (m,) heading of b minus that of a.
        weights: (m,) of the links, positive.
    """
    headings = _tree_headings(count, pairs, rotations, weights)
    ends = np.array(pairs)
    rows = np.arange(len(pairs))
    design = np.zeros((len(pairs), count))
    design[rows, ends[:, 0]], design[rows, ends[:, 1]] = -1.0, 1.0

    def residuals() -> FloatArray:
        return wrap(rotations - (headings[ends[:, 1]] - headings[ends[:, 0]]))

    for _ in range(_ROUNDS):
        left = residuals()
        huber = np.minimum(1.0, _HUBER / np.maximum(np.abs(left), 1e-12))
        root = np.sqrt(weights * huber)
        step = np.linalg.lstsq(design * root[:, None], root * left, rcond=None)[0]
        headings = headings + step
    return residuals()


def _tree_headings(
    count: int, pairs: list[Pair], rotations: FloatArray, weights: FloatArray
) -> FloatArray:
    """(count,) headings along a maximum spanning forest (Prim's order, by Kruskal's sets)."""
    group = np.arange(count)
    headings = np.zeros(count)
    for k in np.argsort(-weights, kind="stable"):
        a, b = pairs[k]
        if group[a] == group[b]:
            continue
        moved = group == group[b]
        headings[moved] += headings[a] + rotations[k] - headings[b]
        group[moved] = group[a]
    return headings


# --------------------------------------------------------------------------------------------
# Confirmation by third views


InlierRows: TypeAlias = Mapping[Pair, IntArray]
"""Of pairs (from, to): (k, 2) rows of the SIFT features of both images that are inliers."""

_SAME = 0.02  # radians, in bearing and elevation: one thing has several features side by side

_ORDER_REACH = 3
"""A link of images farther apart than this in the order needs third views (neighbours this near)
that confirm its features."""

_THIRD_VIEWS = 1.0
"""Such confirmations an inlier, on average, that a link so far needs."""


class ThirdViewConsistency:
    """Links of walks, and the features that make them: a test for perceptual aliasing.

    Halls with two equal sides, corridors with the same lockers: links between them have hundreds of
    inliers, agree in triangles, and are false. They match things of one kind, not one thing: a
    baluster with any baluster. So a feature of one image that is followed into another one, and
    from there into a neighbour on the walk, seldom comes back as the same feature when the
    neighbour is matched directly. Features of a true link do, in most neighbours (after the missing
    correspondences of Zach et al. 2008 and the order of images in Roberts et al. 2011).
    """

    def __init__(
        self,
        images: Sequence[OmniFeatures],
        links: Iterable[Link],
        rows: InlierRows,
        walks: Walks,
    ) -> None:
        """Takes links of images in the order of walks, and the inliers of their answers."""
        self._images, self._walks, self._steps = images, walks, walks.steps()
        self._links = list(links)
        self._maps: dict[Pair, IntArray] = {}
        for link in self._links:
            for pair in ((link.a, link.b), (link.b, link.a)):
                self._maps[pair] = self._mapping(pair, rows)

    def confirmed(self) -> tuple[list[Link], set[Pair], dict[Pair, str]]:
        """Links that are accepted so far, those of them that third views confirm, why others not.

        Links of a few steps need none: the walk itself connects them.
        """
        kept: list[Link] = []
        seen: set[Pair] = set()
        rejected: dict[Pair, str] = {}
        for link in self._links:
            share = self.share(link)
            if share >= _THIRD_VIEWS:
                seen.add((link.a, link.b))
            elif not self._walked(link):
                rejected[link.a, link.b] = (
                    f"{share:.2f} confirmations an inlier by third views, of "
                    f"{_THIRD_VIEWS:g} needed so far apart"
                )
                continue
            kept.append(link)
        return kept, seen, rejected

    def _walked(self, link: Link) -> bool:
        """Whether the walk leads from one image to the other, in a few steps that are links.

        Where neighbours do not match, the walk may have gone on anywhere.
        """
        steps = [(k, k + 1) for k in range(link.a, link.b)]
        near = link.b - link.a <= _ORDER_REACH
        return near and all(step in self._maps and step in self._steps for step in steps)

    def share(self, link: Link) -> float:
        """Confirmations by third views, of either end's neighbours, over the link's inliers."""
        count = self._confirmations(link.a, link.b) + self._confirmations(link.b, link.a)
        return count / max(link.support, 1)

    def _confirmations(self, a: int, b: int) -> int:
        """Features of a that are the same in a neighbour of b, matched directly and by way of b."""
        count = 0
        for c in self._walks.near(b, _ORDER_REACH):
            if c in (a, b) or (b, c) not in self._maps or (a, c) not in self._maps:
                continue
            direct, step = self._maps[a, c], self._maps[a, b]
            by_b = np.where(step >= 0, self._maps[b, c][step], -1)
            both = (direct >= 0) & (by_b >= 0)
            count += self._alike(c, direct[both], by_b[both])
        return count

    def _alike(self, image: int, one: IntArray, other: IntArray) -> int:
        sift = self._images[image].sift
        bearing = np.abs(wrap(sift.bearing[one] - sift.bearing[other]))
        elevation = np.abs(sift.elevation[one] - sift.elevation[other])
        return int(np.count_nonzero((bearing < _SAME) & (elevation < _SAME)))

    def _mapping(self, pair: Pair, rows: InlierRows) -> IntArray:
        """(n,) the second image's row of each feature of the first one, -1 where it has none."""
        out = np.full(len(self._images[pair[0]].sift), -1, dtype=np.int64)
        back, there = rows.get((pair[1], pair[0])), rows.get(pair)
        if back is not None:
            out[back[:, 1]] = back[:, 0]
        if there is not None:
            out[there[:, 0]] = there[:, 1]
        return out


def sift_inliers(answer: Answer, matches: BearingMatches) -> IntArray | None:
    """(k, 2) SIFT features of both images that are inliers of an answer; None of a refusal."""
    if isinstance(answer, Refusal):
        return None
    kept = matches.select(answer.inliers & (matches.kind == FeatureKind.SIFT))
    return np.column_stack([kept.index_a, kept.index_b])


# --------------------------------------------------------------------------------------------
# Image retrieval by visual words: candidates for links, before anything is matched
#
# A vocabulary of SIFT descriptors by k-means; an image is the vector of its words' counts, weighted
# by how rare they are (tf-idf, Sivic and Zisserman 2003) and with repeated ones damped by the
# square root; likeness is the cosine.


_WORDS = 400  # in the vocabulary
_ITERATIONS = 6  # of k-means
_SAMPLE = 10_000  # descriptors that the vocabulary is made of, at most


class VisualWords:
    """The vocabulary of a set of images, and the images in it."""

    def __init__(
        self,
        images: Sequence[OmniFeatures],
        rng: np.random.Generator,
    ) -> None:
        """Learns the words from the images themselves.

        Args:
            images: any number; those without SIFT features are like no other.
            rng: chooses the sample and the first words.
        """
        self._words = _vocabulary(images, rng)
        counts = np.array([self._counts(i) for i in images]).reshape(len(images), -1)
        seen = np.count_nonzero(counts, axis=0)
        self._rarity = np.log((1.0 + len(images)) / (1.0 + seen))
        vectors = [self._weighted(c) for c in counts]
        self._vectors: FloatArray = np.array(vectors).reshape(len(images), -1)

    def likeness(self, image: OmniFeatures) -> FloatArray:
        """(n,) cosines in [0, 1] of one image with all."""
        return np.asarray(self._vectors @ self._weighted(self._counts(image)))

    def likenesses(self) -> FloatArray:
        """(n, n) of all images among each other."""
        return np.asarray(self._vectors @ self._vectors.T)

    def _weighted(self, counts: FloatArray) -> FloatArray:
        vector = np.sqrt(counts) * self._rarity
        length = float(np.linalg.norm(vector))
        return np.asarray(vector / length if length > 0.0 else vector)

    def _counts(self, image: OmniFeatures) -> FloatArray:
        if not len(self._words):
            return np.zeros(0)
        descriptors = _rooted(image)
        # Nearest word: the squared distance without the descriptor's own length.
        score = descriptors @ self._words.T - 0.5 * np.sum(self._words**2, axis=1)
        words = np.argmax(score, axis=1) if len(descriptors) else np.zeros(0, dtype=np.int64)
        return np.bincount(words, minlength=len(self._words)).astype(np.float64)


def _vocabulary(images: Sequence[OmniFeatures], rng: np.random.Generator) -> FloatArray:
    everything = np.vstack([np.empty((0, 128)), *(_rooted(i) for i in images)])
    if len(everything) > _SAMPLE:
        everything = everything[np.sort(rng.choice(len(everything), _SAMPLE, False))]
    words = min(_WORDS, len(everything))
    if words < 2:
        return np.empty((0, 128))
    first = everything[np.sort(rng.choice(len(everything), words, replace=False))]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # a word that nothing is nearest to is kept
        centres, _ = kmeans2(everything, first, iter=_ITERATIONS, minit="matrix")
    return np.asarray(centres)


def _rooted(image: OmniFeatures) -> FloatArray:
    """(n, 128) square roots of the descriptors divided by their sums (Arandjelovic 2012)."""
    descriptors = image.sift.descriptors.astype(np.float64)
    total = descriptors.sum(axis=1, keepdims=True)
    return np.asarray(np.sqrt(descriptors / np.maximum(total, 1.0)))


def candidate_pairs(likenesses: FloatArray, each: int) -> IntArray:
    """(m, 2) pairs i < j of which one is among the ``each`` most alike of the other; 0: all."""
    n = len(likenesses)
    if each == 0 or each >= n - 1:
        return np.argwhere(np.triu(np.ones((n, n), dtype=np.bool_), 1))
    others = likenesses - 2.0 * np.eye(n)  # no image is a candidate of its own
    nearest = np.argsort(-others, axis=1, kind="stable")[:, :each]
    chosen = np.zeros((n, n), dtype=np.bool_)
    chosen[np.arange(n)[:, None], nearest] = True
    return np.argwhere(np.triu(chosen | chosen.T, 1))
